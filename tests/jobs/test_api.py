# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What the Python interface accepts and refuses: names, orientations, and exposures."""

from dataclasses import replace

import numpy as np
import pytest
import rigs

import fluoro_calib_ros as fc
from fluoro_calib_ros.exposures.names import Names
from fluoro_calib_ros.findings import Kind
from fluoro_calib_ros.io.bags.writer import write_bag
from fluoro_calib_ros.io.csv_table import read_names
from fluoro_calib_ros.io.observations import write_observations_csv
from fluoro_calib_ros.jobs import sources

COUNT = 6  # exposures
QUICK = fc.CalibrationOptions(model='none', max_iterations=1)


@pytest.fixture(scope='module')
def calibrations():
    return rigs.true_calibrations(rigs.rig().fluoroscopes)


def exposures(*names, **changes):
    """Exposures of the rig without distortion, with changed fields."""
    return {
        name: [replace(frame, **changes) for frame in rigs.exposures()[name][:COUNT]]
        for name in names
    }


def named(number):
    """A name of letters alone, whose order in a file does not tell the id."""
    return ''.join(chr(ord('a') + int(digit)) for digit in f'{number:04d}')


def test_calibrate_keeps_names_that_are_not_numbers(tmp_path):
    phantom = rigs.rig().phantom
    names = Names({named(i): int(i) for i in phantom.target_id})
    fc.write_phantom(tmp_path / 'phantom.csv', phantom, names)
    frames = [
        replace(frame, target_id=frame.target_id[::-1], uv=frame.uv[::-1])
        for frame in exposures('a')['a']
    ]
    write_observations_csv(tmp_path / 'seen.csv', frames, names)
    survey = fc.read_survey(tmp_path / 'phantom.csv')
    size = frames[0].image_size
    recording = fc.read_source(
        tmp_path / 'seen.csv', image_size=size, settings=fc.FileSettings(names=survey.names)
    )
    outcome = fc.calibrate(recording, survey, QUICK)
    fc.save_outcome(tmp_path / 'result', outcome)
    assert read_names(tmp_path / 'result') == survey.names
    with pytest.raises(fc.DataError, match='in Python image_size of read_source'):
        fc.calibrate(tmp_path / 'seen.csv', tmp_path / 'phantom.csv', QUICK)


def test_calibrate_reads_a_source_with_the_names_of_the_phantom(tmp_path, monkeypatch):
    phantom = rigs.rig().phantom
    names = Names({named(i): int(i) for i in phantom.target_id})
    fc.write_phantom(tmp_path / 'phantom.csv', phantom, names)
    write_bag(tmp_path / 'bag', exposures('a'))
    known = []

    def read_source(*words, settings, **more):
        known.append(settings.names)
        return sources.read_source(*words, settings=settings, **more)

    monkeypatch.setattr('fluoro_calib_ros.api.read_source', read_source)
    outcome = fc.calibrate(tmp_path / 'bag', tmp_path / 'phantom.csv', QUICK)
    assert known == [outcome.request.names] == [names]


def test_orientation_of_other_calibrations_is_refused(calibrations):
    orientation = rigs.true_orientation(rigs.rig().fluoroscopes, calibrations)
    frames = exposures('a', 'b')
    foreign = replace(orientation, calibration_ids=('a-other', 'b-other'))
    body = fc.Body('m', np.arange(3), np.eye(3), np.ones(3))
    for given, cause in (
        ((calibrations, foreign), 'it belongs to the calibration'),
        (({}, orientation), 'no calibration of its'),
    ):
        with pytest.raises(fc.DataError, match=cause):
            fc.reconstruct(frames, *given)
        with pytest.raises(fc.DataError, match=cause):
            fc.track_bodies(frames, *given, [body])


def test_no_fluoroscope_is_refused(calibrations):
    phantom = rigs.rig().phantom
    for job in (lambda: fc.calibrate({}, phantom), lambda: fc.adjust({}, phantom, calibrations)):
        with pytest.raises(fc.DataError, match='no frames of any fluoroscope'):
            job()
    orientation = rigs.true_orientation(rigs.rig().fluoroscopes, calibrations)
    with pytest.raises(fc.DataError, match='image points of none, but two'):
        fc.reconstruct({}, calibrations, orientation)


def test_adjust_refuses_numbers_that_calibrate_refuses(calibrations):
    phantom = rigs.rig().phantom
    vague = replace(phantom, sd_mm=np.full(len(phantom.sd_mm), 5000.0))
    with rigs.refused(Kind.IMPLAUSIBLE_NUMBER, sd_mm=5000.0):
        fc.adjust(exposures('a'), vague, calibrations)
    frames = exposures('a')
    frames['a'] = [replace(f, sigma=np.full(len(f.target_id), 1e5)) for f in frames['a']]
    with rigs.refused(Kind.IMPLAUSIBLE_NUMBER):
        fc.adjust(frames, phantom, calibrations)
    both = exposures('a', 'b')
    both['b'] = [replace(frame, fluoroscope='b') for frame in both['a']]
    with rigs.refused(Kind.SHARED_EXPOSURE, exposures=COUNT):
        fc.adjust(both, phantom, calibrations)


def test_adjust_uses_a_repeated_exposure_once(calibrations):
    first, second = exposures('a')['a'][:2]
    again = [replace(first, number=number) for number in (101, 102)]
    frames = {'a': [first, second, *again]}
    result = fc.adjust(frames, rigs.rig().phantom, calibrations)
    copies = [f for f in result.findings if f.kind is Kind.COPIED_EXPOSURE]
    assert [f.place.exposures for f in copies] == [(101,), (102,)]
    used = {e.exposure for e in result.fluoroscopes['a'].exposures}
    assert used == {first.number, second.number}
