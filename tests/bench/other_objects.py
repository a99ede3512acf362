#!/usr/bin/env python3
"""Writes a simulated session of another object, as a Kinect II would have recorded it, with its true surface and poses.

    other_objects.py OBJECT OUT [--frames N] [--gamma G] [--lobe POWER] [--seed S]

Objects: `vase` (flutes, beads, painted bands, all round), `tablet` (wedges pressed into clay, from the front), `stained` (the
same, of an albedo that changes slowly), `gear` (sharp
teeth, letters cut into the top, from above), `figure` (folds, thin arms, all round). They stand on a grey table among boxes.

Light that goes over one other surface is in images and depth: rays on the true surface, phasors at 80 and 120 MHz over four points of a
pixel. Depth has noise that grows in the dark, a fixed pattern, 1 mm that changes with range, and no measurement on edges. Needs
numpy, scipy, pillow and open3d."""
import argparse
from pathlib import Path

import numpy as np
import open3d as o3d
from PIL import Image
from scipy.ndimage import gaussian_filter, maximum_filter, minimum_filter
from scipy.spatial.transform import Rotation

from board_light_law import rays
from other_surroundings import unit

CAMERA = {"width": 512, "height": 424, "fx": 365.6, "fy": 365.6, "cx": 256.8, "cy": 205.3,
          "k1": 0.0905, "k2": -0.2675, "p1": 0.0, "p2": 0.0, "k3": 0.0949}
LIGHT = np.array([0.052, 0.0, 0.004])
DEPTH_UNITS, FULL_SCALE, STEP = 5000.0, 65535.0, 128
# Linear intensity of white at 1 m, head on.
STRENGTH = 0.19
# Deviation of the depth of white at 1 m, metres, and the least.
DEPTH_NOISE, LEAST_NOISE = 1.3e-3, 0.4e-3
SPEED_OF_LIGHT, FREQUENCIES = 299792458.0, (80e6, 120e6)
# Below this a pixel has no depth; beyond this difference within it, either.
LEAST_LINEAR, EDGE_M = 0.004, 0.025
TABLE_ALBEDO = 0.3
# Light over other surfaces is gathered by so many rays: on the object at every pixel, on the rest at every fourth.
GATHERED, COARSE = 64, 4


def sheet(points, albedo, wraps=False):
    """A mesh of a grid of points (rows, columns, 3), whose last column meets the first if it wraps."""
    rows, columns = points.shape[:2]
    at = np.arange(rows * columns).reshape(rows, columns)
    if wraps:
        at = np.concatenate([at, at[:, :1]], 1)
    a, b, c, d = (corner.ravel() for corner in (at[:-1, :-1], at[:-1, 1:], at[1:, 1:], at[1:, :-1]))
    return points.reshape(-1, 3), np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]), np.broadcast_to(albedo, (rows, columns)).ravel()


def merged(parts):
    vertices, faces, albedo, n = [], [], [], 0
    for v, f, a in parts:
        vertices.append(v)
        faces.append(f + n)
        albedo.append(a)
        n += len(v)
    return np.concatenate(vertices), np.concatenate(faces), np.concatenate(albedo)


def turned(profile_r, z, theta, albedo):
    """A body round the z axis: radii (len(z), len(theta))."""
    points = np.stack([profile_r * np.cos(theta), profile_r * np.sin(theta), np.broadcast_to(z[:, None], profile_r.shape)], -1)
    return sheet(points, albedo, wraps=True)


def bumps(x, y, centres, radius, height):
    """Round bumps (negative: dents) at centres of a plane."""
    total = np.zeros(np.broadcast(x, y).shape)
    for cx, cy in centres:
        total = np.maximum(total, np.clip(1 - ((x - cx) ** 2 + (y - cy) ** 2) / radius**2, 0, None) ** 0.5)
    return height * total


def vase(random):
    z, theta = np.linspace(0, 0.24, 600), np.linspace(0, 2 * np.pi, 1500, endpoint=False)
    up = z[:, None] / 0.24
    r = 0.055 + 0.035 * np.sin(np.pi * np.clip(up * 1.15, 0, 1)) ** 1.2 - 0.012 * np.exp(-((up - 0.88) / 0.07) ** 2)
    belly = np.exp(-((up - 0.42) / 0.2) ** 4)
    r = r + 0.0008 * belly * np.cos(36 * (theta + 1.5 * up))
    around = theta * 0.08
    beads = [(0.08 * 2 * np.pi * i / 16, 0.172) for i in range(16)]
    r = r + bumps(around[None, :], z[:, None], beads, 0.005, 0.0015)
    albedo = np.where((np.abs(up - 0.62) < 0.05) | (np.abs(up - 0.17) < 0.03), 0.32, 0.7) * np.ones_like(theta)
    bottom_and_top = [turned(np.outer(np.linspace(1e-4, 1, 120), r[k]), np.full(120, z[k]), theta, albedo[k]) for k in (0, -1)]
    return merged([turned(r, z, theta, albedo), *bottom_and_top]), "round"


def wedges(x, y, random, pitch):
    """Wedges in rows, as a stylus leaves them: depth below the surface, positive."""
    depth = np.zeros_like(x)
    for row in np.arange(y.min() + pitch, y.max() - pitch / 2, pitch):
        for at in np.arange(x.min() + pitch, x.max() - pitch / 2, pitch * 0.75):
            turn = random.choice([0, np.pi / 2, np.pi / 4]) + random.normal(0, 0.1)
            length, deep = pitch * random.uniform(0.5, 0.9), random.uniform(0.0006, 0.0016)
            dx, dy = x - at - random.normal(0, 0.0005), y - row
            along, across = dx * np.cos(turn) + dy * np.sin(turn), -dx * np.sin(turn) + dy * np.cos(turn)
            share = np.clip((along + length / 2) / length, 0, 1) * (along < length / 2)
            depth = np.maximum(depth, deep * np.clip(share - np.abs(across) / (0.25 * length), 0, 1))
    return depth


def slab(front, x, y, thick, albedo, tilt, lift):
    """A slab whose front is a field of heights over x (columns) and y (rows), leant back by a tilt, degrees."""
    gx, gy = np.meshgrid(x, y)
    back_x, back_y = gx[:: len(y) - 1], gy[:: len(y) - 1]
    face = np.stack([gx, gy, front], -1)
    rim = np.concatenate([face[0], face[1:, -1], face[-1, -2::-1], face[-2:0:-1, 0]])
    behind = rim * [1, 1, 0] - [0, 0, thick]
    sides = np.stack([rim + (behind - rim) * s for s in np.linspace(0, 1, 60)])
    parts = [sheet(face, albedo), sheet(sides, float(np.mean(albedo)), wraps=True)]
    parts.append(sheet(np.stack([np.stack([back_x, back_y, np.full_like(back_x, -thick)], -1)])[0], float(np.mean(albedo))))
    v, f, a = merged(parts)
    v = Rotation.from_euler("x", tilt, degrees=True).apply(v)
    v[:, 2] += lift - v[:, 2].min()
    return v, f, a


def tablet(random, stained=0.0):
    x, y = np.linspace(-0.075, 0.075, 420), np.linspace(-0.1, 0.1, 560)
    gx, gy = np.meshgrid(x, y)
    pillow = 0.012 * (1 - (gx / 0.085) ** 4) * (1 - (gy / 0.115) ** 4)
    stain = gaussian_filter(random.normal(size=gx.shape), 60)
    albedo = 0.55 * (1 + stained * stain / np.abs(stain).max())
    crack = 0.001 * np.exp(-((gx - 0.02 * np.sin(gy * 40) - 0.02) / 0.0008) ** 2)
    return slab(pillow - wedges(gx, gy, random, 0.016) - crack, x, y, 0.025, albedo, 65, 0.0), "front"


def gear(random):
    theta = np.linspace(0, 2 * np.pi, 2400, endpoint=False)
    tooth = np.clip(1.6 * np.cos(20 * theta), -1, 1)
    rim = 0.094 + 0.006 * tooth
    z = np.linspace(0, 0.05, 110)
    side = turned(np.broadcast_to(rim, (len(z), len(theta))), z, theta, 0.5)
    s = np.linspace(1, 1e-4, 260)[:, None]
    px, py = s * rim * np.cos(theta), s * rim * np.sin(theta)
    far = np.hypot(px, py)
    top = 0.05 + 0.012 * np.clip((0.032 - far) / 0.001, 0, 1) - 0.008 * np.clip((0.014 - far) / 0.001, 0, 1)
    top -= 0.004 * np.clip(1 - np.maximum(np.abs(far - 0.06) - 0.015, 0) / 0.002, 0, 1)
    angle = np.mod(np.arctan2(py, px), 2 * np.pi)
    for k in range(14):
        local, kind = angle - (2 * np.pi * k / 14 + 0.2), k % 3
        u, w = local * 0.083, far - 0.083
        strokes = [np.abs(u) < 0.0007, np.abs(u - 0.5 * w) < 0.0007, np.abs(np.hypot(u, w) - 0.003) < 0.0007]
        top -= 0.0008 * (strokes[kind] & (np.abs(w) < 0.004) & (np.abs(u) < 0.006))
    cap = sheet(np.stack([px, py, top], -1), 0.5, wraps=True)
    return merged([side, cap]), "above"


def tube(start, end, radius, albedo):
    axis = (end - start) / np.linalg.norm(end - start)
    across = unit(np.cross(axis, [0.3, 0.9, 0.1]))
    other = np.cross(axis, across)
    s, theta = np.linspace(0, 1, 140)[:, None, None], np.linspace(0, 2 * np.pi, 90, endpoint=False)[None, :, None]
    round_end = radius * np.sqrt(np.clip(1 - np.clip(np.abs(s - 0.5) * 2 - 0.85, 0, None) ** 2 / 0.15**2, 1e-6, 1))
    return sheet(start + s * (end - start) + round_end * (np.cos(theta) * across + np.sin(theta) * other), albedo, wraps=True)


def ball(centre, radius, albedo):
    z, theta = np.cos(np.linspace(np.pi, 0, 160)), np.linspace(0, 2 * np.pi, 300, endpoint=False)
    nose = 0.15 * radius * np.exp(-((theta - 4.7) / 0.25) ** 2) * np.exp(-(z[:, None] / 0.25) ** 2)
    v, f, a = turned(np.sqrt(np.clip(1 - z**2, 1e-9, 1))[:, None] * radius + nose, z * radius, theta, albedo)
    return v + centre, f, a


def figure(random):
    z, theta = np.linspace(0, 0.19, 480), np.linspace(0, 2 * np.pi, 1000, endpoint=False)
    up = z[:, None] / 0.19
    r = 0.05 - 0.022 * np.sin(np.pi * np.clip((up - 0.1) / 0.9, 0, 1)) + 0.006 * np.exp(-((up - 0.85) / 0.12) ** 2)
    skirt = np.clip(1 - up / 0.6, 0, 1)
    r = r + 0.002 * skirt * np.cos(18 * theta + 3 * np.sin(5 * up)) + 0.0006 * np.exp(-((up - 0.7) / 0.1) ** 2) * np.cos(60 * up * np.pi)
    r = r * np.sqrt(np.clip((1.0 - up) / 0.06, 1e-6, 1))
    body = turned(r * (1 + 0.25 * np.cos(2 * theta)), z, theta, 0.65)
    head = ball(np.array([0, 0, 0.205]), 0.024, 0.65)
    hand = [np.array([side * 0.062, -0.02, 0.09]) for side in (-1, 1)]
    shoulder = [np.array([side * 0.03, 0.0, 0.165]) for side in (-1, 1)]
    arms = [tube(shoulder[k], hand[k], 0.0075, 0.65) for k in (0, 1)]
    return merged([body, head, *arms]), "round"


OBJECTS = {"vase": vase, "tablet": tablet, "stained": lambda random: tablet(random, 0.12), "gear": gear, "figure": figure}


def box(centre, size, turn, albedo):
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (0, 2)]) * size / 2
    faces = np.array([[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1], [2, 3, 7], [2, 7, 6], [1, 5, 7], [1, 7, 3], [0, 2, 6], [0, 6, 4]])
    corners = Rotation.from_euler("z", turn).apply(corners) + centre
    # Corners of its own for every face, so that edges stay sharp.
    return corners[faces].reshape(-1, 3), np.arange(36).reshape(-1, 3), np.full(36, albedo)


def surroundings(random):
    table = np.array([[-0.8, -0.8, 0], [0.8, -0.8, 0], [0.8, 0.8, 0], [-0.8, 0.8, 0]])
    parts = [(table, np.array([[0, 1, 2], [0, 2, 3]]), np.full(4, TABLE_ALBEDO))]
    for k in range(9):
        angle, far = 2 * np.pi * (k + random.uniform(0, 0.6)) / 9, random.uniform(0.3, 0.65)
        size = random.uniform([0.06, 0.06, 0.03], [0.14, 0.14, 0.12])
        parts.append(box(np.array([far * np.cos(angle), far * np.sin(angle), 0]), size, random.uniform(0, 3), random.uniform(0.25, 0.5)))
    return merged(parts)


def normals_of(v, f):
    face = np.cross(v[f[:, 1]] - v[f[:, 0]], v[f[:, 2]] - v[f[:, 0]])
    n = np.zeros_like(v)
    for k in range(3):
        for d in range(3):
            n[:, d] += np.bincount(f[:, k], weights=face[:, d], minlength=len(v))
    return unit(n)


def path(kind, n, centre, random):
    """World from camera for each frame: a hand that goes round, with slow wavering."""
    s = np.linspace(0, 1, n)
    waver = gaussian_filter(random.normal(size=(n, 6)), (n / 18, 0))
    waver /= np.abs(waver).max(0)
    if kind == "round":
        azimuth, lift = 2 * np.pi * s * 1.05 - np.pi / 2, np.radians(35 + 20 * np.sin(2 * np.pi * 2.5 * s))
    elif kind == "above":
        azimuth, lift = 2 * np.pi * s * 1.02, np.radians(50 + 18 * np.sin(2 * np.pi * 2 * s))
    else:
        azimuth, lift = -np.pi / 2 + np.radians(45) * np.sin(2 * np.pi * s), np.radians(28 + 18 * np.cos(2 * np.pi * 2 * s))
    radius = 0.6 + 0.06 * waver[:, 0]
    at = centre + radius[:, None] * np.stack([np.cos(lift) * np.cos(azimuth), np.cos(lift) * np.sin(azimuth), np.sin(lift)], 1)
    target = centre + 0.02 * waver[:, 1:4]
    poses = np.tile(np.eye(4), (n, 1, 1))
    forward = unit(target - at)
    right = unit(np.cross(forward, [0, 0, 1.0]))
    frame = np.stack([right, np.cross(forward, right), forward], -1)
    poses[:, :3, :3] = frame @ Rotation.from_euler("z", 0.25 * waver[:, 4:5]).as_matrix()
    poses[:, :3, 3] = at
    return poses


class Scene:
    def __init__(self, mesh):
        self.v, self.f, self.albedo = mesh
        self.n = normals_of(self.v, self.f)
        self.cast = o3d.t.geometry.RaycastingScene(nthreads=2)
        self.cast.add_triangles(o3d.core.Tensor(self.v.astype(np.float32)), o3d.core.Tensor(self.f.astype(np.uint32)))

    def hit(self, origin, direction):
        ray = np.concatenate(np.broadcast_arrays(origin, direction), -1).astype(np.float32)
        found = self.cast.cast_rays(o3d.core.Tensor(ray))
        t, face, uv = (found[key].numpy() for key in ("t_hit", "primitive_ids", "primitive_uvs"))
        corners = self.f[np.where(np.isfinite(t), face, 0)]
        weights = np.stack([1 - uv.sum(-1), uv[..., 0], uv[..., 1]], -1)
        normal = unit((self.n[corners] * weights[..., None]).sum(-2))
        normal *= -np.sign((normal * direction).sum(-1, keepdims=True))
        return t, normal, (self.albedo[corners] * weights).sum(-1)

    def lit(self, point, normal, light, axis, power):
        """Irradiance by the light and the way from it."""
        to_light = light - point
        far = np.linalg.norm(to_light, axis=-1)
        to_light = to_light / far[..., None]
        ray = np.concatenate([point + 1e-4 * normal, to_light], -1).astype(np.float32)
        # What lies beyond the light does not hide it.
        free = self.cast.cast_rays(o3d.core.Tensor(ray))["t_hit"].numpy() > far - 2e-4
        emitted = np.maximum(-(to_light @ axis), 0) ** power
        return free * emitted * np.maximum((normal * to_light).sum(-1), 0) / far**2, far


def gathered(scene, point, normal, light, axis, power, random):
    """Irradiance over one other surface at points (n, 3), and the way from the light on it.

    All points gather by the same directions about their normals, so that what is missed does not change from pixel to pixel."""
    k = np.arange(GATHERED)
    far, turn = np.sqrt((k + 0.5) / GATHERED), 2 * np.pi * (k * 0.6180339887 + random.random())
    across = unit(np.cross(normal, np.where(np.abs(normal[:, :1]) < 0.7, [[1.0, 0, 0]], [[0, 1.0, 0]])))
    other = np.cross(normal, across)
    local = np.stack([far * np.cos(turn), far * np.sin(turn), np.sqrt(1 - far**2)], -1)
    out = local[:, 0, None] * across[:, None] + local[:, 1, None] * other[:, None] + local[:, 2, None] * normal[:, None]
    t, n, albedo = scene.hit((point + 1e-4 * normal)[:, None], out)
    is_hit = np.isfinite(t)
    t = np.where(is_hit, t, 1.0)
    irradiance, way = scene.lit(point[:, None] + t[..., None] * out, n, light, axis, power)
    sent = irradiance * albedo * is_hit
    return sent.mean(-1), ((way + t) * sent).sum(-1) / np.maximum(sent.sum(-1), 1e-12)


def exposure(scene, pose, args, pattern, random):
    """Linear image, and depth along the axis, metres, 0 where there is none."""
    turn, at = pose[:3, :3], pose[:3, 3]
    light, axis = at + turn @ LIGHT, turn[:, 2]
    height, width = CAMERA["height"], CAMERA["width"]
    directions = pattern["rays"]
    total = np.zeros((height, width))
    phasors = [np.zeros((height, width), complex) for _ in FREQUENCIES]
    nearest, farthest, reference = np.full((height, width), np.inf), np.zeros((height, width)), None
    slant = np.linalg.norm(directions, axis=-1)
    over_others, longer = None, None
    for du, dv in ((-0.25, -0.25), (0.25, -0.25), (-0.25, 0.25), (0.25, 0.25)):
        ray = directions + du * pattern["by_u"] + dv * pattern["by_v"]
        ray = unit(ray) @ turn.T
        t, normal, albedo = scene.hit(at, ray)
        seen = np.isfinite(t)
        t = np.where(seen, t, 5.0)
        point = at + t[..., None] * ray
        direct, far = scene.lit(point, normal, light, axis, args.lobe)
        if over_others is None:
            reference = t
            every = (slice(None, None, COARSE),) * 2
            shape = point[every].shape[:2]
            coarse = gathered(scene, point[every].reshape(-1, 3), normal[every].reshape(-1, 3), light, axis, args.lobe, random)
            over_others, longer = (np.kron(part.reshape(shape), np.ones((COARSE, COARSE)))[:height, :width] for part in coarse)
            on_object = seen & ((point > pattern["low"]) & (point < pattern["high"])).all(-1)
            over_others, longer = gaussian_filter(over_others, 3), gaussian_filter(longer, 3)
            over_others[on_object], longer[on_object] = gathered(scene, point[on_object], normal[on_object], light, axis, args.lobe, random)
        gone = np.where(seen, albedo * (direct + over_others), 0)
        total += gone / 4
        for k, frequency in enumerate(FREQUENCIES):
            per_metre = 2 * np.pi * frequency / SPEED_OF_LIGHT
            phasors[k] += np.where(seen, albedo * direct * np.exp(1j * per_metre * (t + far - 2 * reference)), 0)
            phasors[k] += np.where(seen, albedo * over_others * np.exp(1j * per_metre * (t + longer - 2 * reference)), 0)
        nearest, farthest = np.minimum(nearest, np.where(seen, t, 9)), np.maximum(farthest, np.where(seen, t, 9))
    off = np.mean([np.angle(p) / (4 * np.pi * f / SPEED_OF_LIGHT) for p, f in zip(phasors, FREQUENCIES)], 0)
    # The way from the light is not that to the camera by what the sensor's own offset takes off.
    distance = reference + off
    own = np.linalg.norm(directions * (reference / slant)[..., None] - LIGHT, axis=-1) - reference
    distance -= own / 2
    linear = STRENGTH * total * pattern["lens"]
    z = distance / slant
    sigma = np.maximum(DEPTH_NOISE * STRENGTH * 0.8 / np.maximum(linear, 1e-6), LEAST_NOISE)
    noise = random.normal(size=z.shape) * sigma
    z = z + gaussian_filter(noise, 0.6) * 1.4 + pattern["fixed_m"] + 0.001 * np.sin(2 * np.pi * distance / 0.9)
    edge = (farthest - nearest > EDGE_M) | (maximum_filter(farthest, 3) - minimum_filter(nearest, 3) > 0.06)
    edge &= ~((farthest - nearest < EDGE_M) & (random.random(z.shape) < 0.4))
    valid = (farthest < 8) & (linear > LEAST_LINEAR) & (linear < 0.98) & ~edge & (z > 0.4)
    return linear, np.where(valid, z, 0)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("object", choices=sorted(OBJECTS))
    parser.add_argument("out", type=Path, help="a folder that is not there yet")
    parser.add_argument("--frames", type=int, default=150)
    parser.add_argument("--gamma", type=float, default=0.87)
    parser.add_argument("--lobe", type=float, default=1.5, help="power of the cosine by which the emitter's light falls")
    parser.add_argument("--lens", type=float, default=2.0, help="power of the cosine by which the lens darkens")
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()

    random = np.random.default_rng(args.seed)
    (v, f, albedo), kind = OBJECTS[args.object](random)
    scene = Scene(merged([(v, f, albedo), surroundings(random)]))
    directions = rays(CAMERA)
    pattern = {
        "rays": directions,
        "by_u": np.gradient(directions, axis=1),
        "by_v": np.gradient(directions, axis=0),
        "lens": (1 + (directions[..., :2] ** 2).sum(-1)) ** (-0.5 * args.lens),
        "fixed_m": 0.0004 * random.normal(size=directions.shape[:2]) + 0.004 * gaussian_filter(random.normal(size=directions.shape[:2]), 12),
        "low": v.min(0) + [-0.01, -0.01, 0.0005],
        "high": v.max(0) + 0.01,
        "gain": 1 + 0.005 * random.normal(size=directions.shape[:2]),
    }
    for name in ("depth", "ir"):
        (args.out / name).mkdir(parents=True, exist_ok=False)
    poses = path(kind, args.frames, (v.min(0) + v.max(0)) / 2, random)
    lists = {"depth": ["# timestamp filename"], "ir": ["# timestamp filename"], "groundtruth": ["# timestamp tx ty tz qx qy qz qw (world from camera)"]}
    for k, pose in enumerate(poses):
        time = f"{100 + k / 30:.6f}"
        linear, z = exposure(scene, pose, args, pattern, random)
        clean = np.minimum(linear * pattern["gain"], 1.0) ** args.gamma
        noisy = np.clip(clean + random.normal(size=clean.shape) * np.sqrt(0.002**2 + 5e-5 * clean), 0, 1)
        stepped = np.minimum(np.round(noisy * FULL_SCALE / STEP) * STEP, FULL_SCALE)
        Image.fromarray(stepped.astype(np.uint16)).save(args.out / f"ir/{k:05d}.png")
        Image.fromarray(np.round(z * DEPTH_UNITS).astype(np.uint16)).save(args.out / f"depth/{k:05d}.png")
        for name in ("depth", "ir"):
            lists[name].append(f"{time} {name}/{k:05d}.png")
        turn = Rotation.from_matrix(pose[:3, :3]).as_quat()
        lists["groundtruth"].append(" ".join([time, *(f"{x:.9f}" for x in (*pose[:3, 3], *turn))]))
    for name, rows in lists.items():
        (args.out / f"{name}.txt").write_text("\n".join(rows) + "\n")
    np.savez_compressed(args.out / "groundtruth_mesh.npz", v=v.astype(np.float32), f=f.astype(np.int32),
                        n=normals_of(v, f).astype(np.float16), albedo=albedo.astype(np.float16))
    camera = "\n".join(f"{key} = {value}" for key, value in CAMERA.items())
    low, high = v.min(0) + [0, 0, 0.01], v.max(0) + 0.005
    (args.out / "session.toml").write_text(
        f'name = "{args.object}-k2"\nsensor = "kinect2"\ndepth_units_per_metre = {DEPTH_UNITS}\nir_full_scale = {FULL_SCALE}\n\n'
        f"[ir_camera]\n{camera}\n\n[light]\nposition = {LIGHT.tolist()}\nkind = \"emitter\"\n\n"
        f"[object]\nmin = {low.round(4).tolist()}\nmax = {high.round(4).tolist()}\n")


if __name__ == "__main__":
    main()
