#!/usr/bin/env python3
"""Writes a recorded session as another sensor of its kind would have recorded it: another brightness, response and lens.

Usage: other_sensor.py SESSION OUT BRIGHTNESS GAMMA POWER

The infrared images of the simulated session are linearised by the response that they were simulated with, scaled, darkened towards
the corners by the cosine to the power POWER, and sent through GAMMA. Needs numpy and pillow.
"""

import argparse
import shutil
import tomllib
from pathlib import Path

import numpy as np
from PIL import Image

# By which the sessions of the bench were simulated.
TRUE_GAMMA = {"kinect1": 0.80, "kinect2": 0.87}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("session", type=Path)
    parser.add_argument("out", type=Path, help="a folder that is not there yet")
    parser.add_argument("brightness", type=float)
    parser.add_argument("gamma", type=float)
    parser.add_argument("power", type=float)
    args = parser.parse_args()

    shutil.copytree(args.session, args.out)
    session = tomllib.loads((args.session / "session.toml").read_text())
    camera, full_scale = session["ir_camera"], session["ir_full_scale"]
    u, v = np.meshgrid(np.arange(camera["width"]), np.arange(camera["height"]))
    x, y = (u - camera["cx"]) / camera["fx"], (v - camera["cy"]) / camera["fy"]
    lens = (1.0 + x**2 + y**2) ** (-0.5 * args.power)
    for line in (args.session / "ir.txt").read_text().splitlines():
        if not line or line.startswith("#"):
            continue
        name = line.split()[1]
        counts = np.asarray(Image.open(args.session / name), dtype=float)
        linear = (counts / full_scale) ** (1.0 / TRUE_GAMMA[session["sensor"]])
        seen = np.minimum(linear * args.brightness * lens, 1.0) ** args.gamma
        Image.fromarray(np.round(full_scale * seen).astype(np.uint16)).save(args.out / name)


if __name__ == "__main__":
    main()
