#!/usr/bin/env python3
"""Writes a long session: the frames of another one to its end and back to its start, over and over.

    long_scan.py SESSION OUT FRAMES

OUT must not be there yet; all but the lists is linked from SESSION. Times go on evenly, and every frame keeps its true pose.
"""

import argparse
import pathlib

LISTS = ["depth.txt", "ir.txt", "groundtruth.txt"]


def rows(path):
    """Time and the rest of each line of a list."""
    lines = (line for line in path.read_text().splitlines() if line and not line.startswith("#"))
    return [line.split(None, 1) for line in lines]


def there_and_back(n_frames, n_wanted):
    """Which frame comes when."""
    there = list(range(n_frames))
    turn = there + there[-2:0:-1]
    return [turn[k % len(turn)] for k in range(n_wanted)]


def main():
    arguments = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    arguments.add_argument("session", type=pathlib.Path)
    arguments.add_argument("out", type=pathlib.Path)
    arguments.add_argument("frames", type=int)
    given = arguments.parse_args()
    given.out.mkdir()
    for path in given.session.iterdir():
        # Which images are shading images is told for single frames, and most of these come more than once.
        if path.name not in LISTS + ["shading.txt"]:
            (given.out / path.name).symlink_to(path.resolve())
    times = [time for time, _ in rows(given.session / "depth.txt")]
    step = (float(times[-1]) - float(times[0])) / (len(times) - 1)
    order = there_and_back(len(times), given.frames)
    for name in LISTS:
        path = given.session / name
        if not path.exists():
            continue
        of_time = dict(rows(path))
        with open(given.out / name, "w") as out:
            for index, frame in enumerate(order):
                if times[frame] in of_time:
                    print(f"{float(times[0]) + index * step:.6f} {of_time[times[frame]]}", file=out)


if __name__ == "__main__":
    main()
