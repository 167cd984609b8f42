# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Recordings that do not belong together, or not to the fixed calibrations.

The rig has no distortion and its calibrations are exact, so every finding is the fault of the
input. Correct input must pass without a message.
"""

import functools
import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from rigs import calibrated, kinds, refused, run, true_calibrations, true_orientation, turning
from scipy.spatial.distance import pdist, squareform

from fluoro_calib_ros.checks import verdict as verdict_module
from fluoro_calib_ros.checks.beads import check_beads
from fluoro_calib_ros.checks.calibration_evidence import Evidence
from fluoro_calib_ros.checks.field_checks import PRECISION
from fluoro_calib_ros.checks.rig import RigFindings, check_rig, doubtful, rig_findings
from fluoro_calib_ros.errors import DataError
from fluoro_calib_ros.estimation.options import CalibrationRequest
from fluoro_calib_ros.estimation.rig_orientation import orientation_and_scatter
from fluoro_calib_ros.exposures.frame import Frame
from fluoro_calib_ros.exposures.phantom import Phantom
from fluoro_calib_ros.findings import Kind, Severity
from fluoro_calib_ros.io.calibration import save_calibration, save_orientation
from fluoro_calib_ros.io.observations import write_observations_csv
from fluoro_calib_ros.io.phantom import write_phantom
from fluoro_calib_ros.jobs.calibration import adjust
from fluoro_calib_ros.jobs.orientation import orient
from fluoro_calib_ros.jobs.reconstruction import ReconstructionOptions, reconstruct
from fluoro_calib_ros.photogrammetry.rotations import matrix_from_vector
from fluoro_calib_ros.reconstruction.epipolar import (
    cause_of_misses,
    counts_of,
    mismatch,
    recent_misses,
    share_rejected,
)
from fluoro_calib_ros.reconstruction.intersection import (
    FAILED,
    OK,
    OUTSIDE,
    REJECTED,
    SINGLE_VIEW,
    Intersector,
)
from fluoro_calib_ros.reconstruction.reconstruct import RigRecording
from fluoro_calib_ros.reconstruction.timing import RecentExposures
from fluoro_calib_ros.report import html as html_report
from fluoro_calib_ros.simulation.rig import Detection, detect_beads, phantom_poses, virtual_rig

SIZE = 1024
COUNT = 8


@functools.cache
def rig():
    """A rig without distortion."""
    return virtual_rig(1, strength=0.0)


@functools.cache
def calibrations():
    """True calibrations of the rig."""
    return true_calibrations(rig().fluoroscopes)


@functools.cache
def orientation():
    """True orientation of the rig, with a small covariance."""
    return true_orientation(rig().fluoroscopes, calibrations())


@functools.cache
def poses():
    return tuple(phantom_poses(np.random.default_rng(5), COUNT))


def seen(of_rig, of_b=None):
    """Frames of half of the beads that are seen.

    of_b(k, fluoroscope, pose) returns fluoroscope b and the pose that it sees.
    """
    rng = np.random.default_rng(6)
    out = {f.name: [] for f in of_rig.fluoroscopes}
    for k, pose in enumerate(poses()):
        for f in of_rig.fluoroscopes:
            turn, shift, camera = *pose, f
            if of_b and f.name == 'b':
                camera, (turn, shift) = of_b(k, f, pose)
            points = of_rig.true_mm @ turn.T + shift
            ids, uv = detect_beads(rng, camera, points, of_rig.phantom.target_id, Detection())
            out[f.name].append(Frame(f.name, k + 1, ids[::2], uv[::2], f.image_size))
    return out


@functools.cache
def frames():
    return seen(rig())


def scatter(of_frames):
    """Whether exposures give an orientation, and findings that make it doubtful."""
    _, (pairs,) = orientation_and_scatter(of_frames, rig().phantom, calibrations())
    return doubtful(pairs, SIZE, 0.3)


def nudged(mm, rad, first, last=COUNT):
    """Make b see the phantom moved at random in some exposures."""
    rng = np.random.default_rng(7)

    def change(k, fluoroscope, pose):
        turn = matrix_from_vector(rad * rng.normal(size=3)) @ pose[0]
        shift = pose[1] + mm * rng.normal(size=3)
        return fluoroscope, (turn, shift) if first <= k < last else pose

    return change


def rig_moved(mm, rad, first):
    """Move b once, before exposure index `first`."""

    def change(k, fluoroscope, pose):
        if k < first:
            return fluoroscope, pose
        turn = matrix_from_vector(np.array([rad, -rad, 0]))
        return replace(
            fluoroscope,
            rotation=turn @ fluoroscope.rotation,
            position_mm=fluoroscope.position_mm + np.array([mm, 0, -mm]),
        ), pose

    return change


def test_exposures_of_a_rigid_rig_agree():
    assert scatter(frames()) == (True, [])


def of_rig(of_frames):
    """Findings of the exposures on the orientation, and the check of it."""
    request = CalibrationRequest(of_frames, rig().phantom)
    result = adjust(of_frames, rig().phantom, calibrations())
    found = rig_findings(request, result, of_frames, calibrations())
    return found, *check_rig(found)


def test_the_check_of_the_orientation_passes_on_a_rigid_rig():
    """Synchronism cannot be verified without stamps, which is noted in addition."""
    found, check = of_rig(frames())
    assert check.kind is Kind.ORIENTATION and check.passed
    assert found.orientation is not None and check.numbers['ratio'] < 2
    assert kinds(found.notes) == [Kind.TAKEN_ON_TRUST]
    assert check_rig(RigFindings()) == []


def test_frames_of_b_that_are_late_while_the_phantom_moves_fail_the_check():
    """They are late by one frame: about 1.5 mm and 0.3 degrees."""
    _, check = of_rig(seen(rig(), nudged(0.9, 0.003, 0)))
    assert check.passed is False and check.numbers['ratio'] > 5
    assert check.value > check.limit >= calibrations()['a'].image_sd


def test_frames_of_other_exposures_fail_and_frames_without_partner_cannot_tell():
    def numbered(shift, sign=1):
        of_b = frames()['b']
        return {
            'a': frames()['a'],
            'b': [replace(frame, number=sign * frame.number + shift) for frame in of_b],
        }

    last = max(frame.number for frame in frames()['b'])
    for late in (numbered(1), numbered(-2), numbered(last + 1, -1)):
        found, check = of_rig(late)
        assert found.orientation is None and check.passed is False
        assert check.kind is Kind.ORIENTATION and check.value > check.limit < 1
        assert check.numbers['ratio'] > 100 and kinds(found.doubts) == [Kind.PAIRS_CONTRADICT]
    found, check = of_rig(numbered(100))
    assert found.orientation is None and check.passed is None
    assert check.kind is Kind.ORIENTATION and np.isnan([check.value, check.limit]).all()
    assert check.place.fluoroscopes == ('a', 'b') and check.advice


def test_two_beads_exchanged_in_the_survey_are_named():
    """Exposures of one fluoroscope suffice, and the message names the beads."""
    phantom = rig().phantom
    distance = squareform(pdist(phantom.xyz_mm))
    seen_ids = np.concatenate([frame.target_id for frame in frames()['a']])
    often = np.array([np.sum(seen_ids == one) >= 2 for one in phantom.target_id])
    distance[~often] = distance[:, ~often] = np.inf
    np.fill_diagonal(distance, np.inf)
    pair = np.array(np.unravel_index(distance.argmin(), distance.shape))
    xyz = phantom.xyz_mm.copy()
    xyz[pair] = xyz[pair[::-1]]
    wrong = replace(phantom, xyz_mm=xyz)
    of_a = {'a': sorted(frames()['a'], key=lambda frame: frame.number)}
    held = {'a': calibrations()['a']}
    result = adjust(of_a, wrong, held)
    evidence = Evidence(CalibrationRequest(of_a, wrong), held, result, lambda step: None)
    check = check_beads(evidence, ['a'])[0]
    first, second = sorted(phantom.target_id[pair].tolist())
    assert check.passed is False and check.place.target_id == (first, second)
    assert f'bead {first} is exchanged with {second}' in check.cause
    assert check.value == check.numbers['beads'] == 2


@pytest.mark.parametrize('late, trusted', [(0.0, 0), (0.2, 1)])
def test_stamps_say_whether_frames_are_of_one_exposure(late, trusted):
    """Frames are late by a part of the exposure interval in which the image moves far."""
    stamped = {
        name: [
            replace(frame, stamp_ns=int(1e9 * (frame.number + late * (name == 'b'))))
            for frame in of_one
        ]
        for name, of_one in frames().items()
    }
    found, check = of_rig(stamped)
    assert check.passed and len(found.trusted) == trusted
    for one in found.trusted:
        assert one.severity is Severity.WARNING and one.numbers['moved_px'] > 10


def test_a_pair_between_which_the_phantom_moved_is_left_out_and_named():
    bumped = seen(rig(), nudged(3.0, 0.01, 4, 5))
    usable, (found,) = scatter(bumped)
    assert usable and found.kind is Kind.PAIRS_EXCLUDED and found.severity is Severity.WARNING
    assert found.place.fluoroscopes == ('a', 'b') and found.place.exposures == (5,)
    found, _ = orientation_and_scatter(bumped, rig().phantom, calibrations())
    named = {name: replace(one, frame_id=f'tube_{name}') for name, one in calibrations().items()}
    good, _ = orientation_and_scatter(frames(), rig().phantom, named)
    assert (found.frame_id, good.frame_id) == ('a_optical', 'tube_a')
    assert found.exposures == COUNT - 1
    base = [np.linalg.norm(o.position_mm[1] - o.position_mm[0]) for o in (found, good)]
    assert abs(base[0] - base[1]) < 0.5


def test_frame_numbers_that_jump_in_one_fluoroscope_are_left_out():
    shifted = dict(frames())
    shifted['b'] = [replace(f, number=f.number + (f.number > 6)) for f in shifted['b']]
    usable, (found,) = scatter(shifted)
    assert usable and found.kind is Kind.PAIRS_EXCLUDED and found.place.exposures == (8,)


def test_a_rig_that_was_moved_between_exposures_gives_no_orientation():
    usable, (found,) = scatter(seen(rig(), rig_moved(4.0, 0.006, 4)))
    assert not usable and found.kind is Kind.RIG_MOVED and found.place.exposures == (4, 5)


def test_a_phantom_that_moves_between_the_fluoroscopes_gives_no_orientation():
    usable, (found,) = scatter(seen(rig(), nudged(3.0, 0.01, 0)))
    assert not usable and found.kind is Kind.PAIRS_CONTRADICT


def on_an_arm(of_frames, order=range(COUNT)):
    """Frames of a C-arm whose image b shifts with the angle, as orientations express it."""
    angles = np.linspace(-1.4, 1.4, COUNT)[list(order)]

    def at(frame):
        angle = float(angles[frame.number - 1])
        shift = 1.5 * np.array([np.cos(angle), np.sin(angle)]) if frame.fluoroscope == 'b' else 0
        uv = frame.uv + shift
        on = ((uv > 0) & (uv < SIZE - 1)).all(axis=1)
        return replace(frame, target_id=frame.target_id[on], uv=uv[on], angle=angle)

    return {name: [at(frame) for frame in of_one] for name, of_one in of_frames.items()}


MIXED = (3, 6, 0, 5, 1, 7, 2, 4)


def scatter_on_an_arm(of_b=None, order=MIXED, changes=True):
    """As scatter(). changes: whether the calibrations contain a change with the angle."""
    held = calibrations()
    if changes:
        held = {name: turning(c, 90.0, 0.0) for name, c in held.items()}
    frames_on_arm = on_an_arm(seen(rig(), of_b), order)
    _, (pairs,) = orientation_and_scatter(frames_on_arm, rig().phantom, held)
    return doubtful(pairs, SIZE, 0.3)


@pytest.mark.parametrize('order', [MIXED, range(COUNT)])
def test_a_distortion_that_turns_with_a_c_arm_is_not_doubted(order):
    assert scatter_on_an_arm(order=order) == (True, [])


def test_an_arm_whose_calibrations_do_not_change_with_the_angle_is_mentioned():
    usable, (found,) = scatter_on_an_arm(changes=False)
    assert usable and found.kind is Kind.RIG_DEPENDS_ON_ANGLE


@pytest.mark.parametrize('order', [MIXED, range(COUNT)])
def test_movements_are_found_on_a_c_arm_that_turns(order):
    _, (found,) = scatter_on_an_arm(rig_moved(4.0, 0.006, 4), order)
    assert found.kind is Kind.RIG_MOVED and found.place.exposures == (4, 5)
    usable, (found,) = scatter_on_an_arm(nudged(3.0, 0.01, 4, 5), order)
    assert usable and found.kind is Kind.PAIRS_EXCLUDED and found.place.exposures == (5,)
    usable, (found,) = scatter_on_an_arm(nudged(3.0, 0.01, 0), order)
    assert not usable and found.kind is Kind.PAIRS_CONTRADICT


def test_small_movements_are_mentioned():
    usable, (found,) = scatter(seen(rig(), nudged(0.3, 0.001, 0)))
    assert usable and found.kind is Kind.PAIRS_CONTRADICT and found.numbers['ratio'] > 2


# ---- reconstruction


def exchanged(of_frames):
    a, b = of_frames['a'], of_frames['b']
    return {
        'a': [replace(f, fluoroscope='a') for f in b],
        'b': [replace(f, fluoroscope='b') for f in a],
    }


def changed(change, names='ab'):
    """Change the frames of some fluoroscopes."""
    return {n: [change(f) if n in names else f for f in of] for n, of in frames().items()}


def transposed(frame):
    return replace(frame, uv=frame.uv[:, ::-1].copy())


def upside_down(frame):
    return replace(frame, uv=np.column_stack([frame.uv[:, 0], SIZE - 1 - frame.uv[:, 1]]))


def halved(frame):
    return replace(frame, uv=frame.uv / 2)


CONFUSED = {
    'fluoroscopes exchanged': (
        lambda: exchanged(frames()),
        Kind.FLUOROSCOPES_INTERCHANGED,
    ),
    'b one exposure late': (
        lambda: changed(lambda f: replace(f, number=f.number + 1), 'b'),
        Kind.FRAMES_SHIFTED,
    ),
    'ids of b too large': (
        lambda: changed(lambda f: replace(f, target_id=f.target_id + 1), 'b'),
        Kind.IDS_SHIFTED,
    ),
    'u and v exchanged in b': (
        lambda: changed(transposed, 'b'),
        Kind.IMAGE_TRANSPOSED,
    ),
    'u and v exchanged': (lambda: changed(transposed), Kind.IMAGE_TRANSPOSED),
    'v upwards': (lambda: changed(upside_down), Kind.IMAGE_MIRRORED),
    'images of half the size': (
        lambda: changed(halved),
        Kind.RAYS_DO_NOT_MEET,
    ),
    'other ids in b': (
        lambda: changed(lambda f: replace(f, target_id=f.target_id + 1000), 'b'),
        Kind.NO_COMMON_TARGETS,
    ),
}
FROM_FILE = ReconstructionOptions(has_stamps=False)


@pytest.mark.filterwarnings('error')
@pytest.mark.parametrize('case', CONFUSED)
def test_rays_that_do_not_meet_are_refused_with_their_cause(case):
    make, kind = CONFUSED[case]
    with refused(kind):
        reconstruct(make(), calibrations(), orientation(), FROM_FILE)


@pytest.mark.parametrize('step', [1, -1])
@pytest.mark.parametrize('field', ['number', 'target_id'])
def test_shift_that_is_found_is_the_one_that_was_made(field, step):
    shifted = changed(lambda f: replace(f, **{field: getattr(f, field) + step}), 'b')
    recording = RigRecording(shifted, calibrations(), Intersector(orientation()))
    found = recording.reconstruct()
    why = mismatch(recording, found)
    assert why.kind is (Kind.FRAMES_SHIFTED if field == 'number' else Kind.IDS_SHIFTED)
    assert why.numbers['shift'] == step
    share, total = share_rejected(found)
    assert why.numbers['share'] == share > 0.5 and total >= 20
    assert cause_of_misses(recording, found).kind is why.kind


def by_stamp(of, first):
    """Frames with stamps; those of b are counted from another number."""
    return {
        name: [
            replace(f, number=f.number + first * (name == 'b'), stamp_ns=(1 + k) * 10**9)
            for k, f in enumerate(of_view)
        ]
        for name, of_view in of.items()
    }


@pytest.mark.parametrize('first', [0, 100])
def test_causes_are_found_in_frames_that_are_paired_by_stamp(first):
    options = ReconstructionOptions(pair_by='stamp')
    with refused(Kind.IMAGE_MIRRORED):
        reconstruct(by_stamp(changed(upside_down), first), calibrations(), orientation(), options)
    a, b = (frames()[name][0] for name in 'ab')
    one, two = np.intersect1d(a.target_id, b.target_id)[[0, 4]].tolist()
    wrong = {'a': [a] * 24, 'b': [with_ids_of_each_other(one, two)(b)] * 24}
    found = reconstruct(by_stamp(wrong, first), calibrations(), orientation(), options)
    assert [one.kind for one in found.lost_targets] == [Kind.TARGETS_EXCHANGED]


def test_share_of_rejected_points_is_of_points_of_two_views():
    """Single views have no second ray and do not count; failed points count as rejected."""
    status = np.array([OK] * 3 + [OUTSIDE] + [REJECTED] * 2 + [FAILED] * 4 + [SINGLE_VIEW] * 7)
    found = [SimpleNamespace(points=SimpleNamespace(status=part)) for part in (status, status[:4])]
    assert share_rejected(found) == (6 / 14, 14)
    assert share_rejected([]) == (0.0, 0)
    assert recent_misses([]) is None
    counts = counts_of(status)
    assert recent_misses([counts]) is None  # 10 points are too few
    assert recent_misses([counts, counts]).numbers['share'] == 0.6
    alone = counts_of(np.full(20, SINGLE_VIEW))
    assert recent_misses([alone]).kind is Kind.NO_COMMON_TARGETS


def test_some_false_matches_do_not_refuse_a_reconstruction():
    def confuse(frame):
        ids = frame.target_id.copy()
        some = np.random.default_rng(1).permutation(len(ids))[: len(ids) * 2 // 5]
        ids[some] = np.roll(ids[some], 1)
        return replace(frame, target_id=ids)

    outcome = reconstruct(changed(confuse, 'b'), calibrations(), orientation(), FROM_FILE)
    assert outcome.status_counts['OK'] > outcome.status_counts['REJECTED'] > 0


@functools.cache
def distorted():
    """Calibrations with a distortion, and frames that are distorted by it."""
    held = {}
    seen_so = {}
    for name in 'ab':
        # Each command rebuilds the lookup grid, which takes this model a twentieth of the time.
        result = calibrated(name, 6, max_iterations=2, model='collocation')
        calibration = result.calibrations[name]
        held[name] = replace(
            calibrations()[name],
            model=calibration.model,
            train_exposure=calibration.train_exposure,
        )
        seen_so[name] = [
            replace(f, uv=f.uv + calibration.correction(f.uv).duv) for f in frames()[name]
        ]
        seen_so[name] = [
            replace(f, target_id=f.target_id[inside], uv=f.uv[inside])
            for f in seen_so[name]
            for inside in [((f.uv > 0) & (f.uv < SIZE - 1)).all(axis=1)]
        ]
    return held, seen_so


def test_points_that_are_corrected_already_are_recognised():
    held, observed = distorted()
    ids = tuple(held[name].calibration_id for name in orientation().fluoroscopes)
    of_held = replace(orientation(), calibration_ids=ids)
    right = reconstruct(observed, held, of_held, FROM_FILE)
    assert right.widening < 2 and not right.lost_targets
    corrected = changed(lambda f: f)
    with refused(Kind.CORRECTED_ALREADY):
        reconstruct(corrected, held, of_held, FROM_FILE)


def with_ids_of_each_other(first, second):
    """Return a change of frames that exchanges the ids of two targets."""

    def change(frame):
        ids = frame.target_id.copy()
        ids[frame.target_id == first] = second
        ids[frame.target_id == second] = first
        return replace(frame, target_id=ids)

    return change


def test_targets_that_are_rejected_throughout_are_named():
    """Two that are exchanged in b, and one whose image point in a is that of something else."""
    a, b = (frames()[name][0] for name in 'ab')
    one, two, other = np.intersect1d(a.target_id, b.target_id)[[0, 4, 8]].tolist()
    some = {f.fluoroscope: [replace(f, number=k) for k in range(24)] for f in (a, b)}
    assert not reconstruct(some, calibrations(), orientation(), FROM_FILE).lost_targets
    wrong = {**some, 'b': [with_ids_of_each_other(one, two)(f) for f in some['b']]}
    wrong['a'] = [
        replace(f, uv=f.uv + np.sign(511 - f.uv) * 40.0 * (f.target_id == other)[:, None])
        for f in wrong['a']
    ]
    pair, single = reconstruct(wrong, calibrations(), orientation(), FROM_FILE).lost_targets
    assert pair.kind is Kind.TARGETS_EXCHANGED and pair.place.fluoroscopes == ('a', 'b')
    assert pair.place.target_id == (one, two)
    assert single.kind is Kind.TARGETS_REJECTED and single.place.target_id == (other,)


def test_a_stream_whose_rays_miss_each_other_is_noticed_and_forgotten():
    def of(some):
        return RigRecording(some, calibrations(), Intersector(orientation())).reconstruct()

    recent = RecentExposures(lambda frame: None)
    assert recent.faults(orientation(), False) == (None, None)
    for found in of(frames()):
        recent.add({}, found.points)
    assert recent.faults(orientation(), False) == (None, None)
    for _ in range(3):
        for found in of(exchanged(frames())):
            recent.add({}, found.points)
    assert recent.faults(orientation(), False)[0].kind is Kind.RAYS_DO_NOT_MEET
    for _ in range(10):
        for found in of(frames()):
            recent.add({}, found.points)
    assert recent.faults(orientation(), False) == (None, None)


# ---- orientation from a capture, and adjustment


def capture(number=1):
    return {name: [of_one[number - 1]] for name, of_one in frames().items()}


def of_capture(change, names='ab'):
    return {n: [change(f) if n in names else f for f in of] for n, of in capture().items()}


def in_metres():
    phantom = rig().phantom
    return Phantom(phantom.target_id, phantom.xyz_mm / 1000, phantom.sd_mm / 1000)


WRONG_CAPTURES = {
    'metres': (capture, in_metres, Kind.WRONG_UNIT),
    'ids too large by 1': (
        lambda: of_capture(lambda f: replace(f, target_id=f.target_id + 1)),
        None,
        Kind.IDS_SHIFTED,
    ),
    'mirrored': (lambda: of_capture(transposed), None, Kind.IMAGE_MIRRORED),
    'other phantom': (
        capture,
        lambda: replace(rig().phantom, xyz_mm=virtual_rig(2).phantom.xyz_mm),
        Kind.OTHER_PHANTOM,
    ),
}


@pytest.mark.filterwarnings('error')
@pytest.mark.parametrize('job', ['orient', 'adjust'])
@pytest.mark.parametrize('case', WRONG_CAPTURES)
def test_wrong_exposures_are_refused_with_fixed_calibrations(case, job, monkeypatch):
    # The search for mixed units is in vain here, so make it short.
    monkeypatch.setattr('fluoro_calib_ros.checks.mixed_units.SAMPLES', 300)
    monkeypatch.setattr('fluoro_calib_ros.checks.mixed_units.STEPS', 2)
    make, make_phantom, kind = WRONG_CAPTURES[case]
    phantom = rig().phantom if make_phantom is None else make_phantom()
    with refused(kind):
        (orient if job == 'orient' else adjust)(make(), phantom, calibrations())


def test_orientation_from_a_good_capture_is_not_doubted():
    found = orient(capture(), rig().phantom, calibrations())
    assert found.findings == ()
    again = orient(capture(), rig().phantom, calibrations(), present=found.orientation)
    assert again.findings == ()


def test_a_capture_whose_frames_are_of_two_poses_is_noticed_by_the_orientation_before():
    before = orient(capture(), rig().phantom, calibrations()).orientation
    mixed = {'a': capture(1)['a'], 'b': [replace(capture(2)['b'][0], number=1)]}
    (found,) = orient(mixed, rig().phantom, calibrations(), present=before).findings
    assert found.kind is Kind.RIG_MOVED and found.place.fluoroscopes == ('a', 'b')
    assert found.numbers['shift_mm'] > 1


@pytest.mark.filterwarnings('error')
def test_orient_and_adjust_refuse_points_that_are_corrected_already():
    held, observed = distorted()
    phantom = rig().phantom
    of_capture = {name: of_one[:1] for name, of_one in observed.items()}
    assert orient(of_capture, phantom, held).findings == ()
    assert adjust(observed, phantom, held).findings == ()
    for job, of_frames in ((orient, capture()), (adjust, frames())):
        with refused(Kind.CORRECTED_ALREADY):
            job(of_frames, phantom, held)
    only_b = {'a': observed['a'], 'b': frames()['b']}
    with refused(Kind.CORRECTED_ALREADY) as error:
        adjust(only_b, phantom, held)
    assert error.value.finding.place.fluoroscopes == ('b',)


def test_a_file_of_corrected_points_says_so(tmp_path, capsys):
    held, observed = distorted()
    for calibration in held.values():
        save_calibration(tmp_path / 'result', calibration)
    save_orientation(tmp_path / 'result', true_orientation(rig().fluoroscopes, held))
    write_phantom(tmp_path / 'phantom.csv', rig().phantom)
    write_observations_csv(tmp_path / 'seen.csv', observed)
    with_held = ('--calibration', tmp_path / 'result')
    corrected = tmp_path / 'corrected.csv'
    to_file = ('--to', 'observations', '--out', corrected)
    assert run('convert', tmp_path / 'seen.csv', *with_held, '--corrected', *to_file) == 0
    phantom = ('--phantom', tmp_path / 'phantom.csv')
    out = ('--out', tmp_path / 'out.csv')
    size = ('--image-size', '1024x1024')
    for command in (
        ('calibrate', corrected, *size, *phantom, '--out', tmp_path / 'again'),
        ('orient', corrected, *with_held, *phantom),
        ('adjust', corrected, *with_held, *phantom, '--out', tmp_path / 'adjusted'),
        ('reconstruct', corrected, *with_held, *out),
        ('correct', corrected, *with_held, *out),
        ('convert', corrected, *with_held, '--corrected', '--to', 'xmalab2d', *out),
    ):
        capsys.readouterr()
        assert run(*command) == 1
        assert 'are already corrected' in capsys.readouterr().err
    # Uncorrected output can still be converted.
    assert run('convert', corrected, *with_held, '--to', 'xmalab2d', *out) == 0


def wrong_distance(factor):
    """Calibrations with a different principal distance."""
    return {
        name: replace(c, interior=c.interior * [1, 1, factor])
        for name, c in calibrations().items()
    }


def test_a_capture_that_contradicts_the_calibrations_is_doubtful_or_refused():
    try:
        findings = orient(capture(), rig().phantom, wrong_distance(1.05)).findings
    except DataError as error:
        findings = error.findings
    assert findings[0].kind is Kind.RAYS_DO_NOT_MEET


def test_adjusted_exposures_that_contradict_the_calibrations_are_doubtful():
    assert adjust(frames(), rig().phantom, calibrations()).findings == ()
    doubts = adjust(frames(), rig().phantom, wrong_distance(1.05)).findings
    assert kinds(doubts) == [Kind.POOR_CALIBRATION_FIT] * 2
    assert [found.place.fluoroscope for found in doubts] == ['a', 'b']
    assert doubts[0].numbers['ratio'] > 2 and doubts[0].severity is Severity.ERROR


@pytest.mark.parametrize('sigma0, image_sd', [(0.25, 0.25), (1.0, 0.25)])
def test_points_that_tell_their_sigma_fit_a_calibration_of_points_that_did_not(sigma0, image_sd):
    held = {
        name: replace(c, sigma0=sigma0, image_sd=image_sd) for name, c in calibrations().items()
    }
    with_sigma = {
        name: [replace(f, sigma=np.full(len(f.target_id), 0.25)) for f in of_one]
        for name, of_one in frames().items()
    }
    assert adjust(with_sigma, rig().phantom, held).findings == ()


@pytest.mark.long
@pytest.mark.parametrize(
    ('change', 'sentence', 'verdict'),
    [
        (nudged(3.0, 0.01, 4, 5), 'orientation of the rig: without exposure 5, where', 'pass'),
        (rig_moved(4.0, 0.006, 4), 'was moved between exposures 4 and 5', 'fail'),
        (None, '', 'pass'),
    ],
)
def test_what_is_doubtful_about_the_rig_stays_with_the_result(
    change, sentence, verdict, tmp_path, capsys, monkeypatch
):
    monkeypatch.setattr(html_report, 'svg_text', lambda figure: '')
    if change:  # a good rig passes every check; of a bad one, those of the rig matter
        monkeypatch.setattr(verdict_module, 'SUBJECTS', (PRECISION,))
    write_phantom(tmp_path / 'phantom.csv', rig().phantom)
    source = tmp_path / 'observations.csv'
    write_observations_csv(source, seen(rig(), change))
    arguments = ('--image-size', '1024x1024', '--phantom', tmp_path / 'phantom.csv', '--model')
    out = tmp_path / 'result'
    status = {'pass': 0, 'fail': 3}[verdict]
    assert run('calibrate', source, *arguments, 'none', '--out', out) == status
    said = capsys.readouterr().err
    assert sentence in said if sentence else 'orientation of the rig' not in said
    note = json.loads((out / 'result.json').read_text())['rig_note']
    assert sentence in note and bool(note) == bool(sentence)
    monkeypatch.setattr(verdict_module, 'SUBJECTS', (PRECISION,))
    assert run('validate', out) == status
    shown = ' '.join(capsys.readouterr().out.replace('\n  ', ' ').split())
    assert sentence in shown and 'assumes that frames' in shown
    validation = json.loads((out / 'validation.json').read_text())
    assert validation['verdict'] == verdict
    for _ in range(2):
        page = (out / 'report.html').read_text()
        assert ('<p>Note: ' in page) == bool(note)
        assert run('report', out) == 0
    # A capture gives an orientation whatever the exposures show.
    arguments = ('--calibration', out, '--phantom', tmp_path / 'phantom.csv', '--exposures', '1')
    assert run('orient', source, *arguments) == 0
    assert run('validate', out) == 0
    assert 'orientation of the rig:' not in capsys.readouterr().out.partition('Verdict')[2]


def test_the_commands_say_what_is_wrong(tmp_path, capsys):
    for calibration in calibrations().values():
        save_calibration(tmp_path / 'result', calibration)
    save_orientation(tmp_path / 'result', orientation())
    write_phantom(tmp_path / 'phantom.csv', rig().phantom)
    write_observations_csv(tmp_path / 'wrong.csv', exchanged(frames()))
    held = ('--calibration', tmp_path / 'result')
    phantom = ('--phantom', tmp_path / 'phantom.csv')
    assert run('reconstruct', tmp_path / 'wrong.csv', *held, '--out', tmp_path / 'p.csv') == 1
    assert 'fluoroscopes a and b are interchanged' in capsys.readouterr().err
    assert not (tmp_path / 'p.csv').exists()
    write_observations_csv(tmp_path / 'right.csv', frames())
    source = tmp_path / 'right.csv'
    assert run('adjust', source, *held, *phantom, '--out', tmp_path / 'adjusted') == 0
    assert 'doubtful' not in capsys.readouterr().err
    arguments = ('--exposures', '1')
    assert run('orient', source, *held, *phantom, *arguments) == 0
    said = capsys.readouterr().err
    # The phantom of exposure 1 defines another frame, but the fluoroscopes have not moved.
    assert 'differs from the previous' not in said and 'doubtful' not in said
