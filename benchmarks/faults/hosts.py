# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The graph on several hosts, with links that lose frames, delay them and break.

Fluoroscope a, fluoroscope b, the calibration node, and the tracking (correction, reconstruction
and a client) each run on a host with its own address, connected by benchmarks.faults.network.
"""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Any

from fluoro_calib_ros.io.bags.writer import write_bag
from fluoro_calib_ros.simulation.rig import StreamStart, simulate_tracking, virtual_rig

from ..timing import section
from .network import Network, Quality
from .processes import ROOT, Process, node

NAMES = ('a', 'b')
HOSTS = (*NAMES, 'calibration', 'tracking', 'late')
CLIENT = [sys.executable, '-m', 'benchmarks.faults.host_client']
WAIT_S = 90.0
RATE_HZ = 120.0
PROFILE = ROOT / 'config' / 'lossy_links.xml'
CUT_S = 60.0
QUALITIES = (
    Quality(),
    Quality(loss=0.01),
    Quality(loss=0.05),
    Quality(loss=0.10),
    Quality(delay_s=0.001),
    Quality(delay_s=0.050),
    Quality(loss=0.05, delay_s=0.010),
    Quality(loss=0.10, delay_s=0.050),
)
LATE_QUALITIES = (
    Quality(),
    Quality(loss=0.01),
    Quality(loss=0.05),
    Quality(loss=0.10, delay_s=0.05),
)


class Client:
    """The host client as a process on a host; a context manager."""

    def __init__(self, network: Network, host: str) -> None:
        self._process = subprocess.Popen(
            [str(word) for word in network.run_in(host, CLIENT)],
            cwd=ROOT,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def __enter__(self) -> Client:
        self._answer()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._process.kill()
        self._process.communicate()

    def _answer(self) -> dict[str, Any]:
        assert self._process.stdout is not None
        return json.loads(self._process.stdout.readline())

    def ask(self, *words: str) -> dict[str, Any]:
        """Return the answer to a command of benchmarks.faults.host_client."""
        assert self._process.stdin is not None
        self._process.stdin.write(' '.join(words) + '\n')
        self._process.stdin.flush()
        return self._answer()

    def wait(self, condition: Callable[[dict[str, Any]], object], what: str) -> float:
        """Wait until a condition of the state is true; return the waiting time [s]."""
        began = time.monotonic()
        while True:
            state = self.ask('state')
            if condition(state):
                return time.monotonic() - began
            if time.monotonic() - began > WAIT_S:
                raise TimeoutError(f'waited {WAIT_S:g} s for {what}: {json.dumps(state)}')


class Hosts:
    """The nodes of the graph on the hosts of a network; a context manager."""

    def __init__(self, network: Network, folder: Path) -> None:
        self.network = network
        self.folder = folder
        self._stack = ExitStack()
        self._count = 0

    def __enter__(self) -> Hosts:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._stack.close()

    def start(
        self,
        host: str,
        name: str,
        parameters: Mapping[str, object],
        remaps: Mapping[str, str] | None = None,
    ) -> Process:
        """Start a node on a host."""
        self._count += 1
        log = self.folder / f'{self._count}_{host}_{name}.log'
        words = self.network.run_in(host, node(name, parameters, remaps))
        return self._stack.enter_context(Process(words, log))

    def start_graph(self, phantom: Path) -> Client:
        """Start everything but the fluoroscopes; return the client on the tracking host."""
        self.start(
            'calibration',
            'calibration_node',
            {'phantom': phantom, 'calibration_directory': self.folder / 'calibrations'},
        )
        self.start('tracking', 'correction_node', {})
        self.start('tracking', 'reconstruction_node', {})
        return self.start_client('tracking')

    def start_client(self, host: str) -> Client:
        """Start a client on a host."""
        return self._stack.enter_context(Client(self.network, host))

    def play(self, bag: Path, readers: int, **parameters: object) -> list[Process]:
        """Play the frames of each fluoroscope on its own host."""
        return [
            self.start(
                name,
                'player_node',
                {
                    'bag': bag,
                    'topics': f'[/{name}/target_observations]',
                    'wait_for_readers': readers,
                    **parameters,
                },
                {'__node': f'player_{name}'},  # a unique name for its services
            )
            for name in NAMES
        ]


def run(folder: Path, count: int, seed: int) -> str:
    """Run the graph on several hosts; return the sections of the report.

    count: duration of each stream [s].
    """
    sent = _write_stream(folder / 'tracking', float(count), RATE_HZ, seed)
    _write_stream(folder / 'long', CUT_S + 40.0, RATE_HZ, seed)
    sections = []
    for profile in (None, PROFILE):
        with Network(HOSTS, seed, profile) as network, Hosts(network, folder) as hosts:
            sections += _sections(hosts, count, sent)
    return '\n\n'.join(sections)


def _write_stream(bag: Path, seconds: float, rate_hz: float, seed: int) -> int:
    """Write a recording of moving markers; return the number of exposures."""
    start = StreamStart(10**18)
    rig = virtual_rig(1)
    frames = simulate_tracking(rig, seconds, rate_hz, seed, 0.25, start, clusters=5).frames
    write_bag(bag, frames)
    return len(frames['a'])


def _sections(hosts: Hosts, seconds: int, sent: int) -> list[str]:
    """Run the graph on the hosts of a network; return the sections of the report."""
    client = hosts.start_graph(ROOT / 'bags' / 'phantom.csv')
    calibration = _calibrated(hosts, client)
    rows = [_noted(_streamed(hosts, client, quality, sent)) for quality in QUALITIES]
    late = [_noted(_joined_late(hosts, quality)) for quality in LATE_QUALITIES]
    cut = [_noted(_cut_off(hosts, client, name, CUT_S)) for name in ('a', 'calibration')]
    how = hosts.network.profile.name if hosts.network.profile else 'default of Fast DDS'
    return [
        section(
            f'Several hosts, {how}',
            'Fluoroscope a, fluoroscope b, calibration and tracking on a host each. '
            f'{calibration} Then 2 x {RATE_HZ:g} Hz x 30 markers for {seconds} s over links '
            'that lose and delay Ethernet frames. Frames of a and b that arrived at the host '
            'of the tracking, exposures that came out as points, and the latency of the '
            'frames from publication to reception. '
            f'{sum(hosts.network.forwarded().values())} Ethernet frames crossed the switch.',
            ('link', 'sent', 'arrived', 'reconstructed', 'p50 [ms]', 'p99 [ms]', 'max [ms]'),
            rows,
        ),
        section(
            f'Late joiner, {how}',
            'A host that joins when all is over: time until it has both calibrations and the '
            'orientation, from the start of its process.',
            ('link', 'time [s]'),
            late,
        ),
        section(
            f'A host is cut off, {how}',
            f'Its cable is pulled for {CUT_S:g} s during a stream of {RATE_HZ:g} Hz, and plugged '
            'in again.',
            (
                'host',
                'told in the diagnostics after [s]',
                'exposures reconstructed meanwhile',
                'points again after [s]',
            ),
            cut,
        ),
    ]


def _noted(row: list[str]) -> list[str]:
    """Show a row as soon as it is available, since all rows take minutes."""
    print('  ' + ' | '.join(row), file=sys.stderr, flush=True)
    return row


def _calibrated(hosts: Hosts, client: Client) -> str:
    """Collect the exposures of bags/calibration, and calibrate; return a sentence."""
    hosts.play(ROOT / 'bags' / 'calibration', 3, rate=5.0)
    client.wait(
        lambda state: [state['exposures'].get(name) for name in NAMES] == [15, 15], '15 exposures'
    )
    answer = client.ask('calibrate', 'auto')
    if not answer['success']:
        raise SystemExit(answer['message'])
    client.wait(lambda state: len(state['calibrations']) == 2, 'the calibrations')
    client.wait(lambda state: state['orientation'], 'the orientation')
    client.wait(
        lambda state: not any('no calibration' in m for m in state['diagnostics'].values()),
        'the correction node',
    )
    return f'All 15 exposures arrived: {answer["message"]}.'


def _name(quality: Quality) -> str:
    parts = []
    if quality.loss:
        parts.append(f'loss {100 * quality.loss:g} %')
    if quality.delay_s:
        parts.append(f'delay {1000 * quality.delay_s:g} ms')
    return ', '.join(parts) or 'good'


def _streamed(hosts: Hosts, client: Client, quality: Quality, sent: int) -> list[str]:
    """Stream over a link of this quality; return a row of the report."""
    hosts.network.set_quality(Quality())  # discovery is measured separately
    client.ask('begin')
    players = hosts.play(hosts.folder / 'tracking', 3, start_paused='true')
    client.ask('step', *(f'player_{name}' for name in NAMES))
    hosts.network.set_quality(quality)
    client.ask('go', *(f'player_{name}' for name in NAMES))
    for player in players:
        player.wait(600)
    before: dict[str, Any] = {}

    def is_quiet(state: dict[str, Any]) -> bool:
        nonlocal before
        was, before = before, state['came']
        time.sleep(1.0)
        return was == before

    client.wait(is_quiet, 'the end of the stream')
    result = client.ask('result')
    streams = [result[name] for name in NAMES]
    points = result.get('points', {'different': 0})
    return [
        _name(quality),
        str(2 * sent),
        str(sum(stream['different'] for stream in streams)),
        f'{points["different"]} of {sent}',
        *(
            f'{max(stream[key] for stream in streams):.1f}'
            for key in ('p50_ms', 'p99_ms', 'max_ms')
        ),
    ]


def _joined_late(hosts: Hosts, quality: Quality) -> list[str]:
    hosts.network.set_quality(quality)
    began = time.monotonic()
    with Client(hosts.network, 'late') as late:
        try:
            late.wait(
                lambda state: len(state['calibrations']) == 2 and state['orientation'],
                'the latched messages',
            )
        except TimeoutError:
            return [_name(quality), f'not within {WAIT_S:g}']
    return [_name(quality), f'{time.monotonic() - began:.1f}']


def _cut_off(hosts: Hosts, client: Client, host: str, seconds: float) -> list[str]:
    """Disconnect a host during a stream; return a row of the report."""
    hosts.network.set_quality(Quality())
    client.ask('begin')
    players = hosts.play(hosts.folder / 'long', 3, start_paused='true')
    names = [f'player_{name}' for name in NAMES]
    client.ask('step', *names)
    client.ask('go', *names)
    client.wait(lambda state: state['came'].get('points', 0) > 100, 'points')
    client.wait(lambda state: not _stalls(state), 'diagnostics without a stall')
    hosts.network.cut_off(host)
    began = time.monotonic()
    client.ask('begin')
    told = '-'
    if host in NAMES:
        client.wait(_stalls, 'the diagnostics')
        told = f'{time.monotonic() - began:.1f}'
    time.sleep(max(0.0, seconds - (time.monotonic() - began)))
    meanwhile = client.ask('state')['came'].get('points', 0)
    hosts.network.cut_off(host, False)
    client.ask('begin')
    back = client.wait(lambda state: state['came'].get('points', 0) > 0, 'points')
    for player in players:
        player.send(signal.SIGINT)
        player.wait()
    return [host, told, str(meanwhile), f'{back:.1f}']


def _stalls(state: dict[str, Any]) -> bool:
    return any('no frame for' in message for message in state['diagnostics'].values())
