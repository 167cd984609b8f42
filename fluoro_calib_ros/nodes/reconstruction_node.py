# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Node that intersects the corrected views of a rig: points in space with covariance, live."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from fluoro_calib_msgs.msg import (
    CorrectedObservations,
    DriftStatus,
    ReconstructedPoints,
    RigOrientation,
)
from fluoro_calib_msgs.srv import Reset
from sensor_msgs.msg import CameraInfo, PointCloud2
from tf2_msgs.msg import TFMessage
from visualization_msgs.msg import MarkerArray

from ..drift.options import DriftOptions
from ..drift.rig_watch import RigDriftWatch
from ..errors import DataError
from ..exposures.pairing import PairingOptions, exposure_pairer
from ..files.rig_orientation import load_orientation, orientation_path
from ..limits import StreamLimits
from ..options import option
from ..photogrammetry import rig_orientation
from ..photogrammetry.scatter import ObservedScatter
from ..reconstruction.correspondence import CorrectedView
from ..reconstruction.intersection import (
    FAILED,
    OUTSIDE,
    REJECTED,
    SINGLE_VIEW,
    IntersectedPoints,
    Intersector,
)
from ..reconstruction.mismatch import RecentMisses
from ..reconstruction.reconstruct import intersect_exposure, watch_exposure
from .drift_monitor import DriftMonitor, DriftParameters
from .frame_validation import CORRECTED_REFUSALS, validate_corrected
from .messages.camera_info import image_size_of
from .messages.corrected_observations import CorrectedFrame, decode_corrected_observations
from .messages.marker_array import ellipsoid_markers
from .messages.mocap_markers import MocapMarkers, mocap_markers
from .messages.point_cloud import point_cloud
from .messages.reconstructed_points import (
    PointsContent,
    encode_reconstructed_points,
    message_from_points,
)
from .messages.rig_orientation import (
    description_of,
    message_from_orientation,
    orientation_from_message,
)
from .messages.transforms import transforms_of_orientation
from .runtime.diagnostics import ERROR, OK, WARN, LatencyWindow, Status
from .runtime.lifecycle import StreamNode
from .runtime.main import run
from .runtime.parameters import (
    READ_LIMITS,
    CalibratedParameters,
    ParameterGroup,
    declare_read_limits,
    expand_path,
)
from .runtime.qos import latched_qos, observations_qos
from .runtime.refusals import RefusalLog, Refused
from .runtime.stall import StallDetector
from .runtime.stream_reader import FaultHandlers

MAX_ORIENTATIONS = 4  # frames of the previous calibrations may still come
COUNTED_STATUSES = {
    'outside': OUTSIDE,
    'rejected': REJECTED,
    'failed': FAILED,
    'in a single view': SINGLE_VIEW,
}


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


_NODE = ParameterGroup(
    ReconstructionParameters, settable=('reject', 'ellipsoid_sigmas', 'ellipsoid_rate')
)
_PAIRING = ParameterGroup(
    PairingOptions,
    {
        'pair_by': 'pair_by',
        'tolerance_s': 'pair_tolerance',
        'waiting': 'waiting',
        'patience': 'patience',
    },
    settable=('pair_tolerance', 'waiting', 'patience'),
)
_DRIFT = ParameterGroup(
    DriftParameters, settable=('drift_watch', 'drift_rate', 'clusters', 'collect_on_drift')
)
_DRIFT_OPTIONS = ParameterGroup(
    DriftOptions,
    {'warn_interval_h': 'drift_warn_interval', 'error_interval_h': 'drift_error_interval'},
    settable=('drift_warn_interval', 'drift_error_interval'),
)
_LIMITS = ParameterGroup(StreamLimits)
PARAMETERS = (_NODE, _PAIRING, _DRIFT, _DRIFT_OPTIONS, _LIMITS, READ_LIMITS)


@dataclass(frozen=True)
class _View:
    """A corrected frame that waits for its partners."""

    fluoroscope: str
    number: int
    stamp_ns: int
    frame: CorrectedFrame


class _Rig(NamedTuple):
    """An orientation that has arrived, its intersector, scatter, and drift watch if any."""

    orientation_id: str
    orientation: rig_orientation.RigOrientation
    intersector: Intersector
    scatter: ObservedScatter
    watch: RigDriftWatch | None


class ReconstructionNode(StreamNode):
    """Publishes points in space for every exposure with at least two views."""

    def __init__(self) -> None:
        super().__init__('reconstruction_node')
        declare_read_limits(self)
        self._settings = _NODE.declare(self)
        self._limits = _LIMITS.declare(self)
        self._pairing = _PAIRING.declare(self)
        self.autostart = self._settings.autostart
        self._names = self._settings.fluoroscopes
        self._drift = DriftMonitor(
            self._names, _DRIFT.declare(self), _DRIFT_OPTIONS.declare(self), self.get_logger()
        )
        self.reset()
        _NODE.follow(self, self._use_settings)
        _PAIRING.follow(self, self._use_pairing)
        _DRIFT.follow(self, self._use_drift_parameters)
        _DRIFT_OPTIONS.follow(self, self._use_drift_options)

    def reset(self) -> None:
        """Forget the orientations and start counting from zero."""
        # By calibration ids, the oldest first; replaced as a whole.
        self._rigs: dict[tuple[str | None, ...], _Rig] = {}
        self._pairer = exposure_pairer(self._names, self._pairing)
        self._received: Counter[str] = Counter()
        self._stalls = {name: StallDetector() for name in self._names}
        self._refusals = RefusalLog('frame', self.limited_logger)
        self._points: Counter[str] = Counter()
        self._misses = RecentMisses()
        self._exposures = 0
        self._reconstructed = 0
        self._without_orientation = 0
        self._latencies = LatencyWindow()
        self._markers_published_ns = 0
        self._drift.reset()

    # -- parameters

    def _use_settings(self, settings: ReconstructionParameters) -> None:
        self._settings = settings
        self._rigs = {
            ids: rig._replace(intersector=Intersector(rig.orientation, settings.reject))
            for ids, rig in self._rigs.items()
        }

    def _use_pairing(self, pairing: PairingOptions) -> None:
        self._pairing = pairing
        self._pairer.use(pairing)

    def _use_drift_parameters(self, parameters: DriftParameters) -> None:
        if self._drift.use(parameters):
            self._renew_watches()

    def _use_drift_options(self, options: DriftOptions) -> None:
        self._drift.use_options(options)
        self._renew_watches()

    def _renew_watches(self) -> None:
        """Watch for drift from the beginning."""
        try:
            self._rigs = {
                ids: rig._replace(watch=self._drift.make_watch(rig.orientation))
                for ids, rig in self._rigs.items()
            }
        except ValueError as error:  # DataError among them
            self._refusals.last_fault = f'no drift watch: {error}'
            self.get_logger().error(self._refusals.last_fault)

    # -- lifecycle

    def create_outputs(self) -> None:
        """Make the outputs and subscribe to orientations."""
        kinds = {
            'points_with_covariance': ReconstructedPoints,
            'points': PointCloud2,
            'markers': MarkerArray,
        }
        if MocapMarkers is not None:
            kinds['mocap_markers'] = MocapMarkers
        self._outputs = {
            name: self.create_output(kind, f'reconstruction/{name}', observations_qos())
            for name, kind in kinds.items()
        }
        drift = self.create_lifecycle_publisher(DriftStatus, 'reconstruction/drift', 10)
        self.own(drift, self.destroy_publisher, drift)
        collect_anew = self.create_client(Reset, 'collect_anew')
        self.own(collect_anew, self.destroy_client, collect_anew)
        self._drift.connect(drift, collect_anew)
        self._transforms = self.create_publisher(TFMessage, '/tf_static', latched_qos())
        self.own(self._transforms, self.destroy_publisher, self._transforms)
        self._create_inputs()
        self._load_at_start()

    def _create_inputs(self) -> None:
        self.create_input(
            RigOrientation,
            'rig_orientation',
            self._on_orientation,
            latched_qos(),
            self._refusals,
        )
        for name in self._names:
            self.create_input(
                CameraInfo,
                f'{name}/camera_info',
                partial(self._on_camera_info, name),
                latched_qos(),
                self._refusals,
            )

    def create_readers(self) -> None:
        """Receive the corrected observations of all fluoroscopes in one thread."""
        reader = self.create_reader(
            FaultHandlers(
                self._on_undecodable,
                self._refusals.fail,
                self.fail,
                self._on_too_large,
            )
        )
        for name in self._names:
            reader.subscribe(
                CorrectedObservations,
                f'{name}/corrected_observations',
                partial(self._on_view, name),
                observations_qos(),
                decode_corrected_observations,
                self._limits.max_bytes,
            )

    # -- orientation

    def _load_at_start(self) -> None:
        """Begin with the orientation of a file, if there is one."""
        try:
            path = self._settings.orientation_file
            if not path and self._settings.calibration_directory:
                saved = orientation_path(expand_path(self._settings.calibration_directory))
                path = saved if Path(saved).exists() else ''
            if path:
                self._on_orientation(message_from_orientation(load_orientation(path)))
        except DataError as error:
            self.get_logger().error(str(error))
            self._refusals.last_fault = str(error)

    def _on_orientation(self, message: RigOrientation) -> None:
        """Use an orientation, and publish its transforms."""
        try:
            orientation = orientation_from_message(message).subset(self._names)
            rig = _Rig(
                message.orientation_id,
                orientation,
                Intersector(orientation, self._settings.reject),
                ObservedScatter(),
                self._drift.make_watch(orientation),
            )
        except ValueError as error:  # DataError among them
            self._refusals.last_fault = str(error)
            self.get_logger().error(f'orientation refused, the current one stays in use: {error}')
            return
        self._misses = RecentMisses()
        ids = orientation.calibration_ids
        newest = list(self._rigs.items())[-(MAX_ORIENTATIONS - 1) :]
        self._rigs = {**{i: old for i, old in newest if i != ids}, ids: rig}
        self._transforms.publish(transforms_of_orientation(message, self._settings.rig_frame))
        self.get_logger().info(f'{description_of(message)}, in use')

    def _on_camera_info(self, name: str, message: CameraInfo) -> None:
        """Take the image size of a fluoroscope, which the drift watch needs."""
        try:
            size = image_size_of(message, f'{name}/camera_info')
        except DataError as error:
            self._refusals.note(f'camera_info ignored: {error}')
            return
        if self._drift.set_image_size(name, size):
            self._renew_watches()

    # -- corrected observations

    def _on_undecodable(self, topic: str) -> None:
        self._received[topic.partition('/')[0]] += 1
        self._refusals.refuse_undecodable(topic)

    def _on_too_large(self, topic: str, size: int) -> None:
        self._received[topic.partition('/')[0]] += 1
        self._refusals.refuse_too_large(topic, size)

    def _on_view(self, name: str, frame: CorrectedFrame, info: Mapping[str, int]) -> None:
        """Pair a corrected frame, and reconstruct the exposures that are complete by it."""
        self._received[name] += 1
        try:
            validate_corrected(name, frame)
        except Refused as error:
            self._refusals.refuse(error)
            return
        stamp_ns = 1_000_000_000 * frame.sec + frame.nanosec
        for exposure in self._pairer.add(_View(name, frame.frame_number, stamp_ns, frame)):
            self._exposures += 1
            rig = self._rig_of(exposure)
            if rig is None:
                self._without_orientation += 1
                continue
            self._reconstruct(rig, exposure)
            self._latencies.add(time.time_ns() - info['received_timestamp'])

    def _rig_of(self, exposure: Mapping[str, _View]) -> _Rig | None:
        """Return the newest rig with the calibrations by which the views were corrected."""
        rigs = self._rigs
        ids = tuple(
            exposure[name].frame.calibration_id if name in exposure else None
            for name in self._names
        )
        if len(exposure) == len(ids):
            return rigs.get(ids)
        for known_ids, rig in reversed(rigs.items()):
            if all(own in (None, known) for own, known in zip(ids, known_ids)):
                return rig
        return None

    def _reconstruct(self, rig: _Rig, exposure: Mapping[str, _View]) -> None:
        """Intersect the views of an exposure and publish the points."""
        views = [
            _corrected_view(exposure[name].frame) if name in exposure else None
            for name in self._names
        ]
        first = next(exposure[name] for name in self._names if name in exposure)
        self._drift.newest = rig.watch, rig.orientation, first.stamp_ns
        found = intersect_exposure(views, rig.intersector, rig.scatter)
        content = PointsContent(
            first.stamp_ns,
            first.frame.frame_number,
            rig.orientation_id,
            rig.orientation,
            found.target_id,
            found.points,
        )
        self._outputs['points_with_covariance'].publish(encode_reconstructed_points(content))
        self._reconstructed += 1
        self._count_points(found.points)
        self._publish_views(content)
        if rig.watch is not None:
            watch_exposure(rig.watch, first.stamp_ns, found)

    def _count_points(self, points: IntersectedPoints) -> None:
        """Count the points by status."""
        self._points['points'] += len(points.status)
        self._misses.add(points)
        if points.status.any():
            for name, status in COUNTED_STATUSES.items():
                self._points[name] += int(np.count_nonzero(points.status == status))

    def _publish_views(self, content: PointsContent) -> None:
        """Publish the other forms of the points that have subscribers."""
        wanted = [
            name
            for name in ('points', 'markers', 'mocap_markers')
            if name in self._outputs and self._outputs[name].get_subscription_count()
        ]
        if not wanted:
            return
        message = message_from_points(content)
        good = np.flatnonzero(content.points.status <= OUTSIDE)
        if 'points' in wanted:
            self._outputs['points'].publish(point_cloud(message, good))
        if 'mocap_markers' in wanted:
            self._outputs['mocap_markers'].publish(mocap_markers(message, good))
        now = time.monotonic_ns()
        interval_ns = round(1e9 / self._settings.ellipsoid_rate)
        if 'markers' in wanted and now - self._markers_published_ns >= interval_ns:
            self._markers_published_ns = now
            self._outputs['markers'].publish(
                ellipsoid_markers(message, good, self._settings.ellipsoid_sigmas)
            )

    # -- diagnostics

    def diagnose(self) -> list[Status]:
        """Return the status of the reconstruction and of the drift watch."""
        unpaired = sum(self._pairer.unpaired.values())
        rig = next(reversed(self._rigs.values()), None)
        values = {
            **{f'frames received of {name}': self._received[name] for name in self._names},
            'exposures': self._exposures,
            'exposures reconstructed': self._reconstructed,
            'exposures incomplete': self._pairer.incomplete,
            'exposures without orientation': self._without_orientation,
            'frames unpaired': unpaired,
            'frames late': sum(self._pairer.late.values()),
            **self._refusals.values(CORRECTED_REFUSALS),
            'points': self._points['points'],
            **{f'points {name}': self._points[name] for name in COUNTED_STATUSES},
            'limit of false matches widened by': round(rig.scatter.factor, 2) if rig else 1.0,
            'last fault': self._refusals.last_fault,
            'orientation': rig.orientation_id if rig else '',
            'source of the orientation': rig.orientation.source if rig else '',
            **self._latencies.values(),
        }
        status = Status('reconstruction', *self._verdict(unpaired), values)
        return [status, *self._drift.publish_state()]

    def _verdict(self, unpaired: int) -> tuple[bytes, str]:
        """Return level and message of the diagnostics."""
        failure = self._refusals.failure_status()
        if failure:
            return failure
        incompatible = self.incompatible_publishers()
        if incompatible:
            return WARN, next(iter(incompatible.values()))
        if not self._rigs:
            return WARN, self._refusals.last_fault or (
                'no orientation of the rig yet: calibrate with all fluoroscopes, '
                'or capture the phantom with the service orient'
            )
        if not self.readers:
            return WARN, 'the node is not active'
        level, message = self._stream_fault(unpaired) or (OK, '')
        messages = [text for text in (self._stalled(), message) if text]
        return (max(level, WARN), '; '.join(messages)) if messages else (OK, 'reconstructing')

    def _stalled(self) -> str:
        """Return a message where streams have stopped, else ''."""
        messages = {
            name: stall.message(self._received[name]) for name, stall in self._stalls.items()
        }
        return '; '.join(f'{name}: {message}' for name, message in messages.items() if message)

    def _stream_fault(self, unpaired: int) -> tuple[bytes, str] | None:
        """Return level and message where something is wrong with the streams."""
        missing = [n for n in self._names if not self.has_publisher(f'{n}/corrected_observations')]
        if missing:
            return WARN, f'no publisher of corrected observations of {", ".join(missing)}'
        disagreement = self._pairer.stamps.disagreement()
        misses = self._misses.message()
        if misses:
            return ERROR, '; '.join(filter(None, (misses, disagreement)))
        if self._pairer.silent:
            return (
                WARN,
                f'no frames of {", ".join(sorted(self._pairer.silent))}, '
                'points are reconstructed from the other fluoroscopes',
            )
        if self._without_orientation:
            return (
                WARN,
                f'{self._without_orientation} exposures were corrected with calibrations to which '
                'no orientation of the rig belongs',
            )
        refusals = self._refusals.refusal_status()
        if refusals:
            return refusals
        if disagreement:
            return WARN, disagreement
        if unpaired:
            return WARN, f'{unpaired} frames without partner of the other fluoroscopes'
        if self._pairer.incomplete:
            return WARN, f'{self._pairer.incomplete} exposures without all fluoroscopes'
        return None


def _corrected_view(frame: CorrectedFrame) -> CorrectedView:
    """Return the CorrectedView of a frame."""
    return CorrectedView(
        frame.target_id,
        np.array([frame.u, frame.v]).T,
        frame.sigma,
        frame.correction_sd,
        frame.status == OUTSIDE,
    )


def main(args: Sequence[str] | None = None) -> None:
    """Run the node."""
    run(ReconstructionNode, args)


if __name__ == '__main__':
    main()
