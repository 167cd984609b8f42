# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Console scripts of the nodes, which print one sentence if a dependency is not installed."""

from __future__ import annotations

import os
import signal
import sys
from functools import partial
from importlib import import_module
from importlib.util import find_spec

_MESSAGES = 'fluoro_calib_msgs'
# How to install a missing module, by its top-level name.
_REMEDIES = {
    _MESSAGES: (
        'the message package is not built or not sourced: link msg_defs into the workspace '
        '(ln -s fluoro_calib_ros/msg_defs src/fluoro_calib_msgs), run colcon build, and source '
        'install/setup.bash'
    ),
    'rclpy': (
        'ROS 2 is not installed or not sourced: source /opt/ros/<distribution>/setup.bash, or run '
        '`make setup` and use .venv'
    ),
    'textual': 'the dashboard needs it: pip install textual',
    'tornado': 'the page of the dashboard needs it: pip install tornado',
}

# Modules that users know by the name of a command.
COMMANDS = {'watch': 'fluoro-calib watch'}


def missing_module_message(program: str, module: str) -> str:
    """Return what a user can do about a missing module, in one sentence."""
    package = module.partition('.')[0]
    remedy = _REMEDIES.get(package, f'install it, for example by `pip install {package}`')
    return f'{program}: the Python module {package} is missing: {remedy}.'


def _run(module: str) -> None:
    """Import a module and call its main(). An interrupt during the import ends the process.

    A node then exits with status 0, as it does later; for any other, launch reports that it died.
    """
    program = module.rpartition('.')[2]
    program = COMMANDS.get(program, program)
    # The import takes a second; an interrupt must not print a traceback.
    if program.endswith('_node'):
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, lambda *_: os._exit(0))
    else:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    try:
        main = import_module(f'{__package__}.{module}').main
    except ModuleNotFoundError as error:
        if error.name is None or error.name.startswith(__package__ or ''):
            raise
        without_ros = error.name.startswith(_MESSAGES) and find_spec('rclpy') is None
        sys.exit(missing_module_message(program, 'rclpy' if without_ros else error.name))
    sys.exit(main())


calibration_node = partial(_run, 'nodes.calibration_node')
extraction_node = partial(_run, 'nodes.extraction_node')
correction_node = partial(_run, 'nodes.correction_node')
reconstruction_node = partial(_run, 'nodes.reconstruction_node')
image_node = partial(_run, 'nodes.image_node')
player_node = partial(_run, 'nodes.player_node')
recorder_node = partial(_run, 'nodes.recorder_node')
simulator_node = partial(_run, 'nodes.simulator_node')
bridge_node = partial(_run, 'nodes.bridge_node')
watch = partial(_run, 'nodes.dashboard.watch')
demo = partial(_run, 'demo.demo')
