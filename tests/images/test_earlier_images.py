# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Late decisions change earlier images and report which of their ids were wrong."""

import numpy as np

from fluoro_calib_ros.images.marker_decisions import Decision, EarlierImages, Retraction
from fluoro_calib_ros.images.markers import MarkerFrame


def image(number, ids):
    n = len(ids)
    nothing = np.zeros(0)
    return MarkerFrame(
        number,
        np.array(ids),
        uv=np.arange(2.0 * n).reshape(n, 2),
        sigma=np.full(n, 0.05),
        overlapped=np.zeros(n, bool),
        doubtful=np.ones(n, bool),
        missing=nothing.astype(int),
        predicted=np.zeros((0, 2)),
        lost=nothing.astype(bool),
    )


def earlier(most=None):
    out = EarlierImages(most)
    for number, ids in ((3, [1, 2, 3]), (4, [1, 2, 3]), (6, [2, 3]), (7, [3])):
        out.add(image(number, ids))
    return out


def test_exchanged_ids_are_taken_back_where_they_were_given():
    images = earlier()
    found = images.revise(Decision('exchanged', 'a', 8, 4, (1, 2)))
    assert found == [Retraction(4, (1, 2)), Retraction(6, (2,))]
    assert [one.target_id.tolist() for one in images] == [[1, 2, 3], [2, 1, 3], [1, 3], [3]]


def test_dropped_ids_are_taken_back_and_confirmed_ones_are_not():
    images = earlier()
    assert images.revise(Decision('confirmed', 'a', 8, 3, (3,))) == []
    assert [one.doubtful.tolist()[-1] for one in images] == [False] * 4
    assert images.revise(Decision('dropped', 'a', 8, 6, (3,))) == [
        Retraction(6, (3,)),
        Retraction(7, (3,)),
    ]
    assert [one.target_id.tolist() for one in images] == [[1, 2, 3], [1, 2, 3], [2], []]


def test_a_live_view_keeps_the_last_images():
    images = earlier(most=2)
    assert images.revise(Decision('dropped', 'a', 8, 3, (3,))) == [
        Retraction(6, (3,)),
        Retraction(7, (3,)),
    ]
