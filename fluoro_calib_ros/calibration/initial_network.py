# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""From frames to a network: validation, start values and what has to be left out."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from ..distortion.priors import Prior
from ..distortion.series import Series
from ..errors import DataError
from ..exposures.frame import Frame, angles_of, validate_frame
from ..exposures.phantom import Phantom
from ..photogrammetry.exterior_prior import HELD_SD_MM, HELD_SD_RAD, ExteriorPrior
from ..photogrammetry.known_orientation import KnownOrientation
from ..photogrammetry.network import Network
from ..photogrammetry.noise import Noise
from ..photogrammetry.plane_resection import flatness, plane_of, tilt_of
from ..photogrammetry.resection import MIN_FLATNESS, Resection, refine_resection, resection_at
from ..photogrammetry.rotations import rotation_angle
from ..photogrammetry.unknowns import EXTERIOR_SIZE, Parameters
from .start_orientation import (
    UNTILTED,
    View,
    orient_view,
    principal_distance_of_views,
    settle_planes,
    view_of,
)

MIN_EXPOSURES = 3
MIN_TARGETS_OF_EXPOSURE = 12
# Of an exposure whose orientation is known.
MIN_TARGETS_OF_KNOWN = 1
# Flat targets that are tilted less in all exposures do not show the principal distance.
UNTILTED_RAD = np.deg2rad(5.0)
# Smaller differences of rotation and distance make two exposures show one pose of the phantom.
MIN_POSE_RAD = np.deg2rad(2.0)
MIN_POSE_MM = 20.0
# A distance along the optical axis is determined this many times worse than one across it.
AXIAL_FACTOR = 10.0
MAX_MISFIT = 8.0  # residuals of a resection relative to the median of the exposures

Frames = Mapping[str, Sequence[Frame]]  # by fluoroscope
Known = Mapping[str, KnownOrientation]  # by fluoroscope


@dataclass(frozen=True)
class Measured:
    """A network and what it was made from.

    Attributes
    ----------
    network : Network
    start : Parameters
        Start values.
    fluoroscopes : tuple of str
        Names, in the order of the network.
    image_size : tuple of (int, int)
        Width and height [px] by fluoroscope.
    frames : tuple of Frame
        The frame of every exposure of the network.
    target_id : (n,) ndarray of int
        Of the object points.
    left_out : tuple of str
        One sentence for every frame that was not used.
    untilted : tuple of bool
        By fluoroscope, whether all exposures show flat targets parallel to the image.
    known : mapping of str to KnownOrientation
        Orientations that are known beforehand, by fluoroscope.
    """

    network: Network
    start: Parameters
    fluoroscopes: tuple[str, ...]
    image_size: tuple[tuple[int, int], ...]
    frames: tuple[Frame, ...]
    target_id: np.ndarray
    left_out: tuple[str, ...]
    untilted: tuple[bool, ...] = ()
    known: Known = field(default_factory=dict)

    @property
    def angles(self) -> list[np.ndarray]:
        """Angles (e,) of the C-arm [rad] in the exposures of each fluoroscope; NaN: unknown."""
        network = self.network
        exposures = [
            np.unique(network.exposure[network.rows(f)]) for f in range(len(self.fluoroscopes))
        ]
        return [angles_of(self.frames[j] for j in own) for own in exposures]


@dataclass(frozen=True)
class KnownSensor:
    """A fluoroscope whose interior orientation (3,) [px] and correction are known.

    correction: of the n image points of a frame, (n, 2) [px].
    """

    interior: np.ndarray
    correction: Callable[[Frame], np.ndarray]


@dataclass(frozen=True)
class EarlierCalibration:
    """What a calibration with some exposures can take over from one with more of them.

    Attributes
    ----------
    series : mapping of str to Series
        Corrections by fluoroscope.
    varying : frozenset of str
        Fluoroscopes whose distortion differs between exposures.
    noise : Noise
    target_id : (n,) ndarray of int
        Targets with object points, ascending.
    points_mm : (n, 3) ndarray
    priors : dict of str to Prior
        Of the corrections by fluoroscope: those that the last of several such calibrations has
        found, with which the next one starts.
    """

    series: Mapping[str, Series]
    varying: frozenset[str]
    noise: Noise
    target_id: np.ndarray
    points_mm: np.ndarray
    priors: dict[str, Prior] = field(default_factory=dict)

    def points(self, target_id: np.ndarray) -> np.ndarray:
        """Object points (k, 3) [mm] of targets (k,)."""
        return self.points_mm[np.searchsorted(self.target_id, target_id)]


@dataclass(frozen=True)
class StartValues:
    """Start values from an earlier adjustment of the same exposures, instead of resections.

    Attributes
    ----------
    interior : mapping of str to (3,) ndarray
        xp, yp, c [px] by fluoroscope.
    exterior : mapping of (str, int) to ((3, 3) ndarray, (3,) ndarray)
        Rotation and position [mm] by fluoroscope and exposure.
    earlier : EarlierCalibration, optional
        That of the same exposures and others; the orientations are those with its corrections.
    """

    interior: Mapping[str, np.ndarray]
    exterior: Mapping[tuple[str, int], tuple[np.ndarray, np.ndarray]]
    earlier: EarlierCalibration | None = None


@dataclass(frozen=True)
class _Task:
    """What start values are made from; sensors None: the fluoroscopes are to be calibrated."""

    phantom: Phantom
    sensors: Mapping[str, KnownSensor] | None
    principal_distance: float | None
    known: Known
    raise_if_cancelled: Callable[[], None] | None
    starts: StartValues | None = None

    def has_starts(self, name: str, frames: Sequence[Frame]) -> bool:
        """Whether there are start values of all these exposures of a fluoroscope."""
        starts = self.starts
        return (
            starts is not None
            and name in starts.interior
            and all((name, frame.number) in starts.exterior for frame in frames)
        )

    def min_exposures(self, name: str, untilted: bool = True) -> int:
        """Number of exposures that a fluoroscope needs; untilted: of flat targets at rest."""
        if self.sensors is not None or name in self.known:
            return 1
        return 1 if untilted and self.principal_distance is not None else MIN_EXPOSURES

    def min_targets(self, name: str) -> int:
        """Number of targets that an exposure needs."""
        return MIN_TARGETS_OF_KNOWN if name in self.known else MIN_TARGETS_OF_EXPOSURE


@dataclass(frozen=True)
class _Resected:
    """Exposures of one fluoroscope that fit the phantom, and sentences on those that do not."""

    frames: list[Frame]
    resections: list[Resection]
    interior: np.ndarray
    left_out: list[str]
    untilted: bool = False


def nominal_interior(image_size: tuple[int, int], principal_distance: float) -> np.ndarray:
    """Interior orientation (3,) [px] with the principal point at the centre of the image."""
    return np.array([(image_size[0] - 1) / 2, (image_size[1] - 1) / 2, principal_distance])


def measured_network(
    frames: Frames,
    phantom: Phantom,
    principal_distance: float | None = None,
    raise_if_cancelled: Callable[[], None] | None = None,
    known: Known | None = None,
    starts: StartValues | None = None,
) -> Measured:
    """Return network and start values of the frames of fluoroscopes that are to be calibrated.

    Parameters
    ----------
    frames : mapping of str to sequence of Frame
    phantom : Phantom
    principal_distance : float, optional
        Start value [px]; by default it is taken from the observations.
    raise_if_cancelled : callable, optional
        Called for every exposure; may raise to stop.
    known : mapping of str to KnownOrientation, optional
        Orientations that are known beforehand, by fluoroscope.
    starts : StartValues, optional
        Used for a fluoroscope with start values of all its exposures.

    Returns
    -------
    Measured

    Raises
    ------
    DataError
        If a frame is invalid, if exposures or targets are too few, or if all exposures show one
        pose.
    """
    task = _Task(phantom, None, principal_distance, known or {}, raise_if_cancelled, starts)
    return _measured(
        task, {name: _resected(task, name, of_one) for name, of_one in frames.items()}
    )


def network_of_known_sensors(
    frames: Frames,
    phantom: Phantom,
    sensors: Mapping[str, KnownSensor],
    raise_if_cancelled: Callable[[], None] | None = None,
    known: Known | None = None,
    starts: StartValues | None = None,
) -> Measured:
    """Return network and start values with interior orientations and corrections held.

    One exposure of a fluoroscope is enough. The arguments and errors are those of
    `measured_network`; sensors {fluoroscope: KnownSensor}.
    """
    task = _Task(phantom, sensors, None, known or {}, raise_if_cancelled, starts)
    return _measured(
        task, {name: _resected(task, name, of_one) for name, of_one in frames.items()}
    )


def _measured(task: _Task, found: Mapping[str, _Resected]) -> Measured:
    """Return the network of resected exposures {fluoroscope: _Resected}."""
    frames = [frame for one in found.values() for frame in one.frames]
    resections = [resection for one in found.values() for resection in one.resections]
    fluoroscope = np.repeat(np.arange(len(found)), [len(one.frames) for one in found.values()])
    network, target_id = _index(frames, fluoroscope, task, len(found))
    if task.known:
        network = replace(network, exterior=_exterior_prior(task, frames))
    earlier = None if task.starts is None or task.sensors is not None else task.starts.earlier
    start = Parameters(
        np.array([one.interior for one in found.values()]),
        np.array([resection.rotation for resection in resections]),
        np.array([resection.position_mm for resection in resections]),
        network.survey_mm.copy() if earlier is None else earlier.points(target_id),
    )
    sizes = tuple(one.frames[0].image_size for one in found.values())
    left_out = tuple(sentence for one in found.values() for sentence in one.left_out)
    untilted = tuple(one.untilted for one in found.values())
    known = {name: task.known[name] for name in found if name in task.known}
    return Measured(
        network, start, tuple(found), sizes, tuple(frames), target_id, left_out, untilted, known
    )


def _exterior_prior(task: _Task, frames: Sequence[Frame]) -> ExteriorPrior:
    """What is known of the exterior orientations of exposures."""
    rotation = np.tile(np.eye(3), (len(frames), 1, 1))
    position = np.zeros((len(frames), 3))
    sd = np.full((len(frames), EXTERIOR_SIZE), np.inf)
    for row, frame in enumerate(frames):
        known = task.known.get(frame.fluoroscope)
        if known is not None:
            rotation[row] = known.rotation
            position[row] = known.position_mm
            sd[row] = np.repeat(known.exterior_sd or (HELD_SD_MM, HELD_SD_RAD), 3)
    return ExteriorPrior(rotation, position, sd)


def _resected(task: _Task, name: str, frames: Sequence[Frame]) -> _Resected:
    """Resect the exposures of one fluoroscope. Raises DataError."""
    ordered, left_out = _usable_frames(task, name, frames)
    untilted = False
    if name in task.known:
        found, interior, misfits = _place_all(task, name, ordered)
    elif task.has_starts(name, ordered):
        found, interior, misfits = _start_all(task, name, ordered)
    else:
        found, interior, misfits = _resect_all(task, name, ordered)
    if task.sensors is None and name not in task.known:
        untilted = _are_untilted(task, ordered, found)
        _require_determined(task, name, found, untilted)
    left_out += misfits
    fitting = [(frame, one) for frame, one in zip(ordered, found) if one is not None]
    needed = task.min_exposures(name, untilted)
    if len(fitting) < needed:
        if not misfits:
            raise DataError(f'fluoroscope {name}: {_too_few(len(fitting), needed, left_out)}')
        raise DataError(
            f'fluoroscope {name}: only {len(fitting)} of {len(found)} exposures fit the phantom, '
            f'{needed} are needed; the first that does not: {left_out[0]}'
        )
    return _Resected(
        [frame for frame, _ in fitting],
        [one for _, one in fitting],
        interior,
        left_out,
        untilted,
    )


def _no_correction(frame: Frame) -> np.ndarray:
    return np.zeros_like(frame.uv)


def _place_all(
    task: _Task, name: str, frames: Sequence[Frame]
) -> tuple[list[Resection | None], np.ndarray, list[str]]:
    """Known orientations of the frames of one fluoroscope; returns as _resect_all."""
    known = task.known[name]
    sensor = None if task.sensors is None else task.sensors[name]
    correction = _no_correction if sensor is None else sensor.correction
    interior = known.interior if sensor is None else np.asarray(sensor.interior)
    found: list[Resection | None] = []
    for frame in frames:
        xyz = task.phantom.xyz_mm[task.phantom.index(frame.target_id)]
        found.append(
            resection_at(
                known.rotation, known.position_mm, xyz, frame.uv - correction(frame), interior
            )
        )
    return found, interior, _reject_misfits(frames, found)


def _start_all(
    task: _Task, name: str, frames: Sequence[Frame]
) -> tuple[list[Resection | None], np.ndarray, list[str]]:
    """Start values that are given for the frames of one fluoroscope; returns as _resect_all."""
    assert task.starts is not None
    sensor = None if task.sensors is None else task.sensors[name]
    earlier = task.starts.earlier
    correction = _no_correction if sensor is None else sensor.correction
    interior = task.starts.interior[name] if sensor is None else np.asarray(sensor.interior)
    found: list[Resection | None] = []
    for frame in frames:
        rotation, position = task.starts.exterior[name, frame.number]
        xyz = task.phantom.xyz_mm[task.phantom.index(frame.target_id)]
        if sensor is None and earlier is not None:
            uv = frame.uv - earlier.series[name].predict(frame.uv)
            found.append(resection_at(rotation, position, xyz, uv, interior))
            continue
        # The sensor may have another gauge than that of the earlier adjustment.
        found.append(
            refine_resection(xyz, frame.uv - correction(frame), interior, rotation, position)
        )
    return found, interior, _reject_misfits(frames, found)


def _are_untilted(task: _Task, frames: Sequence[Frame], found: Sequence[Resection | None]) -> bool:
    """Whether all exposures show flat targets that are parallel to the image."""
    for frame, one in zip(frames, found):
        if one is None:
            continue
        xyz = task.phantom.xyz_mm[task.phantom.index(frame.target_id)]
        if flatness(xyz) >= MIN_FLATNESS or tilt_of(one.rotation, plane_of(xyz)) > UNTILTED_RAD:
            return False
    return any(one is not None for one in found)


def _require_determined(
    task: _Task, name: str, found: Sequence[Resection | None], untilted: bool
) -> None:
    """Raise DataError where poses determine no principal distance."""
    if not untilted:
        _require_different_poses(name, found)
    elif task.principal_distance is None:
        raise DataError(f'fluoroscope {name}: {UNTILTED}')


def _usable_frames(
    task: _Task, name: str, frames: Sequence[Frame]
) -> tuple[list[Frame], list[str]]:
    """Frames with enough targets, ordered by number, and a sentence for each of the others."""
    ordered: list[Frame] = []
    left_out: list[str] = []
    for frame in sorted((f.sorted() for f in frames), key=lambda f: f.number):
        validate_frame(frame, task.phantom, frames[0].image_size)
        if ordered and ordered[-1].number == frame.number:
            raise DataError(f'fluoroscope {name}: exposure {frame.number} appears twice')
        if len(frame.target_id) < task.min_targets(name):
            left_out.append(
                f'fluoroscope {name}, exposure {frame.number}: {len(frame.target_id)} targets are '
                f'too few, {task.min_targets(name)} are needed'
            )
        else:
            ordered.append(frame)
    needed = task.min_exposures(name)
    if len(ordered) < needed:
        raise DataError(f'fluoroscope {name}: {_too_few(len(ordered), needed, left_out)}')
    return ordered, left_out


def _too_few(count: int, needed: int, left_out: Sequence[str]) -> str:
    """Say that exposures are too few."""
    few = f', {len(left_out)} more have too few targets' if left_out else ''
    return f'{count} exposures are too few, {needed} are needed{few}'


def _resect_all(
    task: _Task, name: str, frames: Sequence[Frame]
) -> tuple[list[Resection | None], np.ndarray, list[str]]:
    """Resections of the frames of one fluoroscope.

    Returns them, None where one fails; the interior orientation (3,); and a sentence for every
    failure.
    """
    sensor = None if task.sensors is None else task.sensors[name]
    correction = _no_correction if sensor is None else sensor.correction
    views = []
    for frame in frames:
        if task.raise_if_cancelled is not None:
            task.raise_if_cancelled()
        xyz = task.phantom.xyz_mm[task.phantom.index(frame.target_id)]
        views.append(view_of(frame, xyz, frame.uv - correction(frame)))
    sentences = [f'{_exposure(view.frame)}: {view.error}' for view in views if view.error]
    if len(sentences) == len(views):
        raise DataError(sentences[0])
    if sensor is None:
        interior = _start_interior(task, name, [view for view in views if not view.error])
    else:
        interior = np.asarray(sensor.interior)
    found: list[Resection | None] = []
    for view in views:
        try:
            found.append(None if view.error else orient_view(view, interior))
        except DataError as error:
            found.append(None)
            sentences.append(f'{_exposure(view.frame)}: {error}')
    if sensor is None:
        found = settle_planes(views, found, interior)
    sentences += _reject_misfits(frames, found)
    return found, interior, sentences


def _start_interior(task: _Task, name: str, views: Sequence[View]) -> np.ndarray:
    """Start values (3,) [px] of the interior orientation. Raises DataError."""
    size = views[0].frame.image_size
    middle = nominal_interior(size, 1.0)[:2]
    try:
        distance = task.principal_distance or principal_distance_of_views(views, middle, size)
    except DataError as error:
        raise DataError(f'fluoroscope {name}: {error}') from None
    return nominal_interior(size, distance)


def _reject_misfits(frames: Sequence[Frame], found: list[Resection | None]) -> list[str]:
    """Set resections to None whose residuals are too large; return a sentence for each."""
    scales = [one.scale for one in found if one is not None]
    typical = np.median(scales) if scales else np.inf
    sentences = []
    for row, (frame, one) in enumerate(zip(frames, found)):
        if one is not None and one.scale > MAX_MISFIT * typical:
            sentences.append(
                f'{_exposure(frame)}: the image points do not fit the phantom, their residuals '
                f'are about {one.scale:.0f} px'
            )
            found[row] = None
    return sentences


def _exposure(frame: Frame) -> str:
    """Name of an exposure in a sentence."""
    return f'fluoroscope {frame.fluoroscope}, exposure {frame.number}'


def _require_different_poses(name: str, resections: Sequence[Resection | None]) -> None:
    """Raise DataError where all exposures show the phantom in one pose."""
    found = [one for one in resections if one is not None]
    if len(found) < 2:
        return
    turn = max(rotation_angle(one.rotation @ found[0].rotation.T) for one in found)
    places = np.array([-one.rotation @ one.position_mm for one in found])
    shift = np.max(np.abs(places - places[0]) / (1, 1, AXIAL_FACTOR))
    if turn < MIN_POSE_RAD and shift < MIN_POSE_MM:
        raise DataError(
            f'fluoroscope {name}: all {len(found)} exposures show the phantom in one pose (turned '
            f'by at most {np.rad2deg(turn):.1f} degrees); turn and move it between the exposures'
        )


def _index(
    frames: Sequence[Frame], fluoroscope: np.ndarray, task: _Task, n_fluoroscopes: int
) -> tuple[Network, np.ndarray]:
    """The network of frames, and the target ids (n,) of its object points."""
    counts = [len(frame.target_id) for frame in frames]
    rows = task.phantom.index(np.concatenate([frame.target_id for frame in frames]))
    used, point = np.unique(rows, return_inverse=True)
    sigma = [
        np.ones(len(frame.target_id)) if frame.sigma is None else frame.sigma for frame in frames
    ]
    network = Network(
        np.concatenate([frame.uv for frame in frames]),
        np.concatenate(sigma),
        np.repeat(np.arange(len(frames)), counts),
        point,
        fluoroscope,
        task.phantom.xyz_mm[used],
        task.phantom.sd_mm[used],
        np.full(n_fluoroscopes, task.sensors is None),
    )
    return network, task.phantom.target_id[used]
