# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Calibrations with known orientations: only the distortion is estimated."""

import time
from dataclasses import replace

import numpy as np
import pytest
import rigs

from benchmarks.targets import known_orientation
from fluoro_calib_ros.checks.verdict import validate_or_report
from fluoro_calib_ros.errors import DataError
from fluoro_calib_ros.estimation.calibrate import calibrate_request
from fluoro_calib_ros.estimation.options import CalibrationOptions, CalibrationRequest
from fluoro_calib_ros.exposures.frame import Frame, MovingPoints
from fluoro_calib_ros.findings import Kind
from fluoro_calib_ros.io.calibration import load_calibrations
from fluoro_calib_ros.io.calibration_request import read_request
from fluoro_calib_ros.io.formats.native import write_known_orientations
from fluoro_calib_ros.io.observations import write_observations_csv
from fluoro_calib_ros.jobs.calibration import run_calibration
from fluoro_calib_ros.jobs.result_folder import save_outcome
from fluoro_calib_ros.photogrammetry.adjustment import adjust
from fluoro_calib_ros.photogrammetry.noise import Noise
from fluoro_calib_ros.photogrammetry.precision import precision
from fluoro_calib_ros.photogrammetry.rig_orientation import ExteriorPrior, KnownOrientation
from fluoro_calib_ros.simulation.rig import Detection, detect_beads

PLAIN = CalibrationOptions(model='none')


def fluoroscope():
    return rigs.rig().fluoroscopes[0]


def truth_of(one):
    return KnownOrientation(one.interior, one.rotation, one.position_mm)


@pytest.fixture(scope='module')
def motion():
    """40 exposures of 4 markers in motion, as one case."""
    return known_orientation(rigs.rig(), 1, 40, 4)


@pytest.fixture(scope='module')
def outcome(motion):
    return run_calibration(motion.request(motion.frames))


def error_inside(model):
    """RMS error [px] of the correction itself, without any part absorbed by an orientation."""
    pixels = np.stack(np.meshgrid(*[np.arange(20.0, 1010, 30)] * 2), axis=2).reshape(-1, 2)
    inside = pixels[~model.outside(pixels)]
    assert len(inside) > 600
    error = model.predict(inside) - fluoroscope().distortion(inside)
    return np.sqrt(np.mean(error**2)), np.sqrt(np.mean(model.evaluate(inside).sd ** 2))


def test_four_markers_an_exposure_give_the_distortion(outcome):
    calibration = outcome.result.calibrations['a']
    rms, claimed = error_inside(calibration.model)
    assert rms < 0.25
    assert claimed == pytest.approx(rms, rel=0.6)
    assert not calibration.interior_estimated
    np.testing.assert_array_equal(calibration.interior, fluoroscope().interior)
    for exposure in outcome.result.fluoroscopes['a'].exposures:
        np.testing.assert_allclose(exposure.position_mm, fluoroscope().position_mm, atol=1e-3)


@pytest.mark.parametrize('model', ['local_linear', 'parametric'])
@pytest.mark.long
def test_other_models_learn_shift_and_scale_too(motion, model):
    """The given principal point is 5 px off; with orientation fixed, the correction has it."""
    shifted = replace(motion.known['a'], interior=motion.known['a'].interior + [5.0, -3.0, 0.0])
    request = replace(motion, known={'a': shifted}).request(motion.frames, model=model)
    model = calibrate_request(request).calibrations['a'].model
    pixels = np.array([[511.0, 511.0], [400.0, 600.0], [650.0, 420.0]])
    wanted = fluoroscope().distortion(pixels) - [5.0, -3.0]
    np.testing.assert_allclose(model.predict(pixels), wanted, atol=1.0)


@pytest.mark.long
def test_an_orientation_with_standard_deviations_is_improved(motion):
    sd = ((20.0, 20.0, 20.0), (1.0, 1e-3))
    wrong = motion.known['a'].interior + [0.0, 0.0, 30.0]
    known = replace(motion.known['a'], interior=wrong, interior_sd=sd[0], exterior_sd=sd[1])
    request = replace(motion, known={'a': known}).request(motion.frames)
    figures = calibrate_request(request).fluoroscopes['a']
    assert 0 < figures.interior_sd[2] < 20
    assert abs(figures.interior[2] - fluoroscope().interior[2]) < 4 * figures.interior_sd[2]


def test_prior_of_an_exterior_orientation_is_weighted_as_it_should_be():
    """An orientation is observed twice: information of the prior and of the images add up."""
    network, truth = rigs.small_network(exposures=3, targets=30, nu=np.inf)
    noise = Noise('gaussian', 0.3)
    free = adjust(network, truth, 0.0, noise)
    without = precision(network, free)
    sd = np.full((3, 6), np.inf)
    sd[0] = np.sqrt(np.diagonal(without.exterior[0]))
    shifted = truth.position_mm.copy()
    shifted[0] += [0.3, 0, 0]
    prior = ExteriorPrior(truth.rotation, shifted, sd)
    weighted = replace(network, exterior=prior)
    found = adjust(weighted, truth, 0.0, noise)
    wanted = np.linalg.inv(np.linalg.inv(without.exterior[0]) + np.diag(prior.weights[0]))
    size = np.sqrt(np.outer(np.diagonal(wanted), np.diagonal(wanted)))
    np.testing.assert_allclose(
        precision(weighted, found).exterior[0] / size, wanted / size, rtol=0, atol=0.1
    )
    off = prior.discrepancies(free.parameters.rotation, free.parameters.position_mm)[0]
    pull = wanted @ (prior.weights[0] * -off)
    moved = found.parameters.position_mm[0] - free.parameters.position_mm[0]
    np.testing.assert_allclose(moved, pull[:3], atol=0.1 * np.abs(pull[:3]).max())
    assert weighted.n_observations == network.n_observations + 6  # of the known exposure


def test_what_is_saved_is_looked_up_and_validated(outcome, motion, tmp_path):
    save_outcome(tmp_path, outcome)
    calibrations = load_calibrations(tmp_path)
    request = read_request(tmp_path, calibrations)
    held = request.known_orientations['a']
    assert held.interior_sd is None and held.exterior_sd is None
    verdict = validate_or_report(
        replace(request, options=replace(request.options, model='none')), calibrations
    )
    assert {'halves', 'held_out', 'drift'} <= {check.name for check in verdict.checks}
    uv = motion.frames[0].uv
    np.testing.assert_allclose(
        calibrations['a'].correct(uv).uv, uv - calibrations['a'].model.predict(uv), atol=0.02
    )
    save_outcome(tmp_path, replace(outcome, request=replace(request, known_orientations={})))
    assert read_request(tmp_path, calibrations).known_orientations == {}


def one_pose():
    """The phantom at rest in one exposure of both fluoroscopes; its frame is the lab frame."""
    rng = np.random.default_rng(4)
    frames = {}
    for one in rigs.rig().fluoroscopes:
        ids, uv = detect_beads(
            rng, one, rigs.rig().true_mm, rigs.rig().phantom.target_id, Detection()
        )
        frames[one.name] = [Frame(one.name, 1, ids, uv, (1024, 1024))]
    return frames


def test_one_pose_is_enough_and_orients_the_rig_in_the_lab():
    known = {one.name: truth_of(one) for one in rigs.rig().fluoroscopes}
    request = CalibrationRequest(one_pose(), rigs.rig().phantom, PLAIN, known_orientations=known)
    # Without a correction, the residuals are too large for a calibration.
    orientation = run_calibration(request, force=True).orientation
    assert orientation.frame_id == 'lab'
    for f, one in enumerate(rigs.rig().fluoroscopes):
        np.testing.assert_allclose(orientation.position_mm[f], one.position_mm, atol=1e-3)


def inverted(known):
    return replace(
        known, rotation=known.rotation.T, position_mm=-known.rotation @ known.position_mm
    )


WRONG = {
    'in metres': lambda k: replace(k, position_mm=k.position_mm / 1000),
    'inverted': inverted,
    'other fluoroscope': lambda k: truth_of(rigs.rig().fluoroscopes[1]),
}


def test_interchanged_fluoroscopes_are_named():
    one, other = rigs.rig().fluoroscopes
    known = {'a': truth_of(other), 'b': truth_of(one)}
    request = CalibrationRequest(one_pose(), rigs.rig().phantom, PLAIN, known_orientations=known)
    with rigs.refused(Kind.FLUOROSCOPES_INTERCHANGED) as error:
        run_calibration(request)
    assert error.value.finding.place.fluoroscopes == ('a', 'b')


@pytest.mark.filterwarnings('error')
@pytest.mark.parametrize('kind', WRONG)
def test_a_wrong_orientation_is_refused_in_a_sentence(kind):
    known = {'a': WRONG[kind](truth_of(fluoroscope()))}
    request = CalibrationRequest(
        {'a': one_pose()['a']}, rigs.rig().phantom, PLAIN, known_orientations=known
    )
    with rigs.refused(Kind.WRONG_KNOWN_ORIENTATION):
        run_calibration(request)


def test_what_does_not_go_together_is_refused():
    known = {'a': truth_of(fluoroscope())}
    frames = {'a': one_pose()['a']}
    request = CalibrationRequest(frames, rigs.rig().phantom, PLAIN, known_orientations=known)
    with pytest.raises(ValueError, match='free network'):
        calibrate_request(replace(request, options=CalibrationOptions(datum='inner')))
    with pytest.raises(DataError, match='fluoroscope c: its orientation is known, but'):
        run_calibration(replace(request, known_orientations={'c': known['a']}))
    points = MovingPoints([1, 1, 1, 1], [1, 2, 3, 12], np.eye(4, 3), np.ones(4))
    assert points.ids(7, 5) == 705
    with pytest.raises(DataError, match=r'exposure 1: the coordinates of target .* are not given'):
        points.as_phantom(frames)
    # Ids of files and messages have 32 bits; those of exposure 1e9 exceeded even 64.
    for exposure in (43_000_000, 10**9, 2**62):
        with pytest.raises(DataError, match='number the exposures from 1 on'):
            MovingPoints([1, exposure], [1, 12], np.eye(2, 3), np.ones(2))


def test_the_command_takes_markers_in_motion(motion, tmp_path, capsys):
    """Coordinates with an exposure column; K, R and t from this project's file."""
    base = 10
    frames = [replace(f, target_id=f.target_id % base) for f in motion.frames]
    write_observations_csv(tmp_path / 'seen.csv', {'a': frames})
    write_known_orientations(tmp_path / 'known.yaml', motion.known)
    phantom = motion.phantom
    lines = [
        f'{target // base},{target % base},{x!r},{y!r},{z!r},{sd!r}'
        for target, (x, y, z), sd in zip(
            phantom.target_id.tolist(), phantom.xyz_mm.tolist(), phantom.sd_mm.tolist()
        )
    ]
    header = 'exposure,target_id,x,y,z,sd'
    (tmp_path / 'points.csv').write_text('\n'.join([header, *lines]) + '\n')
    arguments = (
        'calibrate',
        tmp_path / 'seen.csv',
        '--image-size',
        '1024x1024',
        '--model',
        'none',
        '--fast',
    )
    arguments += ('--phantom', tmp_path / 'points.csv', '--out', tmp_path / 'result')
    assert rigs.run(*arguments, '--known-orientation', tmp_path / 'known.yaml', '--force') == 0
    found = load_calibrations(tmp_path / 'result')['a']
    np.testing.assert_allclose(found.interior, fluoroscope().interior)
    repeated = '\n'.join([header, lines[0], lines[0]])
    (tmp_path / 'points.csv').write_text(repeated + '\n')
    assert rigs.run(*arguments, '--known-orientation', tmp_path / 'known.yaml') == 1
    assert 'row 3: target 0 of exposure 1 is already given in row 2' in capsys.readouterr().err


def test_seconds_of_a_calibration_are_those_that_it_took(motion):
    request = motion.request(motion.frames[:20])
    start = time.perf_counter()
    calibration = calibrate_request(request).calibrations['a']
    assert 0 < calibration.seconds < time.perf_counter() - start
