# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The online processing at lab rates: nodes as processes, compared with plain relays.

    python -m benchmarks.online [--seconds 60] [--only NAME]

The simulator, the nodes under test and the reader (this process) share the machine. A frame
without an output is lost. Latency is reported twice: within the node, from the arrival of the
input (of the last view, for points) to the publication of the output, from the node's diagnostics
(the median of its medians, and the largest of its 99 %, each of 2,000 frames); and from
the stamp of the simulator, set just before it publishes, to the time stamp that DDS gives the
output when it is published, which includes the transfer by DDS. Bodies are the five rigid clusters
of six markers, whose poses replace the points as output. The calibration node ignores frames of
markers and publishes nothing for them: only its CPU time is measured. A flood is that
of tests/ros/flooder.py, on the input of fluoroscope a or, as the same load without messages, on
a topic that nobody reads.
"""

from __future__ import annotations

import argparse
import os
import signal
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from fluoro_calib_msgs.msg import (
    BodyPoses,
    CalibrationStatus,
    CorrectedObservations,
    FluoroscopeCalibration,
    ReconstructedPoints,
    RigOrientation,
    TargetObservations,
)
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from sensor_msgs.msg import CameraInfo

from fluoro_calib_ros.bodies.body import Body
from fluoro_calib_ros.correction.fluoroscope_calibration import (
    FluoroscopeCalibration as Calibration,
)
from fluoro_calib_ros.demo.assessment import isolate_ros_graph
from fluoro_calib_ros.estimation.calibrate import calibrate
from fluoro_calib_ros.estimation.rig_orientation import orientation_and_scatter
from fluoro_calib_ros.io.bodies import write_bodies
from fluoro_calib_ros.nodes.messages.fluoroscope_calibration import message_from_calibration
from fluoro_calib_ros.nodes.messages.rig_orientation import message_from_orientation
from fluoro_calib_ros.nodes.runtime.streams import FaultHandlers, StreamReader
from fluoro_calib_ros.nodes.runtime.topics import latched_qos, observations_qos
from fluoro_calib_ros.photogrammetry.rig_orientation import RigOrientation as Orientation
from fluoro_calib_ros.simulation.rig import simulate_exposures, simulate_tracking, virtual_rig
from tools.sections import show_section

from .timing import table

NAMES = ('a', 'b')
CHAIN_250 = ('markers', 250, ('correction_node', 'reconstruction_node'))
CASES = {  # name: (scene, rate, nodes under test)
    'markers 250 Hz': ('markers', 250, ('correction_node', 'relay_plain')),
    'grid 30 Hz': ('grid', 30, ('correction_node', 'relay_plain')),
    'markers 250 Hz, ignored': ('markers', 250, ('correction_node', 'calibration_node')),
    'markers 1000 Hz': ('markers', 1000, ('correction_node',)),
    'markers 1000 Hz, relay': ('markers', 1000, ('relay_plain',)),
    'markers 1000 Hz, streams': ('markers', 1000, ('relay_streams',)),
    'grid 30 Hz, streams': ('grid', 30, ('relay_streams',)),
    'whole chain 250 Hz': CHAIN_250,
    'bodies 250 Hz': CHAIN_250,
    'whole chain 700 Hz': ('markers', 700, ('correction_node', 'reconstruction_node')),
    'whole chain 1000 Hz': ('markers', 1000, ('correction_node', 'reconstruction_node')),
    'whole chain 1000 Hz, deep': ('markers', 1000, ('correction_node', 'reconstruction_node')),
    'whole chain 250 Hz, flood elsewhere': CHAIN_250,
    'whole chain 250 Hz, flood of a': CHAIN_250,
    'whole chain 250 Hz, flood of a, shed': CHAIN_250,
}
DEEP = {
    f'qos_overrides./{name}/corrected_observations.{end}.depth': 1000
    for name in 'ab'
    for end in ('publisher', 'subscription')
}  # queues of one second instead of a tenth
# As in config/shed_floods.xml, which limits how much such a reader keeps.
SHED = {
    f'qos_overrides./{name}/{topic}.subscription.history': 'keep_all'
    for name in NAMES
    for topic in ('target_observations', 'corrected_observations')
} | {'waiting': 200}
ROOT = Path(__file__).parents[1]
FLOODER = ROOT / 'tests' / 'ros' / 'flooder.py'
FLOOD_STARTS_S = 3.0
OWN_PARAMETERS = {
    'calibration_node': {
        'phantom': ROOT / 'bags' / 'phantom.csv',
        'calibration_directory': Path(os.devnull) / 'none',
    }
}
BODIES = 5  # rigid clusters
OUTPUTS = {
    'correction_node': ('corrected_observations', CorrectedObservations),
    'relay_plain': ('relayed_plain', TargetObservations),
    'relay_streams': ('relayed_streams', TargetObservations),
}
TICK = os.sysconf('SC_CLK_TCK')


def logged(node: Node) -> FaultHandlers:
    """Log every fault of a stream reader of this process."""
    fatal = node.get_logger().fatal
    return FaultHandlers(fatal, lambda topic, error: fatal(f'{topic}: {error!r}'), fatal)


class Reader(Node):
    """Publishes the calibration and counts the outputs of the nodes."""

    def __init__(self, calibrations: Mapping[str, Calibration], orientation: Orientation) -> None:
        super().__init__('reader')
        self.spinner = SingleThreadedExecutor()
        self.spinner.add_node(self)
        for name, calibration in calibrations.items():
            self.create_publisher(
                FluoroscopeCalibration, f'{name}/calibration', latched_qos()
            ).publish(message_from_calibration(calibration))
        self.create_publisher(RigOrientation, 'rig_orientation', latched_qos()).publish(
            message_from_orientation(orientation)
        )
        self.ready: set[str] = set()  # fluoroscopes whose correction is running
        for name in NAMES:
            self.create_subscription(
                CameraInfo,
                f'{name}/camera_info',
                lambda _, name=name: self.ready.add(name),
                latched_qos(),
            )
        self.taken = dict.fromkeys(NAMES, 0)  # frames that a calibration node has received
        for name in NAMES:
            self.create_subscription(
                CalibrationStatus, f'{name}/calibration_status', self._on_status, 10
            )
        self.within: dict[str, list[tuple[float, float]]] = {}  # node: [(p50, p99), ...] [ms]
        self.create_subscription(DiagnosticArray, '/diagnostics', self._on_diagnostics, 50)
        # (node, fluoroscope): [(frame number, latency [ns]), ...]
        self.came: dict[tuple[str, str], list[tuple[int, int]]] = {}
        self.reader: StreamReader | None = None

    def _on_status(self, status: CalibrationStatus) -> None:
        self.taken[status.fluoroscope] = status.frames_received

    def _on_diagnostics(self, array: DiagnosticArray) -> None:
        for status in array.status:
            values = {v.key: v.value for v in status.values}
            if 'latency p50 [ms]' in values:
                self.within.setdefault(status.name.partition(':')[0].strip('/'), []).append(
                    (float(values['latency p50 [ms]']), float(values['latency p99 [ms]']))
                )

    def listen(self, nodes: Sequence[str], of_bodies: bool) -> None:
        """Start counting the outputs of nodes; for a reconstruction, poses of bodies or points."""
        self.came = {}
        self.within = {}
        reader = StreamReader(self, logged(self))
        for node in nodes:
            if node == 'calibration_node':
                continue
            if node == 'reconstruction_node':
                topic, kind = (
                    ('reconstruction/body_poses', BodyPoses)
                    if of_bodies
                    else ('reconstruction/points_with_covariance', ReconstructedPoints)
                )
                self._listen(reader, node, 'ab', topic, kind)
                continue
            topic, kind = OUTPUTS[node]
            for name in NAMES:
                self._listen(reader, node, name, f'{name}/{topic}', kind)
        reader.start()
        self.reader = reader

    def _listen(self, reader: StreamReader, node: str, name: str, topic: str, kind: type) -> None:
        came = self.came[node, name] = []
        reader.subscribe(
            kind,
            topic,
            lambda data, info: came.append(_number_and_latency(data, info)),
            observations_qos(),
            decode=bytes,
        )

    def stop(self) -> None:
        """Stop counting."""
        if self.reader is not None:
            self.reader.stop()

    def wait(self, condition: Callable[[], Any], seconds: float, what: str) -> None:
        """Spin until condition() is true."""
        end = time.monotonic() + seconds
        while not condition():
            if time.monotonic() > end:
                raise SystemExit(f'waited {seconds} s for {what}')
            self.spinner.spin_once(timeout_sec=0.1)


def _number_and_latency(data: bytes, info: dict[str, int]) -> tuple[int, int]:
    """Return frame number and latency [ns] from the CDR bytes of a message."""
    seconds, nanoseconds, length = struct.unpack_from('<iII', data, 4)
    at = 4 + (12 + length + 3) // 4 * 4
    return struct.unpack_from('<I', data, at)[0], info[
        'source_timestamp'
    ] - seconds * 10**9 - nanoseconds


def _cpu(process: subprocess.Popen[Any]) -> float:
    """Return the CPU time [s] that a process has used, summed over its threads."""
    fields = Path(f'/proc/{process.pid}/stat').read_text().rpartition(')')[2].split()
    return (int(fields[11]) + int(fields[12])) / TICK


def _command(node: str, **parameters: Any) -> list[str]:
    module = (
        ['benchmarks.relay', node.removeprefix('relay_')]
        if node.startswith('relay')
        else [f'fluoro_calib_ros.nodes.{node}']
    )
    command = [sys.executable, '-m', *module, '--ros-args']
    for key, value in parameters.items():
        command += ['-p', f'{key}:={value}']
    return command


def measured(
    reader: Reader,
    scene: str,
    rate: float,
    nodes: Sequence[str],
    seconds: float,
    log: IO[bytes],
    parameters: Mapping[str, Any],
) -> list[dict[str, Any]]:
    """Return [{node, lost, p50, p99, max [ms], cpu [us a message]}] of a case."""
    processes = {
        node: subprocess.Popen(
            _command(node, **parameters, **OWN_PARAMETERS.get(node, {})), stdout=log, stderr=log
        )
        for node in nodes
    }
    frames = round(rate * seconds)
    reader.listen(nodes, 'bodies' in parameters)
    reader.ready.clear()
    if 'correction_node' in nodes:
        reader.wait(lambda: len(reader.ready) == len(NAMES), 60, 'the correction node')
    simulator = subprocess.Popen(
        _command(
            'simulator_node',
            scene=scene,
            rate=float(rate),
            clusters=BODIES,
            frames=frames,
            wait_for_readers=len(nodes) - ('reconstruction_node' in nodes),
        ),
        stdout=log,
        stderr=log,
    )
    try:
        reader.wait(lambda: all(reader.came.values()), 60, 'the first frames')
        began = {node: _cpu(p) for node, p in processes.items()} | {
            'simulator_node': _cpu(simulator)
        }
        first = {key: len(of_one) for key, of_one in reader.came.items()}
        reader.wait(
            lambda: simulator.poll() is not None or _nearly(reader.came, frames),
            seconds + 60,
            'the stream',
        )
        used = {node: _cpu(p) - began[node] for node, p in processes.items()}
        counted = {key: len(of_one) - first[key] for key, of_one in reader.came.items()}
        reader.wait(lambda: simulator.poll() is not None, 60, 'the end of the simulator')
        if 'calibration_node' in nodes:
            reader.wait(lambda: min(reader.taken.values()) == frames, 60, 'the calibration node')
    finally:
        for process in (*processes.values(), simulator):
            if process.poll() is None:
                process.send_signal(signal.SIGINT)
        for process in (*processes.values(), simulator):
            process.wait(20)
        reader.stop()
    return [_figures(reader, node, frames, used[node], counted) for node in nodes]


def _nearly(came: Mapping[Any, Sequence[tuple[int, int]]], frames: int) -> bool:
    """Return whether all but the last frames have arrived, where CPU time measurement ends."""
    return all(of_one[-1][0] >= frames - 10 for of_one in came.values())


def _figures(
    reader: Reader, node: str, frames: int, used: float, counted: Mapping[Any, int]
) -> dict[str, Any]:
    if node == 'calibration_node':
        # The messages are those of the other node; the measurement waited until all had arrived.
        messages = sum(counted.values())
        unknown = dict.fromkeys(('within_p50', 'within_p99', 'p50', 'p95', 'p99', 'max'), np.nan)
        lost = len(NAMES) * frames - sum(reader.taken.values())
        cpu_us = used / messages * 1e6
        return {
            'node': node,
            'frames': len(NAMES) * frames,
            'lost': lost,
            **unknown,
            'cpu_us': cpu_us,
        }
    of_node = {key: np.array(of_one) for key, of_one in reader.came.items() if key[0] == node}
    latency = np.concatenate([of_one[:, 1] for of_one in of_node.values()]) * 1e-6
    lost = sum(frames - len(np.unique(of_one[:, 0])) for of_one in of_node.values())
    twice = sum(len(of_one) - len(np.unique(of_one[:, 0])) for of_one in of_node.values())
    messages = sum(counted[key] for key in of_node) * (2 if node == 'reconstruction_node' else 1)
    within = np.array(reader.within.get(node, [(np.nan, np.nan)]))
    return {
        'node': node,
        'frames': frames * len(of_node),
        'lost': lost,
        'twice': twice,
        'within_p50': np.median(within[:, 0]),
        'within_p99': within[:, 1].max(),
        'p50': np.percentile(latency, 50),
        'p95': np.percentile(latency, 95),
        'p99': np.percentile(latency, 99),
        'max': latency.max(),
        'cpu_us': used / messages * 1e6,
    }


def rig_of_the_simulator() -> tuple[dict[str, Calibration], Orientation]:
    """Return calibrations and orientation of the rig that the simulator shows."""
    rig = virtual_rig(1)
    frames = simulate_exposures(rig, 15, 1).frames
    job = calibrate(frames, rig.phantom)
    return job.calibrations, orientation_and_scatter(frames, rig.phantom, job.calibrations)[0]


def write_clusters(folder: Path) -> Path:
    """Write the rigid clusters of the simulator as bodies.csv; return the path."""
    tracking = simulate_tracking(virtual_rig(1), 0.01, 250, seed=1, clusters=BODIES)
    shapes = np.split(tracking.points_mm[0], BODIES)
    ids = np.split(tracking.marker_id, BODIES)
    path = folder / 'bodies.csv'
    write_bodies(
        path,
        [Body(f'b{k}', *each, np.zeros(len(each[0]))) for k, each in enumerate(zip(ids, shapes))],
    )
    return path


def parameters_of(case: str, bodies: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return the parameters of the nodes in a case."""
    of_kind = {'deep': DEEP, 'bodies': bodies, 'shed': SHED}
    return next((given for kind, given in of_kind.items() if kind in case), {})


@contextmanager
def flood(case: str, log: IO[bytes]) -> Iterator[None]:
    """Run a hostile publisher, or one on a topic that nobody reads, if the case requires it."""
    if 'flood' not in case:
        yield
        return
    topic = 'elsewhere' if 'elsewhere' in case else 'a/target_observations'
    remap = f'a/target_observations:={topic}'
    command = [sys.executable, str(FLOODER), '/', '--ros-args', '-r', remap]
    with subprocess.Popen(command, stdout=log, stderr=log) as peer:
        time.sleep(FLOOD_STARTS_S)
        try:
            yield
        finally:
            peer.kill()


@contextmanager
def shedding(on: bool) -> Iterator[None]:
    """Let nodes that are started in this context read config/shed_floods.xml."""
    variable = 'FASTRTPS_DEFAULT_PROFILES_FILE'
    before = os.environ.get(variable)
    if on:
        os.environ[variable] = str(ROOT / 'config' / 'shed_floods.xml')
    try:
        yield
    finally:
        os.environ.pop(variable, None)
        if before is not None:
            os.environ[variable] = before


def run(seconds: float, only: str = '') -> dict[str, list[dict[str, Any]]]:
    """Return the results of the nodes by case."""
    isolate_ros_graph()
    rclpy.init(args=[])
    reader = Reader(*rig_of_the_simulator())
    out = {}
    with (
        open(os.environ.get('ONLINE_LOG', os.devnull), 'ab') as log,
        tempfile.TemporaryDirectory() as folder,
    ):
        bodies = {'bodies': write_clusters(Path(folder))}
        for case, (scene, rate, nodes) in CASES.items():
            if only not in case:
                continue
            with flood(case, log), shedding('shed' in case):
                out[case] = measured(
                    reader,
                    scene,
                    rate,
                    nodes,
                    seconds=seconds,
                    log=log,
                    parameters=parameters_of(case, bodies),
                )
            print(
                case,
                *(
                    ' '.join(
                        f'{k} {v:.3f}' if isinstance(v, float) else f'{k} {v}'
                        for k, v in f.items()
                    )
                    for f in out[case]
                ),
                sep='\n   ',
                flush=True,
            )
    reader.destroy_node()
    rclpy.shutdown()
    return out


def text_of(results: Mapping[str, Sequence[dict[str, Any]]]) -> str:
    """Return a Markdown table of the results."""
    rows = []
    for case, figures in results.items():
        for f in figures:
            latencies = [f[key] for key in ('within_p50', 'within_p99', 'p50', 'p95', 'p99')]
            rows.append(
                [
                    f'{case}: {f["node"]}',
                    str(f['frames']),
                    str(f['lost']),
                    *('-' if np.isnan(ms) else f'{ms:.2f}' for ms in latencies),
                    '-' if np.isnan(f['max']) else f'{f["max"]:.1f}',
                    f'{f["cpu_us"]:.0f}',
                ]
            )
    return table(
        [
            'case: node',
            'frames',
            'lost',
            'in the node p50 [ms]',
            'p99 [ms]',
            'from the stamp p50 [ms]',
            'p95 [ms]',
            'p99 [ms]',
            'max [ms]',
            'CPU per message [us]',
        ],
        rows,
    )


if __name__ == '__main__':
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--seconds', type=float, default=60.0)
    parser.add_argument('--only', default='', help='cases whose name contains this')
    parser.add_argument('--out', type=Path, help='page with the table, docs/how_good/speed.md')
    options = parser.parse_args()
    show_section(text_of(run(options.seconds, options.only)), options.out, 'nodes')
