#!/usr/bin/env python3
"""How processor time and memory of refinement grow with vertices and with views.

    refine_growth.py SCAN [--relief PROGRAM] [--edges MM ...] [--views N ...] [--threads N]

SCAN is an output folder of `relief replay`, with as many shading images as the largest of --views (--config with
`snapshot.max_snapshots = 64`). One line for each edge length with all views, then one for each number of views, spread evenly, at
the configured edge length: vertices, views, processor seconds of the whole command `relief refine`, reading and writing among it,
its wall seconds and its largest resident memory. Python alone is needed."""
import argparse
import json
import os
import pathlib
import shutil
import subprocess
import tempfile
import time

ROOT = pathlib.Path(__file__).resolve().parents[2]


def with_views(scan, n_views, folder):
    """A copy of a scan's folder by links, with so many of its shading images."""
    images = sorted((scan / "snapshots").iterdir())
    if n_views > len(images):
        raise SystemExit(f"{scan} has {len(images)} shading images, {n_views} are asked for")
    (folder / "snapshots").mkdir(parents=True)
    for entry in scan.iterdir():
        if entry.name != "snapshots":
            (folder / entry.name).symlink_to(entry.resolve())
    for number in range(n_views):
        image = images[number * len(images) // n_views]
        (folder / "snapshots" / f"{number:03}").symlink_to(image.resolve())
    return folder


def refine(args, scan, edge_mm, scratch):
    config = scratch / "growth.toml"
    edge = f"edge_length_m = {edge_mm / 1e3}\n" if edge_mm else ""
    config.write_text(f"[refine]\nmax_vertices = 5000000\n{edge}")
    out = scratch / "out"
    command = [args.relief, "refine", scan, "--out", out, "--config", config, "--threads", str(args.threads), "--json"]
    start = time.monotonic()
    with open(scratch / "stdout", "w+") as text:
        child = subprocess.Popen([str(word) for word in command], stdout=text, stderr=subprocess.DEVNULL)
        _, status, usage = os.wait4(child.pid, 0)
        wall = time.monotonic() - start
        text.seek(0)
        told = text.read()
    if status:
        raise SystemExit(f"relief refine failed: {told[-400:]}")
    mesh = json.loads(told)["refined_mesh"]
    shutil.rmtree(out)
    return mesh, usage.ru_utime + usage.ru_stime, wall, usage.ru_maxrss / 1024


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scan", type=pathlib.Path)
    parser.add_argument("--relief", default=str(ROOT / "target/release/relief"))
    parser.add_argument("--edges", type=float, nargs="*", default=[], metavar="MM")
    parser.add_argument("--views", type=int, nargs="*", default=[])
    parser.add_argument("--threads", type=int, default=2)
    args = parser.parse_args()
    n_images = len(list((args.scan / "snapshots").iterdir()))
    for edge_mm, n_views in [(edge, n_images) for edge in args.edges] + [(None, n) for n in args.views]:
        with tempfile.TemporaryDirectory() as scratch:
            scratch = pathlib.Path(scratch)
            scan = with_views(args.scan, n_views, scratch / "scan")
            mesh, cpu, wall, memory = refine(args, scan, edge_mm, scratch)
        print(f"edge {1e3 * mesh['edge_length_m']:.2f} mm, {mesh['vertices']} vertices, {mesh['n_views']} views: "
              f"{cpu:.1f} s processor, {wall:.1f} s wall, {memory:.0f} MiB", flush=True)


if __name__ == "__main__":
    main()
