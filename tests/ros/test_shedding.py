# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""config/shed_floods.xml: messages that find no place while a reader waits are sent again."""

import os
import subprocess
import sys

from ros_graph import ROOT

HONEST = 80
# Output lines report each finished step; input lines allow the next step to begin.
PUBLISH = """
import sys
import rclpy
from std_msgs.msg import Int32
rclpy.init()
nodes = [rclpy.create_node(name) for name in ('honest', 'hostile')]
honest, hostile = (node.create_publisher(Int32, '/a/target_observations', 100) for node in nodes)
while not honest.get_subscription_count() or not hostile.get_subscription_count():
    rclpy.spin_once(nodes[0], timeout_sec=0.1)
print('matched', flush=True)
sys.stdin.readline()
for number in range(int(sys.argv[1])):
    honest.publish(Int32(data=number))
    for _ in range(25):
        hostile.publish(Int32(data=-1))
print('published', flush=True)
sys.stdin.readline()
"""
READ = """
import os, subprocess, sys, time
import rclpy
from rclpy.qos import HistoryPolicy, QoSProfile
from std_msgs.msg import Int32
rclpy.init()
node = rclpy.create_node('reading')
qos = QoSProfile(history=HistoryPolicy.KEEP_ALL, depth=100)
found = []
topic = '/a/target_observations'
reader = node.create_subscription(Int32, topic, lambda message: found.append(message.data), qos)
command = [sys.executable, '-c', sys.argv[2], sys.argv[1]]
pipe = subprocess.PIPE
with subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True) as publishers:
    publishers.stdout.readline()
    while node.count_publishers(topic) < 2 or reader.get_publisher_count() < 2:
        rclpy.spin_once(node, timeout_sec=0.1)
    print(file=publishers.stdin, flush=True)
    publishers.stdout.readline()
    end = time.monotonic() + 30
    while time.monotonic() < end and len(set(found) - {-1}) < int(sys.argv[1]):
        rclpy.spin_once(node, timeout_sec=0.1)
    publishers.stdin.close()
print(len(set(found) - {-1}), found.count(-1), flush=True)
os._exit(0)
"""


def test_flood_displaces_its_own_messages(ros):
    """Part of a flood of 2,000 to an idle reader is displaced; all other messages arrive."""
    profile = str(ROOT / 'config' / 'shed_floods.xml')
    done = subprocess.run(
        [sys.executable, '-c', READ, str(HONEST), PUBLISH],
        env={**os.environ, 'FASTRTPS_DEFAULT_PROFILES_FILE': profile},
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert done.returncode == 0 and not done.stderr, done.stderr
    others, of_flood = map(int, done.stdout.split())
    assert others == HONEST and 0 < of_flood < 1000
