# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""config/shed_floods.xml: what finds no place while a reader waits is sent again."""

import os
import subprocess
import sys

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
sys.stdin.read(1)
for number in range(int(sys.argv[1])):
    honest.publish(Int32(data=number))
    for _ in range(20):
        hostile.publish(Int32(data=-1))
for number in range(400):
    hostile.publish(Int32(data=-1))
    time.sleep(0.001)
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
qos = QoSProfile(history=HistoryPolicy.KEEP_ALL, depth=100)
reader = node.create_subscription(Int32, '/a/target_observations', lambda _: None, qos)
command = [sys.executable, '-c', sys.argv[2], sys.argv[1]]
pipe = subprocess.PIPE
with subprocess.Popen(command, stdin=pipe, stdout=pipe) as publishers:
    while node.count_publishers('/a/target_observations') < 2:
        time.sleep(0.05)
    time.sleep(1)  # the endpoints are matched a little later
    publishers.stdin.write(b'1')
    publishers.stdin.close()
    publishers.stdout.read(1)
    time.sleep(0.5)
    found = []
    end = time.monotonic() + 10
    while time.monotonic() < end and len(set(found) - {-1}) < int(sys.argv[1]):
        taken = reader.handle.take_message(Int32, False)
        if taken is None:
            time.sleep(0.01)
        else:
            found.append(taken[0].data)
    publishers.kill()
print(len(set(found) - {-1}), found.count(-1), flush=True)
os._exit(0)
"""


def test_flood_displaces_its_own_messages(ros):
    """Of 2,000 while the reader takes nothing; all others arrive."""
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
