#!/usr/bin/env python3
"""Writes a session of a Kinect I whose sensor did not rest over the pauses for its shading images.

    moving_pause.py SESSION OUT backwards    (all in reverse: an image is taken where the first frame after the pause is)
    moving_pause.py SESSION OUT between      (without the last frame before each pause: an image is taken between two frames)

OUT must not be there yet; images are linked from SESSION. The measured path goes along, for scoring."""

import argparse
import pathlib
import re

# The images of a pause have the number of the frame before it and their own.
OF_A_PAUSE = re.compile(r"(\d+)_\d\.png$")


def rows(path):
    """Times and the rest of a list's rows."""
    lines = [line.split(maxsplit=1) for line in path.read_text().splitlines() if line.strip() and not line.startswith("#")]
    return [(float(time), rest) for time, rest in lines]


def main():
    arguments = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    arguments.add_argument("session", type=pathlib.Path)
    arguments.add_argument("out", type=pathlib.Path)
    arguments.add_argument("how", choices=["backwards", "between"])
    given = arguments.parse_args()
    given.out.mkdir()
    lists = ["depth.txt", "ir.txt", "groundtruth.txt"]
    for path in given.session.iterdir():
        if path.suffix != ".txt":
            (given.out / path.name).symlink_to(path.resolve())
    read = {name: rows(given.session / name) for name in lists}
    times = [time for time, _ in read["depth.txt"]]
    held = {found[1] for _, name in read["depth.txt"] if (found := OF_A_PAUSE.search(name))}
    for name, listed in read.items():
        if given.how == "backwards":
            listed = [(min(times) + max(times) - time, rest) for time, rest in reversed(listed)]
        elif name == "depth.txt":
            listed = [(time, rest) for time, rest in listed if pathlib.Path(rest).stem not in held]
        (given.out / name).write_text("".join(f"{time:.6f} {rest}\n" for time, rest in listed))


if __name__ == "__main__":
    main()
