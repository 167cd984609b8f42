# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Retractions of the reconstruction node without a graph: early ones, and how many are kept."""

from types import SimpleNamespace

import numpy as np
from fluoro_calib_msgs.msg import Retraction

from fluoro_calib_ros.nodes.messages.observations import stamp_from_nanoseconds, uint32_field
from fluoro_calib_ros.nodes.retractions import MAX_IDS, PointRetractions

NAMES = 'abcdef'


def retractions():
    """Return retractions of points and a list of the ids that they publish."""
    published = []
    output = SimpleNamespace(publish=lambda message: published.append(list(message.target_id)))
    return PointRetractions(SimpleNamespace(create_output=lambda *_: output)), published


def content(stamp_ns, target_id=range(1, 9)):
    return SimpleNamespace(
        stamp_ns=stamp_ns,
        frame_number=1,
        target_id=np.array(target_id),
        orientation=SimpleNamespace(frame_id='rig'),
    )


def retraction(stamp_ns, target_id):
    message = Retraction(target_id=uint32_field(np.array(target_id)))
    message.header.stamp = stamp_from_nanoseconds(stamp_ns)
    return message


def test_all_retractions_that_come_before_their_exposure_count():
    points, published = retractions()
    for target_id in ([1, 2], [5], [2]):
        points.on_retraction('a', retraction(7, target_id))
    points.on_retraction('b', retraction(7, [8]))
    points.on_retraction('a', retraction(8, [3]))
    points.note({'a': 7, 'b': 7}, content(7))
    assert published == [[1, 2, 5], [8]]
    assert points.values()['points retracted'] == 4


def test_early_retractions_of_an_exposure_are_limited():
    points, published = retractions()
    points.on_retraction('a', retraction(7, range(MAX_IDS)))
    points.on_retraction('a', retraction(7, [MAX_IDS]))
    points.note({'a': 7}, content(7, range(MAX_IDS + 1)))
    assert published == [list(range(MAX_IDS))]
