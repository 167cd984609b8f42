# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Two rigs in two namespaces, each with its own calibrations: in whatever order their nodes are
started, killed and restarted, each rig ends up correcting with its own calibrations.
"""

import random
import signal
from dataclasses import replace

import numpy as np
import pytest
from ros_graph import NAMES, Graph

from fluoro_calib_ros.io.calibration import load_calibrations, save_calibration


@pytest.fixture
def rigs(node_server, request, graph, calibrated, tmp_path):
    """Two graphs; .folder holds the calibrations of each, .ids their ids by fluoroscope."""
    (tmp_path / 'other').mkdir()
    other = Graph(tmp_path / 'other', node_server)
    request.node.graphs = [*getattr(request.node, 'graphs', ()), other]
    for number, rig in enumerate((graph, other)):
        rig.folder = tmp_path / f'calibrations_{number}'
        for calibration in load_calibrations(calibrated).values():
            moved = calibration.interior + [0.0, 0.0, float(number)]
            save_calibration(rig.folder, replace(calibration, interior=moved))
        rig.ids = {n: c.calibration_id for n, c in load_calibrations(rig.folder).items()}
        rig.corrected = {n: rig.client.listen(f'{n}/corrected_observations') for n in NAMES}
        rig.nodes = {}
    assert not set(graph.ids.values()) & set(other.ids.values())
    yield graph, other
    other.close()


def start(rig, node):
    if node == 'calibration_node':
        rig.nodes[node] = rig.calibration_node(rig.folder, wait=False)
    else:
        rig.nodes[node] = rig.start(node, wait=False)


def wait_until_corrected(rig, frame):
    """Publish frames until each fluoroscope returns one, and check which calibration was used."""
    numbers = iter(range(10_000))
    for name in NAMES:
        rig.corrected[name].clear()

    def corrected():
        number = next(numbers)
        for name in NAMES:
            rig.client.publish(replace(frame[name], number=number))
        return all(rig.corrected.values())

    rig.client.wait_until(corrected, what=f'corrected frames in {rig.namespace}')
    for name, messages in rig.corrected.items():
        assert {m.calibration_id for m in messages} == {rig.ids[name]}
        assert all(np.isfinite(m.u).all() for m in messages)


def test_two_rigs_end_up_correcting(rigs, tracking):
    frame = {name: tracking[name][0] for name in NAMES}
    order = random.Random(3)
    nodes = [(rig, node) for rig in rigs for node in ('calibration_node', 'correction_node')]
    order.shuffle(nodes)
    for rig, node in nodes:
        start(rig, node)
    for rig in rigs:
        wait_until_corrected(rig, frame)
    # Restart every node, killing half of them first, while the others run or start.
    order.shuffle(nodes)
    for number, (rig, node) in enumerate(nodes):
        process = rig.nodes[node]
        if number % 2:
            process._process.send_signal(signal.SIGKILL)
            process.wait()
        else:
            process.interrupt()
            assert process.wait() == 0, process.log
        start(rig, node)
    for rig in rigs:
        wait_until_corrected(rig, frame)
        assert all(p.running and 'Traceback' not in p.log for p in rig.nodes.values())
