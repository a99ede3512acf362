"""How pure the albedo groups of a refined mesh are: the share of its area whose label is that of its material.

    label_purity.py SESSION REFINED.ply     (needs numpy and scipy; reads the session's truth, so it is for scoring alone)

The mesh is laid on the truth by the first true pose. Each vertex stands for a third of the faces round it and takes the material of
the nearest true vertex, if one is within 4 mm. A label stands for the material that most of its area has. Printed twice: for all
vertices, and for those that some view sees.
"""
import sys

import numpy as np
from scipy.spatial import cKDTree

MAX_DISTANCE_M = 0.004
TYPES = {"float": "<f4", "uchar": "u1"}


def read_mesh(path):
    """Vertices with their properties, and faces, of a PLY as Relief writes it."""
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


def world_from_first(session):
    """Rotation and translation of the first true pose."""
    row = np.loadtxt(f"{session}/groundtruth.txt", comments="#")[0]
    x, y, z, w = row[4:8]
    return np.array([[1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
                     [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
                     [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)]]), row[1:4]


def purity(labels, materials, areas):
    """Area whose label's commonest material is its own, as a share."""
    pure = 0.0
    for label in np.unique(labels):
        of_label = labels == label
        pure += max(areas[of_label & (materials == material)].sum() for material in np.unique(materials))
    return pure / areas.sum()


def main(session, path):
    vertices, faces = read_mesh(path)
    points = np.stack([vertices[axis] for axis in "xyz"], 1).astype(float)
    a, b, c = (points[faces[:, corner]] for corner in range(3))
    thirds = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 6
    areas = sum(np.bincount(faces[:, corner], thirds, len(points)) for corner in range(3))
    rotation, translation = world_from_first(session)
    truth = np.load(f"{session}/groundtruth_mesh.npz")
    distances, nearest = cKDTree(truth["v"]).query(points @ rotation.T + translation)
    materials = np.round(truth["albedo"][nearest].astype(float), 2)
    near = distances < MAX_DISTANCE_M
    for what, chosen in [("all", near), ("seen", near & (vertices["views"] > 0))]:
        share = purity(vertices["label"][chosen], materials[chosen], areas[chosen])
        print(f"{what}: {areas[chosen].sum() / areas.sum():.1%} of the area, label purity {share:.1%}")


if __name__ == "__main__":
    main(*sys.argv[1:])
