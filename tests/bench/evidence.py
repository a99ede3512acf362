#!/usr/bin/env python3
"""What the evidence of a refined mesh is worth: its vertices in five equal parts by `sigma`, and by `coverage`, and by how many shading
images see them, against the truth.

    evidence.py SESSION SCORE.py REFINED.ply        (needs what SCORE.py needs)

This is scoring: it alone reads the session's poses and surface. The mesh is laid on the truth as SCORE.py does. Of each part:
the mean of what it is sorted by if it is, RMS of the distance, RMS of detail (the signed distance less its mean over 8 mm, but for the largest
hundredth) and the mean angle to the true normals, of the vertices that SCORE.py would score: within 10 mm of a truth that some frame saw,
facing as it does, not at its border.
"""

import sys

import numpy as np
from relief_ply import positions, read_mesh
from scipy.spatial import cKDTree
from scoring import scoring_script

N_PARTS = 5
# Shading images that see a vertex: each part goes from one of these to below the next.
VIEWS_FROM = [0, 1, 2, 3, 4, 7, 256]
NEAR_M = 0.01
OFF_RIM_M = 0.006
DETAIL_RADIUS_M = 0.008
# At most: the neighbours of each are looked at.
N_DETAIL = 25000


def main(session, score_path, path):
    score = scoring_script(score_path)
    truth = score.Truth(session)
    vertices, _ = read_mesh(path)
    normals = np.stack([vertices[name] for name in ("nx", "ny", "nz")], 1).astype(float)
    first = truth.T[0]
    points, normals = positions(vertices) @ first[:3, :3].T + first[:3, 3], normals @ first[:3, :3].T
    near = np.linalg.norm(truth.closest(points)[0] - points, axis=1) < 0.02
    aligned = score.icp(truth, points[near][::2])
    points, normals = points @ aligned[:3, :3].T + aligned[:3, 3], normals @ aligned[:3, :3].T
    closest, true_normals, _, _ = truth.closest(points)
    within = ((closest > truth.lo + 0.003) & (closest < truth.hi - 0.003)).all(1)
    scored = within & (np.linalg.norm(points - closest, axis=1) < NEAR_M) & truth.seen(closest, true_normals)
    scored &= np.einsum("ij,ij->i", normals, true_normals) > 0
    rim = truth.rim()
    if len(rim):
        scored &= cKDTree(rim).query(closest)[0] > OFF_RIM_M
    vertices, points, normals = vertices[scored], points[scored], normals[scored]
    closest, true_normals = closest[scored], true_normals[scored]
    signed = np.einsum("ij,ij->i", points - closest, true_normals)
    distances = np.linalg.norm(points - closest, axis=1)
    cosines = np.clip(np.abs(np.einsum("ij,ij->i", normals, true_normals)), 0, 1)
    degrees = np.degrees(np.arccos(cosines))
    chosen = np.random.default_rng(0).permutation(len(points))[:N_DETAIL]
    neighbours = cKDTree(points).query_ball_point(points[chosen], DETAIL_RADIUS_M)
    detail = np.full(len(points), np.nan)
    detail[chosen] = [signed[k] - signed[of].mean() for k, of in zip(chosen, neighbours)]
    detail[np.abs(detail) > np.nanquantile(np.abs(detail), 0.99)] = np.nan

    def rms(values):
        return 1e3 * np.sqrt(np.nanmean(values**2))

    for name, unit in [("sigma", 1e3), ("coverage", 1.0)]:
        print(f"{name}{', mm' if name == 'sigma' else ''}, mean | error RMS mm | detail RMS mm | normals mean °")
        for part in np.array_split(np.argsort(vertices[name], kind="stable"), N_PARTS):
            mean = unit * vertices[name][part].mean()
            print(f"{mean:.3f} | {rms(distances[part]):.3f} | {rms(detail[part]):.3f} | {degrees[part].mean():.2f}")
    print("views, from | share of vertices | of squared detail | error RMS mm | detail RMS mm | normals mean °")
    for first, beyond in zip(VIEWS_FROM, VIEWS_FROM[1:]):
        part = (vertices["views"] >= first) & (vertices["views"] < beyond)
        if not part.any():
            continue
        of_detail = np.nansum(detail[part] ** 2) / np.nansum(detail**2)
        print(
            f"{first} | {part.mean():.3f} | {of_detail:.3f} | {rms(distances[part]):.3f} | {rms(detail[part]):.3f}"
            f" | {degrees[part].mean():.2f}"
        )


if __name__ == "__main__":
    main(*sys.argv[1:])
