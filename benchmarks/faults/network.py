# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Several hosts on one machine: network namespaces connected by a switch of our own.

Each host is a network namespace whose only link is a TAP device. The switch process forwards the
Ethernet frames between them, drops and delays them as requested, and counts them. All traffic
between hosts passes through the switch, whatever the kernel offers for traffic control.
Requires the rights to create namespaces and TAP devices (root).
"""

from __future__ import annotations

import contextlib
import fcntl
import multiprocessing
import os
import struct
import subprocess
import sys
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from types import TracebackType
from typing import Any

TUNSETIFF = 0x400454CA
IFF_TAP = 0x0002
IFF_NO_PI = 0x1000
PREFIX = 'fluoro'
SUBNET = '10.77.0'
SWITCH = Path(__file__).with_name('switch.py')


@dataclass(frozen=True)
class Quality:
    """Treatment of frames by the switch: fraction dropped, and delay of the others [s]."""

    loss: float = 0.0
    delay_s: float = 0.0


class Network:
    """Hosts by name, as a context manager that removes only what it has created.

    profile: Fast DDS profile of all hosts. Raises OSError if namespaces or TAP devices cannot be
    created.
    """

    def __init__(self, hosts: Sequence[str], seed: int = 1, profile: Path | None = None) -> None:
        self.hosts = tuple(hosts)
        self.profile = profile
        self._seed = seed
        self._made: list[str] = []
        self._process: subprocess.Popen[bytes] | None = None
        self._pipe: Connection

    def namespace(self, host: str) -> str:
        """Return the name of the namespace of a host."""
        return f'{PREFIX}_{os.getpid()}_{host}'

    def __enter__(self) -> Network:
        _remove_leftovers()
        descriptors = []
        try:
            for number, host in enumerate(self.hosts):
                descriptors.append(self._make(host, number + 1))
            self._pipe, other = multiprocessing.Pipe()
            passed = [other.fileno(), *descriptors]
            # Run it as a separate program: a fork of a process with ROS contexts crashes when it
            # garbage-collects them.
            self._process = subprocess.Popen(
                [sys.executable, SWITCH, str(self._seed), *map(str, passed)], pass_fds=passed
            )
            other.close()
        except BaseException:
            self._remove()
            raise
        finally:
            for descriptor in descriptors:
                os.close(descriptor)
        return self

    def _make(self, host: str, number: int) -> int:
        """Create a namespace with one link; return the other end of the link."""
        namespace = self.namespace(host)
        _ip('netns', 'add', namespace)
        self._made.append(namespace)
        device = f'fl{os.getpid() % 10**6}_{number}'
        descriptor = os.open('/dev/net/tun', os.O_RDWR | os.O_NONBLOCK)
        try:
            fcntl.ioctl(
                descriptor, TUNSETIFF, struct.pack('16sH', device.encode(), IFF_TAP | IFF_NO_PI)
            )
            _ip('link', 'set', device, 'netns', namespace)
            for words in (
                ('link', 'set', device, 'name', 'eth0'),
                ('address', 'add', f'{SUBNET}.{number}/24', 'dev', 'eth0'),
                ('link', 'set', 'lo', 'up'),
                ('link', 'set', 'eth0', 'up'),
                ('route', 'add', 'default', 'dev', 'eth0'),
            ):
                _ip('-n', namespace, *words)
        except BaseException:
            os.close(descriptor)
            raise
        return descriptor

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._remove()

    def _remove(self) -> None:
        if self._process is not None:
            self._process.kill()
            self._process.wait()
            self._pipe.close()
        for namespace in self._made:
            with contextlib.suppress(OSError):
                _ip('netns', 'delete', namespace)
        self._made.clear()

    def run_in(self, host: str, words: Sequence[object]) -> list[object]:
        """Return the command line that runs a program on a host.

        Processes of different hosts never share memory; they only use UDP.
        """
        variables = ['ROS_AUTOMATIC_DISCOVERY_RANGE=SUBNET', 'FASTDDS_BUILTIN_TRANSPORTS=UDPv4']
        if self.profile is not None:
            variables.append(f'FASTRTPS_DEFAULT_PROFILES_FILE={self.profile}')
        return ['ip', 'netns', 'exec', self.namespace(host), 'env', *variables, *words]

    def set_quality(self, quality: Quality) -> None:
        """Set the loss and delay of frames from now on."""
        self._ask('quality', (quality.loss, quality.delay_s))

    def cut_off(self, host: str, is_off: bool = True) -> None:
        """Disconnect a host, or reconnect it."""
        self._ask('carrier', (self.hosts.index(host), is_off))

    def forwarded(self) -> Counter[tuple[str, str]]:
        """Return the number of forwarded frames by (from, to)."""
        counts: Counter[tuple[int, int]] = self._ask('counts', None)
        return Counter(
            {(self.hosts[one], self.hosts[other]): n for (one, other), n in counts.items()}
        )

    def _ask(self, what: str, content: object) -> Any:
        self._pipe.send((what, content))
        return self._pipe.recv()


def _remove_leftovers() -> None:
    """Remove the namespaces of networks whose process was killed."""
    folder = Path('/run/netns')
    for path in folder.glob(f'{PREFIX}_*_*') if folder.is_dir() else ():
        pid = path.name.split('_')[1]
        if pid.isdigit() and not Path('/proc', pid).exists():
            with contextlib.suppress(OSError):
                _ip('netns', 'delete', path.name)


def _ip(*words: str) -> None:
    done = subprocess.run(['ip', *words], capture_output=True, text=True, check=False)
    if done.returncode:
        raise OSError(f'ip {" ".join(words)}: {done.stderr.strip()}')
