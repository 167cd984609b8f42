# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Node that intersects the corrected views of a rig: points, bodies and joints, live."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial

from fluoro_calib_msgs.action import Heal
from fluoro_calib_msgs.msg import DriftStatus, RigOrientation
from fluoro_calib_msgs.srv import Reset
from rclpy.action import ActionClient
from sensor_msgs.msg import CameraInfo
from tf2_msgs.msg import TFMessage

from ..checks.drift_charts import DriftOptions
from ..errors import DataError
from ..exposures.pairing import PairingOptions, exposure_pairer
from ..exposures.stamps import nanoseconds_from_stamp
from ..limits import StreamLimits
from ..options import option
from ..reconstruction.reconstruct import CorrectedView, intersect_exposure, watch_exposure
from ..reconstruction.timing import RecentExposures
from .drift_monitor import DriftMonitor, DriftParameters
from .frame_validation import CORRECTED_REFUSALS, subscribe_frames, validate_corrected
from .messages.fluoroscope_calibration import image_size_of
from .messages.observations import CorrectedFrame
from .messages.points import PointsContent
from .messages.rig_orientation import message_from_orientation, transforms_of_orientation
from .reconstruction_output import (
    CONDITIONS,
    BodiesOutput,
    PointsCounter,
    PointsOutput,
    ReconstructionState,
    statuses_of,
)
from .retractions import PointRetractions
from .rig_input import BodyFollower, BodyParameters, RigInput, read_body_files
from .runtime.conditions import health_of
from .runtime.diagnostics import LatencyWindow, RefusalLog, Refused, Status
from .runtime.lifecycle import Stream, StreamNode, stream_faults
from .runtime.main import run
from .runtime.parameters import (
    CalibratedParameters,
    check_frame,
    group,
    parameters_of_managed,
)
from .runtime.topics import latched_qos

VIEWS = 'corrected_observations'


@dataclass(frozen=True)
class ReconstructionParameters(CalibratedParameters):
    """Parameters of the reconstruction node."""

    reject: float = option(
        4.0,
        'epipolar distance above which image points do not belong together',
        minimum=1.0,
        maximum=1000.0,
        unit='standard deviations',
    )
    orientation_file: str = option(
        '',
        'rig_orientation.npz to begin with; empty: the one of calibration_directory, if any',
    )
    rig_frame: str = option('rig', 'parent of the optical frames on /tf_static')
    ellipsoid_sigmas: float = option(
        10.0,
        'half axes of the ellipsoids for RViz',
        minimum=0.1,
        maximum=1000.0,
        unit='standard deviations',
    )
    ellipsoid_rate: float = option(
        30.0, 'maximum rate of the MarkerArrays', minimum=0.1, maximum=1000.0, unit='Hz'
    )

    min_fluoroscopes = 2

    def __post_init__(self) -> None:
        super().__post_init__()
        check_frame(self.rig_frame)


@dataclass(frozen=True)
class ReconstructionSettings:
    """Parameter values by group."""

    node: ReconstructionParameters = group(
        ReconstructionParameters, settable=('reject', 'ellipsoid_sigmas', 'ellipsoid_rate')
    )
    pairing: PairingOptions = group(
        PairingOptions,
        {
            'pair_by': 'pair_by',
            'tolerance_s': 'pair_tolerance',
            'waiting': 'waiting',
            'patience': 'patience',
        },
        settable=('pair_tolerance', 'waiting', 'patience'),
    )
    bodies: BodyParameters = group(BodyParameters)
    drift: DriftParameters = group(
        DriftParameters,
        settable=('drift_watch', 'drift_rate', 'clusters', 'collect_on_drift', 'heal_on_drift'),
    )
    drift_limits: DriftOptions = group(
        DriftOptions,
        {'warn_interval_h': 'drift_warn_interval', 'error_interval_h': 'drift_error_interval'},
        settable=('drift_warn_interval', 'drift_error_interval'),
    )
    limits: StreamLimits = group(StreamLimits)


PARAMETERS = parameters_of_managed(ReconstructionSettings)


@dataclass(frozen=True)
class _View:
    """Corrected frame that waits for its partners."""

    fluoroscope: str
    number: int
    stamp_ns: int
    frame: CorrectedFrame

    def corrected(self) -> CorrectedView:
        """Return the corrected image points."""
        return CorrectedView.of_columns(self.frame.target_id, self.frame.columns)


class ReconstructionNode(StreamNode):
    """Publishes points in space for every exposure with at least two views."""

    def __init__(self) -> None:
        super().__init__('reconstruction_node', ReconstructionSettings)
        settings = self.settings
        self._drift = DriftMonitor(
            self.names, settings.drift, settings.drift_limits, self.get_logger()
        )
        self.reset()

    def reset(self) -> None:
        """Discard the orientations and reset all counters."""
        self._drift.reset()
        self._refusals = RefusalLog('frame', self.limited_logger)
        self._streams = {name: Stream(name, self._refusals) for name in self.names}
        self._rigs = RigInput(
            self.names,
            self.settings.node.reject,
            self._drift,
            refusals=self._refusals,
            logger=self.get_logger(),
        )
        self._pairer = exposure_pairer(self.names, self.settings.pairing)
        self._points = PointsCounter()
        self._recent = RecentExposures(_View.corrected)
        self._follower: BodyFollower | None = None
        self._exposures = 0
        self._reconstructed = 0
        self._without_orientation = 0
        self._latencies = LatencyWindow()

    def use(self, settings: ReconstructionSettings) -> None:
        """Apply new settings from now on."""
        super().use(settings)
        self._rigs.use_reject(settings.node.reject)
        self._pairer.use(settings.pairing)
        if self._drift.use(settings.drift, settings.drift_limits):
            self._rigs.renew_watches()

    # -- lifecycle

    def create_outputs(self) -> None:
        """Create the outputs and subscribe to orientations."""
        self._output = PointsOutput(self)
        self._retractions = PointRetractions(self, self.names, self._refusals)
        self._create_bodies()
        drift = self.create_lifecycle_publisher(DriftStatus, 'reconstruction/drift', 10)
        self.own(drift, self.destroy_publisher, drift)
        collect_anew = self.create_client(Reset, 'collect_anew')
        self.own(collect_anew, self.destroy_client, collect_anew)
        heal = ActionClient(self, Heal, 'heal')
        self.own(heal, heal.destroy)
        self._drift.connect(drift, collect_anew, heal)
        self._transforms = self.create_publisher(TFMessage, '/tf_static', latched_qos())
        self.own(self._transforms, self.destroy_publisher, self._transforms)
        for topic, callback in (
            ('rig_orientation', self._on_orientation),
            ('rig_orientation_as_calibrated', self._on_calibrated),
        ):
            self.create_input(RigOrientation, topic, callback, latched_qos(), self._refusals)
        for name in self.names:
            self.create_input(
                CameraInfo,
                f'{name}/camera_info',
                partial(self._on_camera_info, name),
                latched_qos(),
                self._refusals,
            )
        settings = self.settings.node
        saved = self._rigs.saved(settings.orientation_file, settings.calibration_directory)
        if saved is not None:
            self._on_orientation(saved)

    def _create_bodies(self) -> None:
        """Read the files of bodies and joints, and create their outputs. Raises DataError."""
        settings = self.settings
        bodies, joints = read_body_files(settings.bodies, settings.node.rig_frame)
        if bodies:
            self._follower = BodyFollower(bodies, joints, settings.bodies.body_lag)
            names = [body.name for body in bodies]
            rig_frame = settings.node.rig_frame
            self._bodies_output = BodiesOutput(self, names, bool(joints), rig_frame)
            self._retractions.bodies = self._bodies_output.retractions

    def create_readers(self) -> None:
        """Receive the corrected observations of all fluoroscopes in one thread."""
        reader = self.create_reader(stream_faults(self._streams, self.fail))
        subscribe_frames(reader, self, VIEWS, self._on_view)

    def deactivate(self) -> None:
        """Stop the stream readers, and publish the exposures that wait for later frames."""
        super().deactivate()
        for exposure in self._pairer.flush():
            try:
                self._reconstruct(exposure)
            except Exception as error:  # only this exposure is lost
                self._refusals.fail(VIEWS, error)
        for bodies in () if self._follower is None else self._follower.flush():
            self._bodies_output.publish(bodies)

    # -- the rig

    def _on_orientation(self, message: RigOrientation) -> None:
        """Use an orientation, and publish its transforms."""
        if self._rigs.add(message):
            self._recent = RecentExposures(_View.corrected)
            self._publish_transforms(message)

    def _on_calibrated(self, message: RigOrientation) -> None:
        """Store the orientation before healing, which may arrive after the healed orientation."""
        self._rigs.use_calibrated(message)
        if self._rigs.newest is not None and self._rigs.calibrated is not None:
            self._publish_transforms(message_from_orientation(self._rigs.newest.orientation))

    def _publish_transforms(self, message: RigOrientation) -> None:
        self._transforms.publish(
            transforms_of_orientation(message, self.settings.node.rig_frame, self._rigs.calibrated)
        )

    def _on_camera_info(self, name: str, message: CameraInfo) -> None:
        """Store the image size of a fluoroscope, which the drift watch needs."""
        try:
            size = image_size_of(message, f'{name}/camera_info', *self._rigs.camera_of(name))
        except DataError as error:
            self._refusals.note(f'camera_info ignored: {error}')
            return
        if self._drift.set_image_size(name, size):
            self._rigs.renew_watches()

    # -- corrected observations, in the thread of the streams

    def _on_view(self, name: str, frame: CorrectedFrame, info: Mapping[str, int]) -> None:
        """Pair a corrected frame, and reconstruct the exposures that it completes."""
        self._streams[name].received += 1
        try:
            validate_corrected(name, frame)
        except Refused as error:
            self._refusals.refuse(error)
            return
        stamp_ns = nanoseconds_from_stamp(frame)
        for exposure in self._pairer.add(_View(name, frame.frame_number, stamp_ns, frame)):
            if self._reconstruct(exposure):
                self._latencies.add(time.time_ns() - info['received_timestamp'])

    def _reconstruct(self, exposure: Mapping[str, _View]) -> bool:
        """Publish the points, then bodies and joints; return False without an orientation."""
        self._exposures += 1
        rig = self._rigs.rig_of({n: view.frame.calibration_id for n, view in exposure.items()})
        if rig is None:
            self._without_orientation += 1
            return False
        views = [exposure[name].corrected() if name in exposure else None for name in self.names]
        first_view = next(exposure[name] for name in self.names if name in exposure)
        self._drift.newest = rig.watch, rig.orientation, first_view.stamp_ns
        intersector, image_sd = rig.widened()
        intersected = intersect_exposure(views, intersector, rig.scatter, image_sd)
        content = PointsContent(
            stamp_ns=first_view.stamp_ns,
            frame_number=first_view.frame.frame_number,
            orientation_id=rig.orientation_id,
            orientation=rig.orientation,
            target_id=intersected.target_id,
            points=intersected.points,
        )
        settings = self.settings.node
        self._output.publish(content, settings.ellipsoid_sigmas, settings.ellipsoid_rate)
        self._retractions.note({n: view.stamp_ns for n, view in exposure.items()}, content)
        self._reconstructed += 1
        self._points.add(intersected.points)
        self._recent.add(exposure, intersected.points)
        if self._follower is not None:
            widened = rig._replace(intersector=intersector)
            number = content.frame_number
            for bodies in self._follower.add(intersected, widened, number, content.stamp_ns):
                self._bodies_output.publish(bodies)
        if rig.watch is not None:
            watch_exposure(rig.watch, first_view.stamp_ns, intersected)
        return True

    # -- diagnostics

    def diagnose(self) -> list[Status]:
        """Return the status of the reconstruction, of bodies and joints, and of the watch."""
        rig = self._rigs.newest
        misses, timing = (None, None)
        if rig is not None:
            misses, timing = self._recent.faults(rig.orientation, rig.is_doubtful)
        state = ReconstructionState(
            node=self,
            topics=tuple(f'{name}/{VIEWS}' for name in self.names),
            refusals=self._refusals,
            recent=self.recent.growth(
                'reconstruction',
                refused=self._refusals.total,
                overrun=sum(stream.overrun for stream in self._streams.values()),
                unpaired=sum(self._pairer.unpaired.values()),
                incomplete=self._pairer.incomplete,
                without_orientation=self._without_orientation,
            ),
            streams=self._streams,
            rigs=self._rigs,
            pairer=self._pairer,
            misses=misses,
            timing=timing,
        )
        status = Status('reconstruction', *health_of(state, CONDITIONS), self._values())
        bodies = [] if self._follower is None else statuses_of(self._follower, self.recent)
        return [status, *bodies, *self._drift.publish_state()]

    def _values(self) -> dict[str, object]:
        rig = self._rigs.newest
        return {
            **{f'frames received of {name}': s.received for name, s in self._streams.items()},
            **{f'frames lost at the input of {n}': s.overrun for n, s in self._streams.items()},
            'exposures': self._exposures,
            'exposures reconstructed': self._reconstructed,
            'exposures incomplete': self._pairer.incomplete,
            'exposures without orientation': self._without_orientation,
            'frames unpaired': sum(self._pairer.unpaired.values()),
            'frames late': sum(self._pairer.late.values()),
            **self._refusals.values(CORRECTED_REFUSALS),
            **self._points.values(),
            **self._retractions.values(),
            'limit of false matches widened by': round(rig.scatter.factor, 2) if rig else 1.0,
            'last fault': self._refusals.last_fault,
            'orientation': rig.orientation_id if rig else '',
            'source of the orientation': rig.orientation.source if rig else '',
            'healed by': self._rigs.correction,
            **self._latencies.values(),
        }


main = partial(run, ReconstructionNode)

if __name__ == '__main__':
    main()
