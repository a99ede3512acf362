#!/usr/bin/env python3
"""Writes a simulated session as it would have been recorded in a lit room, or of a glossy surface.

    other_surroundings.py SESSION OUT [--ambient SHARE] [--sun SHARE] [--unlit N] [--gloss STRENGTH] [--shininess POWER]
                             [--glossy LEAST MOST]

To the linearised infrared images is added what such surroundings add to Eq. (1), from the true surface and poses:
- ambient light from everywhere (SHARE of the lamp's median irradiance), and some that comes from one side of the room;
- with --unlit N, as many images before those of each shading pose of a Kinect I, while the projector is covered and the lamp is
  not lit yet;
- a Blinn-Phong lobe, rho · STRENGTH · (n·h)^POWER, under the lamp; with --glossy only of the materials of so much true albedo.
Shadows of either are left out. Needs numpy, pillow and open3d; reads the session's truth, so it is for simulation alone."""
import argparse
import shutil
import tomllib
from pathlib import Path

import ate
import numpy as np
import open3d as o3d
from board_light_law import rays
from other_sensor import TRUE_GAMMA
from PIL import Image

# Where the room's light comes from, world frame of the truth; up is z.
SUN = np.array([0.6, -0.5, 0.62])
# Between frames, seconds, and the sensor's noise in the dark as a share of full scale.
FRAME_SECS = 1 / 30
READ_NOISE = 0.002


def unit(vectors):
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-12)


class Truth:
    """What the true surface shows a pixel: normal and albedo."""

    def __init__(self, session):
        mesh = np.load(session / "groundtruth_mesh.npz")
        self.faces, self.normals, self.albedo = mesh["f"], mesh["n"], mesh["albedo"].astype(float)
        self.scene = o3d.t.geometry.RaycastingScene()
        self.scene.add_triangles(o3d.core.Tensor(mesh["v"].astype(np.float32)), o3d.core.Tensor(self.faces.astype(np.uint32)))

    def seen(self, origin, directions):
        """Distance along the directions, world normal facing them, and albedo; distance infinite where there is nothing."""
        cast = np.concatenate([np.broadcast_to(origin, directions.shape), directions], -1).astype(np.float32)
        hit = self.scene.cast_rays(o3d.core.Tensor(cast))
        distance, face, uv = (hit[key].numpy() for key in ("t_hit", "primitive_ids", "primitive_uvs"))
        corners = self.faces[np.where(np.isfinite(distance), face, 0)]
        weights = np.stack([1 - uv.sum(-1), uv[..., 0], uv[..., 1]], -1)
        normal = unit((self.normals[corners] * weights[..., None]).sum(-2))
        normal *= -np.sign((normal * directions).sum(-1, keepdims=True))
        return distance, normal, (self.albedo[corners] * weights).sum(-1)


def save(path, linear, gamma, full_scale):
    counts = np.round(full_scale * np.minimum(linear, 1.0) ** gamma)
    Image.fromarray(counts.astype(np.uint16)).save(path)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("session", type=Path)
    parser.add_argument("out", type=Path, help="a folder that is not there yet")
    parser.add_argument("--ambient", type=float, default=0.0)
    parser.add_argument("--sun", type=float, default=0.0)
    parser.add_argument("--unlit", type=int, default=0)
    parser.add_argument("--gloss", type=float, default=0.0)
    parser.add_argument("--shininess", type=float, default=30.0)
    parser.add_argument("--glossy", type=float, nargs=2, default=(0.0, np.inf), metavar=("LEAST", "MOST"))
    args = parser.parse_args()

    session = tomllib.loads((args.session / "session.toml").read_text())
    gamma, full_scale = TRUE_GAMMA[session["sensor"]], session["ir_full_scale"]
    directions = rays(session["ir_camera"])
    light = np.array(session["light"]["position"])
    poses = {f"{row[0]:.6f}": row for row in ate.read_tum(args.session / "groundtruth.txt")}
    truth = Truth(args.session)
    shutil.copytree(args.session, args.out)
    random = np.random.default_rng(0)
    lists = {name: (args.session / f"{name}.txt").read_text().splitlines() for name in ("depth", "ir")}
    empty = {row.split()[0]: row.split()[1] for row in lists["depth"] if row[:1] != "#"}
    last_lit = -np.inf
    # A Kinect II's emitter lights all of its images.
    shading = args.session / ("shading.txt" if session["light"]["kind"] == "lamp" else "ir.txt")
    for line in shading.read_text().splitlines():
        if not line or line.startswith("#"):
            continue
        time, name = line.split()[:2]
        pose = poses[f"{float(time):.6f}"]
        turn, camera = ate.rotation(pose[4:8]), pose[1:4]
        distance, normal, albedo = truth.seen(camera, directions @ turn.T)
        hit = np.isfinite(distance)
        point = directions * np.where(hit, distance, 1.0)[..., None]
        to_light = light - point
        squared = (to_light**2).sum(-1)
        to_light = to_light / np.sqrt(squared)[..., None]
        normal = normal @ turn
        direct = np.maximum((normal * to_light).sum(-1), 0) / squared
        linear = (np.asarray(Image.open(args.session / name), dtype=float) / full_scale) ** (1 / gamma)
        # The light's strength and the darkening towards the corners, by what the image shows of the known surface.
        usable = hit & (direct > 0.3 / squared) & (linear > 0.01) & (linear < 0.9)
        radius2 = (directions[..., :2] ** 2).sum(-1)
        log_gain = np.log(linear[usable] / (albedo * direct)[usable])
        slope, offset = np.polyfit(np.log1p(radius2[usable]), log_gain, 1)
        gain = np.exp(offset) * (1 + radius2) ** slope
        typical = np.median(direct[usable])
        from_sun = np.maximum(normal @ (unit(SUN) @ turn), 0)
        half = unit(to_light - unit(directions))
        lobe = np.maximum((normal * half).sum(-1), 0) ** args.shininess / squared * (direct > 0)
        ambient = np.where(hit, gain * albedo * typical * (args.ambient + args.sun * from_sun), 0)
        least, most = args.glossy
        is_glossy = hit & (albedo >= least) & (albedo <= most)
        glossy = np.where(is_glossy, gain * albedo * args.gloss * lobe, 0)
        save(args.out / name, linear + ambient + glossy, gamma, full_scale)
        if float(time) - last_lit > 0.2:
            # The first exposure of a pose, whose depth is as empty as that of those before it.
            for k in range(args.unlit, 0, -1):
                before, unlit = float(time) - k * FRAME_SECS, f"{name[:-4]}_unlit{k}.png"
                noise = random.normal(0, READ_NOISE, ambient.shape)
                save(args.out / unlit, np.maximum(ambient**gamma + noise, 0) ** (1 / gamma), gamma, full_scale)
                lists["ir"].append(f"{before:.6f} {unlit}")
                lists["depth"].append(f"{before:.6f} {empty[time]}")
        last_lit = float(time)
    if args.unlit:
        for name, rows in lists.items():
            heading, rows = rows[:1], sorted(rows[1:], key=lambda row: float(row.split()[0]))
            (args.out / f"{name}.txt").write_text("\n".join(heading + rows) + "\n")


if __name__ == "__main__":
    main()
