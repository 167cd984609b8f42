# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Starting and ending the nodes of a graph as processes, where launch is not installed."""

from __future__ import annotations

import os
import socket
import subprocess
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ..processes import Programs

# UDP port of the first participant of a ROS domain (DDSI-RTPS 2.5, section 9.6.1.1).
DISCOVERY_PORT = 7400
PORTS_PER_DOMAIN = 250
FIRST_PARTICIPANT = 10


class NodeProcesses(Programs):
    """Node processes that end together; a context manager.

    log_directory: the output of each node goes to NAME.log in it. namespace: of the nodes; with
    one, the log is NAMESPACE_NAME.log.
    """

    def __init__(self, log_directory: Path, namespace: str = '') -> None:
        super().__init__()
        self._directory = log_directory
        self._namespace = namespace

    def start(
        self, name: str, parameters: Mapping[str, object] | None = None
    ) -> subprocess.Popen[Any]:
        """Start the node fluoro_calib_ros.nodes.NAME with parameters; returns the process."""
        arguments = ['--ros-args']
        for key, value in (parameters or {}).items():
            arguments += ['-p', f'{key}:={value}']
        if self._namespace:
            arguments += ['-r', f'__ns:=/{self._namespace}']
        log_name = '_'.join(filter(None, (self._namespace, name)))
        return self.run(
            f'fluoro_calib_ros.nodes.{name}',
            *arguments,
            log=self._directory / f'{log_name}.log',
        )


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
