#!/usr/bin/env python3
"""Writes a session of a Kinect II whose depth is wrong by its range, too: a sine that is added to every range.

    wiggle.py SESSION OUT MM PERIOD_M PHASE        (needs what depth_error.py needs)

OUT must not be there yet; all but the depth is linked from SESSION.
"""

import argparse
import pathlib
import re

import numpy as np
from PIL import Image

from depth_error import rays


def numbers(text):
    """The keys of a session.toml that are numbers."""
    found = re.findall(r"^(\w+)\s*=\s*([-+.\de]+)\s*(?:#.*)?$", text, re.MULTILINE)
    return {key: float(value) for key, value in found}


def main():
    arguments = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    arguments.add_argument("session", type=pathlib.Path)
    arguments.add_argument("out", type=pathlib.Path)
    for name in ["mm", "period_m", "phase"]:
        arguments.add_argument(name, type=float)
    given = arguments.parse_args()
    session = numbers((given.session / "session.toml").read_text())
    camera = {**session, "width": int(session["width"]), "height": int(session["height"])}
    units = session["depth_units_per_metre"]
    range_per_depth = np.linalg.norm(rays(camera), axis=-1)
    given.out.mkdir()
    (given.out / "depth").mkdir()
    for path in given.session.iterdir():
        if path.name != "depth":
            (given.out / path.name).symlink_to(path.resolve())
    for path in (given.session / "depth").iterdir():
        depth = np.array(Image.open(path)) / units
        ranges = depth * range_per_depth
        ranges += 1e-3 * given.mm * np.sin(2 * np.pi * ranges / given.period_m + given.phase)
        wrong = np.where(depth > 0, np.rint(units * ranges / range_per_depth), 0)
        Image.fromarray(wrong.astype(np.uint16)).save(given.out / "depth" / path.name)


if __name__ == "__main__":
    main()
