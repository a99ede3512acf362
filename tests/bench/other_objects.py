#!/usr/bin/env python3
"""Writes a simulated session of another object, as a Kinect would have recorded it, with its true surface and poses.

    other_objects.py OBJECT OUT [--sensor kinect1] [--frames N] [--gamma G] [--lobe POWER] [--lens POWER] [--tremor MM]
                     [--bounces N] [--seed S] [--turns N] [--path KIND]

Objects: `vase` (flutes, beads, painted bands, all round), `tablet` (wedges pressed into clay, from the front), `stained` (the
same, of an albedo that changes slowly), `painted` (the same, with an ornament), `gear` (sharp
teeth, letters cut into the top, from above), `figure` (folds, thin arms, all round), `bowl` (deep, light goes from wall to wall,
from above), `chest` (sharp edges, frames and strokes, all round), `rock` (rough, all round), `mug` (thin walls, a handle, all round),
`medal` (flat, a low relief, from above), or a folder: the object of that session's truth, recorded once more. They stand on a grey
table among boxes.

Light that goes over other surfaces is in the images: rays on the true surface, over four points of a pixel; over two and more of them as
places spread over the object gather it.

Kinect II: that light is in the depth too, as phasors at 80 and 120 MHz. Depth has noise that grows in the dark, a fixed pattern,
1 mm that changes with range, and no measurement on edges.

Kinect I: depth has steps of 1/8 pixel of disparity, averaged over a window of 9 x 7, correlated noise, an error of scale that
changes slowly over the image, and no measurement in the projector's shadow. Every tenth frame a lamp is on instead for four exposures, the sensor at rest.

Needs numpy, scipy, pillow and open3d."""
import argparse
from pathlib import Path

import numpy as np
import open3d as o3d
from PIL import Image
from scipy.ndimage import gaussian_filter, maximum_filter, minimum_filter, uniform_filter
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from board_light_law import rays
from object_shapes import OBJECTS, merged, surroundings
from other_surroundings import unit

# Light over other surfaces is gathered by so many rays: on the object at every pixel, on the rest at every fourth.
GATHERED, COARSE = 64, 4
# Light over two surfaces and more is known at places of the object so far apart, metres, and of other normals by so much.
SPREAD_M, NORMAL_M = 0.006, 0.01
# A pixel is integrated by two points an axis so far from its middle (Gauss), which blur as much as all of it does.
GAUSS = 0.5 / 3**0.5
# A hand that trembles turns by so much while it moves by a millimetre.
TREMOR_RAD_PER_MM = 0.003


def normals_of(v, f):
    face = np.cross(v[f[:, 1]] - v[f[:, 0]], v[f[:, 2]] - v[f[:, 0]])
    n = np.zeros_like(v)
    for k in range(3):
        for d in range(3):
            n[:, d] += np.bincount(f[:, k], weights=face[:, d], minlength=len(v))
    return unit(n)


def path(kind, n, turns, centre, reach, tremor_mm, random):
    """World from camera for each frame: a hand that goes round at a reach in metres, with slow wavering, and trembles by so much from frame to
    frame."""
    s = np.linspace(0, 1, n)
    waver = gaussian_filter(random.normal(size=(n, 6)), (n / 18, 0))
    waver /= np.abs(waver).max(0)
    if kind == "round":
        azimuth, lift = 2 * np.pi * s * 1.05 * turns - np.pi / 2, np.radians(35 + 20 * np.sin(2 * np.pi * 2.5 * s))
    elif kind == "above":
        azimuth, lift = 2 * np.pi * s * 1.02 * turns, np.radians(50 + 18 * np.sin(2 * np.pi * 2 * s))
    else:
        azimuth, lift = -np.pi / 2 + np.radians(45) * np.sin(2 * np.pi * s), np.radians(28 + 18 * np.cos(2 * np.pi * 2 * s))
    radius = reach + 0.06 * waver[:, 0]
    at = centre + radius[:, None] * np.stack([np.cos(lift) * np.cos(azimuth), np.cos(lift) * np.sin(azimuth), np.sin(lift)], 1)
    target = centre + 0.02 * waver[:, 1:4]
    poses = np.tile(np.eye(4), (n, 1, 1))
    forward = unit(target - at)
    right = unit(np.cross(forward, [0, 0, 1.0]))
    frame = np.stack([right, np.cross(forward, right), forward], -1)
    poses[:, :3, :3] = frame @ Rotation.from_euler("z", 0.25 * waver[:, 4:5]).as_matrix()
    poses[:, :3, 3] = at
    if tremor_mm:
        shake = gaussian_filter(random.normal(size=(n, 6)), (1, 0))
        shake *= np.repeat([1e-3, TREMOR_RAD_PER_MM], 3) * tremor_mm / shake.std(0)
        poses[:, :3, 3] += shake[:, :3]
        poses[:, :3, :3] = poses[:, :3, :3] @ Rotation.from_rotvec(shake[:, 3:]).as_matrix()
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
        return t, normal, (self.albedo[corners] * weights).sum(-1), face

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


def about(normal, turned):
    """Directions (n, GATHERED, 3) about normals (n, 3), as many as the light that comes from there counts.

    All points gather by the same ones, so that what is missed does not change from pixel to pixel."""
    k = np.arange(GATHERED)
    far, turn = np.sqrt((k + 0.5) / GATHERED), 2 * np.pi * (k * 0.6180339887 + turned)
    across = unit(np.cross(normal, np.where(np.abs(normal[:, :1]) < 0.7, [[1.0, 0, 0]], [[0, 1.0, 0]])))
    other = np.cross(normal, across)
    local = np.stack([far * np.cos(turn), far * np.sin(turn), np.sqrt(1 - far**2)], -1)
    return local[:, 0, None] * across[:, None] + local[:, 1, None] * other[:, None] + local[:, 2, None] * normal[:, None]


class Gathering:
    """Irradiance over other surfaces. What the surroundings get that way they do not send on."""

    def __init__(self, scene, n_faces, bounces, random):
        self.scene, self.bounces, self.random = scene, bounces, random
        corners = scene.v[scene.f[:n_faces]]
        centre, normal = corners.mean(1), unit(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))
        side = 2 * np.abs(normal).argmax(1) + (normal.max(1) > -normal.min(1))
        _, places = np.unique(np.column_stack([np.floor(centre / SPREAD_M), side]), axis=0, return_index=True)
        like = np.hstack([centre, NORMAL_M * normal])
        # The last place is that of the surroundings.
        self.place = np.full(len(scene.f), len(places))
        self.place[:n_faces] = cKDTree(like[places]).query(like, workers=2)[1]
        self.point, self.normal = centre[places], normal[places]

    def lit_by(self, light, axis, power):
        """Makes ready for a light: irradiance over two surfaces and more at the places, and the way of it."""
        self.light = light, axis, power
        self.sent, self.way = np.zeros(len(self.point) + 1), np.zeros(len(self.point) + 1)
        if self.bounces > 1:
            hits = self.hits(self.point, self.normal)
        for _ in range(1, self.bounces):
            self.sent[:-1], self.way[:-1] = self.summed(*hits)

    def hits(self, point, normal):
        out = about(normal, self.random.random())
        t, n, albedo, face = self.scene.hit((point + 1e-4 * normal)[:, None], out)
        albedo = albedo * np.isfinite(t)
        t = np.where(np.isfinite(t), t, 1.0)
        direct, way = self.scene.lit(point[:, None] + t[..., None] * out, n, *self.light)
        return t, albedo, np.where(albedo > 0, face.astype(int), -1), direct, way

    def summed(self, t, albedo, face, direct, way):
        place = self.place[face]
        straight, over_others = albedo * direct, albedo * self.sent[place]
        ways = (way + t) * straight + (self.way[place] + t) * over_others
        sent = straight + over_others
        return sent.mean(-1), ways.sum(-1) / np.maximum(sent.sum(-1), 1e-12)

    def at(self, point, normal):
        """Irradiance at points (n, 3), and the way from the light on it."""
        return self.summed(*self.hits(point, normal))


class Kinect:
    """What both cameras have: rays of the pixels, a light fixed to the camera, a lens that darkens towards the corners."""

    def __init__(self, scene, gathering, args, low, high, random):
        self.scene, self.gathering, self.args, self.low, self.high, self.random = scene, gathering, args, low, high, random
        self.rays = rays(self.CAMERA)
        self.slant = np.linalg.norm(self.rays, axis=-1)
        self.lens = (1 + (self.rays[..., :2] ** 2).sum(-1)) ** (-0.5 * args.lens)
        self.gain = 1 + 0.005 * random.normal(size=self.slant.shape)

    def light_of_pixels(self, pose):
        """Four points of every pixel: distance, whether there is a surface, its distance from the light, light that comes straight, light over
        other surfaces and the way of that."""
        turn, at = pose[:3, :3], pose[:3, 3]
        light, axis = at + turn @ self.LIGHT, turn[:, 2]
        self.gathering.lit_by(light, axis, self.args.lobe)
        height, width = self.slant.shape
        by_u, by_v = np.gradient(self.rays, axis=1), np.gradient(self.rays, axis=0)
        over_others, longer = None, None
        for du, dv in ((-GAUSS, -GAUSS), (GAUSS, -GAUSS), (-GAUSS, GAUSS), (GAUSS, GAUSS)):
            ray = unit(self.rays + du * by_u + dv * by_v) @ turn.T
            t, normal, albedo, _ = self.scene.hit(at, ray)
            seen = np.isfinite(t)
            t = np.where(seen, t, 5.0)
            point = at + t[..., None] * ray
            direct, far = self.scene.lit(point, normal, light, axis, self.args.lobe)
            if over_others is None:
                every = (slice(None, None, COARSE),) * 2
                shape = point[every].shape[:2]
                coarse = self.gathering.at(point[every].reshape(-1, 3), normal[every].reshape(-1, 3))
                over_others, longer = (np.kron(part.reshape(shape), np.ones((COARSE, COARSE)))[:height, :width] for part in coarse)
                on_object = seen & ((point > self.low) & (point < self.high)).all(-1)
                over_others, longer = gaussian_filter(over_others, 3), gaussian_filter(longer, 3)
                over_others[on_object], longer[on_object] = self.gathering.at(point[on_object], normal[on_object])
            yield t, seen, far, np.where(seen, albedo * direct, 0), np.where(seen, albedo * over_others, 0), longer

    def observed(self, linear):
        """Counts of an image of linear intensity."""
        clean = np.minimum(linear * self.gain, 1.0) ** self.args.gamma
        noisy = np.clip(clean + self.random.normal(size=clean.shape) * np.sqrt(0.002**2 + self.SHOT * clean), 0, 1)
        return np.minimum(np.round(noisy * self.FULL_SCALE / self.STEP) * self.STEP, self.FULL_SCALE).astype(np.uint16)


class KinectTwo(Kinect):
    NAME, REACH_M, GAMMA, LENS, LOBE = "kinect2", 0.6, 0.87, 2.0, 1.5
    CAMERA = {"width": 512, "height": 424, "fx": 365.6, "fy": 365.6, "cx": 256.8, "cy": 205.3,
              "k1": 0.0905, "k2": -0.2675, "p1": 0.0, "p2": 0.0, "k3": 0.0949}
    LIGHT, KIND = np.array([0.052, 0.0, 0.004]), "emitter"
    DEPTH_UNITS, FULL_SCALE, STEP, SHOT = 5000.0, 65535.0, 128, 5e-5
    # Linear intensity of white at 1 m, head on.
    STRENGTH = 0.19
    # Deviation of the depth of white at 1 m, metres, and the least.
    DEPTH_NOISE, LEAST_NOISE = 1.3e-3, 0.4e-3
    SPEED_OF_LIGHT, FREQUENCIES = 299792458.0, (80e6, 120e6)
    # Below this a pixel has no depth; beyond this difference within it, either.
    LEAST_LINEAR, EDGE_M = 0.004, 0.025

    def __init__(self, *given):
        super().__init__(*given)
        pattern = self.random.normal(size=(2, *self.slant.shape))
        self.fixed_m = 0.0004 * pattern[0] + 0.004 * gaussian_filter(pattern[1], 12)

    def frames(self, k, pose):
        """Seconds after the frame before, name, depth in metres (0: none), image of each frame that frame k of the path becomes."""
        height, width = self.slant.shape
        total, reference = np.zeros((height, width)), None
        phasors = [np.zeros((height, width), complex) for _ in self.FREQUENCIES]
        nearest, farthest = np.full((height, width), np.inf), np.zeros((height, width))
        for t, seen, far, direct, over_others, longer in self.light_of_pixels(pose):
            reference = t if reference is None else reference
            total += (direct + over_others) / 4
            for n, frequency in enumerate(self.FREQUENCIES):
                per_metre = 2 * np.pi * frequency / self.SPEED_OF_LIGHT
                phasors[n] += direct * np.exp(1j * per_metre * (t + far - 2 * reference))
                phasors[n] += over_others * np.exp(1j * per_metre * (t + longer - 2 * reference))
            nearest, farthest = np.minimum(nearest, np.where(seen, t, 9)), np.maximum(farthest, np.where(seen, t, 9))
        off = np.mean([np.angle(p) / (4 * np.pi * f / self.SPEED_OF_LIGHT) for p, f in zip(phasors, self.FREQUENCIES)], 0)
        # The way from the light is not that to the camera by what the sensor's own offset takes off.
        distance = reference + off
        own = np.linalg.norm(self.rays * (reference / self.slant)[..., None] - self.LIGHT, axis=-1) - reference
        distance -= own / 2
        linear = self.STRENGTH * total * self.lens
        z = distance / self.slant
        sigma = np.maximum(self.DEPTH_NOISE * self.STRENGTH * 0.8 / np.maximum(linear, 1e-6), self.LEAST_NOISE)
        noise = self.random.normal(size=z.shape) * sigma
        z = z + gaussian_filter(noise, 0.6) * 1.4 + self.fixed_m + 0.001 * np.sin(2 * np.pi * distance / 0.9)
        edge = (farthest - nearest > self.EDGE_M) | (maximum_filter(farthest, 3) - minimum_filter(nearest, 3) > 0.06)
        edge &= ~((farthest - nearest < self.EDGE_M) & (self.random.random(z.shape) < 0.4))
        valid = (farthest < 8) & (linear > self.LEAST_LINEAR) & (linear < 0.98) & ~edge & (z > 0.4)
        yield 1 / 30, f"{k:05d}", np.where(valid, z, 0), self.observed(linear)


class KinectOne(Kinect):
    NAME, REACH_M, GAMMA, LENS, LOBE = "kinect1", 0.75, 0.80, 1.5, 0.0
    CAMERA = {"width": 640, "height": 480, "fx": 580.0, "fy": 580.0, "cx": 319.5, "cy": 239.5,
              "k1": 0.0, "k2": 0.0, "p1": 0.0, "p2": 0.0, "k3": 0.0}
    LIGHT, KIND = np.array([0.12, -0.07, 0.02]), "lamp"
    DEPTH_UNITS, FULL_SCALE, STEP, SHOT = 1000.0, 1023.0, 1, 2e-5
    # Linear intensity of white at 1 m under the lamp, and under the projector where no speckle falls.
    STRENGTH, SPECKLED = 0.3, 0.15
    BASELINE_M, WINDOW = 0.075, (7, 9)
    # Deviation of the disparity, pixels, over a window; of the error of scale.
    DISPARITY_NOISE, SCALE_ERROR = 0.11, 2e-3
    # A window reaches over a step in depth of less than this.
    STEP_M, NEAREST_M, FARTHEST_M = 0.03, 0.4, 4.0
    EVERY, REST_S, EXPOSURES = 10, 16 / 30, 4

    def __init__(self, *given):
        super().__init__(*given)
        slow = gaussian_filter(self.random.normal(size=self.slant.shape), 60)
        self.scale = 1 + self.SCALE_ERROR * slow / slow.std()

    def depth(self, pose):
        """Depth in metres, 0 where there is none."""
        turn, at = pose[:3, :3], pose[:3, 3]
        ray = self.rays / self.slant[..., None] @ turn.T
        t, _, _, _ = self.scene.hit(at, ray)
        seen = np.isfinite(t)
        z = np.where(seen, t, 9.0) / self.slant
        point = at + np.where(seen, t, 9.0)[..., None] * ray
        to_projector = at + turn @ [self.BASELINE_M, 0, 0] - point
        far = np.linalg.norm(to_projector, axis=-1)
        shade, _, _, _ = self.scene.hit(point + 1e-3 * to_projector, to_projector / far[..., None])
        # Disparity is that of the window's nearer surface, as far as it has one.
        nearest = minimum_filter(z, 5)
        own = np.where(z - nearest < self.STEP_M, 1.0, 0.0)
        per_pixel = self.CAMERA["fx"] * self.BASELINE_M
        disparity = uniform_filter(own * per_pixel / z, self.WINDOW) / np.maximum(uniform_filter(own, self.WINDOW), 1e-6)
        noise = gaussian_filter(self.random.normal(size=z.shape), 2.0)
        disparity += self.DISPARITY_NOISE * noise / noise.std()
        measured = per_pixel / np.maximum(np.round(disparity * 8) / 8, 1e-3) * self.scale
        shaded = np.isfinite(shade) & (shade < far - 5e-3)
        valid = seen & ~shaded & (uniform_filter(own, self.WINDOW) > 0.4) & (measured > self.NEAREST_M) & (measured < self.FARTHEST_M)
        return np.where(valid, measured, 0)

    def frames(self, k, pose):
        """Seconds after the frame before, name, depth in metres (0: none), image or none of each frame that frame k of the path becomes."""
        rests = k % self.EVERY == 6
        depth = self.depth(pose)
        # Speckle: one pixel in nine is bright.
        speckle = None
        if rests or k % self.EVERY == 5:
            dots = self.random.random(depth.shape) < 1 / 9
            speckle = self.observed(self.SPECKLED * gaussian_filter(dots * 9.0, 0.5) * np.where(depth > 0, 1 / np.maximum(depth, 0.3) ** 2, 0) * 0.3)
        yield (self.REST_S if k % self.EVERY == 7 else 1 / 30), f"{k:05d}", depth, speckle
        if rests:
            linear = self.STRENGTH * self.lens * sum(direct + over_others for _, _, _, direct, over_others, _ in self.light_of_pixels(pose)) / 4
            for n in range(self.EXPOSURES):
                yield (self.REST_S if n == 0 else 1 / 30), f"{k:05d}_{n}", np.zeros_like(depth), self.observed(linear)


SENSORS = {sensor.NAME: sensor for sensor in (KinectOne, KinectTwo)}


def object_of(session):
    """Mesh of a recorded session's object: points (n, 3), faces, albedo a point."""
    truth = np.load(session / "groundtruth_mesh.npz")
    return truth["v"].astype(float), truth["f"].astype(int), truth["albedo"].astype(float)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("object", help=f"{', '.join(sorted(OBJECTS))}, or the folder of a session")
    parser.add_argument("out", type=Path, help="a folder that is not there yet")
    parser.add_argument("--sensor", choices=sorted(SENSORS), default="kinect2")
    parser.add_argument("--frames", type=int, default=150)
    parser.add_argument("--path", choices=["round", "above", "front"], help="default: as fits the object; round for that of a session")
    parser.add_argument("--turns", type=float, default=1.0, help="how often the hand goes round")
    parser.add_argument("--gamma", type=float, help="default: 0.80 for a Kinect I, 0.87 for a Kinect II")
    parser.add_argument("--lobe", type=float, help="power of the cosine by which the light falls; default: 0 and 1.5")
    parser.add_argument("--lens", type=float, help="power of the cosine by which the lens darkens; default: 1.5 and 2")
    parser.add_argument("--tremor", type=float, default=0.0, help="deviation of a hand's tremor, mm along each axis; default: none")
    parser.add_argument("--bounces", type=int, default=7, help="over how many other surfaces light goes at most")
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    kind_of_sensor = SENSORS[args.sensor]
    args.gamma = kind_of_sensor.GAMMA if args.gamma is None else args.gamma
    args.lobe = kind_of_sensor.LOBE if args.lobe is None else args.lobe
    args.lens = kind_of_sensor.LENS if args.lens is None else args.lens

    random = np.random.default_rng(args.seed)
    if args.object in OBJECTS:
        (v, f, albedo), kind = OBJECTS[args.object](random)
    elif (Path(args.object) / "groundtruth_mesh.npz").is_file():
        (v, f, albedo), kind = object_of(Path(args.object)), "round"
    else:
        parser.error(f"{args.object}: neither a folder with groundtruth_mesh.npz nor one of {', '.join(sorted(OBJECTS))}")
    scene = Scene(merged([(v, f, albedo), surroundings(random)]))
    sensor = kind_of_sensor(scene, Gathering(scene, len(f), args.bounces, random), args, v.min(0) + [-0.01, -0.01, 0.0005], v.max(0) + 0.01, random)
    for name in ("depth", "ir"):
        (args.out / name).mkdir(parents=True, exist_ok=False)
    poses = path(args.path or kind, args.frames, args.turns, (v.min(0) + v.max(0)) / 2, sensor.REACH_M, args.tremor, random)
    lists = {"depth": ["# timestamp filename"], "ir": ["# timestamp filename"], "groundtruth": ["# timestamp tx ty tz qx qy qz qw (world from camera)"]}
    now = 100.0 - 1 / 30
    for k, pose in enumerate(poses):
        turn = Rotation.from_matrix(pose[:3, :3]).as_quat()
        for later, name, z, counts in sensor.frames(k, pose):
            now += later
            Image.fromarray(np.round(z * sensor.DEPTH_UNITS).astype(np.uint16)).save(args.out / f"depth/{name}.png")
            lists["depth"].append(f"{now:.6f} depth/{name}.png")
            if counts is not None:
                Image.fromarray(counts).save(args.out / f"ir/{name}.png")
                lists["ir"].append(f"{now:.6f} ir/{name}.png")
            lists["groundtruth"].append(" ".join([f"{now:.6f}", *(f"{x:.9f}" for x in (*pose[:3, 3], *turn))]))
    for name, rows in lists.items():
        (args.out / f"{name}.txt").write_text("\n".join(rows) + "\n")
    np.savez_compressed(args.out / "groundtruth_mesh.npz", v=v.astype(np.float32), f=f.astype(np.int32),
                        n=normals_of(v, f).astype(np.float16), albedo=albedo.astype(np.float16))
    camera = "\n".join(f"{key} = {value}" for key, value in sensor.CAMERA.items())
    low, high = v.min(0) + [0, 0, 0.01], v.max(0) + 0.005
    (args.out / "session.toml").write_text(
        f'name = "{Path(args.object).resolve().name}-{args.sensor}"\nsensor = "{args.sensor}"\ndepth_units_per_metre = {sensor.DEPTH_UNITS}\nir_full_scale = {sensor.FULL_SCALE}\n\n'
        f"[ir_camera]\n{camera}\n\n[light]\nposition = {sensor.LIGHT.tolist()}\nkind = \"{sensor.KIND}\"\n\n"
        f"[object]\nmin = {low.round(4).tolist()}\nmax = {high.round(4).tolist()}\n")


if __name__ == "__main__":
    main()
