# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The healing job: diagnose from a recording of bodies what has changed in a rig, and heal it.

Alternating blocks of the recording are used for the diagnosis and for its verdict. The healed rig
passes if no unused block shows a further change.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ..bodies.body import Body, check_bodies, robust_pose, solvable_bodies
from ..bodies.shapes import LearnedShapes
from ..brief import brief_repr
from ..checks.check import Check, verdict_of
from ..correction.base import CorrectionStatus
from ..correction.fluoroscope_calibration import (
    Calibrations,
    FluoroscopeCalibration,
    ids_of,
    with_drift,
    with_larger_sd,
)
from ..correction.series import sd_over_image
from ..errors import DataError
from ..exposures.frame import Frame, Frames, frames_of_targets
from ..exposures.pairing import RecordedPairing
from ..findings import Finding, Kind, Place, Severity
from ..healing.diagnosis import (
    OF_RIG,
    SURE_OF_CAUSE,
    Cause,
    Change,
    Diagnosis,
    Diagnostician,
)
from ..healing.healed_rig import HealedRig, healed_rig, unseen_distortion
from ..healing.rig_adjustment import ObservedBodies, Poses, RigAdjustment
from ..healing.rig_errors import RigErrors, rig_errors
from ..io.access import PathLike
from ..io.calibration import ORIENTATION_NAME as ORIENTATION
from ..io.calibration import SUFFIX, save_calibration, save_orientation
from ..io.documents import write_json
from ..io.folder import FolderKind, replaced_folder
from ..io.versions import HEALING, LEARNED_SHAPES, write_learned_shapes
from ..photogrammetry.rig_orientation import RigOrientation
from ..reconstruction.intersection import OK, OUTSIDE, Intersector
from ..reconstruction.observed_noise import with_observed_noise
from ..reconstruction.reconstruct import RigRecording, orientation_of_recorded
from ..reconstruction.timing import timing_of_recording

BLOCKS = 10  # blocks of a recording, alternately used for the diagnosis and for its verdict
MAX_EXPOSURES = 100  # maximum number used for each of these, evenly spread
MIN_EXPOSURES = BLOCKS  # of the diagnosis, and of each half of its verdict
MIN_RECORDED = 2 * MIN_EXPOSURES
# Largest relative standard deviation (posterior over prior) of a direction of a change that the
# data identify: beyond it, they have determined less than half of the change.
IDENTIFIED = 0.5
CHANGED_MEANWHILE = 'the rig changed during the recording'

_Exposure: TypeAlias = Mapping[str, Frame]


@dataclass(frozen=True)
class HealingOptions(RecordedPairing):
    """Options of healing. Raises ValueError for an invalid value."""


@dataclass(frozen=True)
class HealingOutcome:
    """Changes of a rig, and the rig as it is now.

    Attributes
    ----------
    diagnosis : Diagnosis
    healed : HealedRig or None
        None if nothing in the rig has changed and its claimed errors hold. If nothing has changed,
        but the claimed errors are smaller than those from a knock or drift that bodies do not
        show, it is the calibrated rig with larger ones.
    calibrations : mapping of str to FluoroscopeCalibration
        Of the healed rig.
    orientation : RigOrientation
        Of the healed rig.
    before, after : RigErrors
        Errors of points at the positions of the bodies.
    common_motion : Finding
        Possible common motion of all points, which no body shows.
    verdict : {'pass', 'fail', 'cannot tell'}
    checks : tuple of Check
    findings : tuple of Finding
        The changes.
    exposures : int
        Number of exposures used for the diagnosis.
    noise : Finding or None
        Set if image points have no sigma and their rays show more noise than the calibration.
    """

    __repr__ = brief_repr

    diagnosis: Diagnosis
    healed: HealedRig | None
    calibrations: Calibrations
    orientation: RigOrientation
    before: RigErrors
    after: RigErrors
    common_motion: Finding
    verdict: str
    checks: tuple[Check, ...]
    findings: tuple[Finding, ...]
    exposures: int
    noise: Finding | None = None

    @property
    def unseen_distortion(self) -> Check:
        """Check of how far points may have moved by changes of distortion that no body shows."""
        return next(check for check in self.checks if check.kind is Kind.UNSEEN_DISTORTION)

    @property
    def changed_meanwhile(self) -> bool:
        """Whether unused exposures contradict the diagnosis: the rig changed during recording."""
        return any(
            check.kind is Kind.UNUSED_EXPOSURES and check.passed is False for check in self.checks
        )


def heal_rig(
    frames: Frames,
    calibrations: Calibrations,
    orientation: RigOrientation,
    bodies: Sequence[Body],
    options: HealingOptions | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> HealingOutcome:
    """Find out what has changed in a rig since it was calibrated, and estimate the change.

    Parameters
    ----------
    frames : mapping of str to sequence of Frame
        Observed image points of the markers of bodies, by fluoroscope.
    calibrations : mapping of str to FluoroscopeCalibration
        Calibrations before the change.
    orientation : RigOrientation
        Orientation before the change.
    bodies : sequence of Body
        With the shapes that were learned while the rig was healthy.
    options : HealingOptions, optional
    progress : callable, optional
        Called with the number of completed steps and their total.

    Raises
    ------
    DataError
        For frames that cannot be paired or corrected, fluoroscopes that take their images at
        different times, bodies without learned shapes, and too few exposures that show bodies.
    """
    options = options or HealingOptions()
    step = progress or (lambda done, total: None)
    check_bodies(bodies)
    orientation = orientation_of_recorded(frames, orientation)
    paired, noise = _exposures_of(frames, calibrations, orientation, bodies, options)
    used, unused = _chosen(paired)
    rig = _Rig(calibrations, orientation, solvable_bodies(bodies))
    observed, poses = rig.observe(used)
    _check_seen(poses)
    step(1, 4)
    places = poses.centre_mm[poses.known]
    before = rig_errors(orientation, places)
    diagnostician = Diagnostician(rig.adjustment(), before.scale)
    diagnosis = diagnostician.diagnose(observed, poses)
    step(2, 4)
    changed = [change for change in diagnosis.changes if change.cause in OF_RIG]
    fixed = rig.with_fixed_correction(changed)
    stamp_ns = max(frame.stamp_ns for frame in used[-1].values())
    healed = healed_rig(diagnostician, diagnosis, stamp_ns, len(used))
    after = rig_errors(healed.orientation, places)
    # If nothing has changed, the rig is replaced only if it may err by more than it claims.
    claims_more = after.common_mm > before.common_mm
    new_rig = rig if fixed else rig.healed(healed, is_other=bool(changed) or claims_more)
    is_other = new_rig is not rig
    step(3, 4)
    identified_check = _correctable(fixed) if fixed else _identified(healed.weakest, bool(changed))
    unseen_check = _unseen_distortion(*unseen_distortion(diagnostician, diagnosis))
    checks = [identified_check, _sure(diagnosis, rig), unseen_check]
    if not fixed:  # otherwise they would show the same change
        checks += _unused_exposures(new_rig if changed else rig, unused, diagnosis, before.scale)
    step(4, 4)
    return HealingOutcome(
        diagnosis,
        healed=healed if is_other else None,
        calibrations=new_rig.calibrations,
        orientation=new_rig.orientation,
        before=before,
        after=after if is_other else before,
        common_motion=common_motion(after.common_mm),
        verdict=verdict_of(checks),
        checks=tuple(checks),
        findings=tuple(_finding(change, rig, diagnosis) for change in diagnosis.changes),
        exposures=len(used),
        noise=noise,
    )


def _exposures_of(
    frames: Frames,
    calibrations: Calibrations,
    orientation: RigOrientation,
    bodies: Sequence[Body],
    options: HealingOptions,
) -> tuple[list[dict[str, Frame]], Finding | None]:
    """Return the exposures that show bodies, and a finding on their noise. Raises DataError."""
    markers = np.concatenate([body.target_id for body in bodies])
    recording, noise = with_observed_noise(
        RigRecording(
            frames_of_targets(frames, markers), calibrations, Intersector(orientation), options
        ),
        must_explain=False,
    )
    fault = timing_of_recording(recording)
    if fault is not None:  # it would look like a change of the rig
        raise DataError(fault)
    return recording.exposures, noise


def _check_seen(poses: Poses) -> None:
    """Raise DataError if too few exposures give a pose of a body."""
    count = int(poses.known.any(axis=1).sum())
    if count < MIN_EXPOSURES:
        raise DataError(
            f'{count} of {len(poses.known)} exposures, every second block of the recording, show '
            f'three markers of a body in two views, {MIN_EXPOSURES} are needed'
        )


def _chosen(paired: Sequence[_Exposure]) -> tuple[list[_Exposure], list[_Exposure]]:
    """Return exposures for the diagnosis and for its verdict, from alternating blocks.

    Raises DataError if there are too few.
    """
    count = len(paired)
    if count < MIN_RECORDED:
        raise DataError(f'{count} exposures have two views, {MIN_RECORDED} are needed')
    block = np.arange(count) * BLOCKS // count
    out = []
    for parity in (0, 1):
        rows = np.flatnonzero(block % 2 == parity)
        sample = np.unique(np.linspace(0, len(rows) - 1, MAX_EXPOSURES).astype(int))
        out.append([paired[row] for row in rows[sample]])
    return out[0], out[1]


@dataclass(frozen=True)
class _Rig:
    """State of a rig, and the bodies that it sees."""

    calibrations: Calibrations
    orientation: RigOrientation
    bodies: tuple[Body, ...]

    def adjustment(self) -> RigAdjustment:
        """Return the adjustment of this rig."""
        sizes = [self.calibrations[name].image_size for name in self.orientation.fluoroscopes]
        return RigAdjustment(self.orientation, self.bodies, sizes)

    def observe(self, exposures: Sequence[_Exposure]) -> tuple[ObservedBodies, Poses]:
        """Return the corrected image points of exposures, and initial poses of the bodies."""
        target_id = self.adjustment().target_id
        names = self.orientation.fluoroscopes
        # observed u, v; corrected u, v; standard deviations in total and of the correction
        values = np.full((len(exposures), *target_id.shape, len(names), 6), np.nan)
        flat = values.reshape(len(exposures), target_id.size, len(names), 6)
        for f, name in enumerate(names):
            for row, exposure in enumerate(exposures):
                if name in exposure:
                    marker_rows, marker_values = _corrected(
                        target_id, exposure[name], self.calibrations[name]
                    )
                    flat[row, marker_rows, f] = marker_values
        pixel = values[..., :2]
        uv = values[..., 2:4]
        sigma, correction = np.moveaxis(values[..., 4:], -1, 0)
        seen = np.asarray(np.isfinite(values).all(axis=-1))
        count = np.maximum(seen.sum(axis=0), 1)
        fixed = np.where(seen, correction, 0.0) ** 2
        noise = np.where(seen, np.maximum(sigma**2 - correction**2, 0.01 * sigma**2), 1.0)
        observed = ObservedBodies(uv, pixel, noise, fixed.sum(axis=0) / count, seen)
        return observed, self._first_poses(uv, sigma)

    def _first_poses(self, uv: NDArray[np.float64], sigma: NDArray[np.float64]) -> Poses:
        """Return initial poses that fit the bodies to their markers in space, some maybe wrong."""
        shape = uv.shape[:3]
        views = uv.shape[3]
        points = Intersector(self.orientation, None).intersect(
            uv.reshape(-1, views, 2).transpose(1, 0, 2), sigma.reshape(-1, views).T
        )
        good = np.isin(points.status, (OK, OUTSIDE)).reshape(shape)
        xyz = points.xyz_mm.reshape(*shape, 3)
        known = good.sum(axis=2) >= 3
        rotation = np.tile(np.eye(3), (*shape[:2], 1, 1))
        centre = np.zeros((*shape[:2], 3))
        body_xyz = self.adjustment().xyz
        for t, b in np.argwhere(known):
            rows = np.flatnonzero(good[t, b])
            rotation[t, b], centre[t, b] = robust_pose(body_xyz[b, rows], xyz[t, b, rows])
        return Poses(rotation, centre, known)

    def with_fixed_correction(self, changes: Iterable[Change]) -> list[str]:
        """Return fluoroscopes whose distortion has changed, but whose model allows no change."""
        names = self.orientation.fluoroscopes
        distorted = [
            names[change.fluoroscope] for change in changes if change.cause is Cause.DISTORTION
        ]
        return [name for name in distorted if self.calibrations[name].model.series is None]

    def healed(self, healed: HealedRig, is_other: bool) -> _Rig:
        """Return the rig with the healed changes.

        is_other: if False, only corrections may differ; returns this rig if none does.
        """
        calibrations = dict(self.calibrations)
        names = self.orientation.fluoroscopes
        for f, name in enumerate(names):
            calibration = calibrations[name]
            if f in healed.drift:
                functions, coefficients, covariance = healed.drift[f]
                sd = sd_over_image(functions, covariance)
                calibration = with_drift(calibration, functions, coefficients, sd)
            else:
                calibration = with_larger_sd(calibration, sd_over_image(*healed.unseen[f]))
            if healed.changes[f, 6:].any():
                rows = healed.orientation.covariance_rows([f])[6:]
                calibration = replace(
                    calibration,
                    interior=healed.orientation.interior[f],
                    interior_covariance=healed.orientation.covariance[np.ix_(rows, rows)],
                )
            calibrations[name] = calibration
        if not is_other and ids_of(calibrations) == ids_of(self.calibrations):
            return self
        orientation = replace(
            healed.orientation,
            calibration_ids=tuple(calibrations[name].calibration_id for name in names),
        )
        return replace(self, calibrations=calibrations, orientation=orientation)

    def diagnose(
        self, exposures: Sequence[_Exposure], known: Diagnosis, shape_scale: float
    ) -> Diagnosis | None:
        """Diagnose changes in addition to the known changes of bodies, up to a change of the rig.

        Returns None for too few exposures.
        """
        if len(exposures) < MIN_EXPOSURES:
            return None
        observed, poses = self.observe(exposures)
        for change in known.changes:
            if change.cause is Cause.EXCHANGED:
                observed = observed.exchanged(change.body, *change.markers)
        target_id = self.adjustment().target_id
        left_out = _left_out(known.changes, target_id)
        observed = observed.without(left_out)
        known_poses = poses.known[:, _solvable(target_id, left_out)]
        if known_poses.any(axis=1).sum() < MIN_EXPOSURES:
            return None
        return Diagnostician(self.adjustment(), shape_scale).diagnose(observed, poses, OF_RIG)


def _left_out(changes: Sequence[Change], target_id: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Return which markers (B, M) have changed, themselves or with their body.

    If no body would remain, none is excluded: a rig that changes during the recording makes all
    bodies look soft.
    """
    out = np.zeros(target_id.shape, dtype=bool)
    for change in changes:
        if change.cause not in OF_RIG and change.cause is not Cause.EXCHANGED:
            out[change.body, list(change.markers) or slice(None)] = True
    return out & _solvable(target_id, out).any()


def _solvable(target_id: NDArray[np.int64], left_out: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return which bodies (B,) have at least three markers that are not excluded (B, M)."""
    return np.asarray(((target_id >= 0) & ~left_out).sum(axis=1) >= 3)


def _corrected(
    target_id: NDArray[np.int64], frame: Frame, calibration: FluoroscopeCalibration
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return rows (n,) of the markers of a frame in target_id, and their values (n, 6).

    Image points beyond the calibrated area are excluded.
    """
    _, target_rows, frame_rows = np.intersect1d(
        target_id.ravel(), frame.target_id, return_indices=True
    )
    observed = frame.uv[frame_rows]
    sigma = None if frame.sigma is None else frame.sigma[frame_rows]
    u, v, total, sd, status = calibration.correct_arrays(
        observed[:, 0], observed[:, 1], sigma, frame.angle
    )
    inside = status == CorrectionStatus.OK
    return target_rows[inside], np.column_stack([observed, u, v, total, sd])[inside]


# Findings and checks of a healing.

_KINDS = {
    Cause.ORIENTATION: Kind.FLUOROSCOPE_MOVED,
    Cause.INTERIOR: Kind.INTERIOR_CHANGED,
    Cause.DISTORTION: Kind.DISTORTION_CHANGED,
    Cause.MIGRATED: Kind.MARKER_MIGRATED,
    Cause.EXCHANGED: Kind.MARKERS_EXCHANGED,
    Cause.LOOSE: Kind.MARKER_LOOSE,
    Cause.SOFT: Kind.BODY_NOT_RIGID,
}


def _place_of(change: Change, rig: _Rig) -> Place:
    if change.fluoroscope >= 0:
        return Place((rig.orientation.fluoroscopes[change.fluoroscope],))
    body = rig.bodies[change.body]
    markers = tuple(int(body.target_id[m]) for m in change.markers)
    return Place(target_id=markers, name=f'body {body.name}')


def _finding(change: Change, rig: _Rig, diagnosis: Diagnosis) -> Finding:
    """Return a finding that describes a change."""
    return Finding(
        _KINDS[change.cause],
        _cause_text(change, rig),
        place=_place_of(change, rig),
        severity=Severity.WARNING,
        numbers={'probability': diagnosis.probability[diagnosis.changes.index(change)]},
    )


def _cause_text(change: Change, rig: _Rig) -> str:
    views = len(rig.orientation.fluoroscopes)
    ids = ' and '.join(str(i) for i in _place_of(change, rig).target_id)
    return {
        Cause.ORIENTATION: 'it has moved'
        if views > 2
        else 'it has moved relative to the other fluoroscope, or vice versa',
        Cause.INTERIOR: 'source and detector have moved relative to each other',
        Cause.DISTORTION: 'the distortion has changed',
        Cause.MIGRATED: f'marker {ids} has migrated',
        Cause.EXCHANGED: f'the ids of markers {ids} are exchanged',
        Cause.LOOSE: f'marker {ids} moves relative to the others',
        Cause.SOFT: 'its markers move relative to each other: it is not rigid',
    }[change.cause]


def common_motion(distance_mm: float) -> Finding:
    """Return a finding on the possible common motion of all points [mm]."""
    return Finding(
        Kind.COMMON_MOTION,
        f'a common motion of all points by {distance_mm:.2f} mm (RMS) in the rig frame may be '
        'undetected',
        severity=Severity.NOTE,
        numbers={'distance_mm': distance_mm},
    )


def _unseen_distortion(distance_mm: float, noise_mm: float) -> Check:
    """Check that changes of distortion that bodies do not show are below the noise."""
    return Check(
        Kind.UNSEEN_DISTORTION,
        f'an undetected change of the distortion may have moved points by {distance_mm:.3f} mm '
        '(RMS) relative to each other where the markers were, and by more elsewhere',
        advice='record more bodies, or bodies that move through more of the field of view',
        value=distance_mm,
        limit=noise_mm,
        unit='mm',
    )


def _identified(weakest: float, is_healed: bool) -> Check:
    """Check that the bodies identify the whole change, or would identify a knock."""
    change = 'the change' if is_healed else 'a knock'
    return Check(
        Kind.CHANGE_IDENTIFIED,
        f'the least certain direction of {change} has a standard deviation of '
        f'{100 * weakest:.1f} % of the size that such a change may have',
        advice='record bodies that move through more of the field of view',
        value=weakest,
        limit=IDENTIFIED,
    )


def _correctable(fixed: Sequence[str]) -> Check:
    """Return the failed check for a change of distortion that the models do not allow."""
    return Check(
        Kind.CHANGE_IDENTIFIED,
        'its model of the distortion has no field of standard deviations, to which a change '
        'could be added',
        place=Place(tuple(fixed)),
        advice='calibrate with the phantom; the collocation can be healed',
        value=1.0,
        limit=IDENTIFIED,
    )


def _sure(diagnosis: Diagnosis, rig: _Rig) -> Check:
    """Check that no other cause explains the data nearly as well."""
    doubt = max([1 - probability for probability in diagnosis.probability], default=0.0)
    limit = 1 - SURE_OF_CAUSE
    text = 'no other cause explains the recording as well'
    if doubt > limit:
        worst = int(np.argmin(diagnosis.probability))
        rival = diagnosis.rivals[worst]
        finding = _finding(diagnosis.changes[worst], rig, diagnosis)
        text = f'{finding.place}: {finding.cause}'
        if rival is not None:
            text += f'; or {_place_of(rival, rig)}: {_cause_text(rival, rig)}'
        text += '; the recording does not decide which'
    if not diagnosis.complete:
        doubt = 1.0
        text = f'{len(diagnosis.changes)} changes do not explain the recording'
    return Check(
        Kind.CAUSE_SURE,
        text,
        advice='record more motion, or calibrate with the phantom',
        value=doubt,
        limit=limit,
    )


def _unused_exposures(
    now: _Rig, exposures: Sequence[_Exposure], known: Diagnosis, shape_scale: float
) -> list[Check]:
    """Check both halves of the unused exposures, as a creeping rig changes between them."""
    middle = len(exposures) // 2
    halves = exposures[:middle], exposures[middle:]
    return [
        _unused(now.diagnose(half, known, shape_scale), number, now)
        for number, half in enumerate(halves, 1)
    ]


def _unused(diagnosis_of_unused: Diagnosis | None, half: int, rig: _Rig) -> Check:
    """Check that unused exposures show no further change of the rig."""
    part = f'the {("first", "second")[half - 1]} half of the exposures that were not used'
    if diagnosis_of_unused is None:
        return Check(
            Kind.UNUSED_EXPOSURES,
            f'{part} shows too little of the bodies',
            advice='take a longer recording',
        )
    changes = [change for change in diagnosis_of_unused.changes if change.cause in OF_RIG]
    text = f'{part} shows no further change'
    if changes:
        text = f'{part}: {_place_of(changes[0], rig)}: {_cause_text(changes[0], rig)}'
    elif not diagnosis_of_unused.complete:
        text = f'{len(diagnosis_of_unused.changes)} changes do not explain {part}'
    return Check(
        Kind.UNUSED_EXPOSURES,
        text,
        advice='the rig changes while it is recorded: take another recording, or calibrate with '
        'the phantom',
        value=float(len(changes) + (not diagnosis_of_unused.complete)),
        limit=0.0,
    )


# Folder of a healed rig: calibrations, orientation, and what was changed and why.

VERSION = 1  # format version of healing.json


HEALING_FOLDER = FolderKind(
    'a folder of a healed rig',
    parts=(HEALING, ORIENTATION, LEARNED_SHAPES, f'*{SUFFIX}'),
    marks=(HEALING,),
)


def save_healing(
    directory: PathLike,
    outcome: HealingOutcome,
    parent: RigOrientation,
    learned: LearnedShapes | None = None,
) -> None:
    """Write a healed rig, all or nothing, and the shapes by which it was healed.

    parent: its orientation before healing. Raises DataError.
    """
    with replaced_folder(directory, HEALING_FOLDER) as folder:
        for calibration in outcome.calibrations.values():
            save_calibration(folder, calibration)
        save_orientation(folder, outcome.orientation)
        if learned is not None:
            write_learned_shapes(folder, learned.with_healed(outcome.orientation.orientation_id))
        write_json(folder / HEALING, healing_document(outcome, parent))


def healing_document(outcome: HealingOutcome, parent: RigOrientation) -> dict[str, Any]:
    """Return the content of healing.json, which docs/bodies.md describes."""
    return {
        'version': VERSION,
        'orientation_id': outcome.orientation.orientation_id,
        'parent_orientation_id': parent.orientation_id,
        'calibration_ids': dict(
            zip(outcome.orientation.fluoroscopes, outcome.orientation.calibration_ids)
        ),
        'parent_calibration_ids': dict(zip(parent.fluoroscopes, parent.calibration_ids)),
        'verdict': outcome.verdict,
        'exposures': outcome.exposures,
        'noise_factor': outcome.diagnosis.noise,
        'nothing_else_probability': outcome.diagnosis.no_further_probability,
        'findings': [_finding_document(finding) for finding in outcome.findings],
        'checks': [
            {
                **_finding_document(check),
                'value': check.value,
                'limit': check.limit,
                'passed': check.passed,
            }
            for check in outcome.checks
        ],
        'changes': _changes(outcome),
        'common_motion': _finding_document(outcome.common_motion),
        'unseen_distortion': _finding_document(outcome.unseen_distortion),
        'errors_before': _errors(outcome.before),
        'errors_after': _errors(outcome.after),
    }


def _finding_document(finding: Finding) -> dict[str, Any]:
    return {
        'kind': finding.kind.value,
        'fluoroscopes': list(finding.place.fluoroscopes),
        'target_id': list(finding.place.target_id),
        'sentence': str(finding),
        'numbers': dict(finding.numbers),
    }


def _errors(errors: RigErrors) -> dict[str, float]:
    return {'scale_ppm': 1e6 * errors.scale, 'place_mm': errors.place_mm}


def _changes(outcome: HealingOutcome) -> dict[str, Any]:
    """Return the changes of the changed fluoroscopes, with standard deviations."""
    healed = outcome.healed
    if healed is None:
        return {}
    out = {}
    for f, name in enumerate(outcome.orientation.fluoroscopes):
        if not healed.changes[f].any() and f not in healed.drift:
            continue
        value = healed.changes[f]
        sd = healed.sd[f]
        out[name] = {
            'position_mm': value[:3],
            'position_sd_mm': sd[:3],
            'rotation_deg': np.degrees(value[3:6]),
            'rotation_sd_deg': np.degrees(sd[3:6]),
            'principal_point_px': value[6:8],
            'principal_point_sd_px': sd[6:8],
            'principal_distance_px': value[8],
            'principal_distance_sd_px': sd[8],
            'distortion': f in healed.drift,
        }
    return out
