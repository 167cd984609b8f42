# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""An hour of the stream, faster than real time: no frame is lost, and memory does not grow.

    python -m benchmarks.endurance [--hours 1] [--rate 120]

Frames of one hour at 2 x 120 Hz with 30 markers pass through correction and reconstruction (with
the drift watch and a point cloud subscriber) as fast as the nodes accept them, at most a fraction
of a queue ahead of the published points. The resident memory of both nodes is recorded
every minute of the stream.
"""

from __future__ import annotations

import argparse
import itertools
import os
import signal
import subprocess
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from fluoro_calib_msgs.msg import TargetObservations

from fluoro_calib_ros.demo.assessment import isolate_ros_graph
from fluoro_calib_ros.nodes.messages.observations import message_from_frame
from fluoro_calib_ros.nodes.runtime.topics import OBSERVATION_DEPTH, observations_qos
from fluoro_calib_ros.simulation.rig import simulate_tracking, virtual_rig

from .online import NAMES, Reader, _command, rig_of_the_simulator

NODES = ('correction_node', 'reconstruction_node')
AHEAD = OBSERVATION_DEPTH // 4
PAGE_MB = os.sysconf('SC_PAGE_SIZE') / 2**20


def resident_mb(process: subprocess.Popen[Any]) -> float:
    """Return the resident memory [MB] of a process."""
    return int(Path(f'/proc/{process.pid}/statm').read_text().split()[1]) * PAGE_MB


def wait_for_orientation(reader: Reader) -> None:
    """Wait until the reconstruction node has an orientation and receives all corrected streams.

    Earlier exposures would give no points, and publication would stop after part of a queue.
    """
    known: list[str] = []

    def on_diagnostics(array: DiagnosticArray) -> None:
        values = {v.key: v.value for status in array.status for v in status.values}
        known.append(values.get('orientation', ''))

    subscription = reader.create_subscription(DiagnosticArray, '/diagnostics', on_diagnostics, 50)
    reader.wait(lambda: any(known), 60, 'the orientation')
    topics = [f'{name}/corrected_observations' for name in NAMES]
    # One of the subscribers is this process.
    reader.wait(lambda: all(reader.count_subscribers(t) > 1 for t in topics), 30, 'the streams')
    reader.destroy_subscription(subscription)


def stream(reader: Reader, frames: int, rate_hz: float, note: Callable[[int], None]) -> None:
    """Publish exposures in step with the published points.

    note(number of exposures) is called at every minute of the stream.
    """
    outputs = {
        n: reader.create_publisher(
            TargetObservations, f'{n}/target_observations', observations_qos()
        )
        for n in NAMES
    }
    tracking = simulate_tracking(virtual_rig(1), 10.0, rate_hz, 1, clusters=5).frames
    messages = [
        [(n, message_from_frame(tracking[n][k])) for n in NAMES] for k in range(len(tracking['a']))
    ]
    reader.wait(
        lambda: all(o.get_subscription_count() for o in outputs.values()), 30, 'the readers'
    )
    came = reader.came['reconstruction_node', 'ab']
    start_ns = time.time_ns()
    for number, pair in zip(range(1, frames + 1), itertools.cycle(messages)):
        end = time.monotonic() + 60
        while number - len(came) > AHEAD:
            if time.monotonic() > end:
                raise SystemExit(
                    f'{number} exposures went in, {len(came)} came out, and nothing more for a '
                    'minute'
                )
            time.sleep(0.0005)
        for name, message in pair:
            message.frame_number = number
            seconds, nanoseconds = divmod(start_ns + round(number / rate_hz * 1e9), 10**9)
            message.header.stamp.sec = seconds
            message.header.stamp.nanosec = nanoseconds
            outputs[name].publish(message)
        if number % round(60 * rate_hz) == 0:
            note(number)
    reader.wait(lambda: len(came) >= frames, 30, 'the last points')


def run(hours: float, rate_hz: float) -> dict[str, Any]:
    """Return the results: exposures, frames in and out, seconds, memory {node: [MB by minute]}."""
    isolate_ros_graph()
    rclpy.init(args=[])
    reader = Reader(*rig_of_the_simulator())
    frames = round(3600 * hours * rate_hz)
    processes = {
        node: subprocess.Popen(_command(node), stderr=subprocess.DEVNULL) for node in NODES
    }
    memory: dict[str, list[float]] = {node: [] for node in NODES}

    def note(number: int) -> None:
        for node, process in processes.items():
            memory[node].append(resident_mb(process))
        print(
            f'{number / rate_hz / 60:.0f} min: '
            + ', '.join(f'{n} {m[-1]:.1f} MB' for n, m in memory.items()),
            flush=True,
        )

    try:
        reader.listen(NODES, of_bodies=False)
        reader.ready.clear()
        reader.wait(lambda: len(reader.ready) == len(NAMES), 60, 'the correction node')
        wait_for_orientation(reader)
        began = time.monotonic()
        stream(reader, frames, rate_hz, note)
        seconds = time.monotonic() - began
    finally:
        for process in processes.values():
            process.send_signal(signal.SIGINT)
        for process in processes.values():
            process.wait(20)
        reader.stop()
    out = {key: len({number for number, _ in of_one}) for key, of_one in reader.came.items()}
    reader.destroy_node()
    rclpy.shutdown()
    return {'exposures': frames, 'out': out, 'seconds': seconds, 'memory': memory}


def text_of(figures: dict[str, Any]) -> str:
    """Return the results as text."""
    frames = figures['exposures']
    lines = [
        f'{frames} exposures of 2 x 30 markers in {figures["seconds"]:.0f} s.',
        f'In: 2 x {frames} frames. Out: '
        + ', '.join(f'{node} {name} {count}' for (node, name), count in figures['out'].items()),
    ]
    for node, of_one in figures['memory'].items():
        slope = (
            np.polyfit(np.arange(len(of_one)), of_one, 1)[0] * 60
            if len(of_one) > 2
            else float('nan')
        )
        lines.append(
            f'{node}: {of_one[0]:.1f} MB after one minute of the stream, {of_one[-1]:.1f} MB at '
            f'the end, maximum {max(of_one):.1f} MB, trend {slope:+.2f} MB/h'
        )
    return '\n'.join(lines)


if __name__ == '__main__':
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--hours', type=float, default=1.0)
    parser.add_argument('--rate', type=float, default=120.0)
    options = parser.parse_args()
    print(text_of(run(options.hours, options.rate)))
