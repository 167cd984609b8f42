# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The graph on several hosts, each a network namespace with its own address."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from ros_graph import BAGS, NAMES

sys.path.append(str(Path(__file__).resolve().parents[2]))  # benchmarks are not installed
from benchmarks.faults.hosts import HOSTS, Hosts
from benchmarks.faults.network import Network, Quality

LOSSY = Quality(loss=0.02, delay_s=0.005)


def obstacle_to_namespaces() -> str:
    """Return why this machine cannot create namespaces with devices, or '' if it can."""
    name = f'fluoro-probe-{os.getpid()}'
    try:
        os.close(os.open('/dev/net/tun', os.O_RDWR))
        made = subprocess.run(['ip', 'netns', 'add', name], capture_output=True, text=True)
    except OSError as error:
        return str(error)
    if made.returncode:
        return made.stderr.strip()
    subprocess.run(['ip', 'netns', 'delete', name], check=True)
    return ''


@pytest.fixture
def network(ros):
    """Hosts whose traffic passes through a switch that counts frames."""
    obstacle = obstacle_to_namespaces()
    if obstacle:
        pytest.skip(f'network namespaces cannot be made here: {obstacle}')
    with Network(HOSTS) as network:
        yield network


def test_graph_on_several_hosts(network, tmp_path):
    """The graph calibrates, corrects and reconstructs, also over bad links and after a cut."""
    with Hosts(network, tmp_path) as hosts:
        client = hosts.start_graph(BAGS / 'phantom.csv')
        hosts.play(BAGS / 'calibration', readers=3, rate=10.0)
        client.wait(lambda s: [s['exposures'].get(n) for n in NAMES] == [15, 15], '15 exposures')
        assert network.forwarded()['a', 'calibration'] >= 15
        assert client.ask('calibrate', 'none')['success']
        client.wait(lambda s: len(s['calibrations']) == 2 and s['orientation'], 'calibrations')

        network.set_quality(LOSSY)
        late = hosts.start_client('late')
        ids = client.ask('state')['calibrations']
        late.wait(lambda s: s['calibrations'] == ids and s['orientation'], 'latched messages')

        hosts.play(BAGS / 'tracking', readers=3, rate=0.1, loop='true')
        client.wait(lambda s: s['came'].get('points', 0) > 10, 'points')
        network.cut_off('a')
        client.wait(
            lambda s: any('no frame for' in m for m in s['diagnostics'].values()), 'the stall'
        )
        client.ask('begin')
        assert not client.ask('state')['came'].get('a')
        network.cut_off('a', False)
        client.wait(lambda s: s['came'].get('points', 0) > 10, 'points again')
        assert 'Traceback' not in ''.join(p.read_text() for p in tmp_path.glob('*.log'))
