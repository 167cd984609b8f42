# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""config/shed_floods.xml: what a flood displaces while a reader waits is sent again."""

import os
import subprocess
import sys

import pytest
from ros_graph import ROOT

HONEST = 80
PUBLISH = """
import sys, time
import rclpy
from std_msgs.msg import Int32
rclpy.init()
nodes = [rclpy.create_node(name) for name in ('honest', 'hostile')]
honest, hostile = (node.create_publisher(Int32, '/a/target_observations', 100) for node in nodes)
while not honest.get_subscription_count() or not hostile.get_subscription_count():
    time.sleep(0.05)
time.sleep(0.5)  # a reader discovers publishers on its own
for number in range(int(sys.argv[1])):
    honest.publish(Int32(data=number))
    for _ in range(20):
        hostile.publish(Int32(data=-1))
print(flush=True)
time.sleep(60)
"""
READ = """
import os, subprocess, sys, time
import rclpy
from rclpy.qos import HistoryPolicy, QoSProfile
from std_msgs.msg import Int32
rclpy.init()
node = rclpy.create_node('reading')
qos = QoSProfile(history=HistoryPolicy[sys.argv[1]], depth=100)
reader = node.create_subscription(Int32, '/a/target_observations', lambda _: None, qos)
command = [sys.executable, '-c', sys.argv[3], sys.argv[2]]
with subprocess.Popen(command, stdout=subprocess.PIPE) as publishers:
    publishers.stdout.read(1)
    time.sleep(0.5)
    found = set()
    end = time.monotonic() + 2
    while time.monotonic() < end and len(found - {-1}) < int(sys.argv[2]):
        taken = reader.handle.take_message(Int32, False)
        if taken is None:
            time.sleep(0.01)
        else:
            found.add(taken[0].data)
    publishers.kill()
print(len(found - {-1}), flush=True)
os._exit(0)
"""


@pytest.mark.parametrize('history', ['KEEP_LAST', 'KEEP_ALL'])
def test_flood_displaces_other_messages_unless_all_are_kept(ros, history):
    """1,600 messages of a flood while the reader takes nothing."""
    profile = str(ROOT / 'config' / 'shed_floods.xml')
    done = subprocess.run(
        [sys.executable, '-c', READ, history, str(HONEST), PUBLISH],
        env={**os.environ, 'FASTRTPS_DEFAULT_PROFILES_FILE': profile},
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert done.returncode == 0 and not done.stderr, done.stderr
    kept = int(done.stdout)
    assert kept == HONEST if history == 'KEEP_ALL' else kept < HONEST // 4
