# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Distribution of the tests over the workers of pytest-xdist."""

import gc
import os
import sys

import pytest
from dds_ports import own_ports

try:
    from xdist.scheduler import LoadFileScheduling
except ImportError:  # without the plugin, one process runs all tests
    LoadFileScheduling = None


# Before numpy is imported: workers share the cores, and threads of linear algebra would only wait
# for each other.
for _name in ('OMP_NUM_THREADS', 'OPENBLAS_NUM_THREADS'):
    os.environ.setdefault(_name, '1')

# Many tests start commands; without bytecode on disk each compiles what it loads.
os.environ.pop('PYTHONDONTWRITEBYTECODE', None)
sys.dont_write_bytecode = False

# A third of the time to load the tests is that of the collector, and little of it is garbage.
gc.disable()


def pytest_collection_finish() -> None:
    """Collect garbage again, but not that of the tests and modules, which stay."""
    gc.freeze()
    gc.enable()


def pytest_sessionfinish() -> None:
    """Let pytest, which collects five times at its end, look at what is left once."""
    gc.collect()
    gc.freeze()


@pytest.fixture(scope='session', autouse=True)
def ports(tmp_path_factory):
    """Reserve ports before any test makes a node: Fast DDS reads its profile once."""
    with own_ports(tmp_path_factory.mktemp('dds')):
        yield


ROS = ('tests/ros 1', 'tests/ros 2')
# Files whose tests share the calibrations of tests/rigs.py or tests/turning_rig.py, so that one
# worker makes them once.
SHARING = (
    'tests/estimation/test_calibration.py',
    'tests/estimation/test_self_calibration.py',
    'tests/estimation/test_orientation.py',
    'tests/estimation/test_grid.py',
    'tests/images/test_undistortion.py',
    'tests/estimation/test_collocation.py',
    'tests/estimation/test_local_signal.py',
    'tests/estimation/test_angle_field.py',
    'tests/images/test_angle_maps.py',
    'tests/checks/test_turning.py',
    'tests/checks/test_validation.py',
)
# Other files that take more than 20 s of CPU time. Short files fill the gaps at the end.
LENGTHY = (
    'tests/healing/test_healing.py',
    'tests/estimation/test_survey.py',
    'tests/report/test_experiment.py',
    'tests/test_lint.py',
    'tests/checks/test_wrong_input.py',
    'tests/cli/test_extract.py',
    'tests/cli/test_examples.py',
    'tests/cli/test_cli.py',
    'tests/reconstruction/test_reconstruct_recording.py',
    'tests/checks/test_confused_recordings.py',
    'tests/jobs/test_scheduling.py',
    'tests/report/test_report.py',
)

if LoadFileScheduling is not None:

    class TwoWorkersForRos(LoadFileScheduling):
        """Keep the tests of a file on one worker, and all tests with ROS nodes on two.

        The tests of a file share fixtures, and those of SHARING calibrations. ROS nodes mostly
        wait, so two workers run them while a third one computes; more graphs at once would only
        slow each other down.
        """

        def __init__(self, *arguments) -> None:
            super().__init__(*arguments)
            self._files_of_ros = []

        def _split_scope(self, nodeid: str) -> str:
            name = super()._split_scope(nodeid)
            if name in SHARING:
                return SHARING[0]
            if not name.startswith('tests/ros/'):
                return name
            if name not in self._files_of_ros:
                self._files_of_ros.append(name)
            return ROS[self._files_of_ros.index(name) % len(ROS)]

        def _assign_work_unit(self, node) -> None:
            """Begin with what takes longest."""
            for scope in reversed((*ROS, SHARING[0], *LENGTHY)):
                if scope in self.workqueue:
                    self.workqueue.move_to_end(scope, last=False)
            super()._assign_work_unit(node)

    @pytest.hookimpl(optionalhook=True)
    def pytest_xdist_make_scheduler(config, log):
        """Distribute by file unless another distribution is asked for."""
        if config.getvalue('dist') == 'loadfile':
            return TwoWorkersForRos(config, log)
        return None


LOWER_PRIORITY = 10  # as that of the calibration jobs of the nodes
_seen = set()  # what this worker has run: 'ros', 'others'


def pytest_runtest_setup(item: pytest.Item) -> None:
    """Let the worker with ROS nodes go first: streams and jobs must not starve beside it.

    The nodes inherit the priority of their worker, so the one that begins with them keeps its own.
    """
    kind = 'ros' if item.nodeid.startswith('tests/ros/') else 'others'
    if kind == 'others' and not _seen and hasattr(item.config, 'workerinput'):
        os.nice(LOWER_PRIORITY)
    _seen.add(kind)
