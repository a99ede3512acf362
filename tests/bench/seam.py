#!/usr/bin/env python3
"""How far the last frames of a full turn lie from the first ones where both saw the same surface: the gap at the seam.

    seam.py SESSION TRAJECTORY [FRAMES]     (needs numpy and pillow; TRAJECTORY is a run's, TUM; so many first and last frames, 12)

Depth as recorded is put where the run says that the camera was. In cubes of 8 mm that first and last frames have both seen often, the
plane of all points is fitted, and how far the means of both lie apart along it is the gap there. Printed: its median and root mean square
over the cubes, and that between the odd and the even ones of the first frames, which is noise. What frames get wrong in the same way from
the same side cancels out."""
import pathlib
import sys
import tomllib

import numpy as np
from PIL import Image

from ate import read_tum
from board_light_law import rays, rotation

CUBE_M = 0.008
MIN_POINTS = 30
# Columns of a cube's number.
SPAN = 1 << 20


def points_of(folder, session, files, poses):
    """World points (m) of frames, every second pixel across and down, near edges left out."""
    directions = rays(session["ir_camera"])[::2, ::2]
    clouds = []
    for (_, name), pose in zip(files, poses):
        depth = np.asarray(Image.open(folder / name))[::2, ::2] / session["depth_units_per_metre"]
        slope = np.hypot(*np.gradient(depth))
        use = (depth > 0.3) & (depth < 1.5) & (slope < 0.01)
        clouds.append((directions[use] * depth[use][:, None]) @ rotation(*pose[4:8]).T + pose[1:4])
    return np.concatenate(clouds)


def by_cube(points):
    cubes = np.floor(points / CUBE_M).astype(np.int64) + SPAN // 2
    keys = (cubes[:, 0] * SPAN + cubes[:, 1]) * SPAN + cubes[:, 2]
    order = np.argsort(keys, kind="stable")
    keys, starts, counts = np.unique(keys[order], return_index=True, return_counts=True)
    enough = counts >= MIN_POINTS
    cubes = zip(keys[enough], starts[enough], counts[enough])
    return {key: points[order[start : start + count]] for key, start, count in cubes}


def gaps_mm(some, others):
    some, others = by_cube(some), by_cube(others)
    gaps = []
    for key in some.keys() & others.keys():
        together = np.concatenate([some[key], others[key]])
        spread, axes = np.linalg.eigh(np.cov((together - together.mean(0)).T))
        # Flat within the cube, and not its corner.
        if spread[0] < 0.1 * spread[1]:
            gaps.append(1e3 * (others[key].mean(0) - some[key].mean(0)) @ axes[:, 0])
    return np.array(gaps)


def told(name, gaps):
    print(f"{name}: {np.median(np.abs(gaps)):.2f} mm in the median, {np.sqrt((gaps**2).mean()):.2f} mm RMS over {len(gaps)} cubes")


def main(folder, trajectory, count=12):
    folder, count = pathlib.Path(folder), int(count)
    session = tomllib.loads((folder / "session.toml").read_text())
    files = [line.split() for line in (folder / "depth.txt").read_text().splitlines() if line[:1] != "#"]
    at = {round(float(time), 4): (time, name) for time, name in files}
    path = read_tum(trajectory)
    files = [at[round(time, 4)] for time in path[:, 0]]
    of = lambda chosen: points_of(folder, session, files[chosen], path[chosen])
    told("last frames against the first", gaps_mm(of(slice(0, count)), of(slice(-count, None))))
    told("first frames, odd against even", gaps_mm(of(slice(0, 2 * count, 2)), of(slice(1, 2 * count, 2))))


if __name__ == "__main__":
    main(*sys.argv[1:])
