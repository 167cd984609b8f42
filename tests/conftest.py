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


# Set this before numpy is imported: the workers share the cores, and linear algebra threads
# would only wait for each other.
for _name in ('OMP_NUM_THREADS', 'OPENBLAS_NUM_THREADS'):
    os.environ.setdefault(_name, '1')

# Many tests start commands; without cached bytecode each command compiles what it imports.
os.environ.pop('PYTHONDONTWRITEBYTECODE', None)
sys.dont_write_bytecode = False

# A disk takes milliseconds for each file that it must keep through a power failure. No test
# simulates one; what is flushed is tested with a function in place of this one.
os.fsync = os.fstat

# The collector takes a third of the time to load the tests and finds little garbage.
gc.disable()


def pytest_collection_finish() -> None:
    """Re-enable garbage collection, but exempt the tests and modules, which stay in memory."""
    gc.freeze()
    gc.set_threshold(10_000, 20, 20)  # modules that tests load stay, and take long to traverse
    gc.enable()


def pytest_sessionfinish() -> None:
    """Collect garbage once: pytest collects five times at its end and then has little to do."""
    gc.collect()
    gc.freeze()


@pytest.fixture(scope='session', autouse=True)
def ports(tmp_path_factory):
    """Reserve ports before any test creates a node: Fast DDS reads its profile only once."""
    with own_ports(tmp_path_factory.mktemp('dds')):
        yield


ROS = 'tests/ros/'
# Files whose tests share the calibrations of tests/rigs.py or tests/turning_rig.py: they run in
# the same worker, so that each calibration is computed once.
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
# Scopes that take more than 20 s, longest first. Short ones fill the gaps at the end.
LENGTHY = (
    'tests/ros/test_extraction_node.py',
    'tests/ros/test_live_healing.py',
    'tests/ros/test_live_angles.py',
    'tests/ros/test_whole_graph.py',
    'tests/ros/test_start_and_end.py',
    'tests/ros/test_jobs.py',
    'tests/ros/test_images.py',
    'tests/ros/test_integration.py',
    'tests/ros/test_orienting.py',
    'tests/ros/test_web.py',
    SHARING[0],
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
        wait, so two workers run them, file by file, while a third one computes; more graphs at
        once would only slow each other down.
        """

        def _split_scope(self, nodeid: str) -> str:
            name = super()._split_scope(nodeid)
            return SHARING[0] if name in SHARING else name

        def _assign_work_unit(self, node) -> None:
            """Assign a scope with ROS nodes to the first two workers, while there are any."""
            of_ros = [scope for scope in self.workqueue if scope.startswith(ROS)]
            others = [scope for scope in self.workqueue if not scope.startswith(ROS)]
            scopes = (of_ros if node in self.nodes[:2] else []) or others
            if not scopes:
                node.shutdown()
                return
            longest = next((scope for scope in LENGTHY if scope in scopes), scopes[0])
            self.workqueue.move_to_end(longest, last=False)
            super()._assign_work_unit(node)

    @pytest.hookimpl(optionalhook=True)
    def pytest_xdist_make_scheduler(config, log):
        """Return the scheduler above, unless a distribution other than by file is requested."""
        if config.getvalue('dist') == 'loadfile':
            return TwoWorkersForRos(config, log)
        return None


LOWER_PRIORITY = 10  # niceness increment, the same as for the calibration jobs of the nodes
_seen = set()  # kinds of tests that this worker has run: 'ros', 'others'


def pytest_runtest_setup(item: pytest.Item) -> None:
    """Give the worker with ROS nodes priority: other tests must not starve its streams and jobs.

    Nodes inherit the priority of their worker, so a worker that starts with them keeps its own.
    """
    kind = 'ros' if item.nodeid.startswith('tests/ros/') else 'others'
    if kind == 'others' and not _seen and hasattr(item.config, 'workerinput'):
        os.nice(LOWER_PRIORITY)
    _seen.add(kind)
