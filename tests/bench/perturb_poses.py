#!/usr/bin/env python3
"""Poses that err as those of a badly calibrated rig: a TUM trajectory with a turn and a shift of its own for each pose.

usage: perturb_poses.py TRAJECTORY TURN_MRAD SHIFT_MM SEED > PERTURBED

Directions are random, sizes as given; the first pose stays, since it is the world. For scoring what polishing brings, where
TRAJECTORY may be the truth."""
import sys

import numpy as np


def rotated(axis_angle, xyzw):
    """The quaternion of a turn by `axis_angle` (rad) about the camera's own axes, after `xyzw`."""
    angle = np.linalg.norm(axis_angle)
    x, y, z = axis_angle / max(angle, 1e-15) * np.sin(angle / 2)
    w = np.cos(angle / 2)
    a, b, c, d = xyzw
    return np.array([
        d * x + a * w + b * z - c * y,
        d * y - a * z + b * w + c * x,
        d * z + a * y - b * x + c * w,
        d * w - a * x - b * y - c * z,
    ])


def main():
    path, turn_mrad, shift_mm, seed = sys.argv[1], *map(float, sys.argv[2:5])
    random = np.random.default_rng(int(seed))

    def error(size):
        direction = random.normal(size=3)
        return size * direction / np.linalg.norm(direction)

    rows = [row.split() for row in open(path) if row.strip() and not row.startswith("#")]
    for number, row in enumerate(rows):
        pose = np.array(row[1:8], dtype=float)
        turn, shift = error(1e-3 * turn_mrad), error(1e-3 * shift_mm)
        if number > 0:
            pose[:3] += shift
            pose[3:] = rotated(turn, pose[3:])
        print(row[0], *(f"{value:.9f}" for value in pose))


main()
