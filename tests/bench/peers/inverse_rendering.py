#!/usr/bin/env python3
"""An inverse renderer, Mitsuba 3, on the problem that refinement solves: per-vertex displacements from shading images.

    inverse_rendering.py INPUTS OUT.ply [--epochs N] [--rate R] [--samples N] [--stay MM]

INPUTS is the folder that the example `peer_inputs` writes: the remeshed base surface, from which both start, and what Relief came
to know of every view, so that the peer has its poses, gains and albedos for nothing. The surface is displaced along its normals by
Adam, one view a step in random order, preconditioned ("large steps"); rendered are flat facets under a point light with
shadows, integrated over pixels, against the linear image with the light's lobe taken off at the depth of the base surface. Light over
other surfaces is not rendered. Prints processor seconds and writes the mesh. Needs mitsuba, cholespy, numpy and scipy, and an LLVM of
version 19 or newer in DRJIT_LIBLLVM_PATH."""
import argparse
import json
import pathlib
import time

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.ndimage import map_coordinates

mi.set_variant("llvm_ad_rgb")

# Mitsuba's cameras look along z too, with x to the left and y up.
MITSUBA_AXES = np.diag([-1.0, -1.0, 1.0, 1.0])
# Smoothness of the preconditioner, in Laplacians of the mesh.
LARGE_STEPS = 10.0
# A residual's deviation: what the light model leaves unexplained on these scans, as a share of the mean intensity.
UNEXPLAINED = 0.026


def pinhole_coordinates(camera):
    """Where the pixels of a camera without distortion, its axis in the middle, lie in the distorted image."""
    focal, width, height = camera["fx"], camera["width"], camera["height"]
    u, v = np.meshgrid(np.arange(width), np.arange(height))
    x, y = (u - (width - 1) / 2) / focal, (v - (height - 1) / 2) / focal
    r2 = x * x + y * y
    radial = 1 + r2 * (camera["k1"] + r2 * (camera["k2"] + r2 * camera["k3"]))
    xd = x * radial + 2 * camera["p1"] * x * y + camera["p2"] * (r2 + 2 * x * x)
    yd = y * radial + camera["p1"] * (r2 + 2 * y * y) + 2 * camera["p2"] * x * y
    return np.stack([yd * camera["fy"] + camera["cy"], xd * focal + camera["cx"]])


class View:
    """One view: its sensor over the part of the image where the object is, its light, and what was seen there."""

    def __init__(self, number, folder, views, coordinates, scene, vertices):
        camera = views["camera"]
        pose = np.array(views["world_from_cameras"][number]).reshape(4, 4)
        light = np.array(views["light_position_m"])
        self.light = pose[:3, :3] @ light + pose[:3, 3]
        seen = (vertices - pose[:3, 3]) @ pose[:3, :3]
        size = np.array([camera["width"], camera["height"]])
        pixels = seen[:, :2] / seen[:, 2:] * camera["fx"] + (size - 1) / 2
        low = np.clip(np.floor(pixels.min(0)).astype(int) - 1, 0, size - 1)
        high = np.clip(np.ceil(pixels.max(0)).astype(int) + 2, 1, size)
        (self.width, self.height), (left, top) = high - low, low
        self.sensor = mi.load_dict({
            "type": "perspective", "fov_axis": "x", "fov": float(np.degrees(2 * np.arctan(size[0] / 2 / camera["fx"]))),
            "to_world": mi.ScalarTransform4f(pose @ MITSUBA_AXES), "near_clip": 0.01, "far_clip": 100.0,
            "film": {"type": "hdrfilm", "pixel_format": "luminance", "rfilter": {"type": "box"},
                     "width": int(size[0]), "height": int(size[1]), "crop_offset_x": int(left), "crop_offset_y": int(top),
                     "crop_width": int(self.width), "crop_height": int(self.height)},
            "sampler": {"type": "independent"}})
        image = np.fromfile(folder / f"linear-{number:03}.f32", "<f4").reshape(size[1], size[0])
        image = map_coordinates(image, coordinates, order=1, cval=np.nan)[top:high[1], left:high[0]]
        place = self.places(scene, pose, camera["fx"], size, low)
        ray = place - light
        lobe = np.maximum(ray[..., 2] / np.linalg.norm(ray, axis=-1), 1e-3) ** views["light_lobe_power"]
        usable = np.isfinite(image) & np.isfinite(lobe)
        self.target = mi.TensorXf(np.where(usable, image / lobe, 0.0)[..., None].astype(np.float32))
        self.usable = mi.TensorXf(usable[..., None].astype(np.float32))
        self.n_usable = int(usable.sum())

    def places(self, scene, pose, focal, size, low):
        """The base surface by pixel, camera frame, metres; NaN where there is none."""
        u, v = np.meshgrid(low[0] + np.arange(self.width), low[1] + np.arange(self.height))
        along = np.stack([(u - (size[0] - 1) / 2) / focal, (v - (size[1] - 1) / 2) / focal, np.ones(u.shape)], -1)
        world = (along.reshape(-1, 3) @ pose[:3, :3].T).T.astype(np.float32)
        hit = scene.ray_intersect_preliminary(mi.Ray3f(mi.Point3f(*map(float, pose[:3, 3])), mi.Vector3f(world)))
        depth = np.where(np.isfinite(np.array(hit.t)), np.array(hit.t), np.nan)
        return along * depth.reshape(u.shape)[..., None]


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("inputs", type=pathlib.Path)
    parser.add_argument("out", type=pathlib.Path)
    parser.add_argument("--epochs", type=int, default=20)
    parser.add_argument("--rate", type=float, default=8e-3, help="of Adam, millimetres")
    parser.add_argument("--samples", type=int, default=4, help="rays a pixel")
    parser.add_argument("--stay", type=float, help="deviation of displacements, millimetres, by a prior that holds them; none without")
    args = parser.parse_args()
    views = json.loads((args.inputs / "views.json").read_text())
    albedo = np.fromfile(args.inputs / "albedo.f32", "<f4")
    brightest = float(albedo.max()) * 1.01
    mesh = mi.load_dict({"type": "ply", "filename": str(args.inputs / "base.ply"), "face_normals": True,
                         "bsdf": {"type": "diffuse", "reflectance": {"type": "mesh_attribute", "name": "vertex_albedo"}}})
    mesh.add_attribute("vertex_albedo", 1, albedo / brightest)
    scene = mi.load_dict({"type": "scene", "integrator": {"type": "direct"}, "object": mesh,
                          "lamp": {"type": "point", "position": [0.0, 0.0, 0.0],
                                   "intensity": {"type": "uniform", "value": float(np.pi * brightest)}}})
    params = mi.traverse(scene)
    name = next(key for key in params.keys() if key.endswith("vertex_positions"))
    faces = np.array(params[name.replace("vertex_positions", "faces")]).reshape(-1, 3)
    base = np.array(params[name]).reshape(-1, 3).astype(np.float64)
    corners = base[faces]
    area = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = np.zeros_like(base)
    for corner in range(3):
        np.add.at(normals, faces[:, corner], area)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-20)
    coordinates = pinhole_coordinates(views["camera"])
    all_views = [View(number, args.inputs, views, coordinates, scene, base) for number in range(len(views["world_from_cameras"]))]
    all_views = [view for view in all_views if view.n_usable > 100]

    intensities = [float(dr.sum(view.target, axis=None).array[0]) / view.n_usable for view in all_views]
    variance = (UNEXPLAINED * np.mean(intensities)) ** 2

    start = time.process_time()
    base_points, base_normals = mi.Point3f(base.T.astype(np.float32)), mi.Vector3f(normals.T.astype(np.float32))
    large_steps = mi.ad.LargeSteps(params[name], params[name.replace("vertex_positions", "faces")], LARGE_STEPS)
    # The preconditioner works on three numbers a vertex; the displacement, millimetres, is each of them's mean.
    adam = mi.ad.Adam(lr=args.rate, uniform=True)
    adam["u"] = large_steps.to_differential(dr.zeros(mi.Float, 3 * len(base)))
    random = np.random.default_rng(0)
    for epoch in range(args.epochs):
        total = 0.0
        for step, number in enumerate(random.permutation(len(all_views))):
            view = all_views[number]
            moved = dr.unravel(mi.Vector3f, large_steps.from_differential(adam["u"]))
            displacement_m = (moved.x + moved.y + moved.z) / 3 * 1e-3
            params[name] = dr.ravel(base_points + base_normals * displacement_m)
            params["lamp.position"] = mi.Point3f(*map(float, view.light))
            params.update()
            seed = epoch * len(all_views) + step
            image = mi.render(scene, params, sensor=view.sensor, spp=args.samples, seed=seed)
            error = (image - view.target) * view.usable
            loss = dr.sum(dr.square(error), axis=None) / view.n_usable
            misfit = loss
            if args.stay:
                held = dr.sum(dr.square(displacement_m * (1e3 / args.stay)))
                loss = loss + held * (variance / (view.n_usable * len(all_views)))
            dr.backward(loss)
            adam.step()
            total += float(misfit.array[0])
        print(f"epoch {epoch + 1}: mean square {total / len(all_views):.3e}, {time.process_time() - start:.0f} s processor", flush=True)
    moved = dr.unravel(mi.Vector3f, large_steps.from_differential(adam["u"]))
    params[name] = dr.ravel(base_points + base_normals * ((moved.x + moved.y + moved.z) / 3 * 1e-3))
    params.update()
    print(f"{len(base)} vertices, {len(all_views)} views, {args.epochs} epochs: {time.process_time() - start:.1f} s processor")
    mesh.write_ply(str(args.out))


if __name__ == "__main__":
    main()
