"""How well a run's path agrees with motion capture, apart from how the captured body and its clock lie to the camera.

    hand_eye.py TRAJECTORY GROUNDTRUTH     (both TUM: timestamp tx ty tz qx qy qz qw, world from camera; needs numpy, scipy)

Motion capture follows markers on the sensor. The turn and shift from them to the camera, and the offset of the two clocks, were
measured by whoever made the recording, and err; in a scan that mostly turns the shift alone can outweigh all errors of tracking.
Fitted here are those (clock, turn, shift) and where the worlds lie to one another. Printed: the fitted values; root mean squares of
what positions (mm) and directions (degrees) then differ by, over all poses; and the ATE, as by ate.py, of a perfect path of a point
that far from the captured one, which is what ATE says about the shift alone.
"""
import sys

import ate
import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation, Slerp

# At both ends, where the captured path may not reach as far as the shifted clock.
LEFT_OUT = 5
# Directions and positions count alike when off by so much: radians, metres.
SCALES = 0.02, 0.02


def root_mean_square(differences):
    return np.sqrt((differences**2).sum(1).mean())


def main(trajectory, groundtruth):
    estimate, truth = ate.read_tum(trajectory)[LEFT_OUT:-LEFT_OUT], ate.read_tum(groundtruth)
    turns = Rotation.from_quat(estimate[:, 4:8])
    true_turn_at = Slerp(truth[:, 0], Rotation.from_quat(truth[:, 4:8]))

    def differences(fit):
        clock, world, turn, shift = fit[0], fit[1:4], fit[4:7], fit[7:10]
        times = estimate[:, 0] + clock
        positions = np.stack([np.interp(times, truth[:, 0], truth[:, axis]) for axis in (1, 2, 3)], 1)
        expected = Rotation.from_rotvec(world) * turns * Rotation.from_rotvec(turn)
        directions = (expected.inv() * true_turn_at(times)).as_rotvec()
        return directions, ate.aligned(estimate[:, 1:4] + turns.apply(shift), positions) - positions

    start = (true_turn_at(estimate[0, 0]) * turns[0].inv()).as_rotvec()
    fitted = least_squares(
        lambda fit: np.concatenate([(d / scale).ravel() for d, scale in zip(differences(fit), SCALES)]),
        np.concatenate([[0.0], start, np.zeros(6)]),
    ).x
    directions, positions = differences(fitted)
    captured = truth[:, 1:4]
    shifted = captured - Rotation.from_quat(truth[:, 4:8]).apply(fitted[7:10])
    by_shift = root_mean_square(ate.aligned(shifted, captured) - captured)
    print(f"clock {1e3 * fitted[0]:.1f} ms, turn {np.degrees(np.linalg.norm(fitted[4:7])):.2f} deg, shift {(1e3 * fitted[7:10]).round(1)} mm")
    print(f"left over: {1e3 * root_mean_square(positions):.2f} mm, {np.degrees(root_mean_square(directions)):.3f} deg")
    print(f"ATE RMSE of the shift alone: {1e3 * by_shift:.2f} mm")


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit(__doc__)
    main(*sys.argv[1:])
