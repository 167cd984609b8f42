# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Real nodes as processes, and a client that publishes, subscribes, calls and waits with a
deadline.
"""

import itertools
import os
import signal
import subprocess
import sys
import time
import uuid
from pathlib import Path

import numpy as np
import rclpy
from action_msgs.msg import GoalStatus
from dds_ports import free_domain
from diagnostic_msgs.msg import DiagnosticArray
from fluoro_calib_msgs.action import Heal, SelfCalibrate
from fluoro_calib_msgs.msg import (
    BodyPoses,
    CalibrationStatus,
    CorrectedObservations,
    DriftStatus,
    FluoroscopeCalibration,
    JointAngles,
    ReconstructedPoints,
    Retraction,
    RigOrientation,
    TargetObservations,
)
from fluoro_calib_msgs.srv import (
    Calibrate,
    Capture,
    LoadCalibration,
    Orient,
    Reset,
    SaveCalibration,
)
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from rcl_interfaces.srv import GetParameterTypes
from rclpy.action import ActionClient
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CameraInfo, JointState, PointCloud2
from tf2_msgs.msg import TFMessage
from unique_identifier_msgs.msg import UUID
from visualization_msgs.msg import MarkerArray

from fluoro_calib_ros.exposures.frame import Frame
from fluoro_calib_ros.nodes.messages.bodies import FORMS
from fluoro_calib_ros.nodes.messages.observations import message_from_frame
from fluoro_calib_ros.nodes.runtime.topics import OBSERVATION_DEPTH, latched_qos

ROOT = Path(__file__).parents[2]
BAGS = ROOT / 'bags'
DEADLINE = 60.0  # seconds; nothing takes a tenth of it on an idle machine
JOB_DEADLINE = 240.0  # seconds; for self-calibrations and extractions, which run at low priority
NAMES = ('a', 'b')
SUCCEEDED = GoalStatus.STATUS_SUCCEEDED
CANCELED = GoalStatus.STATUS_CANCELED
ABORTED = GoalStatus.STATUS_ABORTED
# For the client, on a machine that is too busy to keep up with the rate of a stream.
DEEP = QoSProfile(depth=1000, reliability=ReliabilityPolicy.RELIABLE)
TOPICS = {
    'target_observations': (TargetObservations, DEEP),
    'corrected_observations': (CorrectedObservations, DEEP),
    'calibration': (FluoroscopeCalibration, latched_qos()),
    'camera_info': (CameraInfo, latched_qos()),
    'calibration_status': (CalibrationStatus, 10),
    'retractions': (Retraction, DEEP),
    'rig_orientation': (RigOrientation, latched_qos()),
    'points_with_covariance': (ReconstructedPoints, DEEP),
    'points': (PointCloud2, DEEP),
    'markers': (MarkerArray, DEEP),
    'body_poses': (BodyPoses, DEEP),
    'pose': (PoseWithCovarianceStamped, DEEP),
    'odometry': (Odometry, DEEP),
    'joint_angles': (JointAngles, DEEP),
    'joint_states': (JointState, DEEP),
    'tf': (TFMessage, DEEP),
    'drift': (DriftStatus, 10),
    'tf_static': (TFMessage, latched_qos()),
    **{name: (kind, DEEP) for name, (kind, _) in FORMS.items()},
}

SERVICES = {
    'calibrate': Calibrate,
    'capture': Capture,
    'collect_anew': Reset,
    'accept_healing': Reset,
    'load_calibration': LoadCalibration,
    'orient': Orient,
    'reset': Reset,
    'roll_back_healing': Reset,
    'save_calibration': SaveCalibration,
}


def lost_ports(name, pid):
    """Return a line listing removed Fast DDS ports that a process still uses."""
    maps = Path(f'/proc/{pid}/maps').read_text().splitlines()
    lost = {line.split()[-2] for line in maps if 'fastrtps_port' in line and 'deleted' in line}
    return f'{name}: {", ".join(sorted(lost)) or "none"}'


def entry_point(node):
    """Return the command that runs a node or the command-line program fluoro-calib."""
    module = 'fluoro_calib_ros.cli' if node == 'cli' else f'fluoro_calib_ros.nodes.{node}'
    return [sys.executable, '-m', module]


class Process:
    """A command in its own process; its output is in .log."""

    def __init__(self, command, path, environment=None):
        self.path = path
        with open(path, 'wb') as out:
            self._process = subprocess.Popen(
                command,
                cwd=ROOT,
                stdout=out,
                stderr=out,
                start_new_session=True,
                env={**os.environ, **(environment or {}), 'PYTHONFAULTHANDLER': '1'},
            )

    @property
    def log(self):
        return self.path.read_text(errors='replace')

    @property
    def pid(self):
        return self._process.pid

    @property
    def running(self):
        return self._process.poll() is None

    def wait(self, seconds=DEADLINE):
        """Return the exit status of the process once it has ended."""
        return self._process.wait(seconds)

    def interrupt(self):
        self._process.send_signal(signal.SIGINT)

    def kill(self):
        self._process.kill()
        return self.wait()

    def abort(self):
        """End the process so that it prints the stack of each thread."""
        if self.running:
            self._process.send_signal(signal.SIGABRT)
            self.wait()

    def end(self, seconds=10.0):
        """Interrupt the process, kill it if that fails, and return its exit status."""
        if self.running:
            self.interrupt()
        try:
            return self.wait(seconds)
        except subprocess.TimeoutExpired:
            self._process.kill()
            return self.wait()


class ForkedProcess(Process):
    """A node as a process forked from the NodeServer."""

    def __init__(self, server, node, arguments, path, environment):
        self.path = path
        self._process = server.start(node, arguments, path, {**os.environ, **environment})


class Graph:
    """Nodes and a client in their own ROS domain and namespace.

    No graph reuses the ports of one that has just ended: Fast DDS removes its shared-memory ports
    when a process ends, and a node that opens one meanwhile may lose all messages sent to it.

    .fork: whether nodes are forked from a process that has loaded their modules; otherwise each
    is started by the command that users run.
    """

    _numbers = itertools.count(1)

    def __init__(self, directory, server):
        self.fork = True
        self._server = server
        self.namespace = f'/rig{next(self._numbers)}'
        self.directory = directory
        self.processes = []
        domain, self._lock = free_domain()
        self.environment = {'ROS_DOMAIN_ID': str(domain)}
        self._context = Context()
        rclpy.init(args=[], context=self._context, domain_id=domain)
        self.client = Client(self.namespace, self._context)

    def start(self, node, parameters=None, remaps=None, wait=True):
        """Start a node with parameters and remaps; return its Process once the client is
        connected.
        """
        number = len(self.processes)
        arguments = ['--ros-args']
        for key, value in (parameters or {}).items():
            arguments += ['-p', f'{key}:={value}']
        for key, value in {
            '__ns': self.namespace,
            **(remaps or {}),
        }.items():  # of two rules, the first takes effect
            arguments += ['-r', f'{key}:={value}']
        log = self.directory / f'{number}_{node}.log'
        if self.fork:
            process = ForkedProcess(self._server, node, arguments, log, self.environment)
        else:
            process = Process(entry_point(node) + arguments, log, self.environment)
        self.processes.append(process)
        if wait:
            self.client.connect(node, process)
        return process

    def calibration_node(self, directory, wait=True, **parameters):
        return self.start(
            'calibration_node',
            {'phantom': BAGS / 'phantom.csv', 'calibration_directory': directory, **parameters},
            wait=wait,
        )

    def both_nodes(self, directory, **parameters):
        """Start the calibration and correction nodes together; return their processes by name."""
        nodes = {
            'calibration_node': self.calibration_node(directory, wait=False, **parameters),
            'correction_node': self.start('correction_node', wait=False),
        }
        for name, process in nodes.items():
            self.client.connect(name, process)
        return nodes

    def whole_chain(self, directory, reconstruction=None, **parameters):
        """Start the three nodes with the calibrations and the orientation stored in a folder.

        Return the processes by name once points can be reconstructed.
        """
        nodes = {
            **self.both_nodes(directory, **parameters),
            'reconstruction_node': self.start('reconstruction_node', reconstruction),
        }
        for name in NAMES:
            self.client.wait_for_diagnostics(
                'correction_node', lambda s: value_of(s, 'calibration'), name
            )
        self.client.wait_for_diagnostics(
            'reconstruction_node', lambda s: value_of(s, 'orientation'), 'reconstruction'
        )
        self.wait_for_readers(1)
        return nodes

    def wait_for_readers(self, count, node='correction_node', names=NAMES, key='readers'):
        """Wait until a node has discovered `count` readers of its output for every fluoroscope."""
        for name in names:
            self.client.wait_for_diagnostics(
                node, lambda s: int(value_of(s, key) or 0) >= count, name, f'the {key}'
            )

    def play(self, bag, readers, rate=10.0):
        """Play a bag to its end."""
        player = self.start(
            'player_node', {'bag': bag, 'rate': rate, 'wait_for_readers': readers}, wait=False
        )
        self.client.wait_until(lambda: not player.running, what='the end of the player')
        assert player.wait() == 0, player.log

    def last_words(self, end):
        """Return (title, text) pairs with the last statuses and the logs of all nodes.

        end: whether to abort the nodes, so that their logs show the stack of each thread.
        """
        running = {p.path.stem: p.pid for p in self.processes if p.running}
        ports = '\n'.join(map(lost_ports, ['client', *running], [os.getpid(), *running.values()]))
        for process in self.processes if end else ():
            process.abort()
        heard = [
            (key, f'{status.message}\n' + '\n'.join(f'{v.key}: {v.value}' for v in status.values))
            for key, status in self.client.statuses.items()
        ]
        logs = [(f'log of {p.path.name}', p.log) for p in self.processes]
        return [*heard, ('ports in shared memory that were removed while in use', ports), *logs]

    def close(self):
        running = [p for p in self.processes if p.running]
        for process in running:
            process.interrupt()
        for process in running:
            process.end()
        self.client.close()
        rclpy.shutdown(context=self._context)
        self._lock.close()


class Client(Node):
    """A user of the graph; messages[topic] holds the messages received since listen(topic)."""

    def __init__(self, namespace, context):
        super().__init__('client', namespace=namespace, context=context)
        self.messages = {}
        self.statuses = {}
        self.feedback = []
        self._spinner = SingleThreadedExecutor(context=context)
        self._spinner.add_node(self)
        self._callers = {}
        for service, kind in SERVICES.items():
            self.expect(kind, service)
        self._outputs = {
            n: self.create_publisher(TargetObservations, f'{n}/target_observations', DEEP)
            for n in NAMES
        }
        self.create_subscription(DiagnosticArray, '/diagnostics', self._on_diagnostics, 50)
        for name in NAMES:
            self.listen(f'{name}/calibration_status')
        self.published = 0
        self._action = ActionClient(self, SelfCalibrate, 'self_calibrate')
        self._heal = ActionClient(self, Heal, 'heal')
        # An ActionClient drops the feedback that it has not taken before the result.
        self._goal_id = UUID()
        for action, kind in (('self_calibrate', SelfCalibrate), ('heal', Heal)):
            self.create_subscription(
                kind.Impl.FeedbackMessage, f'{action}/_action/feedback', self._on_feedback, DEEP
            )

    # -- waiting

    def wait_until(self, condition, seconds=DEADLINE, what='the condition'):
        """Spin until condition() is true and return its value; fail after the deadline."""
        end = time.monotonic() + seconds
        self._spinner.spin_once(timeout_sec=0)
        while True:
            value = condition()
            if value:
                return value
            assert time.monotonic() < end, f'waited {seconds:g} s for {what}'
            self._spinner.spin_once(timeout_sec=0.1)

    def publish_in_step(self, messages, came, ahead=OBSERVATION_DEPTH // 4):
        """Publish (fluoroscope, message) pairs, never more than `ahead` ahead of came().

        came(): number of messages that were answered or never will be. No queue overflows.
        """
        for number, (name, message) in enumerate(messages):
            self.wait_until(lambda: number - came() < ahead, what='the nodes to keep up')
            self.publish_message(name, message)

    def result_of(self, future, seconds=JOB_DEADLINE, what='an answer'):
        """Return the result of a future."""
        self.wait_until(future.done, seconds, what)
        return future.result()

    def connect(self, node, process):
        """Wait until all endpoints of a newly started node are connected with the client."""

        def connected():
            assert process.running, f'{node} ended: {process.log}'
            if node == 'calibration_node':
                return (
                    self.subscriptions_matched('calibration_node')
                    and self._action.server_is_ready()
                    and self._heal.server_is_ready()
                    and all(self.count_publishers(f'{n}/calibration_status') for n in NAMES)
                )
            if node == 'correction_node':
                return self.subscriptions_matched('correction_node') and all(
                    self.count_publishers(f'{n}/corrected_observations') for n in NAMES
                )
            return any(name == node for name, _ in self.get_node_names_and_namespaces())

        self.wait_until(connected, what=f'{node} to come up')
        self.wait_until_known_to(node)

    def wait_until_known_to(self, node):
        """Wait until a node has discovered all endpoints that the client has created so far.

        Until then, messages and answers may be lost. DDS announces endpoints in the order in which
        they are created: a node that answers a request of the newest client knows the others, too.
        """
        newest = self.create_client(GetParameterTypes, f'{node}/get_parameter_types')
        answers = []
        asked = 0.0

        def answered():
            nonlocal asked
            if newest.service_is_ready() and time.monotonic() > asked + 0.2:
                answers.append(newest.call_async(GetParameterTypes.Request()))
                asked = time.monotonic()
            return any(answer.done() for answer in answers)

        self.wait_until(answered, what=f'{node} to know the client')
        self.destroy_client(newest)

    def subscriptions_matched(self, node):
        """Return whether a node subscribes to the observations and all subscribers match."""
        for name, output in self._outputs.items():
            readers = self.get_subscriptions_info_by_topic(
                f'{self.get_namespace()}/{name}/target_observations'
            )
            if node not in [r.node_name for r in readers] or output.get_subscription_count() < len(
                readers
            ):
                return False
        return True

    # -- topics

    def listen(self, topic):
        """Collect the messages of a topic; return the list to which they are appended."""
        kind, qos = TOPICS[topic.rpartition('/')[2]]
        collected = self.messages[topic] = []
        self.create_subscription(kind, topic, collected.append, qos)
        return collected

    def _on_feedback(self, message):
        if message.goal_id == self._goal_id:
            self.feedback.append(message.feedback)

    def _on_diagnostics(self, array):
        for status in array.status:
            if status.name.startswith(self.get_namespace() + '/'):
                self.statuses[status.name.removeprefix(self.get_namespace() + '/')] = status

    def status(self, name='a'):
        """Return the newest CalibrationStatus of a fluoroscope, None before the first."""
        return (
            self.messages[f'{name}/calibration_status'][-1]
            if self.messages[f'{name}/calibration_status']
            else None
        )

    def wait_for_status(self, condition, name='a', what='a status'):
        """Return the newest CalibrationStatus once it fulfils condition(status)."""
        self.wait_until(lambda: self.status(name) and condition(self.status(name)), what=what)
        return self.status(name)

    def wait_for_diagnostics(self, node, condition, name='a', what='a diagnostic'):
        """Return the newest DiagnosticStatus of a fluoroscope that fulfils condition(status)."""
        key = f'{node}: {name}'
        self.wait_until(
            lambda: key in self.statuses and condition(self.statuses[key]),
            what=f'{what} of {node}',
        )
        return self.statuses[key]

    def publish(self, frame):
        """Publish a Frame."""
        self._outputs[frame.fluoroscope].publish(message_from_frame(frame))

    def publish_message(self, name, message):
        self._outputs[name].publish(message)

    def stream(self, pairs, rate, answered=None):
        """Publish pairs of frames at a rate while the client spins, until end_stream().

        .published counts the pairs. answered(): number of pairs that have come back; the stream is
        never more than half a queue ahead of it, so that an overloaded machine loses nothing.
        """
        self.published = 0

        def publish():
            if answered is not None and self.published - answered() >= OBSERVATION_DEPTH // 2:
                return
            pair = next(pairs, None)
            if pair is not None:
                for frame in pair:
                    self.publish(frame)
                self.published += 1

        self._stream = self.create_timer(1 / rate, publish)

    def end_stream(self):
        self.destroy_timer(self._stream)

    # -- services and action

    def expect(self, kind, service):
        """Create the client of a service before its node starts: see wait_until_known_to()."""
        self._callers[service] = self.create_client(kind, service)

    def call_async(self, kind, service, **fields):
        """Return the future of the response of an expected service."""
        self.wait_until(self._callers[service].service_is_ready, what=f'the service {service}')
        return self._callers[service].call_async(kind.Request(**fields))

    def call(self, kind, service, **fields):
        """Return the response of a service."""
        seconds = JOB_DEADLINE if kind is Calibrate else DEADLINE
        return self.result_of(
            self.call_async(kind, service, **fields), seconds, f'the answer of {service}'
        )

    def goal(self, **fields):
        """Return the handle of an accepted goal.

        Its feedback is collected in .feedback, where the last ones may arrive after the result.
        """
        return self._sent(self._action, SelfCalibrate.Goal(**fields))

    def heal(self, **fields):
        """Do the same as goal() for the action heal."""
        return self._sent(self._heal, Heal.Goal(**fields))

    def _sent(self, action, goal):
        self.feedback = []
        self._goal_id = UUID(uuid=list(uuid.uuid4().bytes))
        handle = self.result_of(action.send_goal_async(goal, goal_uuid=self._goal_id))
        assert handle.accepted
        return handle

    def close(self):
        self._spinner.shutdown()
        for action in (self._action, self._heal):  # they would keep the node in the graph
            action.destroy()
        self.destroy_node()


def value_of(status, key):
    """Return the value of a key of a DiagnosticStatus, or '' if it has no such key."""
    return next((v.value for v in status.values if v.key == key), '')


def standing(frame, count, first=1, rate=60.0, shift=0.0, noise=0.02, start_ns=10**18):
    """Return a stream of frames of a stationary phantom, shifted by shift px per frame."""
    rng = np.random.default_rng(0)
    for i in range(count):
        uv = frame.uv + rng.normal(0, noise, frame.uv.shape) + [shift * i, 0]
        keep = (uv < np.array(frame.image_size) - 1).all(axis=1)
        yield Frame(
            frame.fluoroscope,
            first + i,
            frame.target_id[keep],
            uv[keep],
            frame.image_size,
            None,
            start_ns + round(i / rate * 1e9),
            frame.frame_id,
        )
