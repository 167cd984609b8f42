# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""SIGINT during long computations: nodes do not wait for them to finish."""

import signal
import subprocess
import sys
from dataclasses import replace
from subprocess import PIPE

import numpy as np
import pytest
from fluoro_calib_msgs.msg import FluoroscopeCalibration
from rigs import calibrated, create_model
from ros_graph import ROOT

from fluoro_calib_ros.nodes.messages.fluoroscope_calibration import message_from_calibration
from fluoro_calib_ros.nodes.runtime.topics import latched_qos

SIDE = 8192  # px; preparing this calibration takes a minute
POINTS = 200_000
END_S = 30  # a tenth of it suffices on an idle machine
BUSY = """
import threading
from rclpy.node import Node
from fluoro_calib_ros.nodes.runtime.main import run

class Busy(Node):
    end_s = 1.5

    def __init__(self):
        super().__init__('busy')
        self.create_timer(0.01, self.work)

    def work(self):
        print('at work', flush=True)
        threading.Event().wait()  # for ever, as in a call that does not return

run(Busy)
"""


@pytest.fixture(scope='module')
def costly():
    """Return a calibration message within all limits."""
    uv = np.random.default_rng(1).uniform(0, SIDE - 1, (POINTS, 2))
    small = calibrated('a', 5, model='none').calibrations['a']
    return message_from_calibration(
        replace(
            small,
            image_size=(SIDE, SIDE),
            model=create_model('local_linear', 1000, uv, np.sin(uv), 0.1, 0.0),
            train_exposure=np.zeros(POINTS, dtype=np.int64),
        )
    )


@pytest.mark.parametrize('node', ['image_node', 'correction_node'])
def test_node_ends_while_a_calibration_is_prepared(graph, costly, node):
    process = graph.start(node)
    client = graph.client
    output = client.create_publisher(FluoroscopeCalibration, 'a/calibration', latched_qos())
    client.wait_until(output.get_subscription_count, what='the reader of calibrations')
    output.publish(costly)
    client.wait_until(lambda: 'is being prepared' in process.log, what='the preparation')
    process.interrupt()
    assert process.wait(END_S) == 0
    assert 'in use' not in process.log and 'Traceback' not in process.log


def test_node_that_does_not_end_is_ended(ros):
    """The node ends whatever its main thread does."""
    command = [sys.executable, '-c', BUSY]
    with subprocess.Popen(command, stdout=PIPE, stderr=PIPE, text=True, cwd=ROOT) as node:
        assert node.stdout.readline() == 'at work\n'
        node.send_signal(signal.SIGINT)
        _, log = node.communicate(timeout=END_S)
    assert node.returncode == 1
    assert 'ended by force: the current work takes longer than 1.5 s' in log
