#!/usr/bin/env python3
"""By how much the depth of a scan's shading images is off, by how slantingly the surface is seen.

    depth_error.py SESSION SCORE.py OUT        (needs what SCORE.py needs, and Pillow)

This is scoring: it alone reads the session's measured poses and surface. It compares the depth in OUT/snapshots, as it was
corrected, and as it was recorded, with the true surface from the true poses: mean and median of what is too long, mm, within
the session's box, edges of depth left out.
"""

import argparse
import json
import pathlib

import numpy as np
import open3d as o3d
from PIL import Image
from scipy.ndimage import maximum_filter, minimum_filter
from scoring import scoring_script

SNAPSHOT_UNITS_PER_METRE = 5000.0
COSINES = [0.2, 0.35, 0.5, 0.65, 0.8, 0.9, 0.97, 1.001]
# Next to a step of depth, and farther off than that, a pixel shows something else.
EDGE_M = 0.03
OTHER_SURFACE_M = 0.02


def rays(camera):
    """Directions of the pixels with z = 1: the lens's distortion undone by iteration."""
    u, v = np.meshgrid(np.arange(camera["width"]), np.arange(camera["height"]))
    distorted = np.stack([(u - camera["cx"]) / camera["fx"], (v - camera["cy"]) / camera["fy"]])
    x, y = distorted
    for _ in range(30):
        r2 = x * x + y * y
        radial = 1 + r2 * (camera["k1"] + r2 * (camera["k2"] + r2 * camera.get("k3", 0.0)))
        dx = 2 * camera["p1"] * x * y + camera["p2"] * (r2 + 2 * x * x)
        dy = camera["p1"] * (r2 + 2 * y * y) + 2 * camera["p2"] * x * y
        x, y = (distorted[0] - dx) / radial, (distorted[1] - dy) / radial
    return np.stack([x, y, np.ones_like(x)], axis=-1)


def read_depth(path, units_per_metre):
    return np.array(Image.open(path)) / units_per_metre


def main():
    arguments = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    arguments.add_argument("session", type=pathlib.Path)
    arguments.add_argument("score", type=pathlib.Path)
    arguments.add_argument("out", type=pathlib.Path)
    given = arguments.parse_args()
    score = scoring_script(given.score)
    truth = score.Truth(str(given.session))
    units = score.read_toml(given.session / "session.toml")["depth_units_per_metre"]
    lines = (given.session / "depth.txt").read_text().splitlines()
    recorded = [line.split() for line in lines if not line.startswith("#")]
    times = np.array([float(time) for time, _ in recorded])
    directions = rays(truth.cam)
    rows = {"recorded": [], "corrected": []}
    for snapshot in sorted((given.out / "snapshots").iterdir()):
        time = json.loads((snapshot / "meta.json").read_text())["device_time_secs"]
        pose = truth.T[np.abs(truth.t - time).argmin()]
        turned = directions @ pose[:3, :3].T
        origins = np.broadcast_to(pose[:3, 3], turned.shape)
        cast = truth.scene.cast_rays(o3d.core.Tensor(np.concatenate([origins, turned], -1).astype(np.float32)))
        z, normals = cast["t_hit"].numpy(), cast["primitive_normals"].numpy()
        cosine = np.abs((normals * turned).sum(-1)) / np.linalg.norm(turned, axis=-1)
        depth = np.where(np.isfinite(z), z, 9.0)
        points = origins + turned * depth[..., None]
        wanted = ((points > truth.lo) & (points < truth.hi)).all(-1)
        wanted &= maximum_filter(depth, 5) - minimum_filter(depth, 5) < EDGE_M
        images = {
            "recorded": read_depth(given.session / recorded[np.abs(times - time).argmin()][1], units),
            "corrected": read_depth(snapshot / "depth.png", SNAPSHOT_UNITS_PER_METRE),
        }
        for name, image in images.items():
            excess = image - depth
            seen = wanted & (image > 0) & (np.abs(excess) < OTHER_SURFACE_M)
            rows[name].append(np.stack([1e3 * excess[seen], cosine[seen]]))
    for name, found in rows.items():
        excess, cosine = np.concatenate(found, axis=1)
        print(f"{name}: mean {excess.mean():.2f} mm")
        for low, high in zip([0.0] + COSINES, COSINES):
            part = excess[(cosine >= low) & (cosine < high)]
            if len(part) > 500:
                print(f"  cosine {low:.2f} to {high:.2f}: mean {part.mean():5.2f}, median {np.median(part):5.2f}, {len(part)} pixels")


if __name__ == "__main__":
    main()
