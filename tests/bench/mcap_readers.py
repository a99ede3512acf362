#!/usr/bin/env python3
"""Opens recordings with two readers that share no code with ours, and compares what they read.

    python3 -m venv v && v/bin/pip install mcap-ros2-support rosbags numpy
    v/bin/python tests/bench/mcap_readers.py RECORDING...

RECORDING is a folder with metadata.yaml and segments. `mcap_ros2` reads each segment through its summary and indexes,
`rosbags` the folder as a rosbag2 bag. Both must give the same messages, and depth and IR the same pixels.
"""

import hashlib
import sys
from collections import Counter
from importlib.metadata import version
from pathlib import Path

import numpy as np
from mcap_ros2.reader import read_ros2_messages
from rosbags.highlevel import AnyReader


def image_digest(width, height, encoding, step, data):
    """Size, encoding and pixels of an image, as one number."""
    pixels = np.frombuffer(bytes(data), dtype="<u2").reshape(height, step // 2)[:, :width]
    digest = hashlib.sha256(pixels.tobytes()).hexdigest()[:16]
    return f"{width}x{height} {encoding} {digest}"


def content(kind, message):
    """What is compared of a message: pixels of images, position of poses, text of strings, focal length of cameras."""
    if kind == "sensor_msgs/msg/Image":
        return image_digest(message.width, message.height, message.encoding, message.step, message.data)
    if kind == "sensor_msgs/msg/CameraInfo":
        return f"{message.distortion_model} {float(message.k[0])!r} {[float(k) for k in message.d]!r}"
    if kind == "geometry_msgs/msg/PoseStamped":
        p = message.pose.position
        return f"{float(p.x)!r} {float(p.y)!r} {float(p.z)!r}"
    return message.data


def stamp_ns(message):
    """The header's time, or 0 without a header."""
    if not hasattr(message, "header"):
        return 0
    return message.header.stamp.sec * 10**9 + message.header.stamp.nanosec


def by_mcap_ros2(folder):
    """All messages of all segments."""
    for segment in sorted(folder.glob("*.mcap")):
        for read in read_ros2_messages(str(segment)):
            kind = read.schema.name
            yield read.channel.topic, kind, read.log_time_ns, stamp_ns(read.ros_msg), content(kind, read.ros_msg)


def by_rosbags(folder):
    """All messages of the bag."""
    with AnyReader([folder]) as reader:
        for connection, log_time_ns, raw in reader.messages():
            message = reader.deserialize(raw, connection.msgtype)
            kind = connection.msgtype
            yield connection.topic, kind, log_time_ns, stamp_ns(message), content(kind, message)


def main():
    print("python", sys.version.split()[0], *(f"{name} {version(name)}" for name in ("mcap", "mcap-ros2-support", "rosbags")))
    for folder in map(Path, sys.argv[1:]):
        first, second = sorted(by_mcap_ros2(folder)), sorted(by_rosbags(folder))
        if first != second:
            differing = [(a, b) for a, b in zip(first, second) if a != b]
            sys.exit(f"{folder}: the readers differ: {len(first)} and {len(second)} messages, {differing[:1]}")
        print(f"{folder.name}: {len(first)} messages, the same in both readers")
        for topic, n in sorted(Counter(entry[0] for entry in first).items()):
            print(f"  {n:6} {topic}")


if __name__ == "__main__":
    main()
