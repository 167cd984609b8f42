# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Starting and ending the nodes of a graph as processes, where launch is not installed."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType

END_TIMEOUT_S = 5
# UDP port of the first participant of a ROS domain (DDSI-RTPS 2.5, section 9.6.1.1).
DISCOVERY_PORT = 7400
PORTS_PER_DOMAIN = 250
FIRST_PARTICIPANT = 10


class NodeProcesses:
    """Node processes that end together; a context manager.

    log_directory: the output of each node goes to NAME.log in it. namespace: of the nodes; with
    one, the log is NAMESPACE_NAME.log.
    """

    def __init__(self, log_directory: Path, namespace: str = '') -> None:
        self._directory = log_directory
        self._namespace = namespace
        self._processes: list[subprocess.Popen] = []

    def start(self, name: str, parameters: Mapping[str, object] | None = None) -> subprocess.Popen:
        """Start the node fluoro_calib_ros.nodes.NAME with parameters; returns the process."""
        command = [sys.executable, '-m', f'fluoro_calib_ros.nodes.{name}', '--ros-args']
        for key, value in (parameters or {}).items():
            command += ['-p', f'{key}:={value}']
        if self._namespace:
            command += ['-r', f'__ns:=/{self._namespace}']
        log_name = '_'.join(filter(None, (self._namespace, name)))
        with open(self._directory / f'{log_name}.log', 'ab') as log:
            # In a session of its own: an interrupt from the keyboard reaches the nodes from here,
            # in order.
            process = subprocess.Popen(command, stdout=log, stderr=log, start_new_session=True)
        self._processes.append(process)
        return process

    def failed(self) -> list[subprocess.Popen]:
        """Return the processes that have ended with a fault."""
        return [p for p in self._processes if p.poll() not in (None, 0)]

    def __enter__(self) -> NodeProcesses:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        running = [p for p in self._processes if p.poll() is None]
        for process in running:
            process.send_signal(signal.SIGINT)
        for process in running:
            try:
                process.wait(timeout=END_TIMEOUT_S)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


def isolate_ros_graph() -> None:
    """Keep this process and its children on this machine and in a free ROS domain.

    Environment variables that are set already are left as they are.
    """
    os.environ.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    if 'ROS_DOMAIN_ID' not in os.environ:
        domains = [1 + (os.getpid() + i) % 100 for i in range(100)]
        free = next((domain for domain in domains if _is_free(domain)), domains[0])
        os.environ['ROS_DOMAIN_ID'] = str(free)


def _is_free(domain: int) -> bool:
    """Return whether nobody on this machine uses a ROS domain."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as port:
        try:
            port.bind(('', DISCOVERY_PORT + PORTS_PER_DOMAIN * domain + FIRST_PARTICIPANT))
        except OSError:
            return False
    return True
