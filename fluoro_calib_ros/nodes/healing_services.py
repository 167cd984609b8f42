# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The action heal of a calibration node, and the services that accept or roll back its outcome.

The calibration node has everything that healing needs: the observed image points before any
correction (which may have become wrong), and the calibrations and the orientation in use.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from fluoro_calib_msgs.action import Heal
from fluoro_calib_msgs.srv import Reset
from rclpy.action import CancelResponse
from rclpy.task import Future

from ..bodies.body import Body
from ..bodies.shapes import LearnedShapes
from ..correction.fluoroscope_calibration import FluoroscopeCalibration, ids_of
from ..errors import DataError
from ..exposures.frame import Frame, validate_frame
from ..io.versions import parent_folder, version_folder
from ..jobs.healing import HealingOptions, HealingOutcome, heal_rig
from ..jobs.learning import learned_for
from ..jobs.result_folder import save_calibrations, save_healed_version
from ..photogrammetry.rig_orientation import RigOrientation
from ..processes import in_worker_process
from .calibration_services import Job
from .calibration_settings import MAX_HEAL_S, check_folders
from .capture_services import NodeParts
from .messages.observations import ObservedFrame, frame_from_observed
from .messages.self_calibration import fill_healing
from .runtime.services import telling_service, wake, within

MAX_FRAMES = 20_000  # maximum number collected per fluoroscope, whatever its rate
PAUSE_S = 1.0  # longest interval between frames that counts as time in which markers are seen
CHANGED = 'the rig in use has changed meanwhile, heal it again'


class _Rig(NamedTuple):
    """Rig that is to be healed."""

    learned: LearnedShapes
    calibrations: dict[str, FluoroscopeCalibration]
    orientation: RigOrientation


class MarkerCollection:
    """Frames with markers of bodies, collected in the thread of the streams until finish().

    seconds: stream time with visible markers after which a fluoroscope has enough frames.
    """

    def __init__(
        self,
        bodies: Sequence[Body],
        calibrations: Mapping[str, FluoroscopeCalibration],
        seconds: float = np.inf,
    ) -> None:
        self.frames: dict[str, list[Frame]] = {}
        self.refused: deque[str] = deque(maxlen=1)  # why the last invalid frame was excluded
        self.done = Future()
        self._calibrations = calibrations
        self._markers = np.concatenate([body.target_id for body in bodies])
        self._seconds = seconds
        self._seen_s = dict.fromkeys(calibrations, 0.0)
        self._lock = threading.Lock()

    @property
    def count(self) -> int:
        """Number of frames of all fluoroscopes."""
        return sum(map(len, list(self.frames.values())))

    @property
    def seen_s(self) -> float:
        """Time for which every fluoroscope has seen markers [s]."""
        return min(self._seen_s.values())

    @property
    def is_complete(self) -> bool:
        """Whether all fluoroscopes have enough frames."""
        return all(map(self._is_full, self._calibrations))

    def _is_full(self, name: str) -> bool:
        return self._seen_s[name] >= self._seconds or len(self.frames.get(name, ())) >= MAX_FRAMES

    def add(self, name: str, observed: ObservedFrame, angle: float | None) -> None:
        """Add a valid frame that shows markers of the bodies, without its other targets."""
        calibration = self._calibrations.get(name)
        if calibration is None or self._is_full(name):
            return
        try:
            frame = frame_from_observed(observed, name, angle).sorted()
            validate_frame(frame, image_size=calibration.image_size)
        except DataError as error:
            self.refused.append(str(error))
            return
        seen = np.isin(frame.target_id, self._markers)
        if not seen.any():
            return
        with self._lock:
            if self.done.done():
                return
            frames = self.frames.setdefault(name, [])
            elapsed_s = (frame.stamp_ns - frames[-1].stamp_ns) / 1e9 if frames else 0.0
            self._seen_s[name] += elapsed_s if 0 < elapsed_s <= PAUSE_S else 0.0
            frames.append(frame.rows(seen))

    def finish(self) -> None:
        """End the collection once: after its time, a cancellation, or the end of the node."""
        with self._lock:
            if not self.done.done():
                self.done.set_result(None)


class Healing(Job):
    """The action heal; keeps its outcome until it is accepted."""

    kind = Heal
    action = 'heal'
    title = 'healing'

    def __init__(self, parts: NodeParts) -> None:
        super().__init__(parts)
        self._collection: MarkerCollection | None = None
        self._healed: tuple[HealingOutcome, _Rig] | None = None  # waits to be accepted
        self.services = (
            telling_service(
                'accept_healing', Reset, 'not accepted', lambda _: self._accept(), self._logger
            ),
            telling_service(
                'roll_back_healing', Reset, 'not rolled back', self._roll_back, self._logger
            ),
        )

    def add(self, name: str, observed: ObservedFrame, angle: Callable[[], float | None]) -> None:
        """Give a frame to the collection, if any. Called in the thread of the streams."""
        collection = self._collection
        if collection is not None:
            collection.add(name, observed, angle())

    def stop(self) -> None:
        """Cancel the running job and all later ones."""
        super().stop()
        if self._collection is not None:
            self._collection.finish()

    # -- the action

    def _on_cancel(self, goal: Any) -> CancelResponse:
        """Accept a cancellation, and end a running collection of frames at once."""
        if self._collection is not None:
            self._collection.finish()
        return CancelResponse.ACCEPT

    async def _work(self, goal: Any, result: Any) -> None:
        """Collect frames, diagnose what has changed, and keep the outcome."""
        seconds = goal.request.seconds or self._rig.settings().node.heal_time
        if not 0 < seconds <= MAX_HEAL_S:
            raise DataError(f'seconds must be above 0 and at most {MAX_HEAL_S:g}, not {seconds:g}')
        rig = self._present_rig()
        self._healed = None

        frames = await self._collected(goal, rig, seconds)
        self._raise_if_cancelled(goal.is_cancel_requested)
        if not frames:
            raise DataError(f'no frame with a marker of a body came within {seconds:g} s')
        pairing = self._rig.settings().pairing
        options = HealingOptions(pairing.pair_by, pairing.tolerance_s)
        count = sum(map(len, frames.values()))

        def progress(step: int, steps: int) -> None:
            goal.publish_feedback(
                Heal.Feedback(stage='diagnosing', frames=count, step=step, steps=steps)
            )

        rig_to_heal = frames, rig.calibrations, rig.orientation, rig.learned.bodies
        work = partial(in_worker_process, heal_rig, *rig_to_heal, options, progress=progress)
        outcome = await self._start(work, lambda: goal.is_cancel_requested)
        self._check_unchanged(rig)
        fill_healing(result, outcome, rig.orientation)
        self._logger.info(result.message)
        if outcome.healed is not None:
            self._healed = outcome, rig
            if self._rig.settings().node.heal_accept and outcome.verdict == 'pass':
                result.message += f'; {self._accept()}'

    async def _collected(self, goal: Any, rig: _Rig, seconds: float) -> dict[str, list[Frame]]:
        """Return the frames of the next seconds, fewer if the goal is cancelled."""
        collection = MarkerCollection(rig.learned.bodies, rig.calibrations)

        def publish() -> None:
            goal.publish_feedback(Heal.Feedback(stage='collecting', frames=collection.count))

        publish()
        timer = self._node.create_timer(0.5, publish)
        self._collection = collection
        try:
            await within(self._node, seconds, collection.done, collection.finish)
        finally:
            self._collection = None
            self._node.destroy_timer(timer)
        for reason in collection.refused:
            self._logger.warning(
                f'invalid frames are not used for healing, the last one: {reason}'
            )
        return collection.frames

    def _present_rig(self) -> _Rig:
        """Return the rig to be healed. Raises DataError if something is missing."""
        self._node.check_active()
        calibrations = self._output.all_calibrations()
        if self._output.orientation is None:
            raise DataError('the rig is not oriented yet')
        learned = learned_for(self._rig.directory, self._output.orientation)
        return _Rig(learned, calibrations, self._output.orientation)

    def _check_unchanged(self, rig: _Rig) -> None:
        """Raise DataError if the rig in use is no longer the one that was healed."""
        if rig.orientation is not self._output.orientation or ids_of(rig.calibrations) != ids_of(
            self._output.calibrations
        ):
            raise DataError(CHANGED)

    # -- versions

    def _accept(self) -> str:
        """Save, use and publish the healed rig; return a message. Raises DataError."""
        if self._healed is None:
            raise DataError('there is no healed rig to accept')
        outcome, rig = self._healed
        if outcome.verdict != 'pass':
            reasons = [check.sentence for check in outcome.checks if not check.passed]
            raise DataError(
                f'the verdict on the healed rig is {outcome.verdict}: {"; ".join(reasons)}'
            )
        self._check_unchanged(rig)
        directory = self._rig.directory
        limit = self._rig.settings().limits.max_folders
        for orientation in (rig.orientation, outcome.orientation):
            check_folders(version_folder(directory, orientation.orientation_id), directory, limit)
        save_healed_version(
            directory, outcome, rig.calibrations, rig.orientation, learned=rig.learned
        )
        self._use(outcome.calibrations, outcome.orientation)
        return (
            f'{outcome.orientation.orientation_id} accepted and in use, its parent is '
            f'{rig.orientation.orientation_id}'
        )

    def _roll_back(self, _: Reset.Request) -> str:
        """Return to the parent of the healed rig in use; return a message. Raises DataError."""
        directory = self._rig.directory
        healed_orientation = self._output.orientation
        folder = parent_folder(directory, healed_orientation)
        calibrations, orientation = self._files.load(folder)
        if orientation is None:
            raise DataError(f'{folder}: there is no orientation that belongs to the calibrations')
        save_calibrations(directory, {**self._output.calibrations, **calibrations}, orientation)
        self._use(calibrations, orientation)
        return f'{orientation.orientation_id} is in use again'

    def _use(
        self, calibrations: Mapping[str, FluoroscopeCalibration], orientation: RigOrientation
    ) -> None:
        """Publish the orientation, and those calibrations that are not in use yet."""
        self._healed = None
        current_ids = ids_of(self._output.calibrations)
        new_calibrations = {
            n: c for n, c in calibrations.items() if c.calibration_id != current_ids.get(n)
        }
        self._output.publish(new_calibrations, orientation)
        wake(self._node)
