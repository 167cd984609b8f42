# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Self-calibration of the virtual rig: accuracy, repeatability, invalid input, and results."""

from dataclasses import replace

import numpy as np
import pytest
import rigs
from threadpoolctl import threadpool_limits

from fluoro_calib_ros.correction.base import CorrectionStatus
from fluoro_calib_ros.correction.fluoroscope_calibration import digest_of_sources
from fluoro_calib_ros.errors import DataError
from fluoro_calib_ros.estimation.alternation import Anderson
from fluoro_calib_ros.estimation.calibrate import adjust_with_calibrations, calibrate
from fluoro_calib_ros.estimation.estimator import gauge_basis, gauge_coefficients
from fluoro_calib_ros.estimation.initial_network import measured_network, nominal_interior
from fluoro_calib_ros.estimation.options import CalibrationOptions
from fluoro_calib_ros.estimation.result import Targets, combined_targets
from fluoro_calib_ros.estimation.self_calibration import self_calibrate
from fluoro_calib_ros.exposures.phantom import Phantom
from fluoro_calib_ros.findings import Kind, Place
from fluoro_calib_ros.photogrammetry.network import similarity_directions
from fluoro_calib_ros.photogrammetry.rotations import (
    matrix_from_quaternion,
    matrix_from_vector,
    rotation_angle,
)
from fluoro_calib_ros.simulation.rig import (
    Detection,
    StreamStart,
    detect_beads,
    simulate_exposures,
    virtual_rig,
)

OK, OUTSIDE, INVALID = CorrectionStatus

PHANTOM = rigs.rig().phantom
NOISE_PX = 0.25


def field_error(job, name='a'):
    """RMS difference [px] between correction and true distortion, without the gauge, inside the
    calibrated area.
    """
    calibration = job.calibrations[name]
    fluoroscope = next(f for f in rigs.rig().fluoroscopes if f.name == name)
    grid = np.stack(
        np.meshgrid(np.arange(0, 1024, 31.0), np.arange(0, 1024, 31.0)), axis=2
    ).reshape(-1, 2)
    grid = grid[~calibration.model.outside(grid)]
    error = calibration.model.predict(grid) - fluoroscope.distortion(grid)
    error -= gauge_basis(grid, calibration.interior) @ gauge_coefficients(
        grid, error, calibration.interior
    )
    return float(np.sqrt(np.mean(error**2)))


def target_error(targets):
    """RMSE [mm] of the object points against the truth."""
    return float(
        np.sqrt(
            np.mean((targets.xyz_mm - rigs.rig().true_mm[PHANTOM.index(targets.target_id)]) ** 2)
        )
    )


def frames_of(name='a', count=15):
    """The frames of each fluoroscope, in new lists."""
    return {name: list(rigs.exposures()[name][:count])}


def short(**options):
    """Calibration of two rounds with the first six exposures, shared by the tests."""
    return rigs.calibrated(count=6, max_iterations=2, **options)


def rounds(count, **options):
    return CalibrationOptions(max_iterations=count, **options)


def assert_same_bits(one, other):
    """Assert that two results are equal to the last bit, except for their run times."""
    for name in one.fluoroscopes:
        a = one.fluoroscopes[name]
        b = other.fluoroscopes[name]
        for key in ('interior', 'interior_sd', 'rmse_before', 'rmse_after'):
            np.testing.assert_array_equal(getattr(a, key), getattr(b, key), err_msg=key)
        for ours, theirs in zip(a.exposures, b.exposures, strict=True):
            assert ours.exposure == theirs.exposure
            for key in ('position_mm', 'quaternion_wxyz', 'sd_mm', 'sd_rad'):
                np.testing.assert_array_equal(
                    getattr(ours, key), getattr(theirs, key), err_msg=key
                )
        assert one.calibrations[name].calibration_id == other.calibrations[name].calibration_id
        np.testing.assert_array_equal(
            one.calibrations[name].model.train_duv, other.calibrations[name].model.train_duv
        )
    for key in ('target_id', 'xyz_mm', 'covariance'):
        np.testing.assert_array_equal(
            getattr(one.targets, key), getattr(other.targets, key), err_msg=key
        )
    assert [(r.F, r.G, r.k) for h in one.history.values() for r in h] == [
        (r.F, r.G, r.k) for h in other.history.values() for r in h
    ]


# ---- accuracy


@pytest.mark.long
def test_self_calibration_estimates_the_distortion():
    """15 exposures: the calibration converges, residuals are noise, correction and object points
    are near the truth.
    """
    job = rigs.calibrated()
    figures = job.fluoroscopes['a']
    assert job.converged and job.findings == ()
    assert (figures.rmse_before > 4 * NOISE_PX).all()
    # Raw residuals are smaller than the noise by the square root of their redundancy, here about
    # two thirds.
    assert (figures.rmse_after > 0.6 * NOISE_PX).all() and (figures.rmse_after < NOISE_PX).all()
    assert figures.inliers > 0.97 * figures.observations > 15 * 125
    assert field_error(job) < 0.13
    uncorrected = rigs.calibrated(model='none')
    assert target_error(job.targets) < 0.075 and target_error(job.targets) < 0.7 * target_error(
        uncorrected.targets
    )


@pytest.mark.long
def test_local_linear_is_more_accurate_than_knn():
    knn = rigs.calibrated(model='knn')
    # The steps of knn cause heavy tails, which must not be mistaken for gross errors.
    assert knn.fluoroscopes['a'].rmse_after.max() < 1.2 * NOISE_PX
    assert 2.5 * field_error(rigs.calibrated()) < field_error(knn) < 1.2
    # The covariances of the object points contain what knn cannot follow.
    targets = knn.targets
    offset = targets.xyz_mm - rigs.rig().true_mm[PHANTOM.index(targets.target_id)]
    variance = np.diagonal(targets.covariance, axis1=1, axis2=2)
    assert 0.7 < np.mean(offset**2 / variance) < 1.3


def test_without_a_model_there_is_one_round():
    job = rigs.calibrated(model='none')
    assert job.converged and len(job.history['a']) == 1
    calibration = job.calibrations['a']
    assert (
        calibration.model.kind == 'none'
        and not calibration.model.predict(np.array([[5.0, 5.0]])).any()
    )
    assert job.fluoroscopes['a'].rmse_after.min() > 4 * NOISE_PX


def test_calibration_corrects_unused_exposures():
    """With the calibration fixed, the residuals are near the noise level and the calibration stays
    unchanged.
    """
    test = simulate_exposures(rigs.rig(), 8, seed=77, start=StreamStart(number=100)).frames['a']
    calibration = rigs.calibrated().calibrations['a']
    job = adjust_with_calibrations({'a': test}, PHANTOM, {'a': calibration})
    figures = job.fluoroscopes['a']
    assert (figures.rmse_before > 4 * NOISE_PX).all() and (figures.rmse_after < NOISE_PX).all()
    np.testing.assert_array_equal(figures.interior, calibration.interior)
    assert job.calibrations['a'] is calibration
    # The interior orientation is fixed, but its uncertainty is propagated.
    interior_sd = np.sqrt(np.diag(calibration.interior_covariance))
    np.testing.assert_allclose(figures.interior_sd, interior_sd, rtol=0.05)
    assert [e.exposure for e in figures.exposures] == list(range(100, 108))
    without = adjust_with_calibrations(
        {'a': test}, PHANTOM, {'a': rigs.calibrated(model='none').calibrations['a']}
    )
    assert target_error(job.targets) < 0.8 * target_error(without.targets)


def test_a_single_exposure_can_be_adjusted():
    test = simulate_exposures(rigs.rig(), 1, seed=78).frames['a']
    job = adjust_with_calibrations(
        {'a': test}, PHANTOM, {'a': rigs.calibrated().calibrations['a']}
    )
    assert job.converged and len(job.fluoroscopes['a'].exposures) == 1
    # With one ray per target the survey could absorb all residuals, so the noise is taken from the
    # calibration.
    assert job.fluoroscopes['a'].rmse_after.min() > 0.05 and target_error(job.targets) < 0.1


def test_adjustment_refuses_frames_of_another_image_size():
    """A correction is valid only for pixels of its own image size."""
    other = [replace(frame, image_size=(2048, 1024)) for frame in frames_of()['a']]
    with pytest.raises(
        DataError,
        match='frame 1: the image is 2048 x 1024 px, but the calibration is for 1024 x 1024',
    ):
        adjust_with_calibrations({'a': other}, PHANTOM, {'a': rigs.calibrated().calibrations['a']})


@pytest.mark.long
def test_joint_adjustment_has_common_object_points():
    frames = {name: list(rigs.exposures()[name][:6]) for name in 'ab'}
    joint = calibrate(frames, PHANTOM, rounds(1), joint=True)
    apart = calibrate(frames, PHANTOM, rounds(1))
    assert list(joint.runs) == ['a+b'] and list(apart.runs) == ['a', 'b']
    for job in (joint, apart):
        assert list(job.calibrations) == list(job.fluoroscopes) == ['a', 'b']
        ids = np.unique(np.concatenate([f.target_id for fs in frames.values() for f in fs]))
        np.testing.assert_array_equal(job.targets.target_id, ids)
        assert [len(figures.exposures) for figures in job.fluoroscopes.values()] == [6, 6]
    assert set(joint.history['a+b'][0].k) == {'a', 'b'}
    network = joint.runs['a+b'].measured.network
    assert network.n_image_points == sum(len(f.target_id) for fs in frames.values() for f in fs)
    assert (network.n_exposures, network.n_points, network.n_fluoroscopes) == (12, len(ids), 2)
    assert not np.array_equal(joint.fluoroscopes['a'].interior, apart.fluoroscopes['a'].interior)


# ---- the iteration


@pytest.mark.parametrize('model', ['auto', 'local_linear', 'hybrid', 'knn', 'parametric'])
@pytest.mark.long
def test_fitted_correction_is_orthogonal_to_the_gauge(model):
    """While the interior orientation is estimated, no shift, scale or rotation remains in the
    correction.
    """
    run = rigs.calibrated(model=model).runs['a']
    uv = run.measured.network.uv
    core = run.trained
    whole = model in (
        'auto',
        'hybrid',
        'parametric',
    )  # with all image points, about a round before
    core = np.ones_like(core) if whole else core
    for fitted in (run.correction, run.models['a'].predict(uv)):
        part = gauge_coefficients(uv[core], fitted[core], run.after.parameters.interior[0])
        assert np.max(np.abs(part)) < (0.05 if whole else 1e-3)  # of several px


def test_adjustment_and_model_are_of_the_same_round():
    """The correction fixed in the last adjustment is that of the model, and the last round reports
    its cost.
    """
    job = rigs.calibrated()
    run = job.runs['a']
    # Trend terms that the model does not contain have a prior variance of 1e-8 in the adjustment.
    np.testing.assert_allclose(
        run.models['a'].predict(run.measured.network.uv), run.correction, atol=1e-6
    )
    last = run.history[-1]
    assert last.iteration == len(run.history) and pytest.approx(run.after.cost, abs=0.01) == last.F
    np.testing.assert_allclose(last.rmse['a'], job.fluoroscopes['a'].rmse_after, rtol=1e-3)
    calibration = job.calibrations['a']
    assert (calibration.cost_adjustment, calibration.cost_regression) == (last.F, last.G)
    assert (calibration.iterations, calibration.converged) == (last.iteration, True)
    assert last.k['a'] == calibration.model.k == job.fluoroscopes['a'].k
    expected = run.after.noise.weight(run.after.q) @ np.sum(run.after.residuals**2, axis=1)
    assert last.quadratic == pytest.approx(expected, rel=1e-3)


@pytest.mark.long
def test_convergence_follows_the_tolerance():
    """F and G change by less than the tolerance in the last round only."""
    history = rigs.calibrated(count=6, model='local_linear').history['a']

    def change(now, before):
        return max(abs(now.F - before.F) / max(abs(now.F), now.G), abs(now.G - before.G) / now.G)

    assert 3 < len(history) < 40
    assert change(history[-1], history[-2]) <= 1e-4 and history[-1].change <= 2e-3
    assert change(history[1], history[0]) > 1e-2
    assert history[-1].F < history[0].F


def test_maximum_number_of_rounds_is_reported():
    job = short()
    assert not job.converged and not job.calibrations['a'].converged and len(job.history['a']) == 2


def test_progress_is_reported_after_every_round():
    told = []
    job = calibrate(
        frames_of(count=6), PHANTOM, rounds(3), progress=lambda name, r: told.append((name, r))
    )
    assert told == [('a', r) for r in job.history['a']] and [r.iteration for _, r in told] == [
        1,
        2,
        3,
    ]


def test_a_progress_that_raises_stops_a_calibration():
    """No round follows the call of `progress` that raises."""
    told = []

    class Stop(Exception):
        pass

    def stop(*found):
        told.append(found)
        raise Stop

    with pytest.raises(Stop):
        calibrate(frames_of(count=6), PHANTOM, CalibrationOptions(), progress=stop)
    assert len(told) == 1


@pytest.mark.long
@pytest.mark.parametrize(
    'options',
    [
        {'loss': 'huber'},
        {'loss': 'gaussian'},
        {'model': 'local_linear', 'k': 25},
        {'interior': 'fixed'},
    ],
)
def test_options_reach_the_calculation(options):
    job = short(**options)
    run = job.runs['a']
    plain = short()
    assert run.after.noise.loss == options.get('loss', 'student_t')
    assert run.after.cost != plain.runs['a'].after.cost
    assert all(r.k['a'] == options['k'] for r in run.history if 'k' in options)
    # False matches spoil least squares; all other options reduce the residuals within two rounds.
    if options != {'loss': 'gaussian'}:
        assert (job.fluoroscopes['a'].rmse_after < 0.5 * job.fluoroscopes['a'].rmse_before).all()


@pytest.mark.parametrize(
    'options',
    [
        {'model': 'spline'},
        {'interior': 'free'},
        {'loss': 'cauchy'},
        {'max_iterations': 0},
        {'tolerance': 0.0},
        {'tolerance': float('nan')},
    ],
)
def test_unknown_options_are_refused(options):
    with pytest.raises(ValueError, match=next(iter(options))):
        CalibrationOptions(**options)


def test_fixed_interior_orientation_is_held_and_the_model_compensates():
    """Image centre and given principal distance stay exact and have no standard deviation."""
    job = calibrate(
        frames_of(count=6), PHANTOM, rounds(2, interior='fixed'), principal_distance=4000.0
    )
    np.testing.assert_array_equal(job.fluoroscopes['a'].interior, [511.5, 511.5, 4000.0])
    assert (
        not job.fluoroscopes['a'].interior_sd.any()
        and not job.calibrations['a'].interior_estimated
    )
    run = job.runs['a']
    uv = run.measured.network.uv[run.trained]
    part = gauge_coefficients(uv, run.correction[run.trained], run.after.parameters.interior[0])
    assert np.max(np.abs(part)) > 0.1, 'the gauge is not taken out of the correction'


def test_principal_distance_is_only_a_start_value():
    """The estimated interior orientation is the same for a given and a derived initial value."""
    measured = measured_network(frames_of(), PHANTOM, principal_distance=3900.0)
    np.testing.assert_array_equal(
        measured.start.interior, [nominal_interior((1024, 1024), 3900.0)]
    )
    found = measured_network(frames_of(), PHANTOM).start.interior[0, 2]
    true = rigs.rig().fluoroscopes[0].interior[2]
    assert found == pytest.approx(true, rel=0.04) and found != 3900.0
    one, other = (
        calibrate(
            frames_of(count=6), PHANTOM, CalibrationOptions(model='none'), principal_distance=c
        )
        for c in (None, 3600.0)
    )
    np.testing.assert_allclose(
        one.fluoroscopes['a'].interior, other.fluoroscopes['a'].interior, atol=0.5
    )


def test_start_values_are_near_the_truth():
    """In every exposure, the resected orientation is as close to the truth as the distortion
    allows.
    """
    frames = frames_of()
    simulated = simulate_exposures(rigs.rig(), 15, 1)
    measured = measured_network(frames, PHANTOM)
    fluoroscope = rigs.rig().fluoroscopes[0]
    for row, pose in enumerate(simulated.poses):
        rotation, position = fluoroscope.exterior(pose)
        assert rotation_angle(measured.start.rotation[row] @ rotation.T) < np.deg2rad(1.5)
        # Along the optical axis, the distance depends on the estimated principal distance.
        assert np.linalg.norm(measured.start.position_mm[row] - position) < 100


def test_exterior_orientations_are_those_of_the_rig():
    """Quaternion phantom -> sensor, and position of the source in the phantom frame [mm]."""
    fluoroscope = rigs.rig().fluoroscopes[0]
    poses = simulate_exposures(rigs.rig(), 15, 1).poses
    for found, pose in zip(rigs.calibrated().fluoroscopes['a'].exposures, poses, strict=True):
        rotation, position = fluoroscope.exterior(pose)
        # The principal point, and with it the attitude, is only determined up to the gauge.
        assert rotation_angle(
            matrix_from_quaternion(found.quaternion_wxyz) @ rotation.T
        ) < np.deg2rad(2)
        assert np.linalg.norm(found.position_mm - position) < 40
        assert (found.sd_mm > 0).all() and found.sd_mm.max() < 5 and 0 < found.sd_rad.max() < 1e-2


# ---- repeatability


def test_same_observations_give_the_same_bits():
    assert_same_bits(calibrate(frames_of(count=6), PHANTOM, rounds(2)), short())


@pytest.mark.parametrize('options', [{}, {'model': 'local_linear', 'k': 60}])
@pytest.mark.long
def test_order_of_frames_and_targets_does_not_matter(options):
    """Results agree to the last bit, also with accelerated rounds."""
    rng = np.random.default_rng(1)
    frames = frames_of(count=6)['a']
    shuffled = []
    for frame in rng.permutation(np.array(frames, dtype=object)):
        order = rng.permutation(len(frame.target_id))
        shuffled.append(replace(frame, target_id=frame.target_id[order], uv=frame.uv[order]))
    assert [f.number for f in shuffled] != [f.number for f in frames]
    assert_same_bits(
        *(calibrate({'a': f}, PHANTOM, rounds(4, **options)) for f in (frames, shuffled))
    )


def test_digest_depends_on_the_observations():
    frames = frames_of(count=3)['a']
    digest = digest_of_sources(frames, PHANTOM)
    assert digest == digest_of_sources(frames[::-1], PHANTOM)
    changed = replace(
        frames[1], uv=frames[1].uv + np.where(np.arange(len(frames[1].uv)) == 4, 1e-9, 0)[:, None]
    )
    assert digest != digest_of_sources([frames[0], changed, frames[2]], PHANTOM)
    assert digest != digest_of_sources(frames, replace(PHANTOM, sd_mm=PHANTOM.sd_mm * 2))


def test_sigma_of_one_changes_nothing():
    frames = [replace(f, sigma=np.ones(len(f.target_id))) for f in frames_of(count=6)['a']]
    job = calibrate({'a': frames}, PHANTOM, rounds(2))
    np.testing.assert_array_equal(
        job.fluoroscopes['a'].interior, short().fluoroscopes['a'].interior
    )


def test_observations_are_weighted_by_sigma():
    """Every other exposure is blurred by 2.5 px. Weights by sigma make the object points more
    accurate.
    """
    straight = virtual_rig(1, strength=0.0)
    frames = simulate_exposures(straight, 15, 1, detection=Detection(false_matches=0.0)).frames[
        'a'
    ]
    error = {}
    for told in (True, False):
        rng = np.random.default_rng(2)
        blurred = []
        for frame in frames:
            blur = 2.5 if frame.number % 2 else 0.0
            uv = np.clip(frame.uv + rng.normal(0, 1, frame.uv.shape) * blur, -0.5, 1023.5)
            sigma = np.full(len(uv), np.hypot(blur, NOISE_PX))
            blurred.append(replace(frame, uv=uv, sigma=sigma if told else None))
        job = calibrate({'a': blurred}, PHANTOM, CalibrationOptions('none', loss='gaussian'))
        error[told] = target_error(job.targets)
        if told:
            assert job.runs['a'].after.noise.scale == pytest.approx(1, rel=0.1)
    assert error[True] < 0.9 * error[False]


# ---- refusals


def cut(frame, count):
    return replace(frame, target_id=frame.target_id[:count], uv=frame.uv[:count])


def every(frame, step):
    return replace(frame, target_id=frame.target_id[::step], uv=frame.uv[::step])


def with_value(frame, value):
    uv = frame.uv.copy()
    uv[5, 0] = value
    return replace(frame, uv=uv)


def one_pose(frames):
    """Five copies of the first exposure with new noise."""
    rng = np.random.default_rng(3)
    return [
        replace(frames[0], number=n, uv=frames[0].uv + rng.normal(0, 0.2, frames[0].uv.shape))
        for n in range(5)
    ]


def strangers(frame):
    ids = frame.target_id.copy()
    ids[7] = 9999
    return replace(frame, target_id=ids)


def shuffled_ids(frame, seed=4):
    return replace(frame, target_id=np.random.default_rng(seed).permutation(frame.target_id))


@pytest.mark.parametrize(
    'spoil, said',
    [
        (lambda f: f[:2], 'fluoroscope a: 2 exposures are too few, 3 are needed$'),
        (lambda f: [], 'fluoroscope a: 0 exposures are too few'),
        (
            lambda f: f[:2] + [cut(f[2], 11)],
            'fluoroscope a: 2 exposures are too few, 3 are needed, 1 more has too few',
        ),
        (one_pose, 'fluoroscope a: all 5 exposures show the phantom in one pose'),
        (
            lambda f: f[:4] + [strangers(f[4])],
            'fluoroscope a, frame 5: target 9999 is not on the phantom',
        ),
        (
            lambda f: f[:4] + [with_value(f[4], np.nan)],
            'fluoroscope a, frame 5: the image point of target .* not a number',
        ),
        (
            lambda f: f[:4] + [with_value(f[4], 1024.0)],
            'fluoroscope a, frame 5: target .* is outside the image',
        ),
        (lambda f: f[:4] + [f[2]], 'fluoroscope a: exposure 3 appears twice'),
        (
            lambda f: f[:4] + [replace(f[4], image_size=(1024, 1025))],
            'fluoroscope a, frame 5: the image is 1024 x 1025 px, '
            'but the calibration is for 1024 x 1024 px',
        ),
        (lambda f: f[:4] + [cut(f[4], 0)], 'fluoroscope a, frame 5: the frame is empty'),
        (
            lambda f: [every(frame, 8) for frame in f[:3]],
            'fluoroscope a: [45]. inliers are too few for the correction',
        ),
        (
            lambda f: f[:2] + [shuffled_ids(f[2])],
            'fluoroscope a: only 2 of 3 exposures fit the phantom, 3 are needed; '
            'the first .* fluoroscope a, exposure 3: ',
        ),
    ],
)
def test_insufficient_observations_are_refused(spoil, said):
    """The finding names the fluoroscope, the cause and, where it helps, the exposure."""
    with pytest.raises(DataError, match=said) as caught:
        calibrate({'a': spoil(frames_of()['a'])}, PHANTOM, rounds(1))
    assert '\n' not in str(caught.value)


@pytest.mark.parametrize(
    'degrees, mm, accepted', [(5.0, 0.0, True), (0.0, 30.0, True), (1.0, 10.0, False)]
)
def test_rotations_and_shifts_make_different_poses(degrees, mm, accepted):
    """Either a rotation or a shift suffices to start; too little of both counts as one pose."""
    fluoroscope = rigs.rig().fluoroscopes[0]
    rng = np.random.default_rng(8)
    frames = []
    for n in range(3):
        turn = matrix_from_vector([0, 0, np.deg2rad(degrees) * n / 2])
        points = rigs.rig().true_mm @ turn.T + [0, 0, mm * n / 2]
        ids, uv = detect_beads(
            rng, fluoroscope, points, PHANTOM.target_id, Detection(NOISE_PX, 0.0)
        )
        frames.append(replace(rigs.exposures()['a'][n], target_id=ids, uv=uv))
    if accepted:
        assert len(measured_network({'a': frames}, PHANTOM).frames) == 3
    else:
        with rigs.refused(Kind.ONE_POSE, exposures=3):
            measured_network({'a': frames}, PHANTOM)


def test_frame_that_does_not_fit_the_phantom_is_left_out_and_reported():
    """So is a frame with too few targets; the result equals that without both frames."""
    frames = frames_of(count=8)['a']
    spoilt = frames[:3] + [shuffled_ids(frames[3])] + frames[4:7] + [cut(frames[7], 9)]
    job = calibrate({'a': spoilt}, PHANTOM, rounds(1, model='none'))
    few, poor = job.findings
    assert few.kind is Kind.FEW_TARGETS and few.place == Place(('a',), (8,))
    assert few.numbers == {'targets': 9, 'needed': 12}
    assert poor.kind is Kind.POOR_FIT and poor.place == Place(('a',), (4,))
    assert [e.exposure for e in job.fluoroscopes['a'].exposures] == [1, 2, 3, 5, 6, 7]
    fitting = frames[:3] + frames[4:7]
    without = calibrate({'a': fitting}, PHANTOM, rounds(1, model='none'))
    np.testing.assert_allclose(
        job.fluoroscopes['a'].interior, without.fluoroscopes['a'].interior, atol=0.02
    )


def test_fault_of_the_second_fluoroscope_is_reported_with_its_name():
    frames = {'a': frames_of()['a'], 'b': rigs.exposures()['b'][:2]}
    with rigs.refused(Kind.FEW_EXPOSURES, exposures=2) as error:
        calibrate(frames, PHANTOM, rounds(1), joint=True)
    assert error.value.finding.place == Place(('b',))


# ---- what a calibration returns


def test_calibration_corrects_observed_points():
    """Undistorted = observed - correction. Status: OK inside, OUTSIDE beyond the calibrated area,
    INVALID off the image.
    """
    calibration = rigs.calibrated().calibrations['a']
    fluoroscope = rigs.rig().fluoroscopes[0]
    uv = np.array(
        [[500.0, 400.0], [300.2, 650.9], [2.0, 2.0], [np.nan, 5.0], [1024.0, 5.0], [5.0, -0.6]]
    )
    found = calibration.correct(uv)
    assert found.status.tolist() == [OK, OK, OUTSIDE, INVALID, INVALID, INVALID]
    model = calibration.model.evaluate(uv[:3])
    exact = calibration.correct(uv, exact=True)
    np.testing.assert_allclose(exact.uv[:3], uv[:3] - model.duv, atol=1e-9)
    np.testing.assert_allclose(
        exact.sigma[:3], np.hypot(calibration.image_sd_at(uv[:3]), model.sd), rtol=1e-9
    )
    np.testing.assert_allclose(
        found.uv, exact.uv, atol=0.01
    )  # from the lookup grid, see test_grid.py
    np.testing.assert_allclose(found.sigma, exact.sigma, rtol=1e-3)
    assert np.isnan(found.uv[3:]).all() and np.isnan(found.sigma[3:]).all()
    own = calibration.correct(uv, np.array([3.0, 0.1, 0.1, 0.1, 0.1, 0.1]))
    np.testing.assert_allclose(own.sigma[:2], np.hypot([3.0, 0.1], model.sd[:2]), rtol=1e-3)
    # Up to the gauge, the corrected points are the undistorted ones.
    grid = np.stack(
        np.meshgrid(np.arange(250, 800, 50.0), np.arange(250, 800, 50.0)), axis=2
    ).reshape(-1, 2)
    error = calibration.correct(grid).uv - (grid - fluoroscope.distortion(grid))
    left = error - gauge_basis(grid, calibration.interior) @ gauge_coefficients(
        grid, error, calibration.interior
    )
    assert np.sqrt(np.mean(left**2)) < 0.1
    assert calibration.correct(np.zeros((0, 2))).uv.shape == (0, 2)
    assert calibration.correct(np.full((2, 2), np.nan)).status.tolist() == [INVALID, INVALID]


def test_calibration_id_depends_on_the_content():
    calibration = rigs.calibrated().calibrations['a']
    assert calibration.calibration_id.startswith('a-')
    # Read from a file, without stamps and frame ids, the calibration is the same as from a stream.
    other = replace(calibration, seconds=1.0, stamp_ns=0, frame_id='')
    assert other.calibration_id == calibration.calibration_id
    for changes in (
        {'nu': 9.0},
        {'interior': calibration.interior + 1e-9},
        {'source_digest': 'x'},
        {'fluoroscope': 'b'},
        {'model': replace(calibration.model, k=calibration.model.k + 1)},
        {'image_size': (1024, 1025)},
    ):
        assert replace(calibration, **changes).calibration_id != calibration.calibration_id, (
            changes
        )


def test_calibration_records_its_source():
    job = rigs.calibrated()
    calibration = job.calibrations['a']
    frames = frames_of()['a']
    assert calibration.source_digest == digest_of_sources(frames, PHANTOM)
    assert (calibration.fluoroscope, calibration.frame_id, calibration.image_size) == (
        'a',
        'a_optical',
        (1024, 1024),
    )
    assert calibration.stamp_ns == max(f.stamp_ns for f in frames) and calibration.exposures == 15
    assert calibration.observations == sum(len(f.target_id) for f in frames)
    assert len(calibration.train_exposure) == len(calibration.model.train_uv)
    by_exposure = {f.number: {tuple(p) for p in f.uv} for f in frames}
    assert all(
        tuple(p) in by_exposure[n]
        for n, p in zip(calibration.train_exposure, calibration.model.train_uv)
    )


def test_combined_targets_equal_one_estimation():
    """Combining two estimates that share the survey equals one estimate from the survey and all
    observations.
    """
    rng = np.random.default_rng(5)
    n = 6
    phantom = replace(
        PHANTOM,
        target_id=PHANTOM.target_id[:n],
        xyz_mm=PHANTOM.xyz_mm[:n],
        sd_mm=rng.uniform(0.05, 0.2, n),
    )
    survey = np.eye(3) / phantom.sd_mm[:, None, None] ** 2
    rows = [np.array([0, 1, 2, 4]), np.array([0, 2, 3, 4, 5])]

    def some_information(count):
        a = rng.normal(size=(count, 3, 3)) * 10
        return a @ a.transpose(0, 2, 1)

    information = survey.copy()
    right = (survey @ phantom.xyz_mm[..., None])[..., 0]
    parts = []
    for row in rows:
        own = some_information(len(row))
        seen = (own @ rng.normal(phantom.xyz_mm[row], 0.1)[..., None])[..., 0]
        information[row] += own
        right[row] += seen
        covariance = np.linalg.inv(survey[row] + own)
        mean = (
            covariance @ ((survey[row] @ phantom.xyz_mm[row][..., None])[..., 0] + seen)[..., None]
        )
        parts.append(Targets(phantom.target_id[row], mean[..., 0], covariance))
    both = combined_targets(parts, phantom)
    np.testing.assert_array_equal(both.target_id, phantom.target_id)
    np.testing.assert_allclose(both.covariance, np.linalg.inv(information), rtol=1e-8, atol=1e-15)
    np.testing.assert_allclose(
        both.xyz_mm, (np.linalg.inv(information) @ right[..., None])[..., 0], rtol=1e-10
    )
    assert combined_targets(parts[:1], phantom) is parts[0]


def test_combined_targets_count_the_datum_once():
    """The mean shift of the beads of a small phantom comes from the survey in both estimates."""
    rng = np.random.default_rng(6)
    n = 5
    phantom = replace(
        PHANTOM,
        target_id=PHANTOM.target_id[:n],
        xyz_mm=PHANTOM.xyz_mm[:n],
        sd_mm=np.full(n, 0.1),
    )
    # The images show differences between the beads, but not their common shift.
    between = 1e4 * (np.eye(3 * n) - np.kron(np.ones((n, n)), np.eye(3)) / n)
    survey = 100.0 * np.eye(3 * n)
    seen = [phantom.xyz_mm + rng.normal(0, 0.01, (n, 3)) for _ in range(2)]
    parts = []
    for xyz_mm in seen:
        joint = np.linalg.inv(survey + between)
        mean = joint @ (survey @ phantom.xyz_mm.ravel() + between @ xyz_mm.ravel())
        blocks = joint.reshape(n, 3, n, 3)[np.arange(n), :, np.arange(n), :]
        parts.append(Targets(phantom.target_id, mean.reshape(n, 3), blocks, joint))
    both = combined_targets(parts, phantom)
    truth = np.linalg.inv(survey + 2 * between)
    np.testing.assert_allclose(both.joint_covariance, truth, rtol=1e-8)
    # The common shift is as uncertain as the mean of the survey.
    mean = np.kron(np.ones(n) / n, np.eye(3))
    np.testing.assert_allclose(mean @ truth @ mean.T, 0.01 / n * np.eye(3), atol=1e-12)
    right = survey @ phantom.xyz_mm.ravel() + between @ (seen[0] + seen[1]).ravel()
    np.testing.assert_allclose(both.xyz_mm.ravel(), truth @ right, rtol=1e-10)


@pytest.mark.parametrize('is_open', [True, False])
def test_points_without_joint_covariances_count_an_open_datum_once(is_open):
    """Images show all but shift, turn and scale; if they show a turn, the datum is not open."""
    rng = np.random.default_rng(8)
    n = 60
    sd = rng.uniform(0.05, 0.2, n)
    phantom = Phantom(np.arange(1, n + 1), rng.uniform(-70, 70, (n, 3)), sd)
    centre = phantom.xyz_mm.mean(axis=0)
    datum = similarity_directions(phantom.xyz_mm, centre).reshape(3 * n, 7)
    datum = datum if is_open else datum[:, :3]
    between = 1e4 * (np.eye(3 * n) - datum @ np.linalg.pinv(datum))
    survey = np.diag(np.repeat(1 / sd**2, 3))
    seen = [phantom.xyz_mm + rng.normal(0, 0.01, (n, 3)) for _ in range(2)]

    def points(count):
        joint = np.linalg.inv(survey + count * between)
        right = survey @ phantom.xyz_mm.ravel() + between @ sum(seen[:count]).ravel()
        blocks = joint.reshape(n, 3, n, 3)[np.arange(n), :, np.arange(n), :]
        return Targets(phantom.target_id, (joint @ right).reshape(n, 3), blocks)

    first = points(1)
    parts = [first, replace(first, xyz_mm=first.xyz_mm + seen[1] - seen[0])]
    both = combined_targets(parts, phantom, open_datum=True)
    truth = points(2)
    ratio = np.trace(both.covariance, axis1=1, axis2=2) / np.trace(
        truth.covariance, axis1=1, axis2=2
    )
    if is_open:
        assert ratio == pytest.approx(1, abs=0.05)
        truth_sd = np.sqrt(np.diagonal(truth.covariance, axis1=1, axis2=2))
        assert np.abs((both.xyz_mm - truth.xyz_mm) / truth_sd).max() < 0.3
    else:
        plain = combined_targets(parts, phantom)
        assert both.covariance.tolist() == plain.covariance.tolist()
    # As if each adjustment had an independent datum, which underestimates the variances.
    apart = np.trace(combined_targets(parts, phantom).covariance, axis1=1, axis2=2)
    assert np.median(apart / np.trace(truth.covariance, axis1=1, axis2=2)) < 0.7


def test_points_of_free_networks_are_combined_without_the_survey():
    """The information of each bead is added up, with or without joint covariances."""
    rng = np.random.default_rng(7)
    phantom = replace(
        PHANTOM, target_id=np.arange(1, 5), xyz_mm=PHANTOM.xyz_mm[:4], sd_mm=np.full(4, 0.1)
    )
    root = rng.normal(0, 0.005, (2, 12, 12))
    joint = root @ root.transpose(0, 2, 1)
    blocks = joint.reshape(2, 4, 3, 4, 3)[:, np.arange(4), :, np.arange(4), :].swapaxes(0, 1)
    xyz = phantom.xyz_mm + rng.normal(0, 0.1, (2, 4, 3))
    parts = [Targets(phantom.target_id, x, c, j) for x, c, j in zip(xyz, blocks, joint)]
    own = np.linalg.inv(blocks)
    covariance = np.linalg.inv(own.sum(axis=0))
    expected = (covariance @ (own @ xyz[..., None]).sum(axis=0))[..., 0]
    free = combined_targets(parts, phantom, weighted=False)
    np.testing.assert_allclose(free.covariance, covariance, rtol=1e-8)
    np.testing.assert_allclose(free.xyz_mm, expected, rtol=1e-9)
    assert free.joint_covariance is None
    good = [replace(p, covariance=p.covariance / 100) for p in parts]
    mixed = [replace(good[0], joint_covariance=None), good[1]]
    plain = [replace(p, joint_covariance=None) for p in good]
    one, other = (combined_targets(of, phantom) for of in (mixed, plain))
    np.testing.assert_array_equal(one.xyz_mm, other.xyz_mm)
    assert one.joint_covariance is None


@pytest.mark.parametrize('is_joint', [False, True])
def test_points_that_are_worse_than_the_survey_add_nothing_to_it(is_joint):
    """Such points come from a model that cannot follow the distortion."""
    phantom = replace(
        PHANTOM, target_id=np.arange(1, 6), xyz_mm=PHANTOM.xyz_mm[:5], sd_mm=np.full(5, 0.1)
    )
    good = np.full(5, 0.005)
    bad = np.full(5, 0.05)
    parts = []
    for variance in (bad, bad, good):
        blocks = variance[:, None, None] * np.eye(3)
        joint = np.diag(np.repeat(variance, 3)) if is_joint else None
        parts.append(Targets(phantom.target_id, phantom.xyz_mm + 0.1, blocks, joint))
    alone = combined_targets(parts[:2], phantom)
    np.testing.assert_allclose(alone.covariance, 0.01 * np.broadcast_to(np.eye(3), (5, 3, 3)))
    np.testing.assert_allclose(alone.xyz_mm, phantom.xyz_mm)
    with_good = combined_targets(parts, phantom)
    np.testing.assert_allclose(with_good.covariance, parts[2].covariance)
    np.testing.assert_allclose(with_good.xyz_mm, parts[2].xyz_mm)


@pytest.mark.long
def test_parametric_model_finds_terms_that_follow_the_distortion():
    """With few exposures, the significance tests need the normal matrix at the solution."""
    found = rigs.calibrated('a', 8, model='parametric').fluoroscopes['a']
    assert max(found.rmse_after) < 0.36


# ---- Anderson acceleration


def test_anderson_acceleration_is_much_faster_than_plain_iteration():
    """For a linear contraction by 0.98, thirty rounds gain five digits, plain iteration none."""
    rng = np.random.default_rng(6)
    turn, _ = np.linalg.qr(rng.normal(size=(40, 40)))
    matrix = turn @ np.diag(np.append(np.linspace(0, 0.5, 36), [0.8, 0.9, 0.95, 0.98])) @ turn.T
    wanted = rng.normal(size=40)

    def image(x):
        return wanted + matrix @ (x - wanted)

    plain = mixed = np.zeros(40)
    accelerated = Anderson()
    for _ in range(30):
        plain = image(plain)
        mixed = accelerated.next(mixed, image(mixed))
    assert np.linalg.norm(plain - wanted) > 0.1
    assert np.linalg.norm(mixed - wanted) < 3e-5
    accelerated.restart()
    np.testing.assert_array_equal(
        accelerated.next(np.ones(40), np.full(40, 2.0)), np.full(40, 2.0)
    )


def test_anderson_acceleration_can_ignore_entries():
    """Ignored entries follow the mixing but do not influence the others."""
    rng = np.random.default_rng(7)
    matrix = np.diag([0.9, 0.5, 0.2, 0.7])
    counted = np.array([True, True, True, False])
    alone = Anderson()
    along = Anderson()
    x = np.ones(3)
    y = np.ones(4)
    for _ in range(6):
        x = alone.next(x, matrix[:3, :3] @ x)
        y = along.next(y, matrix @ y + np.append(np.zeros(3), rng.normal(0, 10)), counted)
        np.testing.assert_allclose(y[:3], x, atol=1e-9)


def test_anderson_acceleration_accepts_equal_iterates():
    """Equal iterates, as at the end of a calibration, do not divide by zero."""
    accelerated = Anderson(depth=3)
    x = np.arange(5.0)
    for _ in range(6):
        np.testing.assert_allclose(accelerated.next(x, x), x)


def test_self_calibrate_gives_the_numbers_of_calibrate():
    """self_calibrate takes the output of measured_network."""
    with threadpool_limits(1):
        run = self_calibrate(measured_network(frames_of(count=6), PHANTOM), rounds(2))
    np.testing.assert_allclose(
        run.after.parameters.interior[0], short().fluoroscopes['a'].interior, rtol=1e-9
    )
