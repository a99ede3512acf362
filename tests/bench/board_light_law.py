"""How a real Kinect II's IR falls with distance, on a printed board at known poses.

    board_light_law.py SESSION     (the session `board-k2-real`; needs numpy and pillow)

The board is the plane z = 0 of `poses.txt`. Two of its surfaces are looked at: the white squares of the print, which are
glossy and saturate nearer than 0.9 m, and the matte frame round it, which does not saturate from 0.6 m on. Of each view
the median of log I - log(n.l) is taken and a line fitted against log distance: its slope is gamma times the exponent of
distance, so that -2 means a linear response under the inverse square law. Intervals are of 95 %, by resampling views.
Views in which a surface has more than 2 % of its pixels above 95 % of full scale, or that spread by more than 10 %
(the frame hidden, or the board's corners taken for their opposites), are left out and named.
"""
import pathlib
import sys
import tomllib

import numpy as np
from PIL import Image

# Rectangles of the board, metres: x from, x to, y from, y to.
FRAME = [(-0.083, -0.058, -0.080, 0.260), (-0.080, 0.165, 0.252, 0.265), (-0.080, 0.165, -0.085, -0.062)]
PRINT = [(-0.045, 0.160, -0.050, 0.230)]
# The emitter stands about 5 cm right of the camera.
LIGHT = np.array([0.05, 0.0, 0.0])
CELL_M = 0.002


def rays(camera):
    """Normalised coordinates of all pixels: Brown-Conrady, by fixed-point iteration."""
    u, v = np.meshgrid(np.arange(camera["width"]), np.arange(camera["height"]))
    xd, yd = (u - camera["cx"]) / camera["fx"], (v - camera["cy"]) / camera["fy"]
    x, y = xd.copy(), yd.copy()
    for _ in range(50):
        r2 = x * x + y * y
        radial = 1 + r2 * (camera["k1"] + r2 * (camera["k2"] + r2 * camera["k3"]))
        dx = 2 * camera["p1"] * x * y + camera["p2"] * (r2 + 2 * x * x)
        dy = camera["p1"] * (r2 + 2 * y * y) + 2 * camera["p2"] * x * y
        x, y = (xd - dx) / radial, (yd - dy) / radial
    return np.stack([x, y, np.ones_like(x)], -1)


def rotation(qx, qy, qz, qw):
    return np.array([
        [1 - 2 * (qy * qy + qz * qz), 2 * (qx * qy - qz * qw), 2 * (qx * qz + qy * qw)],
        [2 * (qx * qy + qz * qw), 1 - 2 * (qx * qx + qz * qz), 2 * (qy * qz - qx * qw)],
        [2 * (qx * qz - qy * qw), 2 * (qy * qz + qx * qw), 1 - 2 * (qx * qx + qy * qy)],
    ])


def views(folder):
    """Of each view: board coordinates, distance from the light, cosine of incidence and share of full scale by pixel."""
    session = tomllib.loads((folder / "session.toml").read_text())
    directions = rays(session["ir_camera"])
    files = [line.split()[1] for line in (folder / "ir.txt").read_text().splitlines() if line[:1] != "#"]
    for pose, name in zip(np.loadtxt(folder / "poses.txt"), files):
        world_from_camera = rotation(*pose[4:8])
        along = directions @ world_from_camera.T
        depth = -pose[3] / along[..., 2]
        board = pose[1:4] + along * depth[..., None]
        normal = world_from_camera.T @ np.array([0.0, 0.0, -1.0])
        to_light = LIGHT - directions * depth[..., None]
        distance = np.linalg.norm(to_light, axis=-1)
        intensity = np.asarray(Image.open(folder / name)) / session["ir_full_scale"]
        yield board[..., :2], distance, np.abs(to_light @ normal) / distance, intensity


def within(board, rectangles):
    x, y = board[..., 0], board[..., 1]
    return np.any([(x > a) & (x < b) & (y > c) & (y < d) for a, b, c, d in rectangles], axis=0)


def white_cells(all_views):
    """Cells of the print that are white, two cells from the next edge, from the mean brightness over all views."""
    n = int(0.7 / CELL_M)
    total, count = np.zeros((n, n)), np.zeros((n, n))
    for board, distance, cosine, intensity in all_views:
        use = within(board, PRINT) & (intensity < 0.95) & (intensity > 0.004)
        at = tuple(((board[use][:, axis] + 0.35) / CELL_M).astype(int) for axis in (1, 0))
        np.add.at(total, at, np.log(intensity[use] * distance[use] ** 2 / cosine[use]))
        np.add.at(count, at, 1)
    mean = np.where(count > 0, total / np.maximum(count, 1), -np.inf)
    bright = mean > np.percentile(mean[count > 0], 85) - 0.25
    return np.all([np.roll(bright, (i, j), (0, 1)) for i in range(-2, 3) for j in range(-2, 3)], axis=0)


def law(name, all_views, select):
    points, left_out = [], []
    for number, (board, distance, cosine, intensity) in enumerate(all_views):
        use = select(board)
        if use.sum() < 50:
            left_out.append(number)
            continue
        level = np.log(np.maximum(intensity[use], 1e-4) / cosine[use])
        spread = 1.4826 * np.median(np.abs(level + 2 * np.log(distance[use]) - np.median(level + 2 * np.log(distance[use]))))
        if (intensity[use] > 0.95).mean() > 0.02 or spread > 0.1:
            left_out.append(number)
            continue
        points.append((np.log(np.median(distance[use])), np.median(level), np.median(cosine[use])))
    points = np.array(points)
    random = np.random.default_rng(1)
    slopes = []
    for _ in range(2000):
        sample = points[random.integers(len(points), size=len(points))]
        if np.ptp(sample[:, 0]) > 0.1:
            slopes.append(np.polyfit(sample[:, 0], sample[:, 1], 1)[0])
    slope, offset = np.polyfit(points[:, 0], points[:, 1], 1)
    residual = points[:, 1] - slope * points[:, 0] - offset
    head_on = points[:, 2] > np.median(points[:, 2])
    print(f"{name}: {len(points)} views, {np.exp(points[:, 0].min()):.2f} to {np.exp(points[:, 0].max()):.2f} m, "
          f"gamma x exponent {slope:.3f} ({np.percentile(slopes, 2.5):.3f} to {np.percentile(slopes, 97.5):.3f}), "
          f"residual {np.std(residual) * 100:.1f} %, head-on against tilted views {100 * (residual[head_on].mean() - residual[~head_on].mean()):+.1f} %, "
          f"left out {left_out}")


def main():
    everything = list(views(pathlib.Path(sys.argv[1])))
    white = white_cells(everything)

    def is_white(board):
        at = [np.clip(((board[..., axis] + 0.35) / CELL_M).astype(int), 0, white.shape[0] - 1) for axis in (1, 0)]
        return within(board, PRINT) & white[at[0], at[1]]

    law("white squares", everything, is_white)
    law("matte frame", everything, lambda board: within(board, FRAME))


if __name__ == "__main__":
    main()
