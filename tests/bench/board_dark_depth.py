#!/usr/bin/env python3
"""How far a real Kinect II's depth of dark print lies from that of the white print round it, and what mixes into it.

    board_dark_depth.py SESSION     (the session `board-k2-real`; needs numpy, scipy and pillow)

Of each view that shows the board: how dark the dark squares are against the white ones, the tilt of depth against the board's plane
z = 0 of `poses.txt` (mm in 100 rows), as recorded and if the rays by which it was computed were upside down, how far white pixels lie from a quadratic fitted to them, and dark ones from the same, 6 mm and
more from an edge. Then what a pixel would be off by if light of its neighbours, weighted by a Gaussian, were mixed into it as a phasor
at 100 MHz: a Gaussian's share is fitted to the dark pixels of all views, for each width alone and for all together.
"""
import pathlib
import sys
import tomllib

import numpy as np
from PIL import Image
from scipy import ndimage

from board_flatness import dark_cells
from board_light_law import CELL_M, PRINT, rays, rotation, within

EDGE_M = 0.006
REACH_M = 0.08
SATURATED = 0.92
# 4 pi f / c at 100 MHz, radians per metre: the sensor's three frequencies are 16, 80 and 120 MHz.
RADIANS_PER_M = 4.19
WIDTHS_PX = [1.5, 4.0, 12.0, 40.0]


def listed(folder, name):
    return [line.split()[1] for line in (folder / name).read_text().splitlines() if line[:1] != "#"]


def quadratic(u, v):
    return np.stack([np.ones_like(u), u, v, u * u, v * v, u * v], -1)


def linear(u, v):
    return np.stack([np.ones_like(u), u, v], -1)


def mixed_in(depth, intensity, true_range, length):
    """By what each pixel would be off, millimetres, if all of its surroundings of each width were mixed into it."""
    amplitude = np.where(depth > 0, intensity, 0.0)
    phasors = amplitude * np.exp(1j * RADIANS_PER_M * depth * length)
    for width in WIDTHS_PX:
        blurred = ndimage.gaussian_filter(phasors.real, width) + 1j * ndimage.gaussian_filter(phasors.imag, width)
        across = (blurred * np.exp(-1j * RADIANS_PER_M * true_range)).imag
        yield 1e3 / RADIANS_PER_M * across / np.maximum(intensity, 1e-3)


def main(folder):
    session = tomllib.loads((folder / "session.toml").read_text())
    directions = rays(session["ir_camera"])
    length = np.linalg.norm(directions, axis=-1)
    v, u = (np.indices(length.shape) - np.array(length.shape)[:, None, None] / 2) / 100
    signed = dark_cells(folder)
    mixtures, offs = [], []
    files = zip(np.loadtxt(folder / "poses.txt"), listed(folder, "depth.txt"), listed(folder, "ir.txt"))
    for number, (pose, depth_file, ir_file) in enumerate(files):
        depth = np.asarray(Image.open(folder / depth_file)) / session["depth_units_per_metre"]
        intensity = np.asarray(Image.open(folder / ir_file)) / session["ir_full_scale"]
        along = directions @ rotation(*pose[4:8]).T
        true_depth = -pose[3] / along[..., 2]
        board = (pose[1:4] + along * true_depth[..., None])[..., :2]
        use = (depth > 0) & (np.abs(depth - true_depth) < REACH_M) & within(board, PRINT)
        at = ((board[use] + 0.35) / CELL_M).astype(int)
        from_edge = np.full(depth.shape, np.nan)
        from_edge[use] = signed[at[:, 1], at[:, 0]]
        off = 1e3 * (depth - true_depth)
        white, dark = (from_edge > EDGE_M) & (intensity < SATURATED), from_edge < -EDGE_M
        if white.sum() < 50:
            print(f"view {number}: {white.sum()} white pixels are not saturated, left out")
            continue
        fit = np.linalg.lstsq(quadratic(u[white], v[white]), off[white], rcond=None)[0]
        righted = 1e3 * (depth * length[::-1] / length - true_depth)
        tilt, righted_tilt = (np.linalg.lstsq(linear(u[white], v[white]), e[white], rcond=None)[0][2] for e in (off, righted))
        left = off - quadratic(u, v) @ fit
        print(f"view {number}: {true_depth[white].mean():.2f} m, dark {np.median(intensity[dark]) / np.median(intensity[white]):.3f} of white, "
              f"tilt {tilt:.0f} mm, righted {righted_tilt:.0f} mm, white within {left[white].std():.1f} mm, dark {left[dark].mean():+.1f} \u00b1 {left[dark].std():.1f} mm")
        mixtures.append(np.stack([mixture[dark] for mixture in mixed_in(depth, intensity, true_depth * length, length)], -1))
        offs.append(left[dark])
    mixtures, offs = np.concatenate(mixtures), np.concatenate(offs)
    print(f"dark pixels of all views are off by {np.sqrt((offs**2).mean()):.1f} mm; what is left by what is mixed in:")
    for chosen in [[k] for k in range(len(WIDTHS_PX))] + [list(range(len(WIDTHS_PX)))]:
        shares = np.linalg.lstsq(mixtures[:, chosen], offs, rcond=None)[0]
        left = offs - mixtures[:, chosen] @ shares
        print(f"  {', '.join(f'{WIDTHS_PX[k]:g}' for k in chosen)} px: {np.sqrt((left**2).mean()):.1f} mm, shares {np.round(shares, 3)}")


if __name__ == "__main__":
    main(pathlib.Path(sys.argv[1]))
