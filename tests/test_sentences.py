# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The sentence of every kind of finding, tested once; all other tests assert kinds and numbers.

In the expected sentences, # stands for a number.
"""

import functools
import multiprocessing
import re
from dataclasses import replace
from types import SimpleNamespace as Fake
from unittest import mock

import numpy as np
import pytest
from rigs import (
    adjusted,
    calibrated,
    exposures,
    rig,
    small_network,
    true_calibrations,
    true_orientation,
)

from fluoro_calib_ros.bodies.body import Body
from fluoro_calib_ros.bodies.joints import Joint
from fluoro_calib_ros.bodies.shapes import BodyPlaces, _stability, _unseen, estimate_shape
from fluoro_calib_ros.checks import held_out as held_fit
from fluoro_calib_ros.checks import inputs, mixed_units, verdict
from fluoro_calib_ros.checks import inputs as plausibility
from fluoro_calib_ros.checks import rig as rig_checks
from fluoro_calib_ros.checks import survey as survey_checks
from fluoro_calib_ros.checks.drift_charts import ERROR, WARN
from fluoro_calib_ros.checks.drift_evidence import DriftEstimate
from fluoro_calib_ros.checks.drift_watch import DriftWatch
from fluoro_calib_ros.checks.rig import doubtful
from fluoro_calib_ros.checks.rig_watch import RecordingDriftWatch, widened
from fluoro_calib_ros.checks.survey import unsurveyed
from fluoro_calib_ros.checks.verdict import validate, validate_or_report
from fluoro_calib_ros.errors import DataError
from fluoro_calib_ros.estimation.calibrate import calibrate
from fluoro_calib_ros.estimation.constraints import _without_targets_of_few_rays
from fluoro_calib_ros.estimation.initial_network import measured_network
from fluoro_calib_ros.estimation.options import CalibrationOptions, CalibrationRequest
from fluoro_calib_ros.estimation.rounds import exposures_that_do_not_fit, undetermined_unknowns
from fluoro_calib_ros.estimation.start_orientation import UNTILTED
from fluoro_calib_ros.exposures.collector import without_repeats
from fluoro_calib_ros.exposures.frame import without_strays
from fluoro_calib_ros.exposures.phantom import Phantom
from fluoro_calib_ros.exposures.stamps import StampAgreement, StampTolerance
from fluoro_calib_ros.findings import Finding, Kind, Place, too_few
from fluoro_calib_ros.healing.diagnosis import Cause, Change
from fluoro_calib_ros.images import detection, extraction, lattice, matching
from fluoro_calib_ros.images.codec import as_grey
from fluoro_calib_ros.images.growth import Coordinates, Seen
from fluoro_calib_ros.images.marker_watch import doubt_in
from fluoro_calib_ros.io.calibration import edited, exchanged, failed
from fluoro_calib_ros.io.formats import registry
from fluoro_calib_ros.io.formats.content import FileSettings
from fluoro_calib_ros.jobs import healing, result_folder
from fluoro_calib_ros.jobs import orientation as orienting
from fluoro_calib_ros.jobs import reconstruction as reconstructing
from fluoro_calib_ros.jobs import report as comparing
from fluoro_calib_ros.jobs.bodies import _apart, _impossible
from fluoro_calib_ros.jobs.calibration import _without_copies, _without_shared
from fluoro_calib_ros.jobs.extraction import ImageResult, bent_shadows
from fluoro_calib_ros.jobs.followers import MarkerFollower, _wrong_start
from fluoro_calib_ros.jobs.result_folder import reused_exposures
from fluoro_calib_ros.jobs.sources import read_content
from fluoro_calib_ros.photogrammetry.rig_orientation import KnownOrientation
from fluoro_calib_ros.reconstruction import epipolar, lost_targets, observed_noise
from fluoro_calib_ros.reconstruction.reconstruct import RigRecording
from fluoro_calib_ros.reconstruction.timing import (
    Delay,
    LostFrames,
    delay_finding,
    lost_frames_finding,
)

PHANTOM = rig().phantom
CORNERS = np.array([[-15.0, -12, -3], [14, -10, 5], [2, 16, -8], [-6, 3, 15], [11, 8, 10]])


def _body(name, xyz=CORNERS):
    return Body(name, np.arange(5), xyz, np.full(5, 0.05))


def shape(change=lambda given: given, moves=0.0):
    """Return the first finding on a body with a changed CT, or with a marker 0 that moves [mm]."""
    rng = np.random.default_rng(0)
    places = CORNERS + rng.normal(0, 100, (50, 1, 3)) + rng.normal(0, 0.02, (50, 5, 3))
    places[:, 0] += rng.normal(0, 1, (50, 3)) * moves
    covariance = np.broadcast_to(4e-4 * np.eye(3), (50, 5, 3, 3))
    recorded = BodyPlaces(places, covariance, 0 * covariance)
    return estimate_shape(_body('femur', change(CORNERS)), recorded).findings[0]


SIZES = {'a': (1024, 1024), 'b': (1024, 1024)}
FAST = CalibrationOptions(model='parametric', max_iterations=2)
NUMBER = r'(?:[-+]?[\d.]+(?:e[+-]?\d+)?|nan)'


def frames(count=4):
    return list(exposures()['a'][:count])


@functools.cache
def checks():
    """Return the checks of a verdict by kind, all of them failed."""
    third = [f.target_id % 3 == 1 for f in frames(8)]
    few = [
        replace(f, target_id=f.target_id[kept], uv=f.uv[kept]) for f, kept in zip(frames(8), third)
    ]
    request = CalibrationRequest({'a': few}, PHANTOM, FAST)
    job = calibrate(request.frames, PHANTOM, FAST)
    found = validate(request, job.calibrations).checks
    return {check.kind: replace(check, limit=-1.0) for check in found}


def weak_intersection():
    beads = Fake(target_id=np.arange(7), rays=np.full(7, 4), angle_rad=np.full(7, 0.1))
    return unsurveyed(beads)[0]


def other_view_missing():
    follower = Fake(_begun=False, _settings=Fake(names=('a', 'b')))
    image = np.zeros((4, 4), np.uint8)
    return MarkerFollower._results(follower, {'a': image}, 1, (), None)['a'].finding


def wrong_given_interior():
    calibration = calibrated('a', 6, max_iterations=2).calibrations['a']
    held = replace(calibration, rmse_after=np.array([3.0, 3.0]))
    evidence = Fake(
        calibrations={'a': held}, request=Fake(options=Fake(interior_sd=(1.0, 1.0, 1.0)))
    )
    return verdict._given_interior_check(evidence, 'a', calibration, 3000.0)


def no_validation():
    few = [replace(f, target_id=f.target_id[:5], uv=f.uv[:5]) for f in frames()]
    calibrations = calibrated('a', 6, max_iterations=2).calibrations
    return validate_or_report(CalibrationRequest({'a': few}, PHANTOM), calibrations).checks[0]


def excluded(kind, spoil):
    """Return the finding of a kind on the first exposure, which `spoil` has changed."""
    first, *others = frames(5)
    found = measured_network({'a': [spoil(first), *others]}, PHANTOM).excluded
    return next(one for one in found if one.kind is kind)


def false_matches():
    network = Fake(exposure=np.repeat([0, 1, 2], 10), n_exposures=3, fluoroscope=np.zeros(3, int))
    fits = np.arange(30) >= 7
    run = Fake(
        measured=Fake(network=network, frames=frames(3)),
        after=Fake(noise=Fake(inliers=lambda q: fits), q=None),
    )
    return exposures_that_do_not_fit(run)['a', 1]


def undetermined():
    network, truth = small_network(exposures=4, targets=30, seen=1.0)
    keep = (network.exposure != 1) | (network.point < 2)
    network = replace(
        network,
        **{name: getattr(network, name)[keep] for name in ('uv', 'sigma', 'exposure', 'point')},
    )
    return undetermined_unknowns(
        Fake(network=network, start=truth, fluoroscopes=('a',), frames=frames(4))
    )


def raised(call, *arguments):
    with pytest.raises(DataError) as error:
        call(*arguments)
    return error.value.finding


def phantom_with(count, place):
    """Return the phantom with `count` targets of the first exposure moved to another place."""
    xyz = PHANTOM.xyz_mm.copy()
    xyz[PHANTOM.index(np.unique(frames()[0].target_id)[:count])] = place
    return Phantom(PHANTOM.target_id, xyz, PHANTOM.sd_mm)


def pairs(**changes):
    """Return the scatter of pairs of exposures."""
    k = 8
    return Fake(
        **{
            'fluoroscopes': ('a', 'b'),
            'exposures': np.arange(1, k + 1),
            'off_px': np.full(k, 1.0),
            'used': np.ones(k, bool),
            'unexplained': 1.0,
            'angle_px': 0.0,
            'columns': np.ones((k, 1)),
            'corrected': False,
            'turn': np.tile(np.eye(3), (k, 1, 1)),
            'shift_mm': np.tile([1000.0, 0, 0], (k, 1))
            + np.random.default_rng(1).normal(0, 5, (k, 3)),
            **changes,
        }
    )


def about_pairs(**changes):
    return doubtful(pairs(**changes), 1024, 0.25)[1][0]


def orientation():
    return true_orientation(rig().fluoroscopes, true_calibrations(rig().fluoroscopes))


def moved_rig():
    present = orientation()
    shifted = present.position_mm + np.array([[0.0, 0, 0], [20.0, 0, 0]])
    return orienting._change(present, replace(present, position_mm=shifted))


def disagreement(numbers):
    """Return the finding on stamps of ten exposures of a and b; numbers: theirs by exposure."""
    streams = {
        name: [
            replace(frames()[0], fluoroscope=name, number=numbers(row)[side], stamp_ns=10**7 * row)
            for row in range(1, 11)
        ]
        for side, name in enumerate('ab')
    }
    agreement = StampAgreement(('a', 'b'))
    by_number = {frame.number: frame for frame in streams['b']}
    for row, frame in enumerate(streams['a']):
        partner = by_number.get(frame.number) if numbers(1) != (7, 7) else streams['b'][row]
        agreement.add({'a': frame, 'b': partner} if partner else {'a': frame})
    return agreement.disagreement()


def reused():
    """Return the finding on exposures that a calibration has used."""
    target = 'fluoro_calib_ros.jobs.result_folder.read_calibrated_frames'
    with mock.patch(target, return_value={'a': frames()}):
        return reused_exposures('result', {}, {'a': frames()})


def trial(kind):
    """Return the finding on missing rays for the confusion that a trial reconstruction reports."""
    both = {name: list(of_one[:2]) for name, of_one in exposures().items()}
    rig = Fake(orientation=Fake(fluoroscopes='ab'))
    found = [why for why, _ in epipolar._trials(RigRecording(both, {}, rig), {1, 2})]
    return epipolar.missing_rays(0.9, next(one for one in found if one.kind is kind))


def bead(**changes):
    """Return why a predicted bead is not observed."""
    beads = {
        'uv': 0.0,
        'depth': 1.0,
        'light': 1.0,
        'measured': True,
        'misfit': 0.0,
        'sigma': 0.1,
        **changes,
    }
    beads = Fake(**{name: np.array([value]) for name, value in beads.items()})
    beads.uv = np.full((1, 2), beads.uv[0])
    return extraction._reasons(beads, np.zeros((1, 2)), np.array([2.5]))[0]


def not_measured(n=20):
    view = Fake(
        outlines=lambda _: np.tile(np.eye(2), (n, 1, 1)),
        principal_distance_px=1.0,
        depth=lambda _: np.ones(n),
    )
    found = Fake(view=view, predicted=np.zeros((n, 2)), bead=np.arange(n), detection=np.arange(n))
    light = Fake(above=lambda _: None)
    seen = Fake(uv=np.zeros((n, 2)), in_field=lambda uv: np.ones(n, bool), radius_px=1.0)
    imaging = Fake(
        completed=lambda *_: imaging, size=np.ones(n), profile=None, noise=None, black=0
    )
    model = Coordinates(np.zeros((n, 3)), np.zeros(n))
    with mock.patch.multiple(
        extraction, measure_beads=mock.DEFAULT, _reasons=lambda *_: [extraction.LOST] * n
    ):
        return raised(extraction._measured, Fake(light=light), seen, found, model, imaging)


def unsure_bead(n=10):
    sigma = np.where(np.arange(n) == 3, 1.0, 0.1)
    beads = Fake(uv=np.zeros((n, 2)), sigma=sigma, overlapped=np.zeros(n, bool))
    measured = extraction._Measured(
        np.arange(n),
        beads,
        [None] * n,
        radius_px=np.ones(n),
        imaging=None,
        predicted=Fake(view=None, uv=np.zeros((n, 2)), sd_px=np.zeros(n)),
    )
    return extraction._checked(None, Fake(bead=range(n)), measured).refused[0].finding


def drift(source, confirmed, level=ERROR):
    estimate = DriftEstimate(
        ('a',), 0, 0.5, 0.05, np.array([1.0, 0.0]), 'start', source, confirmed, 0
    )
    return DriftWatch(SIZES)._drift_state(level, estimate, 9.0).finding


def wide_tolerance():
    tolerance = StampTolerance(2_000_000)
    tolerance.interval_ns = 1_000_000
    return tolerance.finding()


def state(observations, learned):
    watch = DriftWatch(SIZES)
    watch._observations = observations
    watch._learned_blocks = [learned]
    return watch._present_state().finding


def no_pose():
    seen = Seen.of(np.random.default_rng(0).uniform(0, 900, (60, 2)), np.ones((1024, 1024)), 3.0)
    with mock.patch.object(matching, '_candidates', lambda *_: ()):
        return raised(matching.match, seen, Fake(grid=None), None)


def principal_distance():
    calibration = calibrated('a', 6, max_iterations=2).calibrations['a']
    with mock.patch.object(plausibility, '_interior_about_middle', lambda _: (0, 0, 9000.0)):
        return plausibility._wrong_given_distance(calibration)


def corrected_already():
    result, *others = adjusted(0.25, a=(2.0, 2.0))
    without, *_ = adjusted(0.25, a=(2.0, 0.2))
    return held_fit.corrected_already(result, without, *others)


def principal_point():
    calibration = true_calibrations(rig().fluoroscopes)['a']
    interior = np.array([4000.0, 500.0, 4000.0])
    figures = Fake(interior=interior, interior_sd=np.ones(3), image_size=(1024, 1024))
    return plausibility._wrong_interior(figures, replace(calibration, interior=interior))


def wrong_known_orientation():
    one = rig().fluoroscopes[0]
    known = {'a': KnownOrientation(one.interior, one.rotation, one.position_mm + 500.0)}
    return inputs.find_wrong_orientation({'a': frames()}, PHANTOM, known)[0]


def in_one_folder_only():
    with mock.patch.multiple(
        comparing,
        load_calibrations=mock.Mock(side_effect=[{'a': None, 'b': None}, {'a': None}]),
        compare_calibrations=mock.DEFAULT,
        _scales=lambda *_: {},
    ):
        return comparing.compare_folders('one', 'two').findings[0]


def of_rig():
    return rig_checks.RigFindings(('a', 'b'), scatter=(pairs(),), noise_px=0.25)


def no_orientation():
    request = Fake(known_orientations={}, phantom=None)
    result = Fake(fluoroscopes={}, starts=None)
    calibrations = dict.fromkeys('ab', Fake(image_sd=0.25))
    error = DataError('fluoroscopes a and b: no exposures have the same number')
    with mock.patch.object(rig_checks, 'orientation_and_scatter', side_effect=error):
        found = rig_checks.rig_findings(request, result, {'a': (), 'b': ()}, calibrations)
    return found.doubts[0]


def saved_note():
    with mock.patch.multiple(
        result_folder,
        read_result=lambda _: {'rig_note': 'orientation of the rig: without exposure 5'},
        saved_orientation=lambda _: None,
    ):
        return result_folder.saved_rig_note('result')


def ambiguous():
    first, rival = (Fake(score=50.0, scale_px=1.0, bead=range(n), against=0) for n in (60, 59))
    with mock.patch.multiple(
        matching,
        _climbed=lambda *_: (first, [rival]),
        _same=lambda *_: False,
        _best_by_size=lambda *_: None,
    ):
        return raised(matching.unambiguous, first, None, Fake(regular=False))


def wrong_format():
    with mock.patch.object(registry, 'recognised', return_value=registry.FORMATS['mayacam2']):
        return raised(read_content, 'cam.csv', FileSettings(), 'survey', 'phantom')


HEALED = Fake(orientation=Fake(fluoroscopes=('a', 'b')), bodies=())


def changed_rig(cause):
    """Return a diagnosis: fluoroscope a has changed or, as the rival, b has moved."""
    rival = Change(Cause.ORIENTATION, fluoroscope=1)
    changes = (Change(cause, fluoroscope=0),)
    return Fake(changes=changes, probability=(0.7,), rivals=(rival,), complete=True)


def changed(cause):
    """Return the finding about fluoroscope a."""
    diagnosis = changed_rig(cause)
    return healing._finding(diagnosis.changes[0], HEALED, diagnosis)


def unsure_cause():
    """Return the check of a diagnosis with a rival."""
    return healing._sure(changed_rig(Cause.INTERIOR), HEALED)


MAKERS = {
    Kind.DATA: lambda: DataError('the file is empty', at='phantom.csv').finding,
    **{
        kind: functools.partial(lambda kind: checks()[kind], kind)
        for kind in (
            Kind.BEADS,
            Kind.DISTANCES,
            Kind.DRIFT,
            Kind.EXPOSURES,
            Kind.HALVES,
            Kind.HELD_OUT,
            Kind.PRECISION,
            Kind.SHAPE,
            Kind.VARIATION,
            Kind.WHITENESS,
            Kind.WORST_AREA,
        )
    },
    Kind.SCALE: lambda: survey_checks._check_scale(
        Fake(
            scale=1.03,
            scale_sd=1e-4,
            given_mm=PHANTOM.xyz_mm,
            given_sd_mm=np.full(len(PHANTOM.xyz_mm), 0.1),
        )
    ),
    Kind.GIVEN_INTERIOR: wrong_given_interior,
    Kind.VALIDATION: no_validation,
    Kind.COPIED_EXPOSURE: lambda: _without_copies(
        {'a': [*frames(), replace(frames()[0], number=9)]}, ()
    )[1][0],
    Kind.REPEATED_POSE: lambda: without_repeats(
        {'a': [*frames(), replace(frames()[0], number=9)]}
    )[1][0],
    Kind.FALSE_MATCHES: false_matches,
    Kind.FEW_RAYS: lambda: _without_targets_of_few_rays(
        measured_network({'a': frames(5)}, PHANTOM)
    ).excluded[0],
    Kind.FEW_TARGETS: lambda: excluded(
        Kind.FEW_TARGETS, lambda f: replace(f, target_id=f.target_id[:5], uv=f.uv[:5])
    ),
    Kind.NOT_ORIENTED: lambda: excluded(
        Kind.NOT_ORIENTED, lambda f: replace(f, uv=f.uv * [1, 0] + [0, 500])
    ),
    Kind.POOR_FIT: lambda: excluded(
        Kind.POOR_FIT, lambda f: replace(f, uv=np.random.default_rng(1).permutation(f.uv))
    ),
    Kind.SHARED_EXPOSURE: lambda: _without_shared(
        {
            'a': frames(),
            'b': [replace(frames(5)[4], fluoroscope='b', number=n) for n in range(9)]
            + [replace(frames()[0], fluoroscope='b', number=20)],
        }
    )[1][0],
    Kind.STRAY_POINTS: lambda: without_strays(
        replace(frames()[0], target_id=np.append(frames()[0].target_id[1:], 9999)), PHANTOM
    )[1],
    Kind.FEW_EXPOSURES: lambda: raised(measured_network, {'a': frames(2)}, PHANTOM),
    Kind.ONE_POSE: lambda: raised(
        measured_network, {'a': [replace(frames()[0], number=n) for n in range(3)]}, PHANTOM
    ),
    Kind.UNDETERMINED: undetermined,
    Kind.UNTILTED_TARGETS: lambda: replace(UNTILTED, place=Place(('a',))),
    Kind.WEAK_INTERSECTION: weak_intersection,
    Kind.DUPLICATE_NAME: lambda: raised(inputs.validate_names, ('a', 'A')),
    Kind.FRAMES_SHIFTED: lambda: trial(Kind.FRAMES_SHIFTED),
    Kind.FRAMES_UNNUMBERED: lambda: disagreement(lambda number: (7, 7)),
    Kind.STAMPS_APART: lambda: disagreement(lambda number: (number, number + 1)),
    Kind.FRAME_LOST: lambda: lost_frames_finding([LostFrames('b', 12, 1)]),
    Kind.FRAMES_DELAYED: lambda: delay_finding(('a', 'b'), Delay(-0.25, 0.01, 1.0), 0.01),
    Kind.IDS_REVERSED: lambda: inputs.CONFUSIONS[2][0],
    Kind.IDS_SHIFTED: lambda: inputs.CONFUSIONS[0][0],
    Kind.IMAGE_MIRRORED: lambda: inputs._MIRRORED,
    Kind.IMAGE_TRANSPOSED: lambda: trial(Kind.IMAGE_TRANSPOSED),
    Kind.IMPLAUSIBLE_NUMBER: lambda: raised(
        inputs.validate_magnitudes,
        {'a': [replace(f, sigma=np.full(len(f.uv), 1e-9)) for f in frames()]},
        PHANTOM,
    ),
    Kind.MIXED_UNITS: lambda: mixed_units._finding(np.arange(1, 9), 10.0),
    Kind.OTHER_PHANTOM: lambda: replace(inputs._OTHER_PHANTOM, place=Place(('a',))),
    Kind.REMOTE_TARGETS: lambda: inputs.find_wrong_phantom({'a': frames()}, phantom_with(1, 9999))[
        0
    ],
    Kind.REPEATED_COORDINATES: lambda: inputs.find_wrong_phantom(
        {'a': frames()}, phantom_with(2, [1, 2, 3])
    )[0],
    Kind.SOURCE_TOO_NEAR: lambda: inputs.wrong_unit(90.0, PHANTOM),
    Kind.WRONG_IMAGE_SIZE: lambda: inputs.wrong_image_size(
        [replace(f, image_size=(4096, 4096)) for f in frames()]
    ),
    Kind.WRONG_KNOWN_ORIENTATION: wrong_known_orientation,
    Kind.WRONG_UNIT: lambda: inputs.wrong_unit(1.5e6, PHANTOM),
    Kind.FEW_INLIERS: lambda: plausibility._few_inliers(Fake(inliers=1, observations=4)),
    Kind.FLUOROSCOPES_INTERCHANGED: lambda: trial(Kind.FLUOROSCOPES_INTERCHANGED),
    Kind.INTERIOR_UNDETERMINED: lambda: plausibility._wrong_interior(
        Fake(
            interior=np.array([500, 500, 4000.0]),
            interior_sd=np.array([9, 9, 900.0]),
            image_size=(1024, 1024),
        ),
        None,
    ),
    Kind.LARGE_RESIDUALS: lambda: plausibility._large_residuals(
        Fake(rmse_after=(9.0, 9.0), image_size=(1024, 1024)), []
    ),
    Kind.PRINCIPAL_POINT_OFF: principal_point,
    Kind.WRONG_PRINCIPAL_DISTANCE: principal_distance,
    Kind.CORRECTED_ALREADY: corrected_already,
    Kind.POOR_CALIBRATION_FIT: lambda: held_fit.poor_fits(*adjusted(0.25, a=(2.0, 2.0)))[0],
    Kind.NO_COMMON_TARGETS: lambda: epipolar.UNMATCHED,
    Kind.NOISE_OBSERVED: lambda: observed_noise._finding(4.0, [Fake(image_sd=0.05)]),
    Kind.PAIRS_CONTRADICT: lambda: about_pairs(unexplained=20.0),
    Kind.PAIRS_EXCLUDED: lambda: about_pairs(used=np.arange(8) != 4),
    Kind.TARGETS_EXCHANGED: lambda: lost_targets._exchange([3, 7], ['a', 'b']),
    Kind.TARGETS_REJECTED: lambda: lost_targets._rejected([3, 7]),
    Kind.RAYS_DO_NOT_MEET: lambda: epipolar.missing_rays(0.9, epipolar.UNKNOWN),
    Kind.RIG_DEPENDS_ON_ANGLE: lambda: about_pairs(angle_px=1.5),
    Kind.RIG_MOVED: moved_rig,
    Kind.RIG_NOTE: saved_note,
    Kind.RIG_NOT_ORIENTED: no_orientation,
    Kind.ORIENTATION: lambda: replace(rig_checks._check(of_rig(), pairs(), 0.1), limit=-1.0),
    Kind.TAKEN_ON_TRUST: lambda: rig_checks._trusted({'a': (), 'b': ()}, pairs(), 0.2),
    Kind.POSE_AMBIGUOUS: ambiguous,
    Kind.MARKER_FOUND_AGAIN: lambda: doubt_in(Kind.MARKER_FOUND_AGAIN, 7, 3, images=4),
    Kind.MARKER_MOVES_ALONE: lambda: doubt_in(Kind.MARKER_MOVES_ALONE, 7, 3),
    Kind.OTHER_SHADOW: lambda: doubt_in(Kind.OTHER_SHADOW, 7, 3),
    Kind.SHADOWS_MET: lambda: doubt_in(Kind.SHADOWS_MET, 7, 3, 4),
    Kind.NOT_IN_BOTH: in_one_folder_only,
    Kind.WRONG_FORMAT: wrong_format,
    Kind.FEW_BEADS: lambda: raised(
        matching.match, Seen.of(np.zeros((3, 2)), np.ones((9, 9)), 3.0), None, None
    ),
    Kind.GRID_NOT_MARKED: lambda: lattice.NOT_MARKED,
    Kind.SHADOWS_BENT: lambda: bent_shadows(
        'a', [ImageResult(sigma=np.full(50, 0.01), bent_px=0.02, frame=Fake())]
    ),
    Kind.IMAGE_ENCODING: lambda: raised(as_grey, np.zeros((9, 9))),
    Kind.IMAGE_EMPTY: lambda: raised(detection._check, np.zeros((200, 200), np.uint8)),
    Kind.NO_POSE: no_pose,
    Kind.POSE_UNSURE: lambda: raised(
        matching._check_evidence,
        Fake(explained=0.01, evidence=99.0, expected=90, found=0.9, apart=0.9, bead=np.arange(60)),
    ),
    Kind.BEAD_ALONE: lambda: extraction.ALONE,
    Kind.BEAD_AWAY: lambda: bead(uv=9.0),
    Kind.BEAD_CONFUSED: lambda: extraction.CONFUSED,
    Kind.BEAD_CONTRAST: lambda: bead(depth=0.1),
    Kind.BEAD_DISTURBED: lambda: bead(misfit=99.0),
    Kind.BEAD_HIDDEN: lambda: bead(sigma=9.0),
    Kind.BEAD_UNSURE: unsure_bead,
    Kind.BEADS_NOT_MEASURED: not_measured,
    Kind.BEAD_LOST: lambda: bead(measured=False),
    Kind.FAILED_VERDICT: lambda: failed('result', {'verdict': 'fail'}),
    Kind.REUSED_EXPOSURES: reused,
    Kind.EDITED_RESULT: lambda: edited('result', {'digest': 'x'}),
    Kind.EXCHANGED_CALIBRATION: lambda: exchanged(
        'result', {'fluoroscopes': {'a': {'calibration_id': 'x'}}}, {'a': Fake(calibration_id='y')}
    ),
    Kind.CLUSTER_CHANGE: lambda: drift('cluster bone', False, WARN),
    Kind.IMAGE_DRIFT: lambda: drift('epipolar', True),
    Kind.LEARNING: lambda: state(1, 1),
    Kind.NO_DRIFT: lambda: state(1, 1000),
    Kind.FEW_MARKERS: lambda: _wrong_start(Fake(finding=None, target_id=[4, 5]), 8),
    Kind.BODY_DIFFERENT: lambda: shape(lambda given: given[[1, 2, 3, 4, 0]] * [1, -1, -1]),
    Kind.BODY_MIRRORED: lambda: shape(lambda given: given * [-1, 1, 1]),
    Kind.BODY_NOT_RIGID: lambda: _stability(_body('femur'), 50.0, 0.5)[0],
    Kind.BODY_ON_A_LINE: lambda: _stability(_body('femur'), 150.0, 0.1)[0],
    Kind.BODY_SCALED: lambda: shape(lambda given: 1.03 * given),
    Kind.BODY_UNSEEN: lambda: _unseen(_body('femur')),
    Kind.JOINT_APART: lambda: _apart(
        Fake(
            joint=Joint('k', 'a', 'b', 'grood_suntay_knee', side='left'),
            translations=np.array([[0.0, 120.0, 160.0], [np.nan] * 3]),
        )
    ),
    Kind.JOINT_IMPOSSIBLE: lambda: _impossible(
        Fake(
            joint=Joint('k', 'a', 'b', 'grood_suntay_knee', side='left'),
            angles=np.deg2rad([[-60.0, 0, 0], [np.nan] * 3]),
            status=np.zeros(2),
        )
    ),
    Kind.MARKER_LOOSE: lambda: shape(moves=0.5),
    Kind.MARKER_MIGRATED: lambda: shape(lambda given: given + np.eye(5, 3)[[0, 4, 4, 4, 4]]),
    Kind.MARKERS_EXCHANGED: lambda: shape(lambda given: given[[1, 0, 2, 3, 4]]),
    Kind.CAUSE_SURE: unsure_cause,
    Kind.CHANGE_IDENTIFIED: lambda: healing._identified(0.7, True),
    Kind.COMMON_MOTION: lambda: healing.common_motion(0.3),
    Kind.DISTORTION_CHANGED: lambda: changed(Cause.DISTORTION),
    Kind.FLUOROSCOPE_MOVED: lambda: changed(Cause.ORIENTATION),
    Kind.INTERIOR_CHANGED: lambda: changed(Cause.INTERIOR),
    Kind.UNSEEN_DISTORTION: lambda: healing._unseen_distortion(0.3, 0.1),
    Kind.UNUSED_EXPOSURES: lambda: healing._unused(changed_rig(Cause.INTERIOR), 1, HEALED),
    Kind.NO_MARKERS: lambda: state(0, 0),
    Kind.OTHER_VIEW_MISSING: other_view_missing,
    Kind.NOT_WATCHED: lambda: (
        reconstructing._drift_watch(
            None, None, reconstructing.ReconstructionOptions(has_stamps=False)
        )[1].finding
    ),
    Kind.SHORT_RECORDING: lambda: RecordingDriftWatch(orientation(), SIZES).verdict().finding,
    Kind.WIDE_TOLERANCE: wide_tolerance,
    Kind.WIDENED_BY_ALARM: lambda: widened(0.05, 0.6, miss_px=2.1, image_sd_px=0.0),
}
SENTENCES = {
    Kind.DATA: 'phantom.csv: the file is empty',
    Kind.BEADS: (
        'bead # lies # mm from its survey, the largest deviation of #: survey again, or give a '
        'larger sd, and calibrate again'
    ),
    Kind.DISTANCES: (
        'distances between beads differ from the survey by # mm, where # mm is expected (scale '
        '#, sd #): the survey is less precise than its sd states, or, if other checks fail too, '
        'the calibration is wrong; survey the phantom again, or give a larger sd'
    ),
    Kind.DRIFT: (
        'fluoroscope a: earlier and later exposures differ by # px, most at the @ of the image '
        '(about u #, v #) by # px: the distortion has changed between the exposures; take all '
        'of them again in one session, with nothing switched, moved or warming up'
    ),
    Kind.EXPOSURES: (
        'fluoroscope a: exposure # deviates most from the calibration of the others, its '
        'residuals are # times the expected ones: inspect it (phantom or fluoroscope moved, '
        'wrong ids), exclude it by a decision in doubtful.csv and calibrate again'
    ),
    Kind.HALVES: (
        'fluoroscope a: two halves of the exposures give corrections that differ by # px, where '
        '# px is predicted, most at the @ of the image (about u #, v #): take # more exposures '
        '(there are #) that show beads there, and keep phantom and fluoroscope still during each'
    ),
    Kind.HELD_OUT: (
        'fluoroscope a: residuals of held-out exposures are # px, where # px is expected: the '
        'calibration does not hold for exposures it has not used; take # more exposures (there '
        'are #) in other poses'
    ),
    Kind.PRECISION: (
        'fluoroscope a: the correction has a standard deviation of # px, at an image noise of '
        '# px: it makes the errors of corrected points # % larger: choose another model '
        '(--model auto), or take # more exposures (there are #), or a phantom with more beads'
    ),
    Kind.SCALE: (
        'by the measured distances the beads are # % further apart than by the given '
        'coordinates: check for an error that all distances share, such as that of the caliper; '
        'if the given coordinates have another scale, give them a larger sd'
    ),
    Kind.SHAPE: (
        'the survey of the phantom is strained relative to the images by # % along (#, #, #), '
        'which displaces beads by # mm (RMS): survey the phantom again, or give a larger sd, and '
        'calibrate again'
    ),
    Kind.VARIATION: (
        'fluoroscope a: the distortion differs between exposures by # px (chi2/dof #, constant '
        'up to #): a C-arm at another angle, a refocused or zoomed lens, an unstable source or '
        'detector, or a phantom that moved, was bent or has a wrong survey; take # more '
        'exposures (there are #) at the angle and setting in use, or calibrate each; or give the '
        'angle of the C-arm with each exposure (angle_deg, or joint_states)'
    ),
    Kind.WHITENESS: (
        'fluoroscope a: the residuals have a trend of # px, most at the @ of the image (about '
        'u #, v #): the correction model parametric does not follow the distortion there; take '
        '# more exposures (there are #) that show beads there, or choose another model '
        '(--model auto)'
    ),
    Kind.WORST_AREA: (
        'fluoroscope a: the largest mean residual of an area, # px, is at the @ of the image '
        '(about u #, v #): take # more exposures (there are #) that show beads there, or choose '
        'another model'
    ),
    Kind.GIVEN_INTERIOR: (
        'fluoroscope a: the given interior orientation, c = # (sd #), xp = # (sd #), yp = # (sd '
        '#) px, contradicts the exposures, which show c = # (sd #), xp = # (sd #), yp = # (sd #) '
        'px: the residuals are # px with the given values and # px without: give the correct '
        'value, a larger --interior-sd, or none'
    ),
    Kind.VALIDATION: (
        'the validation could not be performed: fluoroscope a: # exposures are too few, # are '
        'needed, # more have too few targets'
    ),
    Kind.COPIED_EXPOSURE: ('fluoroscope a, exposure #: the image points are those of exposure #'),
    Kind.REPEATED_POSE: (
        'fluoroscope a: # exposures show the phantom in the pose of an earlier one, and count '
        'as one exposure with it'
    ),
    Kind.FALSE_MATCHES: (
        'fluoroscope a, exposure #: only # % of the image points fit, the others are false matches'
    ),
    Kind.FEW_RAYS: (
        '# targets are seen in fewer than # exposures, too few to determine them without '
        'surveyed coordinates: #, #, #, #, # and # more'
    ),
    Kind.FEW_TARGETS: 'fluoroscope a, exposure #: # targets are too few, # are needed',
    Kind.NOT_ORIENTED: ('fluoroscope a, exposure #: all image points are collinear or coincide'),
    Kind.POOR_FIT: (
        'fluoroscope a, exposure #: the image points do not fit the phantom, their residuals '
        'are about # px'
    ),
    Kind.SHARED_EXPOSURE: (
        'fluoroscopes a and b, exposures # and #: both have the same image points'
    ),
    Kind.STRAY_POINTS: ('fluoroscope a, exposure #: # image point, target # not on the phantom'),
    Kind.FEW_EXPOSURES: 'fluoroscope a: # exposures are too few, # are needed',
    Kind.ONE_POSE: (
        'fluoroscope a: all # exposures show the phantom in one pose (turned by at most # '
        'degrees); turn and move it between the exposures'
    ),
    Kind.UNDETERMINED: (
        'the exposures do not determine the unknowns: the orientation of exposure # of a is '
        'undetermined; add exposures with the phantom turned and moved, with more targets'
    ),
    Kind.WEAK_INTERSECTION: (
        '# beads are not surveyed, their rays meet at less than # degrees: #, #, #, #, # and # '
        'more'
    ),
    Kind.UNTILTED_TARGETS: (
        'fluoroscope a: the targets are flat and not tilted: the principal distance is '
        'undetermined: tilt the target by # degrees or more, or give the principal distance'
    ),
    Kind.DUPLICATE_NAME: (
        'fluoroscopes a and A differ only in case: use one name for one fluoroscope, or rename '
        'one of two'
    ),
    Kind.FRAMES_SHIFTED: (
        '# % of the rays miss each other: the frame numbers of fluoroscope b are too small by #'
    ),
    Kind.FRAMES_UNNUMBERED: (
        'frames of a are not numbered: # in a row have the number #, but different stamps: pair '
        'frames by stamp'
    ),
    Kind.STAMPS_APART: (
        'frames of a and b with the same number are # ms apart (# frame intervals): they belong '
        'to different exposures, or the clocks of the cameras differ: start the cameras together, '
        'or pair frames by stamp'
    ),
    Kind.FRAME_LOST: (
        'fluoroscope b has lost a frame before exposure #: add # to the numbers of its frames '
        'from # on'
    ),
    Kind.FRAMES_DELAYED: (
        'fluoroscope b takes its images # frame intervals (# ms) before fluoroscope a: points '
        'that move are wrong; trigger the fluoroscopes at the same time'
    ),
    Kind.TARGETS_EXCHANGED: (
        'targets # and # are exchanged in fluoroscope a or b: most of their rays miss each other, '
        'and meet with exchanged ids'
    ),
    Kind.TARGETS_REJECTED: (
        'most rays of the targets #, # miss each other: check their ids in each fluoroscope'
    ),
    Kind.IDS_REVERSED: (
        'the target ids run in the opposite order: with the correct ids the image points fit the '
        'phantom'
    ),
    Kind.IDS_SHIFTED: (
        'the target ids are too large by #: with the correct ids the image points fit the phantom'
    ),
    Kind.IMAGE_MIRRORED: (
        'the image is mirrored: u must run to the right and v down, and neither u and v nor axes '
        'of the phantom may be interchanged'
    ),
    Kind.IMAGE_TRANSPOSED: '# % of the rays miss each other: u and v are interchanged',
    Kind.IMPLAUSIBLE_NUMBER: (
        'fluoroscope a, exposure #: sigma of target # is # px, between # and # px are plausible'
    ),
    Kind.MIXED_UNITS: (
        'phantom: # targets, #, #, #, #, # and # more, are in a different unit from the others: '
        'they fit when their coordinates are multiplied by # (cm instead of mm)'
    ),
    Kind.OTHER_PHANTOM: (
        'fluoroscope a: the image points do not fit the phantom: this is another phantom, or '
        'the target ids are wrong'
    ),
    Kind.REMOTE_TARGETS: (
        'phantom: target # is # mm from the centre of the others, most of which are within # mm: '
        'a wrong coordinate, another unit, or a fill value for targets that are not surveyed'
    ),
    Kind.REPEATED_COORDINATES: (
        'phantom: targets #, # are all at (#, #, #) mm: a repeated row, or a fill value for '
        'targets that are not surveyed'
    ),
    Kind.SOURCE_TOO_NEAR: (
        'the source would be # mm from a phantom that is # mm large, closer than in a '
        'fluoroscope: the principal distance is wrong, or the images are from a wide-angle camera'
    ),
    Kind.WRONG_IMAGE_SIZE: (
        'the image points reach only to u = #, v = # of an image of # x # px: the image size '
        'is wrong, or the phantom covers one corner only'
    ),
    Kind.WRONG_KNOWN_ORIENTATION: (
        'fluoroscope a: the known orientation does not fit: the median error of the image points '
        'is # px: check the unit and the frame of the lab, that R and t transform from the lab '
        'to the sensor, and that v runs down'
    ),
    Kind.WRONG_UNIT: (
        'the coordinates of the phantom are not in mm: it would be # mm large and # mm from '
        'the source'
    ),
    Kind.FEW_INLIERS: (
        'only # % of the image points fit, at least # % are needed; the others are false matches'
    ),
    Kind.FLUOROSCOPES_INTERCHANGED: (
        '# % of the rays miss each other: fluoroscopes a and b are interchanged'
    ),
    Kind.INTERIOR_UNDETERMINED: (
        'the interior orientation is not determined: principal distance # px with a standard '
        'deviation of # px, principal point within # px'
    ),
    Kind.LARGE_RESIDUALS: (
        'the residuals are too large: RMSE # px after the correction, at most # px are '
        'plausible; possible causes: false matches, another phantom, or a change of the '
        'distortion between the exposures'
    ),
    Kind.PRINCIPAL_POINT_OFF: (
        'the principal point (#, #) is # px from the centre of the image: wrong target ids, a '
        'wrong image size, or another phantom'
    ),
    Kind.WRONG_PRINCIPAL_DISTANCE: (
        'the principal distance is fixed at # px, but the exposures show about # px: give it in '
        'pixels'
    ),
    Kind.CORRECTED_ALREADY: (
        'fluoroscope a: the image points are already corrected, their RMSE is # px with the '
        'correction and # px without: give the observed image points'
    ),
    Kind.POOR_CALIBRATION_FIT: (
        'fluoroscope a: RMSE # px with the calibration fixed, # times the noise with which it '
        'was determined: the image has changed, or the calibration is of another fluoroscope'
    ),
    Kind.NO_COMMON_TARGETS: (
        'no target is seen by two fluoroscopes in one exposure: the target ids of the '
        'fluoroscopes, or the numbers of their frames, do not belong together'
    ),
    Kind.NOISE_OBSERVED: (
        'the image points have no sigma, and their rays show a noise of # px where the '
        'calibration has # px; the noise of the rays is used: give their sigma, if it is known'
    ),
    Kind.PAIRS_CONTRADICT: (
        'orientation of the rig: the exposures contradict each other: the relative orientation '
        'of fluoroscopes a and b differs between them by # px, # times its standard deviation; '
        'frames with the same number are from different exposures, the phantom moved between '
        'them, a fluoroscope or its image is unstable, or the corrections do not hold in all of '
        'them'
    ),
    Kind.PAIRS_EXCLUDED: (
        'orientation of the rig: without exposure #, where the relative orientation of '
        'fluoroscopes a and b differs by # px: the frames are from different exposures, or the '
        'phantom moved between them'
    ),
    Kind.RAYS_DO_NOT_MEET: (
        '# % of the rays miss each other: the frames, target ids or image coordinates do not '
        'belong together, the fluoroscopes are interchanged, or one was moved since its '
        'orientation was determined'
    ),
    Kind.RIG_DEPENDS_ON_ANGLE: (
        'orientation of the rig: the relative orientation of fluoroscopes a and b changes with '
        'the angle of the C-arm, by # px: it holds for the mean angle; orient the rig from a '
        'capture at the angle in use'
    ),
    Kind.RIG_MOVED: (
        'the relative orientation of fluoroscopes a and b differs from the previous one by # mm '
        'and # degrees (distance of the sources # times): one of them was moved since, the '
        'frames are from different exposures, or this is another phantom'
    ),
    Kind.RIG_NOTE: 'orientation of the rig: without exposure #',
    Kind.RIG_NOT_ORIENTED: (
        'no orientation of the rig: fluoroscopes a and b: no exposures have the same number'
    ),
    Kind.ORIENTATION: (
        'orientation of the rig: the relative orientation of fluoroscopes a and b differs '
        'between the exposures by # px, # times its standard deviation: orient the rig from a '
        'capture'
    ),
    Kind.TAKEN_ON_TRUST: (
        'the orientation of fluoroscopes a and b assumes that frames with the same number are '
        'simultaneous, or that the phantom stands still (they have no stamps): if the phantom '
        'turns steadily, a constant delay looks like another orientation'
    ),
    Kind.POSE_AMBIGUOUS: (
        'the pose is ambiguous: the phantom fits nearly as well in another one (# beads '
        'instead of #); mark it by beads that break its symmetry'
    ),
    Kind.MARKER_FOUND_AGAIN: 'found again after # images',
    Kind.MARKER_MOVES_ALONE: 'it no longer moves with its former neighbours',
    Kind.OTHER_SHADOW: 'another shadow was as close to its prediction',
    Kind.SHADOWS_MET: 'their shadows overlapped and separated',
    Kind.NOT_IN_BOTH: 'fluoroscope b is in one only',
    Kind.WRONG_FORMAT: (
        'cam.csv: this looks like MayaCam # (mayacam2), which has cameras, but a phantom is needed'
    ),
    Kind.FEW_BEADS: 'only # beads are found in the image, at least # are needed',
    Kind.GRID_NOT_MARKED: (
        'the grid is treated as unmarked: ids count from the hole nearest to the centre of each '
        'image: this suffices for the distortion of one fluoroscope, not for the orientation of '
        'two'
    ),
    Kind.SHADOWS_BENT: (
        'fluoroscope a: the distortion within the large shadows shifts their centres by # px '
        '(RMS); some # px of it may remain in the correction, in addition to its standard '
        'deviation: smaller beads reduce it, with the square of their size'
    ),
    Kind.IMAGE_ENCODING: 'the image has pixels of float64, not of # or # bits',
    Kind.IMAGE_EMPTY: 'the image is empty: every pixel has the grey value #',
    Kind.NO_POSE: 'no pose of the phantom fits the beads in the image',
    Kind.POSE_UNSURE: (
        'the best pose of the phantom explains only #% of the beads in its outline'
    ),
    Kind.BEAD_ALONE: 'its neighbours were not found',
    Kind.BEAD_AWAY: '# px from its prediction',
    Kind.BEAD_CONFUSED: 'not distinguished from another bead',
    Kind.BEAD_CONTRAST: 'a contrast of #% of that of a bead',
    Kind.BEAD_DISTURBED: 'another object is next to it',
    Kind.BEAD_HIDDEN: 'hidden by another bead',
    Kind.BEAD_UNSURE: 'sigma # px, that of most beads is # px',
    Kind.BEADS_NOT_MEASURED: (
        'the phantom is found with # beads, of which only # can be measured'
    ),
    Kind.BEAD_LOST: 'cut off, or lost while it was measured',
    Kind.FAILED_VERDICT: (
        'result: the verdict on the calibration is fail: its results may be wrong: fluoro-calib '
        'report result shows the reasons'
    ),
    Kind.REUSED_EXPOSURES: (
        '# of # exposures were used for the calibration: they do not show how accurate it is with '
        'others: record exposures that it has not used'
    ),
    Kind.EDITED_RESULT: (
        'result/result.json: the file was changed after it was written, its figures may not '
        'match the calibration: restore it, or calibrate again'
    ),
    Kind.EXCHANGED_CALIBRATION: (
        'result: the calibration file of a and result.json belong to different calibrations: one '
        'of them was replaced; restore the files of one calibration, or calibrate again'
    ),
    Kind.CLUSTER_CHANGE: (
        'WARN: the image of fluoroscope a has drifted by # px (sd #) towards (#, #), upper left '
        'quarter, about (#, #) px, for # s, relative to the start; detected in cluster bone, '
        'where a bead may have moved, since no other cluster shows the drift'
    ),
    Kind.IMAGE_DRIFT: (
        'ERROR: the image of fluoroscope a has drifted by # px (sd #) towards (#, #), upper left '
        'quarter, about (#, #) px, for # s, relative to the start; detected in the epipolar '
        'residuals'
    ),
    Kind.LEARNING: 'the reference is being learned',
    Kind.NO_DRIFT: 'no drift detected',
    Kind.FEW_MARKERS: 'only # of # markers are at their given initial positions',
    Kind.BODY_MIRRORED: (
        'body femur: its coordinates are mirrored: the points in space deviate from them by # '
        'mm, and from their mirror image by # mm'
    ),
    Kind.BODY_DIFFERENT: (
        'body femur: its coordinates deviate from the markers in space by # mm (RMS), more than '
        'their sd, and no single marker explains it; check ids, axes, units and sd, and whether '
        'they are of this body'
    ),
    Kind.BODY_NOT_RIGID: (
        'body femur: it is not rigid: its markers deviate from its shape by # mm (RMS; at most '
        '# mm by ISO #)'
    ),
    Kind.BODY_ON_A_LINE: (
        'body femur: its markers lie nearly on a line (condition number # per m, at most # by '
        'ISO #): the rotation about this line is poorly determined'
    ),
    Kind.BODY_SCALED: (
        'body femur: distances between its markers in space are # times those of its '
        'coordinates: check the voxel size of the CT, and the scale of the phantom'
    ),
    Kind.JOINT_APART: (
        'joint k: the origins of a and b are # mm apart: check which body is proximal, and the '
        'landmarks and their unit'
    ),
    Kind.JOINT_IMPOSSIBLE: (
        'joint k: flexion is -# to -# degrees, which no joint reaches (limits -# and #): check '
        'the side, which body is proximal, and the landmarks'
    ),
    Kind.BODY_UNSEEN: (
        'body femur: no exposure has three of its markers in space: its shape is not estimated'
    ),
    Kind.MARKER_LOOSE: (
        'body femur: marker # moves relative to the others: its positions scatter by # times '
        'their standard deviations'
    ),
    Kind.MARKER_MIGRATED: (
        'body femur: marker # is # mm from where CT has it, with a standard deviation of # mm: '
        'it has migrated, or is another one'
    ),
    Kind.MARKERS_EXCHANGED: 'body femur: markers # and # are exchanged in CT or in the images',
    Kind.CAUSE_SURE: (
        'fluoroscope a: source and detector have moved relative to each other; or fluoroscope b: '
        'it has moved relative to the other fluoroscope, or vice versa; the recording does not '
        'decide which: record more motion, or calibrate with the phantom'
    ),
    Kind.CHANGE_IDENTIFIED: (
        'the least certain direction of the change has a standard deviation of # % of the size '
        'that such a change may have: record bodies that move through more of the field of view'
    ),
    Kind.COMMON_MOTION: (
        'a common motion of all points by # mm (RMS) in the rig frame may be undetected'
    ),
    Kind.DISTORTION_CHANGED: 'fluoroscope a: the distortion has changed',
    Kind.FLUOROSCOPE_MOVED: (
        'fluoroscope a: it has moved relative to the other fluoroscope, or vice versa'
    ),
    Kind.INTERIOR_CHANGED: 'fluoroscope a: source and detector have moved relative to each other',
    Kind.UNSEEN_DISTORTION: (
        'an undetected change of the distortion may have moved points by # mm (RMS) relative to '
        'each other where the markers were, and by more elsewhere: record more bodies, or bodies '
        'that move through more of the field of view'
    ),
    Kind.UNUSED_EXPOSURES: (
        'the first half of the exposures that were not used: fluoroscope a: source and detector '
        'have moved relative to each other: the rig changes while it is recorded: take another '
        'recording, or calibrate with the phantom'
    ),
    Kind.NO_MARKERS: 'no markers were seen',
    Kind.OTHER_VIEW_MISSING: 'the view of b is missing',
    Kind.NOT_WATCHED: (
        'the file does not contain the times of its exposures, a drift cannot be detected'
    ),
    Kind.SHORT_RECORDING: (
        'the recording is too short to detect a drift: it has # s, of which the first # s are '
        'the reference'
    ),
    Kind.WIDE_TOLERANCE: (
        'stamps that differ by pair_tolerance, # ms, may belong to different exposures, as frames '
        'are # ms apart; frames are paired if their stamps differ by less than half of that: set '
        'pair_tolerance to less than half of the frame interval'
    ),
    Kind.WIDENED_BY_ALARM: (
        'rays miss each other by # px (RMS): until the rig is healed, the standard deviation of '
        'a coordinate is # mm (median) instead of # mm'
    ),
}


def pattern(sentence):
    """Return the regular expression of a sentence; # is a number and @ a place in an image."""
    return re.escape(sentence).replace(r'\#', NUMBER).replace('@', '[a-z ]+')


@pytest.mark.parametrize('kind', MAKERS, ids=lambda kind: kind.value)
def test_sentence_of_a_kind(kind):
    found = MAKERS[kind]()
    assert found.kind is kind
    assert re.fullmatch(pattern(SENTENCES[kind]), found.sentence), found.sentence


def test_every_kind_has_its_sentence():
    assert set(Kind) == set(MAKERS) == set(SENTENCES)


def test_places_in_a_sentence():
    assert str(Place(('a', 'b', 'c'), (3,))) == 'fluoroscopes a, b and c, exposure 3'
    assert str(Place(('a',), (3, 5))) == 'fluoroscope a, exposures 3 and 5'
    assert str(Place(('a',), name='')) == str(Place()) == ''
    found = Finding(Kind.POOR_FIT, 'cause', Place(('a',)), 'advice')
    assert found.sentence == str(found) == 'fluoroscope a: cause: advice'
    assert found.at('x.csv').sentence == 'x.csv: fluoroscope a: cause: advice'


def test_one_thing_is_in_the_singular():
    assert too_few(1, 'exposure') == '1 exposure is too few'
    assert [too_few(n, 'target') for n in (0, 2)] == [f'{n} targets are too few' for n in (0, 2)]
    with pytest.raises(DataError, match='1 exposure is too few, 3 are needed, 1 more has too few'):
        few = [replace(frames(1)[0].rows(np.arange(5)), number=9)]
        measured_network({'a': frames(1) + few}, PHANTOM)


def test_an_error_keeps_its_findings_on_its_way():
    """It is passed through a process pipe, and a place is put in front."""
    given = Finding(Kind.POOR_FIT, 'cause', Place(('a',)), numbers={'residual_px': 9.0})
    here, there = multiprocessing.Pipe()
    there.send(DataError(given, 'line\nend'))
    error = here.recv()
    assert error.findings[0] == given and error.findings[1].kind is Kind.DATA
    assert str(error) == 'fluoroscope a: cause. line\\nend'
    assert error.at('x').finding.numbers == given.numbers
    assert str(error.at('x')) == 'x: fluoroscope a: cause. x: line\\nend'
