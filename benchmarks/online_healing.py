# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The stream while shapes are learned, and while a bumped rig is healed and accepted.

A recording of 30 markers in five bodies at 2 x 120 Hz, of a healthy rig and then of the bumped
one, is played by the player node to the whole chain: calibration, correction and reconstruction.
This process counts the published messages: an exposure without corrected observations or points
is lost. All processes share the machine. Writes a section of docs/how_good/speed.md:
python -m benchmarks.online_healing
"""

from __future__ import annotations

import argparse
import os
import signal
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from fluoro_calib_msgs.action import Heal
from fluoro_calib_msgs.msg import CorrectedObservations, ReconstructedPoints
from fluoro_calib_msgs.srv import Reset
from rclpy.action import ActionClient
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.serialization import deserialize_message
from scipy.spatial.transform import Rotation

from fluoro_calib_ros.bodies.body import Body
from fluoro_calib_ros.demo.assessment import isolate_ros_graph
from fluoro_calib_ros.exposures.frame import Frame
from fluoro_calib_ros.io.bags.writer import write_bag
from fluoro_calib_ros.io.bodies import write_bodies
from fluoro_calib_ros.jobs.result_folder import save_calibrations
from fluoro_calib_ros.nodes.runtime.streams import StreamReader
from fluoro_calib_ros.nodes.runtime.topics import observations_qos
from fluoro_calib_ros.simulation.rig import (
    StreamStart,
    VirtualRig,
    simulate_tracking,
    virtual_rig,
)
from tools.sections import write_section

from .bodies import table
from .online import BODIES, NAMES, ROOT, _command, logged, rig_of_the_simulator

RATE_HZ = 120
HEALTHY_S = 25.0
LEARNED_S = 15.0  # part of the healthy recording from which shapes are learned
BUMPED_S = 240.0  # maximum; the diagnosis takes longer if other programs compute
ACCEPTED_S = 10.0  # counted time with the healed rig
COLLECTED_S = 5.0
MOVED_MM = (3.0, -2.0, 3.5)  # 5 mm and 0.5 degrees
TURNED_DEG = (0.35, -0.28, 0.22)
DEADLINE_S = 200.0
POINTS = 'reconstruction/points_with_covariance'


def bumped(rig: VirtualRig) -> VirtualRig:
    """Return the rig after b was bumped."""
    a, b = rig.fluoroscopes
    turn = Rotation.from_euler('xyz', TURNED_DEG, degrees=True).as_matrix()
    moved = replace(b, rotation=turn @ b.rotation, position_mm=b.position_mm + MOVED_MM)
    return replace(rig, fluoroscopes=(a, moved))


def recording(folder: Path) -> tuple[Path, Path]:
    """Write the recording and bodies.csv; return their paths."""
    rig = virtual_rig(1)
    healthy = simulate_tracking(rig, HEALTHY_S, RATE_HZ, seed=1, clusters=BODIES)
    start = StreamStart()
    after = StreamStart(
        start.stamp_ns + round(1e9 * HEALTHY_S), start.number + round(HEALTHY_S * RATE_HZ)
    )
    knocked = simulate_tracking(
        bumped(rig), BUMPED_S, RATE_HZ, seed=1, start=after, clusters=BODIES
    )
    frames: dict[str, list[Frame]] = {
        name: [*healthy.frames[name], *knocked.frames[name]] for name in NAMES
    }
    write_bag(folder / 'bag', frames)
    ids = np.split(healthy.marker_id, BODIES)
    unknown = [np.full((len(each), 3), np.nan) for each in ids]
    bodies = [Body(f'b{k}', *each, each[1][:, 0]) for k, each in enumerate(zip(ids, unknown))]
    write_bodies(folder / 'bodies.csv', bodies)
    return folder / 'bag', folder / 'bodies.csv'


class Listener(Node):
    """Counts the outputs by exposure number, and heals the rig."""

    def __init__(self) -> None:
        super().__init__('listener')
        self.spinner = SingleThreadedExecutor()
        self.spinner.add_node(self)
        self.statuses: dict[str, str] = {}
        self.create_subscription(DiagnosticArray, '/diagnostics', self._on_diagnostics, 50)
        self.heal = ActionClient(self, Heal, 'heal')
        self.accept = self.create_client(Reset, 'accept_healing')
        self.corrected: dict[str, list[int]] = {name: [] for name in NAMES}
        self.points: dict[int, int] = {}  # number of points, by exposure number
        self._stream = StreamReader(self, logged(self))
        for name in NAMES:
            self._stream.subscribe(
                CorrectedObservations,
                f'{name}/corrected_observations',
                partial(self._on_corrected, name),
                observations_qos(),
                decode=bytes,
            )
        self._stream.subscribe(
            ReconstructedPoints, POINTS, self._on_points, observations_qos(), decode=bytes
        )
        self._stream.start()

    def _on_corrected(self, name: str, data: bytes, _: dict[str, int]) -> None:
        message = deserialize_message(data, CorrectedObservations)
        self.corrected[name].append(message.frame_number)

    def _on_points(self, data: bytes, _: dict[str, int]) -> None:
        message = deserialize_message(data, ReconstructedPoints)
        self.points[message.frame_number] = int(np.isfinite(message.x).sum())

    def _on_diagnostics(self, array: DiagnosticArray) -> None:
        for status in array.status:
            self.statuses[status.name] = status.message

    @property
    def newest(self) -> int:
        """Number of the newest exposure with points."""
        return max(self.points, default=0)

    def wait(self, condition: Callable[[], Any], what: str) -> None:
        """Spin until condition() is true."""
        end = time.monotonic() + DEADLINE_S
        while not condition():
            if time.monotonic() > end:
                raise SystemExit(f'waited {DEADLINE_S} s for {what}; {self.statuses}')
            self.spinner.spin_once(timeout_sec=0.05)

    def result_of(self, future: Any, what: str) -> Any:
        """Spin until a future is done; return its result."""
        self.wait(future.done, what)
        return future.result()

    def close(self) -> None:
        """Stop counting."""
        self._stream.stop()
        self.destroy_node()


@contextmanager
def started(commands: Sequence[list[str]]) -> Iterator[None]:
    """Run processes, and end them on exit."""
    with open(os.environ.get('ONLINE_LOG', os.devnull), 'ab') as log:
        processes = [subprocess.Popen(each, stdout=log, stderr=log) for each in commands]
        try:
            yield
        finally:
            for process in processes:
                if process.poll() is None:
                    process.send_signal(signal.SIGINT)
            for process in processes:
                process.wait(20)


def measure(folder: Path) -> tuple[list[tuple[str, int]], Listener]:
    """Play the recording; return the events with their exposure numbers, and the counts."""
    calibrations, orientation = rig_of_the_simulator()
    saved = folder / 'calibrations'
    save_calibrations(saved, calibrations, orientation)
    bag, bodies = recording(folder)
    given = {
        'phantom': ROOT / 'bags' / 'phantom.csv',
        'calibration_directory': saved,
        'learn_bodies': bodies,
        'learn_time': LEARNED_S,
    }
    listener = Listener()
    nodes = [
        _command('calibration_node', **given),
        _command('correction_node'),
        _command('reconstruction_node'),
    ]
    with started(nodes):
        listener.wait(lambda: listener.count_publishers(POINTS), 'the nodes')
        listener.wait(listener.heal.server_is_ready, 'the action')
        listener.wait(
            lambda: all(
                any(name in key and 'correction' in key for key in listener.statuses)
                for name in NAMES
            ),
            'the correction',
        )
        with started([_command('player_node', bag=bag, wait_for_readers=2)]):
            events = _heal(listener)
            last = listener.newest + round(ACCEPTED_S * RATE_HZ)
            listener.wait(lambda: listener.newest > last, 'points of the healed rig')
    return [*events, ('the end', last)], listener


def _heal(listener: Listener) -> list[tuple[str, int]]:
    """Wait until shapes are learned and the rig is bumped, heal and accept; return the events."""
    names = ', '.join(f'b{k}' for k in range(BODIES))
    learned = f'shapes of {names} learned'
    listener.wait(
        lambda: any(text.startswith(learned) for text in listener.statuses.values()),
        'shapes to be learned',
    )
    events = [('shapes are learned', listener.newest)]
    bump = round(HEALTHY_S * RATE_HZ)
    listener.wait(lambda: listener.newest > bump, 'the bump')
    events.append(('the bump', bump))
    goal = listener.result_of(
        listener.heal.send_goal_async(Heal.Goal(seconds=COLLECTED_S)), 'the goal'
    )
    result = listener.result_of(goal.get_result_async(), 'the healed rig').result
    print(result.message, flush=True)
    if result.verdict != 'pass':
        raise SystemExit(f'the verdict is {result.verdict}')
    events.append(('it is healed', listener.newest))
    accepted = listener.result_of(listener.accept.call_async(Reset.Request()), 'accepting')
    if not accepted.success:
        raise SystemExit(accepted.message)
    events.append(('it is accepted', listener.newest))
    return events


def rows_of(events: list[tuple[str, int]], listener: Listener) -> list[list[str]]:
    """Return table rows with the losses between the events."""
    out = []
    first = min(listener.points)  # before that, publishers and readers discover each other
    for what, last in events:
        expected = range(first, last + 1)
        if not expected:
            continue
        corrected = sum(
            len(set(expected) - set(numbers)) for numbers in listener.corrected.values()
        )
        found = [listener.points.get(number) for number in expected]
        points = [n for n in found if n is not None]
        out.append(
            [
                what,
                str(2 * len(expected)),
                str(corrected),
                str(len(expected)),
                str(found.count(None)),
                f'{np.mean(points):.1f}' if points else '',
            ]
        )
        first = last + 1
    return out


TEXT = """
### Healing beside the stream

Generated by `python -m benchmarks.online_healing`: 30 markers in five bodies, 2 x {rate} Hz,
played from a bag by another process through `calibration_node`, `correction_node` and
`reconstruction_node`. Shapes are learned from {learned:.0f} s; after {healthy:.0f} s the rig is
bumped by 5 mm and 0.5 degrees, healed from {collected:.0f} s by the action `heal`, and the healed
rig is accepted; {accepted:.0f} s of it are counted. Lost: frames without corrected observations,
exposures without points.

{rows}
"""
HEADER = 'until|frames|lost|exposures|lost|points in each'


def main() -> None:
    """Run the measurements and write the section."""
    argparse.ArgumentParser(description=__doc__.splitlines()[0]).parse_args()
    isolate_ros_graph()
    rclpy.init(args=[])
    with tempfile.TemporaryDirectory() as folder:
        events, listener = measure(Path(folder))
    rows = rows_of(events, listener)
    listener.close()
    rclpy.shutdown()
    text = TEXT.format(
        rate=RATE_HZ,
        learned=LEARNED_S,
        healthy=HEALTHY_S,
        collected=COLLECTED_S,
        accepted=ACCEPTED_S,
        rows=table(HEADER, rows),
    )
    print(text)
    write_section(ROOT / 'docs' / 'how_good' / 'speed.md', 'online healing', text)


if __name__ == '__main__':
    main()
