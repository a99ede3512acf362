"""Meshes as Relief writes them: binary PLY, properties of vertices floats and bytes, faces triangles."""
import numpy as np

TYPES = {"float": "<f4", "uchar": "u1"}


def read_mesh(path):
    """Vertices with their properties, and the corners of the faces."""
    with open(path, "rb") as file:
        counts, properties, element = {}, [], None
        while (words := file.readline().split()) != [b"end_header"]:
            if words[0] == b"element":
                element = words[1].decode()
                counts[element] = int(words[2])
            elif words[0] == b"property" and element == "vertex":
                properties.append((words[2].decode(), TYPES[words[1].decode()]))
        vertex = np.dtype(properties)
        vertices = np.frombuffer(file.read(vertex.itemsize * counts["vertex"]), vertex)
        faces = np.frombuffer(file.read(), [("n", "u1"), ("corners", "<i4", 3)], counts["face"])
    return vertices, faces["corners"]


def positions(vertices):
    """Their positions, metres, a row each."""
    return np.stack([vertices[axis] for axis in "xyz"], 1).astype(float)


def write_mesh(path, vertices, faces):
    """Vertices, metres, and the corners of the faces, a row each."""
    header = (f"ply\nformat binary_little_endian 1.0\nelement vertex {len(vertices)}\nproperty float x\nproperty float y\n"
              f"property float z\nelement face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n")
    rows = np.empty(len(faces), dtype=[("n", "u1"), ("corners", "<i4", 3)])
    rows["n"], rows["corners"] = 3, faces
    path.write_bytes(header.encode() + vertices.astype("<f4").tobytes() + rows.tobytes())
