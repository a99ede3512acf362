#!/usr/bin/env python3
"""Writes a session of a Kinect I whose lamp is brighter at one pose than at another: 0.5 to 1.5 times PERCENT up or down.

    uneven_lamp.py SESSION OUT PERCENT        (needs numpy and Pillow)

OUT must not be there yet; all but the infrared is linked from SESSION.
"""

import argparse
import pathlib
import re

import numpy as np
from PIL import Image

# Exposures of one pose follow one another; more frames than this lie between two poses.
SAME_POSE_FRAMES = 3
FULL_SCALE = 1023


def main():
    arguments = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    arguments.add_argument("session", type=pathlib.Path)
    arguments.add_argument("out", type=pathlib.Path)
    arguments.add_argument("percent", type=float)
    given = arguments.parse_args()
    given.out.mkdir()
    (given.out / "ir").mkdir()
    for path in given.session.iterdir():
        if path.name != "ir":
            (given.out / path.name).symlink_to(path.resolve())
    chance = np.random.default_rng(5)
    before, brightness = None, 1.0
    for path in sorted((given.session / "ir").iterdir()):
        number = int(re.match(r"\d+", path.name).group())
        if before is None or number - before > SAME_POSE_FRAMES:
            brightness = 1 + 0.01 * given.percent * chance.choice([-1, 1]) * (0.5 + chance.random())
        before = number
        counts = np.rint(brightness * np.array(Image.open(path)).astype(float))
        counts = np.clip(counts, 0, FULL_SCALE).astype(np.uint16)
        Image.fromarray(counts).save(given.out / "ir" / path.name)


if __name__ == "__main__":
    main()
