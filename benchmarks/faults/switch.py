# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A switch between the TAP devices of hosts, run as a separate program.

Drops and delays Ethernet frames as requested by its parent process, and counts them.
"""

from __future__ import annotations

import contextlib
import fcntl
import heapq
import itertools
import os
import random
import struct
import sys
import time
from collections import Counter
from collections.abc import Sequence
from multiprocessing.connection import Connection, wait
from typing import Any

TUNSETCARRIER = 0x400454E2
FRAME_BYTES = 65536


class Switch:
    """Forwards frames between devices."""

    def __init__(self, devices: Sequence[int], seed: int) -> None:
        self._devices = devices
        self._rng = random.Random(seed)
        self._loss = 0.0
        self._delay_s = 0.0
        self._off: set[int] = set()  # disconnected ports
        self._port_of: dict[bytes, int] = {}  # port by Ethernet address
        self._waiting: list[tuple[float, int, int, int, bytes]] = []
        self._numbers = itertools.count()
        self._counts: Counter[tuple[int, int]] = Counter()

    def run(self, pipe: Connection, parent: int) -> None:
        """Forward frames and answer the parent until it has gone."""
        ports = {device: port for port, device in enumerate(self._devices)}
        while os.getppid() == parent:
            timeout = 0.5
            if self._waiting:
                timeout = min(max(self._waiting[0][0] - time.monotonic(), 0.0), timeout)
            sources: list[Any] = [*self._devices, pipe]
            for source in wait(sources, timeout):
                if isinstance(source, int):
                    self._receive(ports[source])
                else:
                    try:
                        pipe.send(self._answer(*pipe.recv()))
                    except EOFError:
                        return
            while self._waiting and self._waiting[0][0] <= time.monotonic():
                _, _, source_port, port, frame = heapq.heappop(self._waiting)
                self._deliver(source_port, port, frame)

    def _receive(self, source: int) -> None:
        """Receive all frames of a port."""
        while True:
            try:
                frame = os.read(self._devices[source], FRAME_BYTES)
            except OSError:  # no frame is left, or the device is down
                return
            self._port_of[frame[6:12]] = source
            known = self._port_of.get(frame[:6])
            others = [known] if known is not None else range(len(self._devices))
            for port in others:
                if port != source and self._rng.random() >= self._loss:
                    due = time.monotonic() + self._delay_s
                    heapq.heappush(self._waiting, (due, next(self._numbers), source, port, frame))

    def _deliver(self, source: int, port: int, frame: bytes) -> None:
        if source in self._off or port in self._off:
            return
        with contextlib.suppress(OSError):  # its queue is full, or the device is down
            os.write(self._devices[port], frame)
            self._counts[source, port] += 1

    def _answer(self, what: str, content: Any) -> Any:
        if what == 'quality':
            self._loss, self._delay_s = content
        elif what == 'carrier':
            port, is_off = content
            (self._off.add if is_off else self._off.discard)(port)
            fcntl.ioctl(self._devices[port], TUNSETCARRIER, struct.pack('i', not is_off))
        return Counter(self._counts)


def main() -> None:
    """Run a switch; arguments: seed, descriptor of the pipe, descriptors of the devices."""
    seed, pipe, *devices = map(int, sys.argv[1:])
    with contextlib.suppress(KeyboardInterrupt):
        Switch(devices, seed).run(Connection(pipe), os.getppid())


if __name__ == '__main__':
    main()
