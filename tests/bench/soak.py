"""A daemon for an hour under the eyes of a page: does it grow, and does it lose count of frames?

`python3 soak.py PROGRAM SESSION [--secs 3600] [--rate 30] [--port 8090] [--folder DIR] [--record] [-- ARGUMENT...]` starts `PROGRAM run` on
the recording, a folder of images, played there and back over and over, so that the camera never jumps, and looks on as a page does: previews by
WebSocket, events, the mesh whenever it is new; and /metrics. Every ten seconds a line goes to DIR/samples.tsv. At the end it sends SIGTERM and tells the drift of memory from the
end of the warm-up, the first sixth, to the end (medians of a minute), and whether every frame was accounted for.
Needs nothing but Python and Linux. Exit code 0 if the drift is at most 2 %, no frame is missing, and the daemon ended in order.
"""

import argparse
import base64
import http.client
import json
import os
import pathlib
import re
import shutil
import signal
import socket
import statistics
import struct
import subprocess
import sys
import threading
import time

SAMPLE_SECS = 10
MAX_DRIFT = 0.02
COLUMNS = ["secs", "rss_mb", "anonymous_mb", "threads", "files", "produced", "fused", "lost", "dropped", "without_depth", "in_flight",
           "unaccounted", "previews", "events", "meshes", "state"]


class Onlookers:
    """What a page does, or one part of it, each in a thread of its own."""

    def __init__(self, port, only=None):
        self.port = port
        self.previews = self.events = self.meshes = 0
        self.ended = False
        looks = {"previews": self.watch_previews, "events": self.watch_events, "mesh": self.watch_mesh}
        for look in [looks[only]] if only else looks.values():
            threading.Thread(target=self.keep, args=(look,), daemon=True).start()

    def keep(self, look):
        while not self.ended:
            try:
                look()
            except (OSError, http.client.HTTPException, struct.error):
                pass
            time.sleep(1)

    def watch_previews(self):
        with socket.create_connection(("127.0.0.1", self.port), timeout=30) as stream:
            key = base64.b64encode(os.urandom(16)).decode()
            stream.sendall(f"GET /api/v1/ws HTTP/1.1\r\nHost: 127.0.0.1:{self.port}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
                           f"Sec-WebSocket-Key: {key}\r\nSec-WebSocket-Version: 13\r\n\r\n".encode())
            reader = stream.makefile("rb")
            while reader.readline() not in (b"\r\n", b""):
                pass
            stream.sendall(frame(1, json.dumps({"type": "want", "previews": True}).encode()))
            while not self.ended:
                head = exactly(reader, 2)
                length = head[1] & 0x7F
                if length == 126:
                    (length,) = struct.unpack(">H", exactly(reader, 2))
                elif length == 127:
                    (length,) = struct.unpack(">Q", exactly(reader, 8))
                payload = exactly(reader, length)
                code = head[0] & 0x0F
                if code == 8:
                    return
                if code == 9:
                    stream.sendall(frame(10, payload))
                self.previews += code == 2 and payload[0] in (1, 2)

    def watch_events(self):
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=30)
        connection.request("GET", "/api/v1/events")
        answer = connection.getresponse()
        while not self.ended:
            line = answer.readline()
            if not line:
                return
            self.events += line.startswith(b"event:")

    def watch_mesh(self):
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=30)
        seen = ""
        while not self.ended:
            connection.request("GET", "/api/v1/scan/mesh?lod=full", headers={"If-None-Match": seen} if seen else {})
            answer = connection.getresponse()
            answer.read()
            if answer.status == 200:
                seen = answer.getheader("ETag") or ""
                self.meshes += 1
            time.sleep(0.5)


def exactly(reader, n):
    data = reader.read(n)
    if len(data) < n:
        raise OSError("the socket is closed")
    return data


def frame(code, payload):
    """A short WebSocket frame of a client, masked with zeros."""
    return bytes([0x80 | code, 0x80 | len(payload)]) + bytes(4) + payload


def ask(port, method, path, body=None):
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=30)
    headers = {"Content-Type": "application/json"} if body else {}
    connection.request(method, path, body, headers)
    answer = connection.getresponse()
    return answer.status, answer.read().decode()


def sample(port, pid):
    _, text = ask(port, "GET", "/metrics")
    metric = lambda name: float(re.search(rf"^relief_{re.escape(name)} (\S+)$", text, re.M)[1])
    outcome = lambda name: metric(f'frames_total{{outcome="{name}"}}')
    status = pathlib.Path(f"/proc/{pid}/status").read_text()
    memory = lambda key: int(re.search(rf"{key}:\s+(\d+) kB", status)[1]) / 1024
    state = re.search(r'tracking_state\{state="(\w+)"\} 1', text)
    return {
        "rss_mb": memory("VmRSS"), "anonymous_mb": memory("RssAnon"),
        "threads": int(re.search(r"Threads:\s+(\d+)", status)[1]), "files": len(os.listdir(f"/proc/{pid}/fd")),
        "produced": metric("frames_produced_total"), "fused": outcome("fused"), "lost": outcome("lost"), "dropped": outcome("dropped"),
        "without_depth": outcome("without_depth"), "in_flight": metric("frames_in_flight"), "unaccounted": metric("frames_unaccounted"),
        "state": state[1] if state else "",
    }


def there_and_back(session, folder, rate):
    """The recording with its frames forwards and then backwards, at a rate; images are linked."""
    folder.mkdir()
    for entry in session.iterdir():
        if entry.is_dir():
            (folder / entry.name).symlink_to(entry.resolve())
        elif entry.suffix == ".toml":
            shutil.copy(entry, folder)
    for name in ("depth.txt", "ir.txt"):
        if not (session / name).exists():
            continue
        lines = [line.split() for line in (session / name).read_text().splitlines() if line.strip() and not line.startswith("#")]
        images = [image for _, image in lines]
        images += images[-2:0:-1]
        (folder / name).write_text("".join(f"{100 + k / rate:.6f} {image}\n" for k, image in enumerate(images)))
    return folder


def wait_until_it_answers(port, daemon):
    for _ in range(300):
        if daemon.poll() is not None:
            sys.exit(f"the daemon ended with {daemon.returncode}")
        try:
            return ask(port, "GET", "/healthz")
        except OSError:
            time.sleep(0.2)
    sys.exit("the daemon does not answer")


def main():
    arguments = argparse.ArgumentParser()
    arguments.add_argument("program")
    arguments.add_argument("session", type=pathlib.Path)
    arguments.add_argument("--secs", type=float, default=3600)
    arguments.add_argument("--rate", type=float, default=30, help="frames a second")
    arguments.add_argument("--port", type=int, default=8090)
    arguments.add_argument("--folder", type=pathlib.Path, default=pathlib.Path("soak"))
    arguments.add_argument("--record", action="store_true")
    arguments.add_argument("more", nargs="*", help="further arguments of `relief run`, after --")
    given = arguments.parse_args()

    signal.signal(signal.SIGTERM, lambda *_: sys.exit("ended before the time"))
    with socket.socket() as probe:
        if probe.connect_ex(("127.0.0.1", given.port)) == 0:
            sys.exit(f"port {given.port} is taken")
    given.folder.mkdir(parents=True)
    session = there_and_back(given.session, given.folder / "session", given.rate)
    command = [given.program, "run", "--replay", str(session), "--repeat", "--listen", f"127.0.0.1:{given.port}", "--data",
               str(given.folder / "data"), *(["--record"] if given.record else []), *given.more]
    with open(given.folder / "daemon.log", "wb") as log:
        daemon = subprocess.Popen(command, stdout=log, stderr=log)
    try:
        wait_until_it_answers(given.port, daemon)
        status, body = ask(given.port, "POST", "/api/v1/scan", '{"label":"soak"}')
        if status != 201:
            sys.exit(f"no scan: {body}")
        rows = watch(given, daemon)
    finally:
        daemon.send_signal(signal.SIGTERM)
        told = time.monotonic()
        code = daemon.wait(120)
    print(f"ended with {code}, {time.monotonic() - told:.1f} s after SIGTERM")
    sys.exit(0 if tell(rows) and code == 0 else 1)


def watch(given, daemon):
    onlookers = Onlookers(given.port)
    began = time.monotonic()
    rows = []
    with open(given.folder / "samples.tsv", "w") as table:
        print(*COLUMNS, sep="\t", file=table)
        while time.monotonic() - began < given.secs:
            time.sleep(SAMPLE_SECS)
            row = sample(given.port, daemon.pid)
            row |= {"secs": time.monotonic() - began, "previews": onlookers.previews, "events": onlookers.events, "meshes": onlookers.meshes}
            rows.append(row)
            print(*(f"{row[column]:.1f}" if isinstance(row[column], float) else row[column] for column in COLUMNS), sep="\t", file=table, flush=True)
    onlookers.ended = True
    return rows


def tell(rows):
    """Prints the figures; whether they are as they should be."""
    minute = max(1, min(60 // SAMPLE_SECS, len(rows) // 6))
    warm = len(rows) // 6
    early = statistics.median(row["rss_mb"] for row in rows[warm:warm + minute])
    late = statistics.median(row["rss_mb"] for row in rows[-minute:])
    drift = late / early - 1
    unaccounted = max(abs(row["unaccounted"]) for row in rows)
    last = rows[-1]
    print(f"resident memory {early:.1f} MB after {rows[warm]['secs']:.0f} s, {late:.1f} MB after {last['secs']:.0f} s: {drift:+.2%}; most {max(row['rss_mb'] for row in rows):.1f} MB")
    print(f"frames: {last['produced']:.0f} produced, {last['fused']:.0f} fused, {last['lost']:.0f} lost, {last['dropped']:.0f} dropped; "
          f"unaccounted at most {unaccounted:.0f} in {len(rows)} samples")
    print(f"clients: {last['previews']} previews, {last['events']} events, {last['meshes']} meshes; {last['threads']} threads, {last['files']} files open")
    return abs(drift) <= MAX_DRIFT and unaccounted == 0


if __name__ == "__main__":
    main()
