# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Learning of body shapes by a calibration node while the rig is healthy, for the action heal.

Once a second the next step is taken: frames of markers are collected in the thread of the streams,
and shapes are estimated from them in a separate process.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from fluoro_calib_msgs.msg import DriftStatus
from rclpy.task import Future

from ..bodies.shapes import LearnedShapes
from ..errors import DataError, ErrorsAt
from ..io.bodies import read_bodies
from ..io.versions import has_drift_alarm, write_drift_alarm, write_learned_shapes
from ..jobs.bodies import BodiesOptions
from ..jobs.learning import DRIFTED, learn_shapes, learned_for
from ..jobs.result_folder import belongs_to
from ..photogrammetry.rig_orientation import RigOrientation
from ..processes import in_worker_process
from .capture_services import NodeParts, RigServices
from .healing_services import MarkerCollection
from .messages.observations import ObservedFrame
from .runtime.diagnostics import OK, WARN, Health, Status
from .runtime.parameters import expand_path
from .runtime.services import Cancelled

DRIFT = 'the drift watch has given an alarm: no shapes are learned before the next calibration'


class ShapeLearning(RigServices):
    """Learns shapes once for each orientation that is not healed, before any drift alarm."""

    services = ()

    def __init__(self, parts: NodeParts) -> None:
        super().__init__(parts)
        path = self._rig.settings().node.learn_bodies
        with ErrorsAt('learn_bodies'):
            self._bodies = read_bodies(expand_path(path)) if path else ()
        self._orientation: RigOrientation | None = None  # orientation in use while learning
        self._window: MarkerCollection | None = None
        self._job: Future | None = None
        self._alarmed = False  # whether the drift watch has raised an alarm for this orientation
        self._learned: LearnedShapes | None = None
        self._refusal = ''  # why the last shapes were not learned

    def add(self, name: str, observed: ObservedFrame, angle: Callable[[], float | None]) -> None:
        """Add a frame to the collection window, if any. Called in the thread of the streams."""
        window = self._window
        if window is not None:
            window.add(name, observed, angle())

    def on_drift(self, message: DriftStatus) -> None:
        """Stop learning if the drift watch has raised an alarm."""
        # A message received right after a new orientation may refer to the previous one.
        orientation = self._orientation
        if message.level == DriftStatus.OK or orientation is not self._output.orientation:
            return
        self._window = None
        if orientation is not None and not self._alarmed:
            self._alarmed = True
            try:  # keep the alarm for the time after a restart
                write_drift_alarm(self._rig.directory, orientation.orientation_id, message.message)
            except (DataError, OSError) as error:
                self._logger.error(f'the alarm of the drift watch is not saved: {error}')

    def diagnose(self) -> list[Status]:
        """Take the next step; return the progress of learning, empty without bodies to learn."""
        if not self._bodies:
            return []
        if self._orientation is not self._output.orientation:
            self._begin_anew()
        if self._job is not None and self._job.done():
            self._finish(self._job)
        return [Status('shapes', *self._step())]

    def _begin_anew(self) -> None:
        """Start with the orientation in use; shapes already learned with it are kept."""
        self._orientation = orientation = self._output.orientation
        self._window = self._learned = None
        self._alarmed = False
        self._refusal = ''
        if orientation is not None:
            try:
                self._alarmed = has_drift_alarm(self._rig.directory, orientation.orientation_id)
            except DataError as error:
                self._alarmed = True
                self._logger.error(str(error))
            try:
                self._learned = learned_for(self._rig.directory, orientation)
            except DataError as error:
                self._logger.info(f'shapes of bodies are learned: {error}')

    def _step(self) -> Health:
        """Collect frames or start the estimation; return level and message."""
        orientation = self._orientation
        learned = self._learned
        if learned is not None:
            names = ', '.join(body.name for body in learned.bodies)
            return Health(OK, f'shapes of {names} learned from {learned.exposures} exposures')
        calibrations = self._output.calibrations
        if orientation is None or not belongs_to(orientation, calibrations):
            return Health(OK, 'shapes are learned once the rig is oriented')
        if orientation.source == 'healing':
            return Health(WARN, 'no shapes are learned with a healed rig')
        if self._alarmed:
            return Health(WARN, DRIFT)
        if self._job is not None:
            return Health(OK, 'shapes are being estimated')
        window = self._window
        if window is None:
            seconds = self._rig.settings().node.learn_time
            window = self._window = MarkerCollection(self._bodies, calibrations, seconds)
        if window.is_complete:
            self._window = None
            self._estimate(window, orientation)
        refusal = f'not learned: {self._refusal}; ' if self._refusal else ''
        return Health(WARN if refusal else OK, f'{refusal}markers seen for {window.seen_s:.1f} s')

    def _estimate(self, window: MarkerCollection, orientation: RigOrientation) -> None:
        """Estimate shapes in another process."""
        pairing = self._rig.settings().pairing
        options = BodiesOptions(pairing.pair_by, pairing.tolerance_s)
        calibrations = self._output.calibrations

        arguments = window.frames, calibrations, orientation, self._bodies, options
        self._job = self._start(
            partial(in_worker_process, learn_shapes, *arguments),
            lambda: self._orientation is not orientation or self._alarmed,
        )

    def _finish(self, done: Future) -> None:
        """Save the learned shapes, unless there has been an alarm meanwhile."""
        self._job = None
        orientation = self._orientation
        try:
            learned = done.result()
            if orientation is None or self._alarmed:
                return
            learned.check(orientation.orientation_id)
            write_learned_shapes(self._rig.directory, learned)
        except Cancelled:
            return
        except Exception as error:  # a bug must not end the diagnostics
            self._refusal = str(error)
            self._logger.error(f'no shapes learned: {error}')
            self._alarmed |= isinstance(error, DataError) and error.finding.kind in DRIFTED
            return
        self._learned = learned
        for finding in learned.findings:
            self._logger.warning(finding.sentence)
        self._logger.info(f'shapes of {len(learned.bodies)} bodies learned')
