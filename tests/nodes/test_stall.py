# Copyright 2026 fluoro_calib_ros maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""A stream that stops."""

from fluoro_calib_ros.nodes.runtime.stall import StallDetector


class Clock:
    """A clock that is set by hand."""

    def __init__(self):
        self.time = 100.0

    def __call__(self):
        return self.time


def messages(counts):
    """What a detector says of counts that it is asked about once a second."""
    clock = Clock()
    detector = StallDetector(clock)
    said = []
    for count in counts:
        clock.time += 1.0
        said.append(detector.message(count))
    return said


def test_stop_of_a_stream_is_told_within_two_seconds_and_its_return_too():
    said = messages([250, 500, 500, 500, 750])
    assert said[:2] == ['', '']
    assert said[2] == 'no frame for 1 s; before, there were 250 a second'
    assert said[3].startswith('no frame for 2 s')
    assert said[4] == ''


def test_exposures_taken_one_by_one_are_no_stream():
    assert messages([0, 1, 1, 1, 2, 2]) == [''] * 6


def test_nothing_is_said_before_the_first_frame():
    assert messages([0, 0, 0]) == [''] * 3


def test_counts_that_start_again_are_no_stop():
    assert messages([250, 500, 20, 270])[2:] == ['', '']
