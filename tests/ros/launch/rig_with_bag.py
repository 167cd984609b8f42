# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A rig in a namespace plays a bag, collects exposures and records everything.

The parameter file sets a pattern for all nodes; launch arguments take precedence over it.
"""

import unittest

import launch_testing
from shipped import BAGS, DEADLINE, FOLDER, rig

from fluoro_calib_ros.io.bags.reader import read_frames

TOPICS = [f'/launched/{name}/target_observations' for name in 'ab']


def generate_test_description():
    """Start the nodes of a rig with a player and a recorder."""
    parameters = FOLDER / 'parameters.yaml'
    parameters.write_text(
        "/**:\n  ros__parameters:\n    phantom: ''\n    collect: still\n    still_time: 0.2\n"
    )
    return rig(
        namespace='launched',
        phantom=BAGS / 'phantom.csv',
        calibration_directory=FOLDER / 'calibrations',
        params_file=parameters,
        bag=BAGS / 'calibration',
        bag_topics=str(TOPICS).replace('/launched', ''),
        bag_rate='5',
        record=FOLDER / 'recorded',
        record_topics=str(TOPICS),
    )


class TestNodes(unittest.TestCase):
    """Tests that run while the nodes are up."""

    def test_exposures_are_collected_and_recorded(self, proc_output, proc_info):
        """The whole bag is collected: the player waits for its readers, including the recorder."""
        for topic in TOPICS:
            proc_output.assertWaitFor(f'recording {topic}', timeout=DEADLINE, stream='stderr')
        proc_output.assertWaitFor('exposure 15 collected', timeout=DEADLINE, stream='stderr')
        proc_info.assertWaitForShutdown(process='player_node', timeout=DEADLINE)


@launch_testing.post_shutdown_test()
class TestEnd(unittest.TestCase):
    """Tests that run after launch has interrupted the nodes."""

    def test_all_nodes_end_cleanly(self, proc_info, proc_output):
        """Every exit status is 0, and there is no traceback."""
        launch_testing.asserts.assertExitCodes(proc_info)
        assert not any(b'Traceback' in one.text for one in proc_output)

    def test_recorded_bag_is_complete(self):
        """The recorded bag holds every frame of the bag that was played."""
        found = read_frames(FOLDER / 'recorded').frames
        played = read_frames(BAGS / 'calibration').frames
        counts = {name: len(frames) for name, frames in found.items()}
        assert counts == {name: len(frames) for name, frames in played.items()}
