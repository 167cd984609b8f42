"""Distribution of the tests over the workers of pytest-xdist."""

import pytest

try:
    from xdist.scheduler import LoadFileScheduling
except ImportError:  # without the plugin, one process runs all tests
    LoadFileScheduling = None


if LoadFileScheduling is not None:

    class OneWorkerForRos(LoadFileScheduling):
        """Keep the tests of a file on one worker, and all tests with ROS nodes on one.

        The tests of a file share fixtures. ROS nodes mostly wait, so one worker runs them while
        the others compute; two graphs at once would only slow each other down.
        """

        def _split_scope(self, nodeid: str) -> str:
            if nodeid.startswith('tests/ros/'):
                return 'tests/ros'
            return super()._split_scope(nodeid)

    @pytest.hookimpl(optionalhook=True)
    def pytest_xdist_make_scheduler(config, log):
        """Distribute by file unless another distribution is asked for."""
        if config.getvalue('dist') == 'loadfile':
            return OneWorkerForRos(config, log)
        return None
