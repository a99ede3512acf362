#!/usr/bin/env python3
"""Copies a Kinect II's session with the infrared blurred as by the camera's motion.

    motion_blur.py SESSION OUT SHARE     (needs numpy, scipy and pillow; reads the true poses, so it is for simulated sessions)

Each image becomes the mean over the way that its surface goes on it while it is exposed, SHARE of the time from frame to frame: 0.3 is
the 10 ms or so of a Kinect II, 0.9 the worst that a frame could be. Printed: the length of the blur in the middle of the image, pixels,
5th, 50th and 95th percentile of all frames. Depth stays as it is."""
import shutil
import sys
from pathlib import Path

import ate
import numpy as np
import tomllib
from PIL import Image
from scipy.ndimage import distance_transform_edt, map_coordinates

POINTS = 9


def world_from_camera(row):
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = ate.rotation(row[4:8]), row[1:4]
    return pose


def main(session, out, share):
    session, out = Path(session), Path(out)
    shutil.copytree(session, out)
    about = tomllib.loads((session / "session.toml").read_text())
    camera = about["ir_camera"]
    focal, middle = np.array([camera["fx"], camera["fy"]]), np.array([camera["cx"], camera["cy"]])
    names = [[line.split()[1] for line in (session / f"{kind}.txt").read_text().splitlines() if line[0] != "#"] for kind in ("depth", "ir")]
    poses = [world_from_camera(row) for row in ate.read_tum(str(session / "groundtruth.txt"))]
    v, u = np.mgrid[: camera["height"], : camera["width"]].astype(float)
    at_the_middle = (abs(u - middle[0]) < 0.1 * camera["width"]) & (abs(v - middle[1]) < 0.1 * camera["height"])
    lengths = []
    for k, (depth, ir) in enumerate(zip(*names)):
        z = np.array(Image.open(session / depth)) / about["depth_units_per_metre"]
        z = z[tuple(distance_transform_edt(z == 0, return_distances=False, return_indices=True))]
        points = np.concatenate([(np.stack([u, v], -1) - middle) / focal * z[..., None], z[..., None]], -1)
        before, after = max(k - 1, 0), min(k + 1, len(poses) - 1)

        def seen_from(other):
            turned = np.linalg.inv(poses[other]) @ poses[k]
            moved = points @ turned[:3, :3].T + turned[:3, 3]
            return moved[..., :2] / moved[..., 2:] * focal + middle

        way = (seen_from(after) - seen_from(before)) / (after - before) * float(share)
        lengths.append(np.median(np.linalg.norm(way[at_the_middle], axis=-1)))
        counts = np.array(Image.open(session / ir)).astype(float)
        along = [map_coordinates(counts, [v + s * way[..., 1], u + s * way[..., 0]], order=1, mode="nearest")
                 for s in np.linspace(-0.5, 0.5, POINTS)]
        Image.fromarray(np.round(np.mean(along, 0)).astype(np.uint16)).save(out / ir)
    print("blur in the middle, px:", np.percentile(lengths, [5, 50, 95]).round(2))


if __name__ == "__main__":
    main(*sys.argv[1:])
