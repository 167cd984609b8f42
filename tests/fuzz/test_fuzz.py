# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The targets of `make fuzz` with hypothesis: every reader gives a result or one sentence.

There are few examples per target, the same in every run. `make fuzz SECONDS=3600` runs longer.
"""

import functools
import re

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from fuzz.__main__ import NAMES, load
from fuzz.harness import check

TOKENS = [
    *(b'nan', b'inf', b'-1', b'0', b'1e308', b'1e-308', b'-1e300', b'9' * 30, b'1_0', b'', b'\n'),
    *(
        b'\0',
        b'"',
        b"'",
        b'[' * 200,
        b'{',
        b'(' * 50,
        b'&a',
        b'*a',
        b'x' * 2000,
        b'\xff\xfe',
        b';',
    ),
    *(b',', b'null', b'true', b'\x1b[2J', '\u2028'.encode(), b'\xff\xff\xff\xff', b'\0\0\0\x80'),
    *(b'\xff' * 8, b'\0' * 8, b'\0\0\0\0\0\0\xf0\x7f', b'\0\0\0\0\0\0\xf8\x7f'),
]
WORD = re.compile(rb'[-+.\w]+')
NEED_ROS = ('calibration_message', 'image_message', 'wire')
EXAMPLES = {  # number of examples of the slow targets
    **{'exchange': 10, 'bag_mcap': 15, 'bag_metadata': 15, 'numbers': 6, 'result_folder': 5},
    **{
        'archive_npz': 20,
        'calibration_npz': 25,
        'calibration_message': 10,
        'c3d': 10,
        'sleap': 10,
        'points_csv': 20,
    },
}


@st.composite
def damaged(draw, seeds):
    """Return a seed in which some words or bytes are replaced, doubled or cut off."""
    content = bytearray(draw(st.sampled_from(seeds)))
    for _ in range(draw(st.integers(1, 4))):
        kind = draw(st.sampled_from(['word', 'bytes', 'double', 'cut', 'bit']))
        at = draw(st.integers(0, max(len(content) - 1, 0)))
        length = draw(st.integers(0, 40))
        if kind == 'word':
            match = WORD.search(content, at)
            if match:
                content[match.start() : match.end()] = draw(st.sampled_from(TOKENS))
        elif kind == 'bytes':
            content[at : at + length] = draw(st.sampled_from(TOKENS) | st.binary(max_size=16))
        elif kind == 'double':
            content[at:at] = content[at : at + length]
        elif kind == 'bit' and content:
            content[at] ^= 1 << draw(st.integers(0, 7))
        elif kind == 'cut' and draw(st.booleans()):
            del content[at:]
    return bytes(content)


@functools.cache
def target_and_seeds(name):
    """Return a target and its seeds, some of which take long to make."""
    target = load(name)
    return target, list(target.seeds())


def of_targets(names):
    """Return the parameters of a test; targets that need ROS get its marker."""
    return [pytest.param(n, marks=[pytest.mark.ros] if n in NEED_ROS else []) for n in names]


@pytest.mark.parametrize('name', of_targets(NAMES))
def test_reader_gives_a_result_or_one_sentence(name, tmp_path):
    target, seeds = target_and_seeds(name)

    @settings(
        max_examples=EXAMPLES.get(name, 40),
        derandomize=True,
        database=None,
        deadline=None,
        suppress_health_check=list(HealthCheck),
    )
    @given(damaged(seeds))
    def property_holds(data):
        check(target, data, tmp_path)

    property_holds()


# Readers of these targets take different kinds of files: each seed is refused by one reader.
SEVERAL_KINDS = (
    *('bag_metadata', 'calibration_message', 'exchange', 'image_message', 'images', 'numbers'),
    *('phantom_csv', 'rig_toml'),
)


@pytest.mark.parametrize('name', of_targets(n for n in NAMES if n not in SEVERAL_KINDS))
def test_first_seed_is_accepted(name, tmp_path):
    """Otherwise the fuzzer would begin with an input that is refused at once."""
    target, seeds = target_and_seeds(name)
    assert check(target, seeds[0], tmp_path)
