#!/usr/bin/env python3
"""Where the error that refinement leaves comes from: one thing after the other is replaced by the truth, and the result scored.

    loss_ablation.py SESSION SCORE.py OUT [--relief PROGRAM]        (needs what SCORE.py needs)

This is scoring: it alone reads the session's measured poses and surface. In turn
- as it is: tracked poses, fused surface;
- true poses: fused at them, views aligned as always, and not at all;
- one albedo: materials are not told apart;
- true poses for fusion alone, or for the shading images alone;
- true surface at true poses: the fused mesh within the object's box replaced by the true one, so that what hides, where albedos
  are estimated, and what the displacement starts from is right; what the refined mesh then lacks is what images and light model
  put in.
Outputs of the program lie in OUT. One line each: normals, detail,
distance of base and of refined mesh."""
import argparse
import pathlib
import subprocess

import numpy as np
from relief_ply import write_mesh
from scipy.spatial.transform import Rotation
from scoring import scoring_script

ROOT = pathlib.Path(__file__).resolve().parents[2]


def relief(args, out, command, config=""):
    """Runs the program into a folder, unless that is there from an earlier run."""
    if not out.exists():
        file = out.with_suffix(".toml")
        file.write_text(config)
        words = [args.relief, *command, "--out", out, "--config", file, "--json"]
        subprocess.run([str(word) for word in words], check=True, stdout=subprocess.DEVNULL)
    return out


def with_true_surface(score, truth, scan, folder):
    """A copy of a scan in the truth's frame, by links, whose surface within the object's box is the true one."""
    if not folder.exists():
        folder.mkdir()
        for entry in scan.iterdir():
            if entry.name != "base.ply":
                (folder / entry.name).symlink_to(entry.resolve())
        vertices, faces = score.load(str(scan / "base.ply"))
        inside = ((vertices > truth.lo - 0.005) & (vertices < truth.hi + 0.005)).all(1)
        around = faces[~inside[faces].any(1)]
        write_mesh(folder / "base.ply", np.concatenate([vertices, truth.v]), np.concatenate([around, truth.f + len(vertices)]))
    return folder


def truth_from_scan(score, truth, scan):
    """Takes a tracked scan's frame to the truth's: by the first camera's pose, then by the surface."""
    first = truth.T[0]
    vertices = score.load(str(scan / "base.ply"))[0] @ first[:3, :3].T + first[:3, 3]
    inside = vertices[((vertices > truth.lo) & (vertices < truth.hi)).all(1)]
    near = inside[np.linalg.norm(truth.closest(inside)[0] - inside, axis=1) < 0.02]
    return score.icp(truth, near[:: max(1, len(near) // 30000)]) @ first


def with_view_poses(score, scan, folder, moved):
    """A copy of a scan, by links, with other poses of its shading images; `moved` gives them by time and present pose."""
    if not folder.exists():
        (folder / "snapshots").mkdir(parents=True)
        for entry in scan.iterdir():
            if entry.name != "snapshots":
                (folder / entry.name).symlink_to(entry.resolve())
        for image in sorted((scan / "snapshots").iterdir()):
            copy = folder / "snapshots" / image.name
            copy.mkdir()
            for entry in image.iterdir():
                if entry.name != "pose.txt":
                    (copy / entry.name).symlink_to(entry.resolve())
            times, poses = score.read_poses(image / "pose.txt")
            pose = moved(times[0], poses[0])
            turn = Rotation.from_matrix(pose[:3, :3]).as_quat()
            (copy / "pose.txt").write_text(" ".join(f"{x:.9f}" for x in [times[0], *pose[:3, 3], *turn]) + "\n")
    return folder


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("session", type=pathlib.Path)
    parser.add_argument("score", type=pathlib.Path)
    parser.add_argument("out", type=pathlib.Path)
    parser.add_argument("--relief", default=str(ROOT / "target/release/relief"))
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    score = scoring_script(args.score)
    truth = score.Truth(str(args.session))

    def told(what, *meshes):
        for mesh in meshes:
            if not mesh.exists():
                print(f"{what}, {mesh.stem}: none, for the reason above", flush=True)
                continue
            found = score.score(str(args.session), str(mesh), truth)
            if "error" in found:
                print(f"{what}, {mesh.stem}: {found['error']}", flush=True)
                continue
            print(f"{what}, {mesh.stem}: normals {found['normal_mean_deg']:.2f}, detail {found['detail_rms_mm']:.3f} mm, "
                  f"mean {found['mean_mm']:.3f} mm, complete {found['completeness']:.3f}", flush=True)

    replay = ["replay", args.session]
    poses = ["--poses", args.session / "groundtruth.txt"]
    one_albedo = "[refine]\nmax_albedos = 1\n"
    unaligned = "[refine.alignment]\niterations = 0\n"
    tracked = relief(args, args.out / "tracked", replay)
    told("as it is", tracked / "base.ply", tracked / "refined.ply")
    again = relief(args, args.out / "one-albedo", ["refine", tracked], one_albedo)
    told("one albedo", again / "refined.ply")
    true = relief(args, args.out / "true-poses", replay + poses)
    told("true poses", true / "base.ply", true / "refined.ply")
    again = relief(args, args.out / "unaligned", ["refine", true], unaligned)
    told("true poses, views not aligned", again / "refined.ply")
    aligned = truth_from_scan(score, truth, tracked)

    def true_pose(time, _):
        return np.linalg.inv(aligned) @ truth.T[np.abs(truth.t - time).argmin()]

    crossed = with_view_poses(score, tracked, args.out / "true-views", true_pose)
    again = relief(args, args.out / "refined-from-true-views", ["refine", crossed])
    told("fused at tracked poses, true poses of the shading images", again / "refined.ply")
    tracked_images = args.out / "tracked-images"
    if not tracked_images.exists():
        tracked_images.mkdir()
        for entry in true.iterdir():
            other = tracked if entry.name == "snapshots" else true
            (tracked_images / entry.name).symlink_to((other / entry.name).resolve())
    crossed = with_view_poses(score, tracked_images, args.out / "tracked-views", lambda _, pose: aligned @ pose)
    again = relief(args, args.out / "refined-from-tracked-views", ["refine", crossed])
    told("fused at true poses, tracked poses of the shading images", again / "refined.ply")
    surface = with_true_surface(score, truth, true, args.out / "true-surface")
    for what, config in [("", ""), (", views not aligned", unaligned), (", one albedo", one_albedo)]:
        again = relief(args, args.out / f"from-true-surface{what.replace(', ', '-').replace(' ', '-')}", ["refine", surface], config)
        told(f"true poses and surface{what}", again / "refined.ply")


if __name__ == "__main__":
    main()
