"""What looking on, recording and refining cost a scan that goes on.

`python3 capture_rate.py PROGRAM SESSION [--rounds 3] [--secs 20] [--rate 30]` plays SESSION (a folder of images) there and back at its real
rate and compares, in turns, so that both meet the same machine:
- frames fused a second of a scan alone, and of one that is recorded and looked at as by a page (previews, events, mesh, see soak.py)
  while a refinement runs beside it;
- processor time of a paused scan with and without a client that is sent previews.
Needs nothing but Python and Linux.
"""

import argparse
import json
import os
import pathlib
import signal
import statistics
import subprocess
import tempfile
import time

from soak import Onlookers, ask, there_and_back, wait_until_it_answers

# So long a refinement that it outlasts its turn.
LONG_REFINEMENT = {"RELIEF_REFINE__N_ROUNDS": "20"}


class Daemon:
    def __init__(self, program, session, folder, port, *more):
        self.port = port
        command = [program, "run", "--replay", str(session), "--repeat", "--listen", f"127.0.0.1:{port}", "--data", str(folder), *more]
        environment = {**os.environ, "RELIEF_CONFIG_ROOT": "/nonexistent", **LONG_REFINEMENT}
        self.process = subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        wait_until_it_answers(port, self.process)

    def post(self, path):
        status, body = ask(self.port, "POST", f"/api/v1/{path}", "{}")
        assert status < 300, body

    def status(self):
        return json.loads(ask(self.port, "GET", "/api/v1/status")[1])

    def wait_for(self, is_it):
        while not is_it(self.status()):
            time.sleep(0.05)

    def start_scan(self):
        self.post("scan")
        self.wait_for(lambda status: status["snapshots"]["accepted"] > 5)

    def processor_secs(self):
        fields = pathlib.Path(f"/proc/{self.process.pid}/stat").read_text().rsplit(") ", 1)[1].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")

    def end(self):
        self.process.send_signal(signal.SIGTERM)
        self.process.wait(60)


def rates(daemon, secs):
    """Frames produced, fused and recorded a second."""
    def counts():
        status = daemon.status()
        return status["frames"]["produced"], status["frames"]["fused"], status["recording"]["recorded"]
    began, before = time.monotonic(), counts()
    time.sleep(secs)
    elapsed = time.monotonic() - began
    return [(after - first) / elapsed for after, first in zip(counts(), before)]


def capture(given, session, scratch):
    alone = Daemon(given.program, session, scratch / "alone", 8093)
    beset = Daemon(given.program, session, scratch / "beset", 8094, "--record")
    shares = []
    for number in range(given.rounds):
        alone.start_scan()
        produced, fused, _ = rates(alone, given.secs)
        alone.post("scan/abandon")
        alone.wait_for(lambda status: status["state"] == "idle")

        beset.start_scan()
        beset.post("scan/finish")
        beset.wait_for(lambda status: status["refinement"]["state"] == "running")
        beset.start_scan()
        onlookers = Onlookers(beset.port)
        beset_produced, beset_fused, recorded = rates(beset, given.secs)
        state = beset.status()["refinement"]["state"]
        onlookers.ended = True
        print(f"round {number + 1}: alone {produced:.2f} produced, {fused:.2f} fused a second; with previews ({onlookers.previews / given.secs:.1f} a "
              f"second), {onlookers.meshes} meshes, a refinement ({state}) and the recorder {beset_produced:.2f} produced, {beset_fused:.2f} "
              f"fused, {recorded:.2f} recorded; load {os.getloadavg()[0]:.1f}", flush=True)
        if state == "running":
            shares.append(beset_fused / fused)
            ask(beset.port, "POST", f"/api/v1/jobs/{beset.status()['refinement']['job']}/cancel", "{}")
        beset.post("scan/abandon")
        beset.wait_for(lambda status: status["state"] == "idle")
    alone.end()
    beset.end()
    print(f"fused with all that against alone: median {statistics.median(shares):.1%} of {', '.join(f'{share:.1%}' for share in shares)}")


def previews(given, session, scratch):
    daemon = Daemon(given.program, session, scratch / "paused", 8095)
    daemon.start_scan()
    daemon.post("scan/pause")
    costs = []
    for _ in range(given.rounds):
        shares = []
        for is_watched in (False, True):
            onlookers = Onlookers(daemon.port, only="previews") if is_watched else None
            # What was asked for before is made for two seconds more.
            time.sleep(3)
            n_before = onlookers.previews if onlookers else 0
            before = daemon.processor_secs()
            time.sleep(given.secs)
            shares.append((daemon.processor_secs() - before) / given.secs)
        n = (onlookers.previews - n_before) / given.secs
        onlookers.ended = True
        costs.append(shares[1] - shares[0])
        print(f"paused: {shares[0]:.2%} of a core without, {shares[1]:.2%} with {n:.1f} previews a second", flush=True)
        time.sleep(1)
    daemon.end()
    print(f"previews: median {statistics.median(costs):.2%} of a core")


def main():
    arguments = argparse.ArgumentParser()
    arguments.add_argument("program")
    arguments.add_argument("session", type=pathlib.Path)
    arguments.add_argument("--rounds", type=int, default=3)
    arguments.add_argument("--secs", type=float, default=20)
    arguments.add_argument("--rate", type=float, default=30, help="frames a second")
    given = arguments.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        scratch = pathlib.Path(scratch)
        session = there_and_back(given.session, scratch / "session", given.rate)
        previews(given, session, scratch)
        capture(given, session, scratch)


if __name__ == "__main__":
    main()
