#!/usr/bin/env python3
"""Open3D's dense SLAM beside `relief bench` on one session: processor time a frame, trajectory error.

    compare.py SESSION [--voxel-size M] [--depth-max M] [--repeats N] [--frames N] [--relief PROGRAM]

Prints one line of JSON for each run. With --frames both get the session's first N depth images. See README.md beside this file."""
import argparse
import json
import pathlib
import subprocess
import sys
import tempfile
import time
import tomllib

import numpy as np
import open3d as o3d
import open3d.core as o3c

sys.path.insert(0, str(pathlib.Path(__file__).resolve().parents[1]))
from ate import aligned, paired, read_tum  # noqa: E402

ROOT = pathlib.Path(__file__).resolve().parents[3]


def session_camera(session):
    """Intrinsic matrix of a session's camera, and its depth units a metre."""
    description = tomllib.loads((session / "session.toml").read_text())
    camera = description["ir_camera"]
    matrix = [[camera["fx"], 0, camera["cx"]], [0, camera["fy"], camera["cy"]], [0, 0, 1]]
    return o3c.Tensor(matrix, o3c.float64), float(description["depth_units_per_metre"])


def depth_images(session):
    for row in (session / "depth.txt").read_text().splitlines():
        if row.strip() and not row.startswith("#"):
            stamp, name = row.split()[:2]
            yield float(stamp), o3d.t.io.read_image(str(session / name))


def shortened(session, n_images, folder):
    """A session in `folder` with the first depth images of another, and of its infrared list what is no later; all else is linked."""
    for entry in session.resolve().iterdir():
        (folder / entry.name).symlink_to(entry)
    rows = (session / "depth.txt").read_text().splitlines()
    stamps = [float(row.split()[0]) for row in rows if row.strip() and not row.startswith("#")]
    last = stamps[:n_images][-1]
    for name in ("depth.txt", "ir.txt"):
        if not (session / name).exists():
            continue
        rows = (session / name).read_text().splitlines(keepends=True)
        kept = [row for row in rows if not row.strip() or row.startswith("#") or float(row.split()[0]) <= last]
        (folder / name).unlink()
        (folder / name).write_text("".join(kept))
    return folder


def open3d_run(session, args):
    """Frame-to-model tracking as in Open3D's dense SLAM example; poses are those of the frames that it tracked."""
    matrix, units = session_camera(session)
    device = o3c.Device("CPU:0")
    slam = o3d.t.pipelines.slam
    model, frames, pose, rows, cpu_ms = None, None, o3c.Tensor(np.eye(4)), [], []
    n_failed = 0
    for stamp, depth in depth_images(session):
        if not np.any(depth.as_tensor().numpy()):
            continue
        if model is None:
            model = slam.Model(args.voxel_size, 16, 100_000, pose, device)
            frames = [slam.Frame(depth.rows, depth.columns, matrix, device) for _ in range(2)]
            black = o3d.t.geometry.Image(o3c.Tensor.zeros((depth.rows, depth.columns, 3), o3c.uint8))
        live, seen = frames
        live.set_data_from_image("depth", depth)
        live.set_data_from_image("color", black)
        start = time.process_time()
        if rows:
            try:
                result = model.track_frame_to_model(live, seen, units, args.depth_max, 0.07)
                pose = pose @ result.transformation
            except RuntimeError:
                n_failed += 1
        model.update_frame_pose(len(rows), pose)
        model.integrate(live, units, args.depth_max, 8.0)
        model.synthesize_model_frame(seen, units, 0.1, args.depth_max, 8.0, False)
        cpu_ms.append(1e3 * (time.process_time() - start))
        rows.append(np.concatenate([[stamp], pose.numpy()[:3, 3]]))
    return {
        "system": f"Open3D {o3d.__version__}",
        "frames": len(rows),
        "lost": n_failed,
        "frame_cpu_ms": float(np.median(cpu_ms)),
        "ate_mm": ate_mm(np.array(rows), session),
    }


def relief_run(session, args):
    command = [args.relief, "bench", str(session), "--json", "--voxel-size", str(args.voxel_size)]
    command += ["--depth-max", str(args.depth_max)]
    measured = json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
    trajectory = measured["trajectory"]
    return {
        "system": "relief",
        "frames": measured["frames"]["tracked"],
        "lost": measured["frames"]["lost"],
        "frame_cpu_ms": measured["frame_cpu_ms"],
        "ate_mm": trajectory and 1e3 * trajectory["rmse_m"],
    }


def ate_mm(rows, session):
    truth = session / "groundtruth.txt"
    if not truth.exists():
        return None
    estimate, truth = paired(rows, read_tum(truth))
    error = np.linalg.norm(aligned(estimate[:, 1:4], truth[:, 1:4]) - truth[:, 1:4], axis=1)
    return 1e3 * float(np.sqrt((error**2).mean()))


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("session", type=pathlib.Path)
    parser.add_argument("--voxel-size", type=float, default=0.005)
    parser.add_argument("--depth-max", type=float, default=2.0)
    parser.add_argument("--repeats", type=int, default=1)
    parser.add_argument("--frames", type=int, help="depth images, the first of the session, at least 1; all without it")
    parser.add_argument("--relief", default=str(ROOT / "target/release/relief"))
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        session = args.session
        if args.frames is not None:
            session = shortened(session, args.frames, pathlib.Path(folder))
        for _ in range(args.repeats):
            for run in (relief_run, open3d_run):
                print(json.dumps(run(session, args)), flush=True)


if __name__ == "__main__":
    main()
