# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Retractions of the reconstruction node without a graph: early ones, and how many are kept."""

from types import SimpleNamespace

import numpy as np
from fluoro_calib_msgs.msg import Retraction

from fluoro_calib_ros.nodes.messages.observations import stamp_from_nanoseconds, uint32_field
from fluoro_calib_ros.nodes.retractions import MAX_IDS, PointRetractions
from fluoro_calib_ros.nodes.runtime.streams import REMEMBERED

NAMES = 'abcdef'


def retractions():
    """Return retractions of points and a list of the ids that they publish."""
    published = []
    output = SimpleNamespace(publish=lambda message: published.append(list(message.target_id)))
    node = SimpleNamespace(create_output=lambda *_: output, create_input=lambda *_: None)
    return PointRetractions(node, NAMES, None), published


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


def test_points_of_as_many_exposures_are_kept_whatever_the_number_of_fluoroscopes():
    points, published = retractions()
    for stamp_ns in range(REMEMBERED + 1):
        points.note(dict.fromkeys(NAMES, stamp_ns), content(stamp_ns))
    points.on_retraction('a', retraction(0, [3]))
    assert not published
    points.on_retraction('a', retraction(1, [3]))
    points.on_retraction('f', retraction(1, [4]))
    assert published == [[3], [4]]


def test_as_many_early_retractions_are_kept_whatever_the_number_of_fluoroscopes():
    points, published = retractions()
    for stamp_ns in range(REMEMBERED):
        for name in NAMES:
            points.on_retraction(name, retraction(stamp_ns, [3]))
    points.note(dict.fromkeys(NAMES, 0), content(0))
    assert published == [[3]] * len(NAMES)
