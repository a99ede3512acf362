#!/usr/bin/env python3
"""Whether `relief evaluate --truth` takes the figures that a session's scoring script takes.

    evaluate_against_score.py SESSION SCORE.py SCAN OUT [--relief PROGRAM]        (needs what SCORE.py needs)

This is scoring: it alone reads the session's first measured pose and its surface, which it writes as a mesh for `--truth`. SCAN is an
output folder of the session, OUT a new folder: the scan is refined anew, and its base mesh and that are evaluated, and scored. A line for
each figure of either mesh, both figures and how far one is from the other; it ends with 1 where that is more than 2 %. The script takes points
by chance, and its detail scatters by up to 3 %: what is compared with is the mean of several."""
import argparse
import json
import pathlib
import subprocess
import sys
import unittest.mock

import numpy as np
from relief_ply import write_mesh
from scipy.spatial.transform import Rotation
from scoring import scoring_script

ROOT = pathlib.Path(__file__).resolve().parents[2]
# Both call them by these names.
FIGURES = ["mean_mm", "median_mm", "rms_mm", "detail_rms_mm", "normal_mean_deg", "normal_median_deg", "completeness"]
MAX_DIFFERENCE = 0.02
N_SAMPLINGS = 8


def relief(args, *words):
    """What the program prints."""
    return subprocess.run([str(word) for word in [args.relief, *words]], check=True, stdout=subprocess.PIPE).stdout


def evaluated(args, truth):
    """What the program says of the base mesh and of the refined one."""
    surface = args.out / "truth.ply"
    write_mesh(surface, truth.v, truth.f)
    first = truth.T[0]
    pose = [*first[:3, 3], *Rotation.from_matrix(first[:3, :3]).as_quat()]
    # With `=`, since numbers may begin with a minus.
    numbers = {"--truth-pose": pose, "--truth-box": [*truth.lo, *truth.hi]}
    placed = [f"{option}={','.join(f'{x:.9f}' for x in values)}" for option, values in numbers.items()]
    said = relief(args, "evaluate", args.scan, "--out", args.out / "evaluation", "--folds", "0", "--truth", surface, *placed, "--json")
    return json.loads(said)["truth"]


def scored(score, session, mesh, truth):
    """What the scoring script says of a mesh, means over several samplings."""
    generator = np.random.default_rng
    samplings = []
    for seed in range(N_SAMPLINGS):
        with unittest.mock.patch("numpy.random.default_rng", lambda _, seed=seed: generator(seed)):
            samplings.append(score.score(str(session), str(mesh), truth))
    return {figure: np.mean([sampling[figure] for sampling in samplings]) for figure in FIGURES}


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("session", type=pathlib.Path)
    parser.add_argument("score", type=pathlib.Path)
    parser.add_argument("scan", type=pathlib.Path)
    parser.add_argument("out", type=pathlib.Path)
    parser.add_argument("--relief", default=str(ROOT / "target/release/relief"))
    args = parser.parse_args()
    score = scoring_script(args.score)
    truth = score.Truth(str(args.session))
    args.out.mkdir(parents=True)
    # Not as the session was refined when it was fused: kept depth and meshes are rounded.
    relief(args, "refine", args.scan, "--out", args.out / "refined")
    said = evaluated(args, truth)
    worst = 0.0
    for mesh in ["base", "refined"]:
        wanted = scored(score, args.session, args.out / "refined" / f"{mesh}.ply", truth)
        for figure in FIGURES:
            difference = said[mesh][figure] / wanted[figure] - 1
            worst = max(worst, abs(difference))
            print(f"{mesh:8} {figure:18} {said[mesh][figure]:8.4f} {wanted[figure]:8.4f} {100 * difference:+6.2f} %")
    print(f"farthest apart: {100 * worst:.2f} %")
    return int(not worst <= MAX_DIFFERENCE)


if __name__ == "__main__":
    sys.exit(main())
