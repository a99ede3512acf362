#!/usr/bin/env python3
"""Writes a session in whose first part a ball hangs in the air that is gone later: what was fused and is free now.

    visitor.py SESSION TRAJECTORY OUT [--from 10 --until 50 --radius-m 0.05 --nearer-m 0.2]        (needs what depth_error.py needs)
    visitor.py SESSION TRAJECTORY OUT --mesh MESH        how many cm² of a mesh of OUT lie on the ball

TRAJECTORY is that of a replay of SESSION, and places the ball: before the middle of frame `from`, so much nearer than what is seen there.
OUT must not be there yet; all but the depth is linked from SESSION.
"""

import argparse
import pathlib

import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation

from depth_error import rays
from wiggle import numbers

# Of the ball's depth, metres.
NOISE_M = 0.0015
# What lies so near to the ball is the ball's.
NEAR_M = 0.01


def hits(origin, directions, centre, radius_m):
    """Depth along rays with z = 1 to a ball; infinite where they miss."""
    to_centre = centre - origin
    a = np.sum(directions**2, axis=-1)
    b = directions @ to_centre
    under_root = b**2 - a * (to_centre @ to_centre - radius_m**2)
    return np.where(under_root > 0, (b - np.sqrt(np.maximum(under_root, 0))) / a, np.inf)


def tracked_frames(session, trajectory):
    """Paths of the depth images that were tracked, and their poses: rotation and shift, world from camera."""
    lines = (line.split() for line in (session / "depth.txt").read_text().splitlines())
    names = {float(line[0]): session / line[1] for line in lines if line and line[0] != "#"}
    tracked = [row for row in trajectory if row[0] in names]
    return [names[row[0]] for row in tracked], [(Rotation.from_quat(row[4:8]), row[1:4]) for row in tracked]


def place(poses, depths, frame, nearer_m):
    """Middle of the ball, world."""
    depth = depths(frame)
    middle = depth[tuple(slice(3 * side // 8, 5 * side // 8) for side in depth.shape)]
    along = np.median(middle[middle > 0]) - nearer_m
    rotation, shift = poses[frame]
    return rotation.apply([0.0, 0.0, along]) + shift


def area_on(mesh, centre, radius_m):
    import open3d as o3d

    mesh = o3d.io.read_triangle_mesh(str(mesh))
    corners = np.asarray(mesh.vertices)[np.asarray(mesh.triangles)]
    is_on = np.linalg.norm(corners.mean(axis=1) - centre, axis=1) < radius_m + NEAR_M
    sides = corners[is_on, 1:] - corners[is_on, :1]
    return 0.5 * np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1).sum()


def main():
    arguments = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    for name in ["session", "trajectory", "out"]:
        arguments.add_argument(name, type=pathlib.Path)
    arguments.add_argument("--from", dest="first", type=int, default=10)
    arguments.add_argument("--until", type=int, default=50)
    arguments.add_argument("--radius-m", type=float, default=0.05)
    arguments.add_argument("--nearer-m", type=float, default=0.2)
    arguments.add_argument("--mesh", type=pathlib.Path)
    given = arguments.parse_args()
    session = numbers((given.session / "session.toml").read_text())
    camera = {**session, "width": int(session["width"]), "height": int(session["height"])}
    units = session["depth_units_per_metre"]
    paths, poses = tracked_frames(given.session, np.loadtxt(given.trajectory))
    centre = place(poses, lambda k: np.array(Image.open(paths[k])) / units, given.first, given.nearer_m)
    if given.mesh:
        print(f"{1e4 * area_on(given.mesh, centre, given.radius_m):.1f} cm² on the ball")
        return
    given.out.mkdir()
    (given.out / "depth").mkdir()
    for path in given.session.iterdir():
        if path.name != "depth":
            (given.out / path.name).symlink_to(path.resolve())
    directions = rays(camera)
    noise = np.random.default_rng(1)
    n_pixels = 0
    for path in (given.session / "depth").iterdir():
        k = paths.index(path) if path in paths else None
        depth = np.array(Image.open(path)) / units
        if k is not None and given.first <= k < given.until:
            rotation, shift = poses[k]
            ball = hits(shift, rotation.apply(directions.reshape(-1, 3)), centre, given.radius_m)
            ball = ball.reshape(depth.shape) + NOISE_M * noise.standard_normal(depth.shape)
            depth = np.where(np.isfinite(ball) & ((depth == 0) | (ball < depth)), ball, depth)
            n_pixels += np.isfinite(ball).sum()
        Image.fromarray(np.rint(units * depth).astype(np.uint16)).save(given.out / "depth" / path.name)
    print(f"{n_pixels / max(given.until - given.first, 1):.0f} pixels of the ball in a frame")


if __name__ == "__main__":
    main()
