#!/usr/bin/env python3
"""How flat a real printed board and the wall behind it come out, and whether the print shows as relief.

    board_flatness.py SESSION MESH...     (the session `board-k2-real`; needs numpy, scipy and pillow)

The board is the plane z = 0 of `poses.txt`, in whose frame the meshes are. For every mesh, of the vertices of the board and of
the wall, which is the largest plane behind the board:
- flatness: root mean square distance from the best plane, and from the mean within 20 mm, which leaves out slow errors of depth;
- tilt against the board's true plane (the wall's is unknown);
- print: mean height by signed distance from the nearest edge of a printed square, white side positive, from 8 mm on the
  dark side to 8 mm on the white one, less the mean of all; its range is the relief that the print makes.
Heights are towards the camera."""
import pathlib
import sys

import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree

from board_light_law import CELL_M, PRINT, views, within
from relief_ply import positions, read_mesh

# Heights beyond this from a plane are something else, metres.
REACH_M = 0.02
LOCAL_M = 0.02
PROFILE_MM = np.arange(-8, 9, 2)


def plane(points):
    """Point and normal of the best plane, outliers beyond three robust sigmas left out."""
    used = points
    for _ in range(5):
        centre = used.mean(0)
        normal = np.linalg.svd(used[:: max(1, len(used) // 20000)] - centre, full_matrices=False)[2][2]
        height = (points - centre) @ normal
        used = points[np.abs(height) < 3 * max(1.4826 * np.median(np.abs(height)), 1e-4)]
    return centre, normal * (-np.sign(normal[2]) or 1.0)


def largest_plane(points):
    """Point and normal of the plane that most points are near, by random samples, then fitted."""
    random = np.random.default_rng(0)
    few = points[random.choice(len(points), min(len(points), 20000), replace=False)]
    best, most = None, 0
    for _ in range(500):
        a, b, c = few[random.choice(len(few), 3, replace=False)]
        normal = np.cross(b - a, c - a)
        length = np.linalg.norm(normal)
        if length > 1e-4:
            near = np.abs((few - a) @ normal / length) < REACH_M
            if near.sum() > most:
                best, most = (a, normal / length), near.sum()
    return plane(points[np.abs((points - best[0]) @ best[1]) < REACH_M])


def locally(points, heights):
    """Heights less their mean within `LOCAL_M`."""
    tree = cKDTree(points)
    around = tree.query_ball_point(points, LOCAL_M, workers=2)
    return heights - np.array([heights[near].mean() for near in around])


def dark_cells(session):
    """On a grid over the board: signed distance to the nearest edge of a square, metres, positive in white; NaN off the print."""
    n = int(0.7 / CELL_M)
    total, count = np.zeros((n, n)), np.zeros((n, n))
    for board, distance, cosine, intensity in views(session):
        use = within(board, PRINT) & (intensity > 0.004)
        at = tuple(((board[use][:, axis] + 0.35) / CELL_M).astype(int) for axis in (1, 0))
        np.add.at(total, at, np.log(np.minimum(intensity[use], 0.95) * distance[use] ** 2 / cosine[use]))
        np.add.at(count, at, 1)
    mean = np.where(count > 0, total / np.maximum(count, 1), np.nan)
    low, high = np.nanpercentile(mean, [10, 90])
    white = mean > (low + high) / 2
    inside = count > 0
    signed = ndimage.distance_transform_edt(white) - ndimage.distance_transform_edt(~white)
    # The print's own border is no edge of a square.
    border = ndimage.distance_transform_edt(inside) * CELL_M
    return np.where(inside & (np.abs(signed) * CELL_M < border), signed * CELL_M, np.nan)


def print_profile(points, heights, signed):
    at = tuple(((points[:, axis] + 0.35) / CELL_M).astype(int) for axis in (1, 0))
    distance_mm = 1e3 * signed[at]
    bins = [np.abs(distance_mm - middle) < 1 for middle in PROFILE_MM]
    return np.array([1e3 * heights[chosen].mean() if chosen.sum() > 20 else np.nan for chosen in bins])


def told(name, points, true_normal=None):
    centre, normal = plane(points)
    height = (points - centre) @ normal
    near = np.abs(height) < REACH_M
    points, height = points[near], height[near]
    chosen = np.random.default_rng(0).choice(len(points), min(len(points), 60000), replace=False)
    points, height = points[chosen], height[chosen]
    local = locally(points, height)
    tilt = "" if true_normal is None else f", tilted {np.degrees(np.arccos(min(1, abs(normal @ true_normal)))):.2f}°"
    print(f"  {name}: flat to {1e3 * np.sqrt((height**2).mean()):.2f} mm, within {1e3 * LOCAL_M:.0f} mm to "
          f"{1e3 * np.sqrt((local**2).mean()):.3f} mm{tilt}, {near.sum()} vertices")
    return points, local


def main():
    session = pathlib.Path(sys.argv[1])
    signed = dark_cells(session)
    for path in map(pathlib.Path, sys.argv[2:]):
        print(path)
        vertices = positions(read_mesh(path)[0])
        # Not the matte frame's outer rim, where depth mixes board and wall.
        on_board = within(vertices[:, :2], [(-0.070, 0.155, -0.070, 0.250)]) & (np.abs(vertices[:, 2]) < 0.06)
        if on_board.sum() < 1000:
            print(f"  board: {on_board.sum()} vertices only")
            continue
        points, local = told("board", vertices[on_board], np.array([0.0, 0.0, 1.0]))
        profile = print_profile(points, local, signed)
        print(f"  print: height across edges of squares {np.round(profile, 3).tolist()} mm at {PROFILE_MM.tolist()} mm, "
              f"range {np.nanmax(profile) - np.nanmin(profile):.3f} mm")
        behind = vertices[vertices[:, 2] > 0.15] if (vertices[:, 2] > 0.15).sum() > 1000 else vertices[vertices[:, 2] < -0.15]
        if len(behind) > 1000:
            wall = largest_plane(behind)
            told("wall", behind[np.abs((behind - wall[0]) @ wall[1]) < REACH_M])


if __name__ == "__main__":
    main()
