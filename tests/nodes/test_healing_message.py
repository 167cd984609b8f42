# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The Heal result of a rig that changes during the recording."""

from types import SimpleNamespace

import pytest
from fluoro_calib_msgs.action import Heal

from fluoro_calib_ros.jobs.healing import _unseen_distortion, common_motion
from fluoro_calib_ros.nodes.messages.self_calibration import fill_healing


@pytest.mark.parametrize(
    'meanwhile, message',
    [
        (True, 'the rig changed during the recording'),
        (False, 'no change is evident'),
    ],
)
def test_message_tells_that_the_rig_changed_during_the_recording(meanwhile, message):
    outcome = SimpleNamespace(
        verdict='fail',
        findings=(),
        diagnosis=SimpleNamespace(probability=()),
        checks=(),
        exposures=20,
        after=SimpleNamespace(place_mm=0.01, scale=1e-4),
        healed=None,
        changed_meanwhile=meanwhile,
        common_motion=common_motion(0.3),
        unseen_distortion=_unseen_distortion(0.02, 0.1),
    )
    result = Heal.Result()
    fill_healing(result, outcome, SimpleNamespace(orientation_id='rig-0'))
    unseen = f'{common_motion(0.3).sentence}; {outcome.unseen_distortion.sentence}'
    assert result.message == f'{message}; {unseen}; verdict: fail'
