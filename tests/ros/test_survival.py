# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A stream continues regardless of earlier, additional or missing messages and nodes."""

import itertools
import signal
from dataclasses import replace

import pytest
from ros_graph import NAMES, value_of

from fluoro_calib_ros.io.calibration import load_calibrations

COUNT = 40
POINTS = 'reconstruction/points_with_covariance'


class Rig:
    """The whole chain, with frames to stream through it."""

    def __init__(self, graph, folder, tracking):
        self.graph = graph
        self.folder = folder
        self.client = graph.client
        self.points = self.client.listen(POINTS)
        self.nodes = graph.whole_chain(folder)
        self._pairs = list(zip(*(tracking[n][:COUNT] for n in NAMES)))

    def stream(self, later_s=0.0, number=0):
        """Publish all pairs; return once each is reconstructed."""
        before = len(self.points)
        for sent, pair in enumerate(self._pairs):
            self.client.wait_until(
                lambda: sent - (len(self.points) - before) < 10, what='the nodes to keep up'
            )
            for frame in pair:
                stamp_ns = frame.stamp_ns + round(later_s * 1e9)
                changed = replace(frame, number=frame.number + number, stamp_ns=stamp_ns)
                self.client.publish(changed)
        self.client.wait_until(lambda: len(self.points) == before + COUNT, what='all points')

    def wait_until_reconstructed(self):
        """Publish pairs until points arrive again, and wait for those of the last pair.

        The first pairs are lost if nodes have just been started.
        """
        before = len(self.points)
        numbers = itertools.count(max(self.points[-1].frame_number, 10**6) + 1)

        def publish():
            number = next(numbers)
            for frame in self._pairs[0]:
                self.client.publish(replace(frame, number=number))
            return number

        self.client.wait_until(lambda: publish() and len(self.points) > before, what='points')
        last = publish()
        self.client.wait_until(
            lambda: self.points[-1].frame_number == last, what='the last points'
        )

    def is_clean(self):
        return all(n.running and 'Traceback' not in n.log for n in self.nodes.values())


@pytest.fixture(scope='module')
def rig(module_graph, by_command, tracking):
    return Rig(module_graph, by_command, tracking)


def test_repeated_recording_and_clocks_that_jump(rig):
    """Nothing is lost when a bag is replayed or clocks jump forwards or backwards."""
    rig.stream()
    rig.stream()
    rig.stream(later_s=-3600.0, number=COUNT)
    rig.stream(later_s=86400.0, number=2 * COUNT)
    rig.stream(later_s=-0.01, number=3 * COUNT)
    assert rig.is_clean()


def test_subscriber_that_never_reads_holds_nobody_up(rig, tmp_path):
    """The subscriber is stopped but still present, and requests reliable messages."""
    topics = [f'{rig.graph.namespace}/{POINTS}']
    topics += [f'{rig.graph.namespace}/{n}/corrected_observations' for n in NAMES]
    reader = rig.graph.start('recorder_node', {'folder': tmp_path / 'bag', 'topics': str(topics)})
    rig.client.wait_until(
        lambda: all(rig.client.count_subscribers(topic) >= 2 for topic in topics),
        what='the reader',
    )
    reader._process.send_signal(signal.SIGSTOP)
    for _ in range(5):  # twice the queue length
        rig.stream()
    reader._process.send_signal(signal.SIGCONT)
    assert reader.end() == 0 and rig.is_clean()


def test_second_calibration_node_is_told_and_changes_nothing(rig):
    client = rig.client
    ids = {n: c.calibration_id for n, c in load_calibrations(rig.folder).items()}
    second = rig.graph.start(
        'calibration_node',
        {'calibration_directory': rig.folder},
        {'__node': 'second'},
        wait=False,
    )

    def is_told(node):
        return client.wait_for_diagnostics(
            node, lambda s: s.level == b'\2' and '2 nodes publish' in s.message
        )

    for node in ('calibration_node', 'second', 'correction_node'):
        is_told(node)
    rig.stream()
    assert second.end() == 0
    for name in NAMES:
        client.wait_for_diagnostics(
            'correction_node',
            lambda s, name=name: s.level != b'\2' and value_of(s, 'calibration') == ids[name],
            name,
        )
    rig.stream()
    assert rig.is_clean()


@pytest.mark.parametrize('node', ['correction_node', 'reconstruction_node', 'calibration_node'])
def test_node_killed_in_mid_stream_is_replaced(rig, node):
    rig.nodes[node]._process.kill()
    rig.nodes[node].wait()
    if node == 'calibration_node':
        rig.stream()  # the stream does not depend on it
        rig.nodes[node] = rig.graph.calibration_node(rig.folder)
    else:
        rig.nodes[node] = rig.graph.start(node, wait=False)
    rig.wait_until_reconstructed()
    assert rig.is_clean()
