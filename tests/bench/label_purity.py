"""How pure the albedo groups of a refined mesh are: the share of its area whose label is that of its material.

    label_purity.py SESSION REFINED.ply     (needs numpy and scipy; reads the session's truth, so it is for scoring alone)

The mesh is laid on the truth by the first true pose. Each vertex stands for a third of the faces round it and takes the material of
the nearest true vertex, if one is within 4 mm. A label stands for the material that most of its area has. Printed twice: for all
vertices, and for those that some view sees.
"""
import sys

import ate
import numpy as np
from relief_ply import positions, read_mesh
from scipy.spatial import cKDTree

MAX_DISTANCE_M = 0.004


def purity(labels, materials, areas):
    """Area whose label's commonest material is its own, as a share."""
    pure = 0.0
    for label in np.unique(labels):
        of_label = labels == label
        pure += max(areas[of_label & (materials == material)].sum() for material in np.unique(materials))
    return pure / areas.sum()


def main(session, path):
    vertices, faces = read_mesh(path)
    points = positions(vertices)
    a, b, c = (points[faces[:, corner]] for corner in range(3))
    thirds = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 6
    areas = sum(np.bincount(faces[:, corner], thirds, len(points)) for corner in range(3))
    first = ate.read_tum(f"{session}/groundtruth.txt")[0]
    world_from_first, translation = ate.rotation(first[4:8]), first[1:4]
    truth = np.load(f"{session}/groundtruth_mesh.npz")
    distances, nearest = cKDTree(truth["v"]).query(points @ world_from_first.T + translation)
    materials = np.round(truth["albedo"][nearest].astype(float), 2)
    near = distances < MAX_DISTANCE_M
    for what, chosen in [("all", near), ("seen", near & (vertices["views"] > 0))]:
        share = purity(vertices["label"][chosen], materials[chosen], areas[chosen])
        print(f"{what}: {areas[chosen].sum() / areas.sum():.1%} of the area, label purity {share:.1%}")


if __name__ == "__main__":
    main(*sys.argv[1:])
