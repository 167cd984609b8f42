# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Parts of the extraction node: numbers of images, the queue, the worker process."""

import multiprocessing
import os
import signal
import threading
import time

import numpy as np
import pytest

from fluoro_calib_ros.exposures.stamps import ExposureNumbers
from fluoro_calib_ros.jobs.followers import Observations, follower_process
from fluoro_calib_ros.nodes.image_stream import LATE, ExposureQueue, _is_complete

MS = 1_000_000


def test_images_of_an_exposure_have_the_same_number_whatever_is_lost():
    numbers = ExposureNumbers('ab', 2 * MS)
    start = 10**18
    came = [('a', 0), ('b', 1), ('a', 100), ('a', 200), ('b', 201), ('b', 299), ('a', 300)]
    found = [(name, numbers.number(name, start + ms * MS)) for name, ms in came]
    assert found == [('a', 1), ('b', 1), ('a', 2), ('a', 3), ('b', 3), ('b', 4), ('a', 4)]


def test_a_lost_image_shifts_no_numbers_if_the_tolerance_is_too_large():
    numbers = ExposureNumbers('ab', 2 * MS)
    found = [
        [numbers.number(name, 10**18 + row * MS) for name in 'ab' if (name, row) != ('a', 50)]
        for row in range(100)
    ]
    assert found == [[row + 1] * (1 if row == 50 else 2) for row in range(100)]


def test_numbers_are_in_order_of_time_where_images_of_one_fluoroscope_arrive_first():
    """The image of b at 300 ms is lost, and its next one arrives before that of a at 300 ms."""
    numbers = ExposureNumbers('ab', 2 * MS)
    came = [('b', ms) for ms in (0, 100, 200, 400)] + [('a', ms) for ms in range(0, 600, 100)]
    found = {(name, ms): numbers.number(name, 10**18 + ms * MS) for name, ms in came}
    assert found == {(name, ms): 1 + ms // 100 for name, ms in came}


def test_stills_are_counted_without_gaps():
    numbers = ExposureNumbers('ab', 2 * MS)
    seconds = (1, 6, 11, 26, 31, 300)
    found = [numbers.number(name, 10**18 + s * 1000 * MS) for s in seconds for name in 'ab']
    assert found == [1, 1, 2, 2, 3, 3, 4, 4, 5, 5, 6, 6]


def test_a_repeated_recording_is_numbered_on():
    numbers = ExposureNumbers('ab', MS)
    found = [numbers.number(name, 5 * MS * i) for _ in range(2) for i in (1, 2) for name in 'ab']
    assert found == [1, 1, 2, 2, 3, 3, 4, 4]


def test_images_without_a_stamp_are_counted_by_fluoroscope():
    numbers = ExposureNumbers('ab', MS)
    assert [numbers.number(name, 0) for name in 'aabab'] == [1, 2, 1, 3, 2]


def next_of(queue, name):
    """Return the next item of a fluoroscope, or None once the queue is closed."""
    exposure = queue.get([name])
    return exposure and exposure[1][name]


def test_a_full_queue_sheds_the_oldest_exposure_that_is_not_begun():
    queue = ExposureQueue('ab', 2)
    lost = [queue.put(name, number, (name, number)) for number in (1, 2) for name in 'ab']
    assert lost == [[]] * 4
    assert next_of(queue, 'a') == ('a', 1)
    assert queue.put('a', 3, ('a', 3)) == []
    assert queue.put('b', 3, ('b', 3)) == ['a', 'b']  # exposure 2, since 1 has begun
    assert queue.put('a', 2, ('a', 2)) == ['a']  # too late
    assert [next_of(queue, 'b'), next_of(queue, 'b'), next_of(queue, 'a')] == [
        ('b', 1),
        ('b', 3),
        ('a', 3),
    ]
    assert queue.waiting('a') == queue.waiting('b') == 0


def test_a_queue_whose_exposures_are_all_begun_sheds_the_oldest_item():
    queue = ExposureQueue('ab', 1)
    for number in (1, 2):
        queue.put('a', number, number)
        next_of(queue, 'a')
    assert queue.put('b', 1, 1) == [] and queue.put('b', 2, 2) == ['b']
    assert next_of(queue, 'b') == 2


def test_an_exposure_is_given_out_whole_or_when_its_partner_is_lost():
    queue = ExposureQueue('ab', LATE + 1)
    for name, number in (('a', 1), ('b', 1), ('a', 2), ('b', 3)):
        queue.put(name, number, (name, number))
    forever = 600.0  # timeout [s] that must not be needed for lost images
    assert queue.get('ab', forever) == (1, {'a': ('a', 1), 'b': ('b', 1)})
    assert queue.get('ab', forever) == (2, {'a': ('a', 2)})  # b has already reached 3
    assert queue.get('ab', 0.0) == (3, {'b': ('b', 3)})  # a may still deliver 3
    for number in range(4, 5 + LATE):
        queue.put('a', number, ('a', number))
    assert queue.get('ab', forever) == (4, {'a': ('a', 4)})  # b is several exposures late
    assert queue.put('b', 4, ('b', 4)) == ['b']  # too late: it must not be given out again
    queue.close()
    assert queue.get('ab', forever) is None


@pytest.mark.parametrize(
    ('a', 'b', 'complete'),
    [
        ([1], [1], True),
        ([1], [], False),  # b may still arrive
        ([1, 2], [], False),  # b is one exposure late, as in a burst
        ([1, 2, 3], [], False),  # b has the largest allowed delay
        ([1, 2, 3, 4], [], True),  # the queue stops waiting for b
        ([1], [2], True),  # b has lost it
        ([], [3], False),
        ([], [3, 4, 5, 6], True),
        ([2], [1], True),
    ],
)
def test_exposure_is_complete_when_nothing_is_to_come(a, b, complete):
    assert _is_complete({'a': dict.fromkeys(a), 'b': dict.fromkeys(b)}) is complete


def test_exposure_waits_for_a_partner_as_long_as_told():
    queue = ExposureQueue('ab', 4)
    queue.put('a', 1, 'image')
    start = time.monotonic()
    assert queue.get('ab', 0.2) == (1, {'a': 'image'})
    assert 0.19 < time.monotonic() - start < 5


def test_closing_a_queue_ends_the_wait():
    queue = ExposureQueue('a', 1)
    found = []
    waiting = threading.Thread(target=lambda: found.append(next_of(queue, 'a')))
    waiting.start()
    queue.close()
    waiting.join(10)
    assert found == [None]


class Fragile:
    """Follower that counts images, and fails as the first pixel of the image requests."""

    def __init__(self):
        self.count = 0

    def extract(self, images, number, overlays=(), angles=None):
        image = images['a']
        self.count += 1
        if image[0, 0] == 1:
            raise ZeroDivisionError('one')
        if image[0, 0] == 2:
            raise SystemExit(3)
        if image[0, 0] == 3:
            threading.Event().wait()  # until terminated
        return {'a': Observations(expected=self.count)}


@pytest.mark.long
def test_a_failure_loses_one_image_an_interrupt_none_and_closing_ends_the_one_in_work():
    process = follower_process(Fragile)

    def extract(value):
        return process({'a': np.full((2, 2), value, np.uint8)}, 1)['a'].expected

    assert extract(0) == 1
    with pytest.raises(RuntimeError, match='one'):
        extract(1)
    for child in multiprocessing.active_children():
        os.kill(child.pid, signal.SIGINT)  # as a terminal sends it to all processes of a node
    assert extract(0) == 3
    with pytest.raises(RuntimeError, match='ended with status 3'):
        extract(2)
    assert extract(0) == 1  # a new process has been started
    errors = []

    def last():
        with pytest.raises(RuntimeError) as error:
            extract(3)
        errors.append(str(error.value))

    thread = threading.Thread(target=last)
    thread.start()
    process.close()
    thread.join(10)
    assert len(errors) == 1
