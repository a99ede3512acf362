"""Absolute trajectory error of a run against a session's measured path.

    ate.py TRAJECTORY GROUNDTRUTH     (both TUM: timestamp tx ty tz qx qy qz qw, world from camera; needs numpy)

Poses are paired by time, 20 ms apart at most, and the trajectory is moved rigidly onto the truth (Umeyama 1991 without
scale). Printed: how many poses were paired, root mean square and largest distance of the positions (mm), and the drift:
how far the motion from the first frame to the last is off, in position (mm) and angle (degrees). The drift needs no
alignment; on a path that comes back it is the error that closing the loop would take away.
"""
import sys

import numpy as np

MAX_APART_SECS = 0.020


def read_tum(path):
    rows = np.loadtxt(path, comments="#", ndmin=2)
    return rows[np.argsort(rows[:, 0])]


def paired(estimate, truth):
    """Rows of both that belong together: to each estimated pose the true one nearest in time."""
    after = np.searchsorted(truth[:, 0], estimate[:, 0]).clip(1, len(truth) - 1)
    before_is_nearer = estimate[:, 0] - truth[after - 1, 0] < truth[after, 0] - estimate[:, 0]
    nearest = after - before_is_nearer
    near = np.abs(truth[nearest, 0] - estimate[:, 0]) <= MAX_APART_SECS
    return estimate[near], truth[nearest[near]]


def rotation(quaternion_xyzw):
    x, y, z, w = quaternion_xyzw / np.linalg.norm(quaternion_xyzw)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def aligned(source, target):
    """The source points moved rigidly to where they fit the target points best."""
    source_mean, target_mean = source.mean(0), target.mean(0)
    u, _, vt = np.linalg.svd((target - target_mean).T @ (source - source_mean))
    turn = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt
    return (source - source_mean) @ turn.T + target_mean


def motion(rows):
    """Motion from the first pose to the last, in the frame of the first."""
    first, last = rotation(rows[0, 4:8]), rotation(rows[-1, 4:8])
    return first.T @ last, first.T @ (rows[-1, 1:4] - rows[0, 1:4])


def main(trajectory, groundtruth):
    estimate, truth = paired(read_tum(trajectory), read_tum(groundtruth))
    if len(estimate) < 3:
        sys.exit(f"{len(estimate)} poses have a true one within {MAX_APART_SECS} s, must be 3 at least")
    error_mm = 1e3 * np.linalg.norm(aligned(estimate[:, 1:4], truth[:, 1:4]) - truth[:, 1:4], axis=1)
    (turn, move), (true_turn, true_move) = motion(estimate), motion(truth)
    cosine = (np.trace(turn.T @ true_turn) - 1) / 2
    print(
        f"poses {len(estimate)}, ATE RMSE {np.sqrt((error_mm**2).mean()):.2f} mm, max {error_mm.max():.2f} mm, "
        f"drift {1e3 * np.linalg.norm(move - true_move):.2f} mm "
        f"{np.degrees(np.arccos(np.clip(cosine, -1, 1))):.3f} deg"
    )


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit(__doc__)
    main(*sys.argv[1:])
