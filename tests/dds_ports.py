# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Ports and ROS domains that no other session on this machine uses."""

import contextlib
import fcntl
import itertools
import os
import socket
import tempfile
from pathlib import Path

import pytest

BASE = 'FLUORO_CALIB_TEST_PORT_BASE'
PROFILE = """\
<dds xmlns="http://www.eprosima.com/XMLSchemas/fastRTPS_Profiles">
  <profiles>
    <participant profile_name="tests" is_default_profile="true">
      <rtps><port><portBase>{base}</portBase></port></rtps>
    </participant>
  </profiles>
</dds>
"""


@contextlib.contextmanager
def own_ports(directory):
    """Give all ROS processes of this session Fast DDS ports that no other session uses.

    Each participant has a port of its own in the 400 below the base, whatever its domain.
    If another session took over the port of a participant that has just ended, it could lose it:
    a process that ends removes its ports in shared memory, and also ports that it considers broken
    (https://github.com/eProsima/Fast-DDS/issues/6117).
    """
    base, lock = _free_base()
    profile = Path(directory) / 'ports.xml'
    profile.write_text(PROFILE.format(base=base))
    with pytest.MonkeyPatch.context() as patch, lock:
        patch.setenv('FASTRTPS_DEFAULT_PROFILES_FILE', str(profile))
        patch.setenv(BASE, str(base))
        yield


def _free_base():
    """Return the port that Fast DDS counts from, and the open lock file that reserves it."""
    for base in range(7000, 3000, -410):  # not 7400, the default of a rig nearby
        try:
            return base, _locked(f'ports_{base}')
        except OSError:
            continue
    raise RuntimeError('ten other sessions of these tests run on this machine')


def domains_with_stale_ports(base):
    """Return the ROS domains whose processes have left ports in shared memory."""
    names = os.listdir('/dev/shm')
    ports = (name.removeprefix('fastrtps_port') for name in names)
    return {(int(port) - base) // 250 for port in ports if port.isdecimal()}


_next_domain = itertools.count(os.getpid())


def free_domain():
    """Return an unused ROS domain of this machine, and the open lock file that reserves it.

    The last used domain comes up last, and those in which a killed process left ports in shared
    memory after all others: Fast DDS may take these ports for broken, and messages are lost.
    """
    base = int(os.environ[BASE])
    first = next(_next_domain)
    domains = [20 + (first + i) % 80 for i in range(80)]  # above the ports of own_ports
    stale = domains_with_stale_ports(base)
    for domain in sorted(domains, key=stale.__contains__):
        try:
            lock = _locked(f'domain_{domain}')
        except OSError:
            continue
        try:
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as port:
                port.bind(
                    ('', base + 250 * domain + 10)
                )  # the bind fails if the domain has a first participant
            return domain, lock
        except OSError:
            lock.close()
    raise RuntimeError('all ROS domains from 20 to 99 are in use on this machine')


def _locked(name):
    """Open and lock the lock file of a name; raise OSError if another session holds the lock."""
    path = Path(tempfile.gettempdir()) / f'fluoro_calib_test_{name}.lock'
    lock = open(path, 'a')  # noqa: SIM115 the lock is held by the caller
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        lock.close()
        raise
    return lock
