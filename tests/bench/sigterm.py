"""SIGTERM in every state of the daemon: how long it takes to end, with which code, and what is kept.

`python3 sigterm.py PROGRAM SESSION [--times 4] [--only STATE] [--seed 1]` brings `PROGRAM run --record` into each of the states below, over
recordings made of SESSION's images (a folder, as tests/data/demo), so many times, and sends SIGTERM at a random moment of it. After
each end it looks whether
- the exit code is 0 (130 after a second SIGTERM), and the daemon ended within 10 s;
- a scan that fused anything has its base mesh, a report in which no frame is missing, and a refinement that waits;
- what was recorded is whole (`PROGRAM session verify`; after a second SIGTERM once a next daemon has mended it).
Needs nothing but Python and Linux. Exit code 0 if all that holds.
"""

import argparse
import json
import os
import pathlib
import random
import shutil
import signal
import statistics
import struct
import subprocess
import sys
import tempfile
import threading
import time
import zlib

from soak import ask, there_and_back, wait_until_it_answers

PORT = 8091
MAX_SECS = 10
SIZE = (512, 424)


def grey(path, value):
    """A 16-bit image of one value."""
    def chunk(kind, data):
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
    row = b"\0" + struct.pack(">H", value) * SIZE[0]
    head = struct.pack(">IIBBBBB", *SIZE, 16, 0, 0, 0, 0)
    body = zlib.compress(row * SIZE[1])
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", body) + chunk(b"IEND", b""))


class Recordings:
    """The sessions that states come from."""

    def __init__(self, session, folder):
        self.good = there_and_back(session, folder / "good", 30)
        self.dark = self.edited("dark", depth=lambda k, image: "none.png")
        self.covered = self.edited("covered", depth=lambda k, image: image if k < 30 else "none.png")
        self.jumping = self.edited("jumping", depth=lambda k, image: image if k < 30 else ["depth/00000.png", "depth/00028.png"][k % 2])
        # After the dark one frame of a known place, and then none for four seconds: no second one confirms the place.
        self.unconfirmed = self.edited("unconfirmed", depth=lambda k, image: image if k < 30 else "none.png" if (k - 30) % 11 < 10 else "depth/00010.png",
                                       gaps=lambda k: 4 * max(0, (k - 30) // 11))
        self.glaring = self.edited("glaring", ir=lambda k, image: "full.png")

    def edited(self, name, depth=lambda k, image: image, ir=lambda k, image: image, gaps=lambda k: 0):
        """The good session, three times as long, with other images in some places."""
        folder = self.good.parent / name
        shutil.copytree(self.good, folder, symlinks=True)
        grey(folder / "none.png", 0)
        grey(folder / "full.png", 65535)
        for list_name, edit in (("depth.txt", depth), ("ir.txt", ir)):
            images = [line.split()[1] for line in (self.good / list_name).read_text().splitlines()] * 3
            lines = (f"{100 + k / 30 + gaps(k):.6f} {edit(k, image)}\n" for k, image in enumerate(images))
            (folder / list_name).write_text("".join(lines))
        return folder


class Run:
    """One daemon."""

    def __init__(self, given, session, folder):
        self.given, self.folder = given, folder
        self.command = [given.program, "run", "--replay", str(session), "--repeat", "--record", "--listen", f"127.0.0.1:{PORT}", "--data",
                        str(folder)]
        self.environment = {**os.environ, "RELIEF_CONFIG_ROOT": "/nonexistent"}
        self.start()

    def start(self):
        with open(self.folder.parent / "daemon.log", "ab") as log:
            self.daemon = subprocess.Popen(self.command, env=self.environment, stdout=log, stderr=log)
        wait_until_it_answers(PORT, self.daemon)

    def post(self, path, body="{}"):
        return ask(PORT, "POST", f"/api/v1/{path}", body)

    def status(self):
        return json.loads(ask(PORT, "GET", "/api/v1/status")[1])

    def await_status(self, is_it):
        """Waits for it; false if it does not come within a minute."""
        for _ in range(1200):
            if is_it(self.status()):
                return True
            time.sleep(0.05)
        return False

    def scan(self):
        assert self.post("scan")[0] == 201

    def in_state(self, *states):
        assert self.await_status(lambda status: status["state"] in states), f"{states} did not come: {self.status()['state']}"

    def with_images(self):
        self.scan()
        assert self.await_status(lambda status: status["snapshots"]["accepted"] > 2), "no shading images"

    def refining(self):
        self.with_images()
        self.post("scan/finish")
        assert self.await_status(lambda status: status["refinement"]["state"] == "running"), "no refinement"


def tracking(run):
    run.with_images()
    run.in_state("tracking", "degraded")


def state(name):
    def reach(run):
        run.scan()
        run.in_state(name)
    return reach


def command(path):
    def reach(run):
        tracking(run)
        run.post(f"scan/{path}")
    return reach


def starting(run):
    threading.Thread(target=lambda: run.post("scan"), daemon=True).start()


def meshing(run):
    command("finish")(run)
    run.in_state("draining", "idle")


def refining_beside(run):
    run.refining()
    run.scan()
    run.in_state("tracking", "degraded")


# Name, recording, how the state is reached, and how long it lasts at least, seconds.
STATES = [
    ("idle", "good", lambda run: None, 0.5),
    ("starting", "good", starting, 0.05),
    ("warming", "dark", lambda run: run.scan(), 1.0),
    ("tracking", "good", tracking, 2.0),
    ("degraded, infrared", "glaring", state("degraded"), 1.0),
    ("lost, lens covered", "covered", state("lost"), 1.0),
    ("lost, elsewhere", "jumping", state("lost"), 1.0),
    ("relocalising", "unconfirmed", state("relocalising"), 0.0),
    ("paused", "good", command("pause"), 1.0),
    ("snapshotting", "good", command("snapshot"), 0.0),
    ("undoing", "good", command("undo"), 0.1),
    ("writing on the way", "good", command("refine"), 0.3),
    ("draining after finish", "good", meshing, 1.0),
    ("draining after abandon", "good", command("abandon"), 0.3),
    ("refining", "good", Run.refining, 3.0),
    ("refining and tracking", "good", refining_beside, 2.0),
    ("told twice", "good", tracking, 1.0),
]


def end(run, is_told_twice, rng):
    """Sends SIGTERM; the exit code and how long the end took, seconds."""
    told = time.monotonic()
    run.daemon.send_signal(signal.SIGTERM)
    if is_told_twice:
        time.sleep(rng.uniform(0.0, 0.3))
        told = time.monotonic()
        run.daemon.send_signal(signal.SIGTERM)
    try:
        code = run.daemon.wait(60)
    except subprocess.TimeoutExpired:
        run.daemon.kill()
        code = run.daemon.wait()
    return code, time.monotonic() - told


def faults_of(run, name, code, secs):
    """What is not as it should be."""
    is_told_twice = name == "told twice"
    faults = []
    if code not in ((0, 130) if is_told_twice else (0,)):
        faults.append(f"exit code {code}")
    if secs > MAX_SECS:
        faults.append(f"{secs:.1f} s")
    if is_told_twice:
        # The next daemon mends what was left open, and ends.
        run.start()
        if (next_code := end(run, False, None)[0]) != 0:
            faults.append(f"the next daemon ended with {next_code}")
    jobs = [json.loads(path.read_text())["scan"] for path in (run.folder / "spool" / "waiting").glob("*.json")]
    for session in (run.folder / "sessions").iterdir():
        if list(session.rglob("*.mcap")):
            recording = next(session.rglob("*.mcap")).parent
            verified = subprocess.run([run.given.program, "session", "verify", str(recording)], capture_output=True, text=True)
            if verified.returncode != 0:
                faults.append(f"{session.name}: {verified.stdout}{verified.stderr}")
        if is_told_twice and code == 130:
            continue
        if json.loads((session / "scan.json").read_text())["interim_of"]:
            # Written down on the way, it has no report of its own, and the whole scan is refined in its place.
            continue
        reports = [session / file for file in ("capture-report.json", "report.json") if (session / file).exists()]
        if not reports:
            if (session / "base.ply").exists():
                faults.append(f"{session.name}: a mesh without a report")
            continue
        report = json.loads(reports[0].read_text())
        frames = report["frames"]
        # What was seen once or twice makes no surface, and of a scan of less than five seconds nothing is left when five are taken
        # back: there is nothing to refine.
        has_surface = frames["fused"] > 5 and name != "undoing"
        if frames["unaccounted"]:
            faults.append(f"{session.name}: {frames['unaccounted']} frames are missing")
        if has_surface and not (session / "base.ply").stat().st_size > 10_000:
            faults.append(f"{session.name}: no base mesh")
        is_refined = (session / "refined.ply").exists()
        has_images = any((session / "snapshots").glob("*/ir.png")) if (session / "snapshots").exists() else False
        if has_surface and has_images and name != "draining after abandon" and session.name not in jobs and not is_refined:
            faults.append(f"{session.name}: no refinement waits")
    return faults


def main():
    arguments = argparse.ArgumentParser()
    arguments.add_argument("program")
    arguments.add_argument("session", type=pathlib.Path)
    arguments.add_argument("--times", type=int, default=4)
    arguments.add_argument("--only", default="")
    arguments.add_argument("--seed", type=int, default=1)
    given = arguments.parse_args()
    rng = random.Random(given.seed)
    all_faults, all_secs = 0, []
    with tempfile.TemporaryDirectory() as scratch:
        scratch = pathlib.Path(scratch)
        recordings = Recordings(given.session, scratch)
        for name, recording, reach, lasts in STATES:
            if given.only not in name:
                continue
            took, codes, said = [], set(), []
            for trial in range(given.times):
                data = scratch / f"data-{trial}"
                run = Run(given, getattr(recordings, recording), data)
                try:
                    reach(run)
                    time.sleep(rng.uniform(0.0, lasts))
                    code, secs = end(run, name == "told twice", rng)
                finally:
                    run.daemon.kill()
                took.append(secs)
                codes.add(code)
                said += faults_of(run, name, code, secs)
                shutil.rmtree(data)
            print(f"{name:24} {len(took)} times: median {statistics.median(took):.2f} s, slowest {max(took):.2f} s, exit code "
                  f"{', '.join(map(str, sorted(codes)))}{''.join(f'{chr(10)}    {fault}' for fault in said)}", flush=True)
            all_faults += len(said)
            all_secs += took
    print(f"{len(all_secs)} ends: median {statistics.median(all_secs):.2f} s, slowest {max(all_secs):.2f} s; {all_faults} faults")
    sys.exit(1 if all_faults else 0)


if __name__ == "__main__":
    main()
