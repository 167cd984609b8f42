# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Run the graph of a rig under SROS 2, with the policy of config/sros2_policy.xml enforced.

python -m benchmarks.secured KEYSTORE [--foreign KEYSTORE]

KEYSTORE is created as described in docs/reliability.md; the ROS of this environment must have a
Fast DDS with security plugins. Calibrates from bags/calibration and reconstructs bags/tracking
with each node in its enclave; then tries to publish a calibration from the enclave of the player,
without keys, and with keys of another authority.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import rclpy
from fluoro_calib_msgs.msg import CalibrationStatus
from fluoro_calib_msgs.srv import Calibrate
from rclpy.executors import SingleThreadedExecutor
from sensor_msgs.msg import PointCloud2

from .faults.processes import ROOT, Process, node

TIMEOUT_S = 60.0
LOG_LENGTH = 2000  # characters of each log that are shown after a failure
INTRUDER = """
import sys, time
import rclpy
from fluoro_calib_msgs.msg import FluoroscopeCalibration
from rclpy.qos import QoSDurabilityPolicy, QoSProfile
rclpy.init(args=sys.argv)
name = sys.argv[-1].rpartition('/')[2]  # of the enclave: no other name has rights there
node = rclpy.create_node(name, start_parameter_services=False)
latched = QoSProfile(depth=1, durability=QoSDurabilityPolicy.TRANSIENT_LOCAL)
output = node.create_publisher(FluoroscopeCalibration, '/a/calibration', latched)
output.publish(FluoroscopeCalibration())
readers = 0
end = time.monotonic() + 10.0
while time.monotonic() < end:
    rclpy.spin_once(node, timeout_sec=0.1)
    readers = max(readers, output.get_subscription_count())
print(f'published; readers: {readers}')
"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('keystore', type=Path)
    parser.add_argument('--foreign', type=Path, help='keystore of another authority')
    arguments = parser.parse_args()
    os.environ.update(_enforced(arguments.keystore))
    with tempfile.TemporaryDirectory(prefix='secured_') as folder:
        os.environ['ROS_LOG_DIR'] = str(Path(folder) / 'ros_log')
        try:
            for line in run(Path(folder), arguments.foreign):
                print(line, flush=True)
        except TimeoutError:
            for log in sorted(Path(folder).glob('*.log')):
                print(f'--- {log.name}', log.read_text()[-LOG_LENGTH:], sep='\n')
            raise


def run(folder: Path, foreign: Path | None) -> Iterator[str]:
    """Run the graph, then the intruders; yield lines of the report."""
    rig = {'phantom': ROOT / 'bags' / 'phantom.csv'}
    with ExitStack() as stack:
        start = _Starter(folder, stack)
        start('calibration_node', {**rig, 'calibration_directory': folder / 'calibrations'})
        start('correction_node')
        start('reconstruction_node')
        operator = stack.enter_context(_operator())
        bag = {'bag': ROOT / 'bags' / 'calibration', 'rate': 5.0, 'wait_for_readers': 2}
        player = start('player_node', bag)
        player.wait(TIMEOUT_S)
        operator.wait(lambda: operator.collected, 'the exposures')
        yield f'exposures collected: {operator.collected}'
        answer = operator.calibrate()
        yield f'calibrate: {answer.success}, {answer.message}'
        # Loop, because the first frames may precede the calibrations.
        bag = {'bag': ROOT / 'bags' / 'tracking', 'wait_for_readers': 2, 'loop': 'true'}
        start('player_node', bag)
        operator.wait(lambda: operator.exposures >= 100, 'points in space')
        yield f'exposures reconstructed: {operator.exposures} and more'
        for title, settings, enclave in _intruders(foreign):
            words = [sys.executable, '-c', INTRUDER, '--ros-args', '--enclave', enclave]
            with _environment(settings), Process(words, folder / 'intruder.log') as intruder:
                status = intruder.wait(TIMEOUT_S)
                said = (intruder.output.strip().splitlines() or [''])[-1]
            yield f'{title}: status {status}, {said[:160]}'
        for name, process in start.nodes.items():
            yield f'{name}: {"runs" if process.running else "ended: " + process.output[-300:]}'


def _intruders(foreign: Path | None) -> Iterator[tuple[str, Mapping[str, str], str]]:
    """Yield title, environment and enclave of the processes that try to publish a calibration."""
    yield 'enclave of the player', {}, '/fluoro/player_node'
    yield 'no keys', {'ROS_SECURITY_ENABLE': 'false'}, '/fluoro/calibration_node'
    if foreign is not None:
        yield 'keys of another authority', _enforced(foreign), '/fluoro/calibration_node'


def _enforced(keystore: Path) -> dict[str, str]:
    return {
        'ROS_SECURITY_KEYSTORE': str(keystore.resolve()),
        'ROS_SECURITY_ENABLE': 'true',
        'ROS_SECURITY_STRATEGY': 'Enforce',
    }


@contextmanager
def _environment(settings: Mapping[str, str]) -> Iterator[None]:
    """Set environment variables for the processes that are started within this context."""
    before = dict(os.environ)
    os.environ.update(settings)
    try:
        yield
    finally:
        os.environ.clear()
        os.environ.update(before)


class _Starter:
    """Starts nodes, each in its enclave, that end with a stack of contexts."""

    def __init__(self, folder: Path, stack: ExitStack) -> None:
        self.nodes: dict[str, Process] = {}
        self._folder = folder
        self._stack = stack

    def __call__(self, name: str, parameters: Mapping[str, object] | None = None) -> Process:
        words = [*node(name, parameters), '--enclave', f'/fluoro/{name}']
        log = self._folder / f'{name}_{len(self.nodes)}.log'
        self.nodes[name] = self._stack.enter_context(Process(words, log))
        return self.nodes[name]


@dataclass
class _Operator:
    """A user who calls the services, in the enclave of the operator."""

    node: rclpy.node.Node
    executor: SingleThreadedExecutor
    counts: dict[str, int] = field(default_factory=dict)
    exposures: int = 0

    def __post_init__(self) -> None:
        for name in 'ab':
            topic = f'{name}/calibration_status'
            self.node.create_subscription(CalibrationStatus, topic, self._on_status, 10)
        points = 'reconstruction/points'
        self.node.create_subscription(PointCloud2, points, self._on_points, 100)
        self._client = self.node.create_client(Calibrate, 'calibrate')

    @property
    def collected(self) -> int:
        """Exposures that both fluoroscopes have, once these are all of the bag."""
        least = min(self.counts.values()) if len(self.counts) == 2 else 0
        return least if least >= 15 else 0

    def calibrate(self) -> Calibrate.Response:
        self.wait(self._client.service_is_ready, 'the service')
        answer = self._client.call_async(Calibrate.Request())
        self.wait(answer.done, 'the calibration')
        return answer.result()

    def wait(self, condition: Callable[[], object], what: str) -> None:
        """Spin until a condition is true. Raise TimeoutError after the deadline."""
        end = time.monotonic() + TIMEOUT_S
        while not condition():
            if time.monotonic() > end:
                raise TimeoutError(f'waited {TIMEOUT_S:g} s for {what}')
            self.executor.spin_once(timeout_sec=0.1)

    def _on_status(self, status: CalibrationStatus) -> None:
        self.counts[status.fluoroscope] = status.exposures

    def _on_points(self, _: PointCloud2) -> None:
        self.exposures += 1


@contextmanager
def _operator() -> Iterator[_Operator]:
    rclpy.init(args=['--ros-args', '--enclave', '/fluoro/operator'])
    node = rclpy.create_node('operator')
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    try:
        yield _Operator(node, executor)
    finally:
        executor.shutdown()
        node.destroy_node()
        rclpy.shutdown()


if __name__ == '__main__':
    main()
