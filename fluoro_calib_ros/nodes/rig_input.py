# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Received orientations of the rig, and the tracking of bodies and joints in it."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from fluoro_calib_msgs.msg import RigOrientation
from numpy.typing import NDArray

from ..bodies.body import Body, solvable_bodies
from ..bodies.tracking import BodyTracker, JointTracker, TrackedExposure, poses_of, twists_of
from ..checks.rig_watch import RigDriftWatch
from ..errors import DataError, ErrorsAt
from ..exposures.stamps import Order, StampOrder
from ..findings import Severity
from ..io.bodies import JointEntry, read_bodies, read_joints
from ..io.calibration import load_orientation, orientation_path
from ..io.versions import calibrated_orientation
from ..options import option
from ..photogrammetry import rig_orientation
from ..photogrammetry.noise import ObservedScatter
from ..reconstruction.intersection import Intersector
from ..reconstruction.reconstruct import IntersectedViews
from .drift_monitor import DriftMonitor
from .messages.bodies import BodiesContent
from .messages.rig_orientation import (
    description_of,
    jump_text,
    message_from_orientation,
    orientation_from_message,
)
from .runtime.diagnostics import Logger, RefusalLog
from .runtime.parameters import expand_path

MAX_ORIENTATIONS = 4  # as frames of the previous calibrations may still arrive


class Rig(NamedTuple):
    """Received orientation, its intersector, observed scatter, and drift watch, if any."""

    orientation_id: str
    orientation: rig_orientation.RigOrientation
    intersector: Intersector
    scatter: ObservedScatter
    watch: RigDriftWatch | None

    @property
    def is_doubtful(self) -> bool:
        """Whether rays miss each other by more than expected, or the drift watch has an alarm."""
        has_drifted = self.watch is not None and self.watch.state.level > Severity.NOTE
        return has_drifted or self.scatter.factor > 1

    def widened(self) -> tuple[Intersector, float]:
        """Return the intersector and the increase of sigma [px], widened after a drift alarm."""
        watch = self.watch
        return (self.intersector, 0.0) if watch is None else watch.widened(self.intersector)


class RigInput:
    """The last orientations, by the calibrations that they belong to.

    The executor's thread replaces them as a whole, and the thread of the streams reads them.

    names: fluoroscopes. reject: epipolar distance above which image points do not belong together
    [standard deviations].
    """

    def __init__(
        self,
        names: Sequence[str],
        reject: float,
        drift: DriftMonitor,
        *,
        refusals: RefusalLog,
        logger: Logger,
    ) -> None:
        self._names = names
        self._reject = reject
        self._drift = drift
        self._refusals = refusals
        self._logger = logger
        # By calibration ids, oldest first; replaced as a whole.
        self._rigs: dict[tuple[str | None, ...], Rig] = {}
        self._calibrated: rig_orientation.RigOrientation | None = None  # before healing

    @property
    def calibrated(self) -> rig_orientation.RigOrientation | None:
        """Orientation from which the newest one was healed, None if the newest is not healed."""
        rig, orientation = self.newest, self._calibrated
        if rig is None or orientation is None or rig.orientation.source != 'healing':
            return None
        return orientation if orientation.frame_id == rig.orientation.frame_id else None

    @property
    def correction(self) -> str:
        """How far the newest orientation differs from the one before healing, as text."""
        rig, calibrated = self.newest, self.calibrated
        return '' if rig is None or calibrated is None else jump_text(calibrated, rig.orientation)

    @property
    def newest(self) -> Rig | None:
        """The rig of the last received orientation."""
        return next(reversed(self._rigs.values()), None)

    def camera_of(self, name: str) -> tuple[str, NDArray[np.float64] | None]:
        """Return optical frame and interior orientation (3,) in the newest rig, or '' and None."""
        rig = self.newest
        if rig is None:
            return '', None
        index = rig.orientation.fluoroscopes.index(name)
        return rig.orientation.optical_frame_ids[index], rig.orientation.interior[index]

    def rig_of(self, calibration_ids: Mapping[str, str]) -> Rig | None:
        """Return the newest rig that matches the calibration ids of some views, by fluoroscope."""
        rigs = self._rigs
        ids = tuple(calibration_ids.get(name) for name in self._names)
        if len(calibration_ids) == len(ids):
            return rigs.get(ids)
        for known_ids, rig in reversed(rigs.items()):
            if all(
                calibration_id in (None, known_id)
                for calibration_id, known_id in zip(ids, known_ids)
            ):
                return rig
        return None

    def add(self, message: RigOrientation) -> bool:
        """Use an orientation from now on; return False if it is refused.

        A known orientation, which is received again if its publisher restarts, keeps its watch: a
        new watch would take a drift for the reference.
        """
        try:
            orientation = orientation_from_message(message).subset(self._names)
            ids = orientation.calibration_ids
            known = self._rigs.get(ids)
            if known is not None and known.orientation_id == message.orientation_id:
                self._rigs = {**{i: rig for i, rig in self._rigs.items() if i != ids}, ids: known}
                return True
            rig = Rig(
                message.orientation_id,
                orientation,
                Intersector(orientation, self._reject),
                ObservedScatter(),
                self._drift.make_watch(orientation),
            )
        except ValueError as error:  # DataError among them
            self._refusals.last_fault = str(error)
            self._logger.error(f'orientation refused, the current one stays in use: {error}')
            return False
        jump = '' if self.newest is None else jump_text(self.newest.orientation, orientation)
        if jump:
            self._logger.warning(f'the transforms of the rig jump: {jump}')
        newest = list(self._rigs.items())[-(MAX_ORIENTATIONS - 1) :]
        self._rigs = {**{i: old for i, old in newest if i != ids}, ids: rig}
        self._logger.info(f'{description_of(message)}, in use')
        return True

    def use_calibrated(self, message: RigOrientation) -> None:
        """Store the orientation from which the newest one was healed, unless it is refused."""
        try:
            self._calibrated = orientation_from_message(message).subset(self._names)
        except ValueError as error:  # DataError among them
            self._logger.error(f'orientation as calibrated refused: {error}')

    def saved(self, file: str, folder: str) -> RigOrientation | None:
        """Return the orientation of a file, else of a folder, or None if there is none."""
        try:
            path = file
            if not path and folder:
                saved_path = orientation_path(expand_path(folder))
                path = saved_path if Path(saved_path).exists() else ''
            if not path:
                return None
            orientation = load_orientation(path)
            if folder:
                self._calibrated = calibrated_orientation(expand_path(folder), orientation)
            return message_from_orientation(orientation)
        except DataError as error:
            self._logger.error(str(error))
            self._refusals.last_fault = str(error)
            return None

    def use_reject(self, reject: float) -> None:
        """Use another rejection limit from now on."""
        self._reject = reject
        self._rigs = {
            ids: rig._replace(intersector=Intersector(rig.orientation, reject))
            for ids, rig in self._rigs.items()
        }

    def renew_watches(self) -> None:
        """Restart all drift watches."""
        if any(rig.watch is not None for rig in self._rigs.values()):
            self._logger.warning(
                'the drift watch starts anew: its reference is learned again, and an alarm ends'
            )
        try:
            self._rigs = {
                ids: rig._replace(watch=self._drift.make_watch(rig.orientation))
                for ids, rig in self._rigs.items()
            }
        except ValueError as error:  # DataError among them
            self._refusals.last_fault = f'no drift watch: {error}'
            self._logger.error(self._refusals.last_fault)


# A body's name is part of topic names, and the name of a TF frame.
BODY_NAME = re.compile('[A-Za-z][A-Za-z0-9_]*')
FORGETTING = 0.01  # weight of the newest exposure in the mean misfit and share of rejections


@dataclass(frozen=True)
class BodyParameters:
    """Parameters of bodies and joints."""

    bodies: str = option(
        '', 'bodies.csv: rigid bodies and their markers, whose poses are published; empty: none'
    )
    joints: str = option('', 'joints.toml: joints between these bodies; empty: none')
    body_lag: int = option(
        0,
        'exposures after which a pose is published, smoothed by those that came meanwhile',
        minimum=0,
        maximum=100,
        unit='exposures',
    )

    def __post_init__(self) -> None:
        if self.joints and not self.bodies:
            raise ValueError('joints: the parameter bodies, which they are between, is not set')


def read_body_files(
    parameters: BodyParameters, rig_frame: str = ''
) -> tuple[tuple[Body, ...], tuple[JointEntry, ...]]:
    """Return the bodies and joints of files. Raises DataError that names the file.

    rig_frame: name of the parent frame, which no body can have.
    """
    if not parameters.bodies:
        return (), ()
    path = expand_path(parameters.bodies)
    bodies = read_bodies(path)
    with ErrorsAt(path):
        bodies = solvable_bodies(bodies)
        for body in bodies:
            if not BODY_NAME.fullmatch(body.name):
                raise DataError(
                    f'body {body.name!r}: a name in topics has letters, digits and _, and begins '
                    'with a letter'
                )
            if body.name == rig_frame:
                raise DataError(
                    f'body {body.name}: it is a frame in TF, whose parent rig_frame has this name'
                )
    if not parameters.joints:
        return bodies, ()
    path = expand_path(parameters.joints)
    joints = read_joints(path, bodies)
    with ErrorsAt(path):
        for entry in joints:
            JointTracker(entry.joint, entry.neutral)
    return bodies, joints


class BodiesState(NamedTuple):
    """State of B bodies in the last published exposure."""

    stamp_ns: int
    #: (B,)
    status: NDArray[np.uint8]
    markers: NDArray[np.int64]
    #: (B,) stamp of the last exposure that shows each body [ns]; -1 if none does
    seen_ns: NDArray[np.int64]
    #: (B,) mean of chi-squared over its expectation, of about the last 100 exposures; NaN if none
    misfit: NDArray[np.float64]
    rejected: NDArray[np.float64]  #: (B, M) share of them in which each marker was excluded


class BodyFollower:
    """Follows bodies and joints through the exposures of a stream.

    The stream's thread adds exposures; the executor's reads `state`, which is replaced as a whole.
    """

    def __init__(self, bodies: Sequence[Body], joints: Sequence[JointEntry], lag: int) -> None:
        self.bodies = tuple(bodies)
        self._entries = tuple(joints)
        self._lag = lag
        self._begin()
        self.untimed = 0  #: number of skipped exposures, which are not later than the one before
        self._rig: Rig | None = None
        self._tracker: BodyTracker | None = None
        self._order = StampOrder()

    def add(
        self, exposure: IntersectedViews, rig: Rig, number: int, stamp_ns: int
    ) -> list[BodiesContent]:
        """Add an exposure; return the contents of the exposures that are now ready for output.

        A new tracker is started if the orientation or the rejection limit changes. So it is if the
        stamps restart, as if a recording is played again.
        """
        order = self._order.add(stamp_ns)
        begins_anew = order is Order.RESTART
        out = []
        if self._tracker is None or begins_anew or not self._is_same(rig):
            out = self.flush()
            self._tracker = BodyTracker(
                rig.orientation, self.bodies, rig.intersector.reject or np.inf, self._lag
            )
            if begins_anew:
                self._begin()
        self._tracker.use(rig.intersector.orientation)
        self._rig = rig
        self.untimed += order is Order.LATE
        tracked = self._tracker.add(exposure, number, stamp_ns)
        return out if tracked is None else [*out, self._content(tracked)]

    def _is_same(self, rig: Rig) -> bool:
        """Return whether the tracker matches a rig."""
        current = self._rig
        return current is not None and (current.orientation_id, current.intersector.reject) == (
            rig.orientation_id,
            rig.intersector.reject,
        )

    def _begin(self) -> None:
        """Set the state before the first exposure of a stream."""
        self.joints = [JointTracker(entry.joint, entry.neutral) for entry in self._entries]
        self.state: BodiesState | None = None  #: None before the first exposure
        self._squares = np.zeros((2, len(self.bodies)))  # chi-squared and expectation
        self._rejected = np.zeros((len(self.bodies), 1))

    def flush(self) -> list[BodiesContent]:
        """Return the contents of exposures that wait for later ones; the next is a new start."""
        tracker, self._tracker = self._tracker, None
        if tracker is None:
            return []
        return [self._content(exposure) for exposure in tracker.flush()]

    def _content(self, tracked: TrackedExposure) -> BodiesContent:
        """Return poses and joints of an exposure, and update the state."""
        assert self._rig is not None
        poses = poses_of(self.bodies, [tracked])
        by_name = {pose.body: pose for pose in poses}
        self._note(tracked)
        twist, twist_covariance = twists_of(self.bodies, tracked)
        return BodiesContent(
            stamp_ns=tracked.stamp_ns,
            frame_number=tracked.number,
            orientation_id=self._rig.orientation_id,
            orientation=self._rig.orientation,
            bodies=self.bodies,
            poses=poses,
            twist=twist,
            twist_covariance=twist_covariance,
            joints=[
                joint.add(by_name[joint.joint.proximal], by_name[joint.joint.distal])
                for joint in self.joints
            ],
            used=[
                body.target_id[used[: len(body.target_id)]]
                for body, used in zip(self.bodies, tracked.frame.used)
            ],
        )

    def _note(self, tracked: TrackedExposure) -> None:
        """Update the state with an exposure."""
        frame = tracked.frame
        known = frame.alone & (frame.freedom > 0)
        newest = np.where(known, [frame.chi2, frame.freedom], 0.0)
        self._squares = (1 - FORGETTING * known) * self._squares + FORGETTING * newest
        weight = FORGETTING * known[:, None]
        excluded = np.isfinite(frame.test) & ~frame.used
        self._rejected = (1 - weight) * self._rejected + weight * excluded
        before = np.full(len(self.bodies), -1) if self.state is None else self.state.seen_ns
        chi2, expected = self._squares
        markers = frame.markers
        self.state = BodiesState(
            tracked.stamp_ns,
            tracked.status,
            markers,
            seen_ns=np.where(markers > 0, tracked.stamp_ns, before),
            misfit=np.where(expected > 0, chi2 / np.where(expected > 0, expected, 1.0), np.nan),
            rejected=self._rejected,
        )
