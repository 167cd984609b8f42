# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

import numpy as np
import pytest

from fluoro_calib_ros.exposures.frame import Frame
from fluoro_calib_ros.findings import Kind, Severity
from fluoro_calib_ros.jobs.extraction import ImageResult, bent_shadows


def image(bent_px, sigma_px=0.02, count=50):
    frame = Frame('a', 1, np.arange(count), np.zeros((count, 2)), (100, 100))
    return ImageResult(sigma=np.full(count, sigma_px), bent_px=bent_px, frame=frame)


def test_shifts_beyond_the_noise_of_a_correction_are_told():
    found = bent_shadows('a', [image(0.02), image(0.03), ImageResult(bent_px=1.0)])
    assert (found.kind, found.severity) == (Kind.SHADOWS_BENT, Severity.WARNING)
    assert found.place.fluoroscopes == ('a',)
    assert found.numbers['bent_px'] == pytest.approx(np.sqrt(0.00065))
    assert found.numbers['left_px'] == pytest.approx(0.55 * np.sqrt(0.00065))


def test_more_exposures_show_smaller_shifts():
    # The noise of a correction from image points of 0.02 px: 0.0183 px for 50, 0.0046 px for 800.
    assert bent_shadows('a', [image(0.03)]) is None
    assert bent_shadows('a', [image(0.034)]) is not None
    assert bent_shadows('a', [image(0.008)] * 16) is None
    assert bent_shadows('a', [image(0.009)] * 16) is not None
