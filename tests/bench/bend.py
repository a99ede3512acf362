#!/usr/bin/env python3
"""Copies a session of a Kinect II as libfreenect2's CPU and OpenGL decoders would have delivered it: bent.

    bend.py SESSION OUT     (OUT is a folder that is not there yet; needs numpy and pillow)

They divide what was measured along a pixel's ray by the length of the ray in the row mirrored at the middle of the image.
"""
import pathlib
import shutil
import sys
import tomllib

import numpy as np
from PIL import Image

from board_light_law import rays


def main(session, out):
    shutil.copytree(session, out)
    camera = tomllib.loads((session / "session.toml").read_text())["ir_camera"]
    length = np.linalg.norm(rays(camera), axis=-1)
    for path in (out / "depth").glob("*.png"):
        depth = np.asarray(Image.open(path)) * length / length[::-1]
        Image.fromarray(np.round(depth).astype(np.uint16)).save(path)


if __name__ == "__main__":
    main(*map(pathlib.Path, sys.argv[1:3]))
