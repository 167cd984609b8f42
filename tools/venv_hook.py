# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Give every Python of the project's .venv the environment that ROS needs, without sourcing.

tools/setup_env.py copies this file into the venv as fluoro_calib_venv.py, with a .pth file that
imports it before anything else. The shared libraries of ROS are found only by LD_LIBRARY_PATH,
which the loader reads when a process starts, so this hook re-executes Python in place with the
right value. The ROS wheels do the same (ros_wheels_bootstrapper), but mistake a mark left by
another venv's process for their own, and leave it to chance which ROS comes first if one has been
sourced.
"""

from __future__ import annotations

import _signal  # built in, unlike the module signal, whose import takes as long as this whole hook
import os
import sys

MARK = '_ROS_WHEELS_BOOTSTRAP_COMPLETE'  # the wheels' mark; if set, their bootstrap does nothing
IS_FIRST = os.environ.get(MARK) != sys.prefix

# An interrupt before a program can handle it must end the program without a traceback, and a node
# with status 0, as it does later: launch reports a node with any other status as died.
_IS_NODE = any(word.endswith('_node') for word in sys.orig_argv[1:2])
if _signal.getsignal(_signal.SIGINT) is _signal.default_int_handler:
    if _IS_NODE:
        for _number in (_signal.SIGINT, _signal.SIGTERM):
            _signal.signal(_number, lambda *_: os._exit(0))
    elif IS_FIRST:
        _signal.signal(_signal.SIGINT, _signal.SIG_DFL)


def environment(old: dict[str, str], prefix: str) -> dict[str, str]:
    """Return the environment in which a Python of the venv `prefix` finds its own ROS and no
    other.
    """
    new = dict(old)

    def entries(name: str) -> list[str]:
        return [entry for entry in old.get(name, '').split(os.pathsep) if entry]

    def below(entry: str, folders: list[str]) -> bool:
        return any((entry + '/').startswith(folder.rstrip('/') + '/') for folder in folders)

    # Anything else that was sourced is another ROS with its workspaces, or workspaces that were
    # built on top of this one.
    others = [
        entry
        for entry in entries('AMENT_PREFIX_PATH')
        if os.path.realpath(entry) != os.path.realpath(prefix)
    ]
    foreign = any(os.path.exists(os.path.join(entry, 'lib', 'librcl.so')) for entry in others)
    dropped, overlays = (others, []) if foreign else ([], others)

    version = f'python{sys.version_info.major}.{sys.version_info.minor}'
    site_packages = os.path.join(prefix, 'lib', version, 'site-packages')
    libraries = [os.path.join(prefix, 'lib')]
    libraries += sorted(
        os.path.join(site_packages, name)
        for name in os.listdir(site_packages)
        if name.startswith('ros_') and name.endswith('.libs')
    )

    for name, own in (
        ('AMENT_PREFIX_PATH', [prefix]),
        ('LD_LIBRARY_PATH', libraries),
        ('PYTHONPATH', []),
    ):
        kept = [entry for entry in entries(name) if entry not in own and not below(entry, dropped)]
        first = [entry for entry in kept if below(entry, overlays)]
        value = first + own + [entry for entry in kept if entry not in first]
        if value:
            new[name] = os.pathsep.join(value)
        else:
            new.pop(name, None)
    if foreign:
        new.pop('RMW_IMPLEMENTATION', None)  # may not be among the wheels
    # rcl does not start if it cannot write its log.
    if not {'ROS_LOG_DIR', 'ROS_HOME'} & new.keys():
        home = new.setdefault('HOME', os.path.expanduser('~'))
        logs = [path for path in (home + '/.ros/log', home + '/.ros', home) if os.path.isdir(path)]
        if not logs or not os.access(logs[0], os.W_OK):
            import tempfile  # rarely needed, and takes half the time of this hook

            new['ROS_LOG_DIR'] = os.path.join(tempfile.gettempdir(), f'ros_log_{os.getuid()}')
    new[MARK] = prefix
    return new


if IS_FIRST:
    os.execve(sys.executable, sys.orig_argv, environment(dict(os.environ), sys.prefix))
