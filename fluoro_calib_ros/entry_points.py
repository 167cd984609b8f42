# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Console scripts of the nodes: one sentence where what they need is not installed."""

from __future__ import annotations

import os
import signal
import sys
from importlib import import_module
from importlib.util import find_spec

_MESSAGES = 'fluoro_calib_msgs'
# Where the installation of a missing module is described, by its top-level name.
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

# Modules that a user knows as a command.
COMMANDS = {'watch': 'fluoro-calib watch'}


def calibration_node() -> None:
    """Run the calibration node."""
    _run('nodes.calibration_node')


def extraction_node() -> None:
    """Run the extraction node."""
    _run('nodes.extraction_node')


def correction_node() -> None:
    """Run the correction node."""
    _run('nodes.correction_node')


def reconstruction_node() -> None:
    """Run the reconstruction node."""
    _run('nodes.reconstruction_node')


def image_node() -> None:
    """Run the image node."""
    _run('nodes.image_node')


def player_node() -> None:
    """Run the player."""
    _run('nodes.player_node')


def recorder_node() -> None:
    """Run the recorder."""
    _run('nodes.recorder_node')


def simulator_node() -> None:
    """Run the simulator."""
    _run('nodes.simulator_node')


def bridge_node() -> None:
    """Run the bridge to Foxglove."""
    _run('nodes.bridge_node')


def watch() -> None:
    """Run the dashboard."""
    _run('nodes.dashboard.watch')


def demo() -> None:
    """Run the demo."""
    _run('demo.demo')


def missing_module_message(program: str, module: str) -> str:
    """Return what a user does about a missing module, in one sentence."""
    package = module.partition('.')[0]
    remedy = _REMEDIES.get(package, f'install it, for example by `pip install {package}`')
    return f'{program}: the Python module {package} is missing: {remedy}.'


def _run(module: str) -> None:
    """Import a module and call its main(). An interrupt during the import ends the process.

    A node then ends with status 0, as it does later: launch calls anything else a node that died.
    """
    program = module.rpartition('.')[2]
    program = COMMANDS.get(program, program)
    # The import takes a second: no traceback.
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
