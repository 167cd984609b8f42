# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The recorder at lab rates: which messages are lost, and why.

    python -m benchmarks.recording [--seconds 60] [--depth 100 30] [--profile FILE]

2 x 250 Hz with 30 markers and 2 x 30 Hz images of 1024 x 1024 mono8, from one publisher process to
the recorder on the same machine. Each message has a number, and is lost if the bag does not
contain it. depth: queue depths of the publishers of frames and images. profile: Fast DDS profile
of both processes. Late is the delay of the publisher: if large, the machine was too busy for the
test.
"""

from __future__ import annotations

import argparse
import heapq
import json
import os
import resource
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import rclpy
from fluoro_calib_msgs.msg import TargetObservations
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import QoSProfile
from rclpy.serialization import serialize_message
from sensor_msgs.msg import Image

from fluoro_calib_ros.demo.assessment import isolate_ros_graph
from fluoro_calib_ros.io.bags.reader import iterate_messages
from fluoro_calib_ros.nodes.messages.observations import message_from_frame
from fluoro_calib_ros.simulation.rig import simulate_tracking, virtual_rig

from .timing import table

FRAMES_HZ = 250.0
IMAGES_HZ = 30.0
SIZE = 1024
# Position of the message number in the bytes: it replaces the stamp, the first field of every
# type.
STAMP = slice(4, 8)
ROOT = Path(__file__).resolve().parents[1]


def publish(seconds: float, depths: tuple[int, int]) -> None:
    """Publish at the rates; print the numbers of sent messages and the largest delay."""
    rclpy.init(args=[])
    node = rclpy.create_node('rig')
    spinner = SingleThreadedExecutor()
    spinner.add_node(node)
    frames = simulate_tracking(virtual_rig(1), 0.1, 100.0, 1, clusters=5).frames
    rng = np.random.default_rng(1)
    noise = rng.integers(0, 16, (SIZE, SIZE), np.uint8) + np.uint8(100)
    image = Image(height=SIZE, width=SIZE, encoding='mono8', step=SIZE)
    image.data.frombytes(noise.tobytes())
    outputs = []
    for name in 'ab':
        for kind, topic, message, rate, depth in (
            (
                TargetObservations,
                'target_observations',
                message_from_frame(frames[name][0]),
                FRAMES_HZ,
                depths[0],
            ),
            (Image, 'image_raw', image, IMAGES_HZ, depths[1]),
        ):
            output = node.create_publisher(kind, f'{name}/{topic}', QoSProfile(depth=depth))
            outputs.append((output, bytearray(serialize_message(message)), rate))
    while not all(output.get_subscription_count() for output, _, _ in outputs):
        spinner.spin_once(timeout_sec=0.1)
    time.sleep(1.0)
    start = time.monotonic()
    due = [(start, number, 0) for number in range(len(outputs))]
    heapq.heapify(due)
    sent = [0] * len(outputs)
    latest = 0.0
    while due[0][0] < start + seconds:
        moment, number, count = due[0]
        output, data, rate = outputs[number]
        time.sleep(max(0.0, moment - time.monotonic()))
        latest = max(latest, time.monotonic() - moment)
        data[STAMP] = (count + 1).to_bytes(4, 'little')
        output.publish(bytes(data))
        sent[number] += 1
        heapq.heapreplace(due, (start + (count + 1) / rate, number, count + 1))
    for output, _, _ in outputs:
        output.wait_for_all_acked()
    print(json.dumps({'sent': {o.topic_name: n for (o, _, _), n in zip(outputs, sent)}}))
    print(json.dumps({'late_s': latest}))
    rclpy.shutdown()


def record(seconds: float, depths: tuple[int, int], profile: Path | None) -> list[str]:
    """Record the messages that another process publishes; return a row of the table."""
    if profile is not None:
        os.environ['FASTRTPS_DEFAULT_PROFILES_FILE'] = str(profile)
    with tempfile.TemporaryDirectory() as folder:
        bag = Path(folder, 'bag')
        words = [sys.executable, '-m', 'fluoro_calib_ros.nodes.recorder_node', '--ros-args']
        recorder = subprocess.Popen(
            [*words, '-p', f'folder:={bag}'], cwd=ROOT, stderr=subprocess.PIPE, text=True
        )
        publisher = subprocess.run(
            [sys.executable, '-m', 'benchmarks.recording', '--publish']
            + ['--seconds', str(seconds), '--depth', *map(str, depths)],
            cwd=ROOT,
            stdout=subprocess.PIPE,
            text=True,
            check=True,
        )
        time.sleep(1.0)
        recorder.send_signal(signal.SIGINT)
        _, log = recorder.communicate()
        usage = resource.getrusage(resource.RUSAGE_CHILDREN)
        sent, late = (json.loads(line) for line in publisher.stdout.splitlines())
        return _row(bag, sent['sent'], late['late_s'], log, usage.ru_maxrss / 1024)


def _row(bag: Path, sent: dict[str, int], late_s: float, log: str, memory_mb: float) -> list[str]:
    found: dict[str, set[int]] = {topic: set() for topic in sent}
    times: list[int] = []
    for message in iterate_messages(bag, list(sent)):
        found[message.topic].add(int.from_bytes(message.data[STAMP], 'little'))
        times.append(message.log_time_ns)
    lost = {topic: count - len(found[topic]) for topic, count in sent.items()}
    last = log.splitlines()[-1] if log else ''
    return [
        *(
            f'{sum(n for t, n in lost.items() if t.endswith(end))} of '
            f'{sum(n for t, n in sent.items() if t.endswith(end))}'
            for end in ('target_observations', 'image_raw')
        ),
        last.partition('recorded to')[2].partition(', ')[2] or last,
        f'{np.diff(np.sort(times)).max() * 1e-9:.2f}',
        f'{late_s:.2f}',
        f'{memory_mb:.0f}',
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or '').splitlines()[0])
    parser.add_argument('--seconds', type=float, default=60.0)
    parser.add_argument('--depth', type=int, nargs=2, default=(100, 30))
    parser.add_argument('--profile', type=Path, default=None)
    parser.add_argument('--publish', action='store_true', help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    isolate_ros_graph()
    depths = (arguments.depth[0], arguments.depth[1])
    if arguments.publish:
        publish(arguments.seconds, depths)
        return
    row = record(arguments.seconds, depths, arguments.profile)
    header = ('lost frames', 'lost images', 'recorder', 'longest pause [s]', 'late [s]', 'MB')
    print(table(header, [row]))


if __name__ == '__main__':
    main()
