# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Make a network from frames: validation, initial values, and exclusion of frames."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from ..correction.series import Series
from ..errors import DataError
from ..exposures.collector import MIN_EXPOSURES
from ..exposures.frame import Frame, Frames, angles_of, validate_frame
from ..exposures.phantom import Phantom
from ..findings import Finding, Kind, Place, Severity, too_few
from ..photogrammetry.adjustment import TOLERANCE, Adjustment, adjust
from ..photogrammetry.network import Network
from ..photogrammetry.noise import Noise
from ..photogrammetry.outliers import adjust_and_estimate_noise
from ..photogrammetry.plane_resection import is_flat, plane_of, tilt_of
from ..photogrammetry.precision import Precision, precision
from ..photogrammetry.resection import Resection, refine_resection, resection_at
from ..photogrammetry.rig_orientation import (
    ExteriorPrior,
    KnownOrientation,
)
from ..photogrammetry.rotations import rotation_angle
from ..photogrammetry.unknowns import POSE_SIZE, RIGID_SD_MM, RIGID_SD_RAD, Parameters
from .priors import Prior
from .start_orientation import (
    UNTILTED,
    View,
    orient_view,
    principal_distance_of_views,
    settle_planes,
    view_of,
)

# Adjustment of a network with its precision, for every step of a calibration.

START_GROSS = 0.01  # initial share of gross errors when the noise is estimated
ADVICE = 'add exposures with the phantom turned and moved'
TOO_FLAT = replace(
    UNTILTED,
    cause='the targets are flat and tilted too little to determine the principal distance',
)
SINGULAR = f'the exposures do not determine the unknowns: the normal matrix is singular; {ADVICE}'


def start_noise(loss: str) -> Noise:
    """Return the initial noise model of an estimation.

    A Student-t noise also has a share of gross errors.
    """
    return Noise(loss, gross=START_GROSS if loss == 'student_t' else 0.0)


# Decrease of F that an adjustment before the last may leave: a hundredth of a sigma.
ROUND_TOLERANCE = 1e-4


def adjusted_with_precision(
    network: Network,
    start: Parameters,
    correction: NDArray[np.float64] | float,
    noise: Noise,
    tolerance: float = TOLERANCE,
    noise_fixed: bool = False,
) -> tuple[Adjustment, Precision]:
    """Adjust a network and compute its precision.

    Parameters
    ----------
    network : Network
    start : Parameters
        Initial values of the unknowns.
    correction : (N, 2) ndarray or float
        Corrections of the image points [px], fixed.
    noise : Noise
        Initial values of the noise model, or the noise model itself with noise_fixed.
    tolerance : float
        Decrease of the cost at which the adjustment stops.
    noise_fixed : bool
        Whether to keep the noise model fixed instead of estimating it.

    Raises
    ------
    DataError
        If the network does not determine the unknowns.
    """
    adjusted = adjust if noise_fixed else adjust_and_estimate_noise
    try:
        result = adjusted(network, start, correction=correction, noise=noise, tolerance=tolerance)
        return result, precision(network, result, correction)
    except np.linalg.LinAlgError:
        raise undetermined(network) from None


def undetermined(network: Network) -> DataError:
    """Return the error of a network whose normal matrix is singular.

    For flat targets that are tilted little, noise decides whether the matrix is singular; the
    reported cause is that they are flat.
    """
    if is_flat(network.survey_mm):
        return DataError(TOO_FLAT)
    return DataError(SINGULAR, kind=Kind.UNDETERMINED)


def with_additional(adjustment: Adjustment, values: tuple[NDArray[np.float64], ...]) -> Adjustment:
    """Return an adjustment whose parameters have additional parameters of these values."""
    return replace(adjustment, parameters=replace(adjustment.parameters, additional=values))


MIN_TARGETS_OF_EXPOSURE = 12
# Least tilt of flat targets, in any exposure, that determines the principal distance.
UNTILTED_RAD = np.deg2rad(5.0)
TILTED_RAD = np.deg2rad(20.0)  # least tilt of flat targets that is advised
# Two exposures show the same pose of the phantom if their rotation and distance differ by less.
MIN_POSE_RAD = np.deg2rad(2.0)
MIN_POSE_SHIFT = 0.02  # of the distance from the source; 20 mm in a usual rig
AXIAL_FACTOR = 10.0  # uncertainty of a distance along the optical axis, relative to one across it
MAX_MISFIT = 8.0  # limit of the residuals of a resection, relative to the median of the exposures

Known = Mapping[str, KnownOrientation]  # by fluoroscope


@dataclass(frozen=True)
class Measured:
    """A network and its sources."""

    network: Network
    start: Parameters  #: initial values of the unknowns
    fluoroscopes: tuple[str, ...]  #: names, in the order of the network
    image_size: tuple[tuple[int, int], ...]  #: width and height [px] by fluoroscope
    frames: tuple[Frame, ...]  #: the frame of every exposure of the network
    target_id: NDArray[np.int64]  #: (n,) target ids of the object points
    excluded: tuple[Finding, ...]  #: one finding for every frame that is not used
    #: by fluoroscope: whether all exposures show flat targets parallel to the image
    untilted: tuple[bool, ...] = ()
    #: orientations known beforehand, by fluoroscope
    known: Known = field(default_factory=dict)

    @property
    def angles(self) -> list[NDArray[np.float64]]:
        """Angles (e,) of the C-arm [rad] in the exposures of each fluoroscope; NaN: unknown."""
        return [
            angles_of(self.frames[j] for j in np.flatnonzero(self.network.fluoroscope == f))
            for f in range(len(self.fluoroscopes))
        ]


@dataclass(frozen=True)
class KnownSensor:
    """A fluoroscope whose interior orientation (3,) [px] and correction are known.

    correction: function of a Frame with n image points that returns their corrections (n, 2) [px].
    """

    interior: NDArray[np.float64]
    correction: Callable[[Frame], NDArray[np.float64]]


@dataclass(frozen=True)
class EarlierCalibration:
    """Results of a calibration that one with fewer of its exposures can use."""

    series: Mapping[str, Series]  #: corrections by fluoroscope
    varying: frozenset[str]  #: fluoroscopes whose distortion differs between exposures
    noise: Noise
    target_id: NDArray[np.int64]  #: (n,) targets with object points, ascending
    points_mm: NDArray[np.float64]  #: (n, 3)
    #: priors of the corrections by fluoroscope, found by the last of several such calibrations;
    #: the next one starts with them
    priors: dict[str, Prior] = field(default_factory=dict)

    def points(self, target_id: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return the object points (k, 3) [mm] of targets (k,)."""
        return self.points_mm[np.searchsorted(self.target_id, target_id)]


@dataclass(frozen=True)
class StartValues:
    """Initial values from an earlier adjustment of the same exposures, replacing resections."""

    interior: Mapping[str, NDArray[np.float64]]  #: (3,) xp, yp, c [px] by fluoroscope
    #: (3, 3) rotation and position [mm] by fluoroscope and exposure
    exterior: Mapping[tuple[str, int], tuple[NDArray[np.float64], NDArray[np.float64]]]
    #: calibration with these and other exposures; the orientations belong to its corrections
    earlier: EarlierCalibration | None = None


@dataclass(frozen=True)
class _Task:
    """Input for the initial values; sensors None: the fluoroscopes are to be calibrated."""

    phantom: Phantom
    sensors: Mapping[str, KnownSensor] | None
    principal_distance: float | None
    known: Known
    starts: StartValues | None = None

    def has_starts(self, name: str, frames: Sequence[Frame]) -> bool:
        """Whether there are initial values for all these exposures of a fluoroscope."""
        starts = self.starts
        return (
            starts is not None
            and name in starts.interior
            and all((name, frame.number) in starts.exterior for frame in frames)
        )

    def min_exposures(self, name: str, frames: Sequence[Frame], untilted: bool = True) -> int:
        """Return the number of exposures needed; untilted: targets are parallel to the image."""
        if self.sensors is not None or name in self.known:
            return 1
        if untilted and self.principal_distance is not None:
            return 1
        # A flat target determines the distortion, one in space the interior orientation.
        flat = {is_flat(self.xyz(frame)) for frame in frames}
        return MIN_EXPOSURES if len(flat) < 2 else 2

    def min_targets(self, name: str) -> int:
        """Return the number of targets that an exposure needs."""
        return 1 if name in self.known else MIN_TARGETS_OF_EXPOSURE

    def xyz(self, frame: Frame) -> NDArray[np.float64]:
        """Return the surveyed coordinates (n, 3) [mm] of the targets of a frame."""
        return self.phantom.xyz_mm[self.phantom.index(frame.target_id)]

    def uv(self, name: str, frame: Frame) -> NDArray[np.float64]:
        """Return the image points (n, 2) [px] of a frame, corrected if the correction is known."""
        return (
            frame.uv if self.sensors is None else frame.uv - self.sensors[name].correction(frame)
        )

    def interior(self, name: str, start: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the interior orientation (3,) [px] if it is known, else the initial values."""
        return start if self.sensors is None else np.asarray(self.sensors[name].interior)


@dataclass(frozen=True)
class _Resected:
    """Exposures of one fluoroscope that fit the phantom, and findings on the others."""

    frames: list[Frame]
    resections: list[Resection]
    interior: NDArray[np.float64]
    excluded: list[Finding]
    untilted: bool = False


def nominal_interior(
    image_size: tuple[int, int], principal_distance: float
) -> NDArray[np.float64]:
    """Return the interior orientation (3,) [px] with the principal point at the image centre."""
    return np.array([(image_size[0] - 1) / 2, (image_size[1] - 1) / 2, principal_distance])


def measured_network(
    frames: Frames,
    phantom: Phantom,
    principal_distance: float | None = None,
    known: Known | None = None,
    starts: StartValues | None = None,
    sensors: Mapping[str, KnownSensor] | None = None,
) -> Measured:
    """Return the network of frames, with initial values for an adjustment.

    principal_distance: initial value [px]; by default it is found from the observations. known:
    orientations known beforehand, by fluoroscope. starts: used for a fluoroscope if it has initial
    values of all its exposures. sensors {fluoroscope: KnownSensor}: fixed interior orientations
    and corrections, with which one exposure is enough; by default these are to be calibrated.
    Raises DataError for invalid frames, too few exposures or targets, or a single common pose.
    """
    task = _Task(phantom, sensors, principal_distance, known or {}, starts)
    return _measured(
        task, {name: _resected(task, name, exposures) for name, exposures in frames.items()}
    )


def _measured(task: _Task, resected_views: Mapping[str, _Resected]) -> Measured:
    """Return the network of resected exposures {fluoroscope: _Resected}."""
    frames = [frame for resected in resected_views.values() for frame in resected.frames]
    resections = [
        resection for resected in resected_views.values() for resection in resected.resections
    ]
    fluoroscope = np.repeat(
        np.arange(len(resected_views)),
        [len(resected.frames) for resected in resected_views.values()],
    )
    network, target_id = _index(frames, fluoroscope, task, len(resected_views))
    if task.known:
        network = replace(network, exterior=_exterior_prior(task, frames))
    earlier = None if task.starts is None or task.sensors is not None else task.starts.earlier
    start = Parameters(
        np.array([resected.interior for resected in resected_views.values()]),
        np.array([resection.rotation for resection in resections]),
        np.array([resection.position_mm for resection in resections]),
        network.survey_mm.copy() if earlier is None else earlier.points(target_id),
    )
    sizes = tuple(resected.frames[0].image_size for resected in resected_views.values())
    excluded = tuple(
        finding for resected in resected_views.values() for finding in resected.excluded
    )
    untilted = tuple(resected.untilted for resected in resected_views.values())
    known = {name: task.known[name] for name in resected_views if name in task.known}
    return Measured(
        network=network,
        start=start,
        fluoroscopes=tuple(resected_views),
        image_size=sizes,
        frames=tuple(frames),
        target_id=target_id,
        excluded=excluded,
        untilted=untilted,
        known=known,
    )


def _exterior_prior(task: _Task, frames: Sequence[Frame]) -> ExteriorPrior:
    """Return the prior of the exterior orientations of exposures."""
    rotation = np.tile(np.eye(3), (len(frames), 1, 1))
    position = np.zeros((len(frames), 3))
    sd = np.full((len(frames), POSE_SIZE), np.inf)
    for row, frame in enumerate(frames):
        known = task.known.get(frame.fluoroscope)
        if known is not None:
            rotation[row] = known.rotation
            position[row] = known.position_mm
            sd[row] = np.repeat(known.exterior_sd or (RIGID_SD_MM, RIGID_SD_RAD), 3)
    return ExteriorPrior(rotation, position, sd)


def _resected(task: _Task, name: str, frames: Sequence[Frame]) -> _Resected:
    """Resect the exposures of one fluoroscope. Raises DataError."""
    ordered, excluded = _usable_frames(task, name, frames)
    untilted = False
    if name in task.known:
        resections, interior, misfits = _place_all(task, name, ordered)
    elif task.has_starts(name, ordered):
        resections, interior, misfits = _start_all(task, name, ordered)
    else:
        resections, interior, misfits = _resect_all(task, name, ordered)
    if task.sensors is None and name not in task.known:
        untilted = _are_untilted(task, ordered, resections)
        _require_determined(task, name, resections, untilted)
    excluded += misfits
    fitting = [
        (frame, resection)
        for frame, resection in zip(ordered, resections)
        if resection is not None
    ]
    needed = task.min_exposures(name, [frame for frame, _ in fitting], untilted)
    if len(fitting) < needed:
        if not misfits:
            raise DataError(_too_few(name, len(fitting), needed, excluded))
        raise DataError(
            f'only {len(fitting)} of {len(resections)} exposures fit the phantom, '
            f'{needed} are needed; the first that does not: {excluded[0]}',
            kind=excluded[0].kind,
            place=Place((name,), excluded[0].place.exposures, name=f'fluoroscope {name}'),
            numbers={'fitting': len(fitting), 'needed': needed},
        )
    return _Resected(
        [frame for frame, _ in fitting],
        [resection for _, resection in fitting],
        interior,
        excluded,
        untilted,
    )


def _place_all(
    task: _Task, name: str, frames: Sequence[Frame]
) -> tuple[list[Resection | None], NDArray[np.float64], list[Finding]]:
    """Use the known orientation for all frames of one fluoroscope; returns as `_resect_all`."""
    known = task.known[name]
    interior = task.interior(name, known.interior)
    pose = known.rotation, known.position_mm
    resections: list[Resection | None] = [
        resection_at(*pose, task.xyz(frame), task.uv(name, frame), interior) for frame in frames
    ]
    return resections, interior, _reject_poor_fits(frames, resections)


def _start_all(
    task: _Task, name: str, frames: Sequence[Frame]
) -> tuple[list[Resection | None], NDArray[np.float64], list[Finding]]:
    """Use the given initial values for the frames of one fluoroscope; returns as `_resect_all`."""
    assert task.starts is not None
    earlier = task.starts.earlier
    interior = task.interior(name, task.starts.interior[name])
    resections: list[Resection | None] = []
    for frame in frames:
        pose = task.starts.exterior[name, frame.number]
        xyz = task.xyz(frame)
        if task.sensors is None and earlier is not None:
            uv = frame.uv - earlier.series[name].predict(frame.uv)
            resections.append(resection_at(*pose, xyz, uv, interior))
        else:  # the sensor may have another gauge than the earlier adjustment
            resections.append(refine_resection(xyz, task.uv(name, frame), interior, *pose))
    return resections, interior, _reject_poor_fits(frames, resections)


def _are_untilted(
    task: _Task, frames: Sequence[Frame], resections: Sequence[Resection | None]
) -> bool:
    """Whether all exposures show flat targets parallel to the image."""
    for frame, resection in zip(frames, resections):
        if resection is None:
            continue
        xyz = task.xyz(frame)
        if not is_flat(xyz) or tilt_of(resection.rotation, plane_of(xyz)) > UNTILTED_RAD:
            return False
    return any(resection is not None for resection in resections)


def is_hardly_tilted(measured: Measured) -> bool:
    """Whether all targets are flat, and initially tilted less than advised."""
    survey = measured.network.survey_mm
    if not is_flat(survey):
        return False
    plane = plane_of(survey)
    return all(tilt_of(rotation, plane) < TILTED_RAD for rotation in measured.start.rotation)


def _require_determined(
    task: _Task, name: str, resections: Sequence[Resection | None], untilted: bool
) -> None:
    """Raise DataError if the poses do not determine the principal distance."""
    if not untilted:
        _require_different_poses(name, resections)
    elif task.principal_distance is None:
        raise DataError(replace(UNTILTED, place=Place((name,))))


def _usable_frames(
    task: _Task, name: str, frames: Sequence[Frame]
) -> tuple[list[Frame], list[Finding]]:
    """Return frames with enough targets, ordered by number, and findings on the others."""
    ordered: list[Frame] = []
    excluded: list[Finding] = []
    needed_targets = task.min_targets(name)
    for frame in sorted((f.sorted() for f in frames), key=lambda f: f.number):
        validate_frame(frame, task.phantom, frames[0].image_size)
        if ordered and ordered[-1].number == frame.number:
            raise DataError(f'fluoroscope {name}: exposure {frame.number} appears twice')
        count = len(frame.target_id)
        if count < needed_targets:
            excluded.append(
                Finding(
                    Kind.FEW_TARGETS,
                    f'{too_few(count, "target")}, {needed_targets} are needed',
                    frame.place,
                    severity=Severity.NOTE,
                    numbers={'targets': count, 'needed': needed_targets},
                )
            )
        else:
            ordered.append(frame)
    needed = task.min_exposures(name, ordered)
    if len(ordered) < needed:
        raise DataError(_too_few(name, len(ordered), needed, excluded))
    return ordered, excluded


def _too_few(name: str, count: int, needed: int, excluded: Sequence[Finding]) -> Finding:
    """Return the finding that a fluoroscope has too few exposures."""
    has = 'has' if len(excluded) == 1 else 'have'
    remark = f', {len(excluded)} more {has} too few targets' if excluded else ''
    return Finding(
        Kind.FEW_EXPOSURES,
        f'{too_few(count, "exposure")}, {needed} are needed{remark}',
        Place((name,)),
        numbers={'exposures': count, 'needed': needed, 'few_targets': len(excluded)},
    )


def _resect_all(
    task: _Task, name: str, frames: Sequence[Frame]
) -> tuple[list[Resection | None], NDArray[np.float64], list[Finding]]:
    """Resect the frames of one fluoroscope.

    Returns the resections, None for each failure; the interior orientation (3,); and a finding for
    each failure.
    """
    views = [view_of(frame, task.xyz(frame), task.uv(name, frame)) for frame in frames]
    excluded = [_not_oriented(view.frame, view.error) for view in views if view.error]
    if len(excluded) == len(views):
        raise DataError(excluded[0])
    if task.sensors is None:
        interior = _start_interior(task, name, [view for view in views if not view.error])
    else:
        interior = np.asarray(task.sensors[name].interior)
    resections: list[Resection | None] = []
    for view in views:
        try:
            resections.append(None if view.error else orient_view(view, interior))
        except DataError as error:
            resections.append(None)
            excluded.append(_not_oriented(view.frame, error.finding))
    if task.sensors is None:
        resections = settle_planes(views, resections, interior)
    excluded += _reject_poor_fits(frames, resections)
    return resections, interior, excluded


def _start_interior(task: _Task, name: str, views: Sequence[View]) -> NDArray[np.float64]:
    """Return the initial interior orientation (3,) [px]. Raises DataError."""
    size = views[0].frame.image_size
    middle = nominal_interior(size, 1.0)[:2]
    try:
        distance = task.principal_distance or principal_distance_of_views(views, middle, size)
    except DataError as error:
        raise DataError(replace(error.finding, place=Place((name,)))) from None
    return nominal_interior(size, distance)


def _reject_poor_fits(
    frames: Sequence[Frame], resections: list[Resection | None]
) -> list[Finding]:
    """Replace resections with too large residuals by None; return a finding for each."""
    scales = [resection.scale for resection in resections if resection is not None]
    typical = np.median(scales) if scales else np.inf
    out = []
    for row, (frame, resection) in enumerate(zip(frames, resections)):
        if resection is not None and resection.scale > MAX_MISFIT * typical:
            out.append(
                Finding(
                    Kind.POOR_FIT,
                    'the image points do not fit the phantom, their residuals are about '
                    f'{resection.scale:.0f} px',
                    frame.place,
                    severity=Severity.NOTE,
                    numbers={'residual_px': float(resection.scale)},
                )
            )
            resections[row] = None
    return out


def _not_oriented(frame: Frame, reason: Finding) -> Finding:
    """Return the reason why an exposure without orientation is excluded."""
    kind = Kind.NOT_ORIENTED if reason.kind is Kind.DATA else reason.kind
    return replace(reason, kind=kind, place=frame.place, severity=Severity.NOTE)


def _require_different_poses(name: str, resections: Sequence[Resection | None]) -> None:
    """Raise DataError if all exposures show the phantom in the same pose."""
    oriented = [resection for resection in resections if resection is not None]
    if len(oriented) < 2:
        return
    turn = max(
        rotation_angle(resection.rotation @ oriented[0].rotation.T) for resection in oriented
    )
    places = np.array([-resection.rotation @ resection.position_mm for resection in oriented])
    shift = np.max(np.abs(places - places[0]) / (1, 1, AXIAL_FACTOR))
    if turn < MIN_POSE_RAD and shift < MIN_POSE_SHIFT * np.median(np.abs(places[:, 2])):
        raise DataError(
            f'all {len(oriented)} exposures show the phantom in one pose (turned by at most '
            f'{np.rad2deg(turn):.1f} degrees); turn and move it between the exposures',
            kind=Kind.ONE_POSE,
            place=Place((name,)),
            numbers={'exposures': len(oriented), 'turn_deg': float(np.rad2deg(turn))},
        )


def _index(
    frames: Sequence[Frame], fluoroscope: NDArray[np.int64], task: _Task, n_fluoroscopes: int
) -> tuple[Network, NDArray[np.int64]]:
    """Return the network of frames, and the target ids (n,) of its object points."""
    counts = [len(frame.target_id) for frame in frames]
    rows = task.phantom.index(np.concatenate([frame.target_id for frame in frames]))
    used, point = np.unique(rows, return_inverse=True)
    sigma = [
        np.ones(len(frame.target_id)) if frame.sigma is None else frame.sigma for frame in frames
    ]
    network = Network(
        uv=np.concatenate([frame.uv for frame in frames]),
        sigma=np.concatenate(sigma),
        exposure=np.repeat(np.arange(len(frames)), counts),
        point=point,
        fluoroscope=fluoroscope,
        survey_mm=task.phantom.xyz_mm[used],
        survey_sd_mm=task.phantom.sd_mm[used],
        interior_free=np.full(n_fluoroscopes, task.sensors is None),
    )
    return network, task.phantom.target_id[used]
