"""Node that intersects the corrected views of a rig: points in space, with how good they are,
live.
"""

import time
from collections import Counter
from dataclasses import dataclass
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

from ..drift.clusters import parse_clusters
from ..drift.options import DriftOptions
from ..drift.rig_watch import RigDriftWatch
from ..errors import DataError
from ..exposures.pairing import PATIENCE, exposure_pairer
from ..files.rig_orientation import load_orientation
from ..reconstruction.intersection import FAILED, OUTSIDE, REJECTED, SINGLE_VIEW, Intersector
from ..reconstruction.reconstruct import CorrectedView, intersect_views, watch_views
from . import support
from .checks import Refused, check_corrected
from .conversion import to_stamp
from .qos import LATCHED, OBSERVATIONS
from .spatial import (
    MocapMarkers,
    cloud_message,
    drift_message,
    ellipsoids_message,
    message_from_orientation,
    mocap_message,
    orientation_from_message,
    points_message,
    transforms_of,
)
from .support import StartError, declare
from .wire import Corrected, corrected_of, points_bytes

KINDS = ('undecodable', 'lengths', 'repeated target', 'sigma')  # of refused messages
ORIENTATIONS = 4  # that are kept: frames of the calibration before may still come


@dataclass(frozen=True)
class _View:
    """A corrected frame that waits for its partners."""

    fluoroscope: str
    number: int
    stamp_ns: int
    frame: Corrected


class _Rig(NamedTuple):
    """An orientation that arrived, and what is made of it once; watch: RigDriftWatch, None while there
    is none.
    """

    orientation_id: str
    orientation: object
    intersector: Intersector
    watch: RigDriftWatch | None


class ReconstructionNode(support.StreamNode):
    """Publishes points in space for every exposure of which two fluoroscopes have come, or more."""

    def __init__(self):
        super().__init__('reconstruction_node')
        self._names = support.fluoroscopes_of(self, least=2)
        self._pairing = (
            declare(
                self, 'pair_by', 'frame_number', 'how frames are paired: frame_number or stamp'
            ),
            round(
                1e9
                * declare(
                    self,
                    'pair_tolerance',
                    0.002,
                    'largest difference of the stamps of a pair [s]',
                    0.0,
                    1.0,
                )
            ),
            declare(
                self,
                'waiting',
                64,
                'frames of a fluoroscope that wait for their partners',
                1,
                10000,
            ),
            declare(
                self,
                'patience',
                PATIENCE,
                'frames of two others for which a silent one of three or '
                'more fluoroscopes is waited for',
                1,
                10000,
            ),
        )
        self._reject = declare(
            self,
            'reject',
            4.0,
            'epipolar distance above which image points do not belong '
            'together [standard deviations]',
            1.0,
            1000.0,
        )
        self._file = declare(
            self,
            'orientation_file',
            '',
            'rig_orientation.npz to begin with; empty: the orientation '
            'comes from the topic rig_orientation',
        )
        self._sigmas = declare(
            self,
            'ellipsoid_sigmas',
            10.0,
            'half axes of the ellipsoids for RViz [standard deviations]',
            0.1,
            1000.0,
        )
        self._every_ns = round(
            1e9 / declare(self, 'ellipsoid_rate', 30.0, 'most MarkerArrays a second', 0.1, 1000.0)
        )
        self._read_watch()
        try:
            exposure_pairer(self._names, *self._pairing)
        except ValueError as error:
            raise StartError(f'parameter {error}') from None
        self.forget()

    def _read_watch(self):
        """Parameters of the drift watch. Raises StartError."""
        self._watching = declare(
            self, 'drift_watch', True, 'look in the stream for a drift of the calibration'
        )
        hours = [
            declare(
                self,
                f'drift_{level}_interval',
                default,
                f'mean time between two false alarms of the level {level.upper()} [h of stream]',
                0.01,
                1e6,
            )
            for level, default in (('warn', 10.0), ('error', 1000.0))
        ]
        self._watch_rate = declare(
            self,
            'drift_rate',
            120.0,
            'most exposures a second that the drift watch looks at',
            1.0,
            10000.0,
        )
        clusters = declare(
            self,
            'clusters',
            [''],
            'rigid clusters of targets, whose distances must not change: '
            "'tibia: 1001 1002 1003', ...",
        )
        self._collect_on_drift = declare(
            self,
            'collect_on_drift',
            False,
            'at a drift of level ERROR call the service collect_anew of the calibration node',
        )
        try:
            self._clusters = parse_clusters([text for text in clusters if text])
            self._watch_options = DriftOptions(warn_interval_h=hours[0], error_interval_h=hours[1])
        except ValueError as error:
            raise StartError(
                f'parameter clusters, drift_warn_interval or drift_error_interval: {error}'
            ) from None

    def forget(self):
        """Begin to count, without an orientation."""
        self._rigs = {}  # calibration ids: _Rig; replaced as a whole
        self._pairer = exposure_pairer(self._names, *self._pairing)
        self._received = Counter()
        self._refused = Counter()
        self._points = Counter()
        self._exposures = self._reconstructed = self._without_orientation = 0
        self._last_fault = ''
        self._latencies = support.Latencies()
        self._drawn = 0
        self._sizes = {}
        self._newest = None
        self._alarmed = False

    # -- lifecycle

    def make(self):
        """Make outputs, and take orientations."""
        kinds = {
            'points_with_covariance': ReconstructedPoints,
            'points': PointCloud2,
            'markers': MarkerArray,
        }
        if MocapMarkers is not None:
            kinds['mocap_markers'] = MocapMarkers
        self._outputs = {
            name: self.publisher(kind, f'reconstruction/{name}', OBSERVATIONS)
            for name, kind in kinds.items()
        }
        for name, made in (
            ('drift', self.create_lifecycle_publisher(DriftStatus, 'reconstruction/drift', 10)),
            ('tf', self.create_publisher(TFMessage, '/tf_static', LATCHED)),
        ):
            self._outputs[name] = self.kept(made, self.destroy_publisher, made)
        self._collect_anew = client = self.create_client(Reset, 'collect_anew')
        self.kept(client, self.destroy_client, client)
        inputs = [
            self.create_subscription(
                RigOrientation, 'rig_orientation', self._on_orientation, LATCHED
            )
        ]
        inputs += [
            self.create_subscription(
                CameraInfo,
                f'{name}/camera_info',
                lambda message, name=name: self._on_info(name, message),
                LATCHED,
            )
            for name in self._names
        ]
        for subscription in inputs:
            self.kept(subscription, self.destroy_subscription, subscription)
        if self._file:
            try:
                self._on_orientation(message_from_orientation(load_orientation(self._file)))
            except DataError as error:
                self.get_logger().error(str(error))
                self._last_fault = str(error)

    def listen(self):
        """Take corrected observations, all in one thread."""
        reader = self.reader(self._on_undecodable)
        for name in self._names:
            reader.subscribe(
                CorrectedObservations,
                f'{name}/corrected_observations',
                lambda frame, info, name=name: self._on_view(name, frame, info),
                OBSERVATIONS,
                corrected_of,
            )

    # -- orientation

    def _on_orientation(self, message):
        """Take an orientation over, and tell TF."""
        try:
            orientation = orientation_from_message(message).subset(self._names)
            rig = _Rig(
                message.orientation_id,
                orientation,
                Intersector(orientation, self._reject),
                self._watch_of(orientation),
            )
        except ValueError as error:  # DataError among them
            self._last_fault = str(error)
            self.get_logger().error(f'orientation refused, the running one stays: {error}')
            return
        kept = list(self._rigs.items())[-(ORIENTATIONS - 1) :]
        self._rigs = {
            **{ids: old for ids, old in kept if ids != orientation.calibration_ids},
            orientation.calibration_ids: rig,
        }
        self._outputs['tf'].publish(transforms_of(message))
        self.get_logger().info(
            f'orientation {message.orientation_id} now, by {message.source} '
            f'({message.exposures} exposures), in frame {message.header.frame_id}'
        )

    def _watch_of(self, orientation):
        """RigDriftWatch of an orientation, None where none is wanted or the sizes of the images are not
        known yet.
        """
        if not self._watching or any(name not in self._sizes for name in self._names):
            return None
        return RigDriftWatch(
            orientation, self._sizes, self._watch_options, self._clusters, self._watch_rate
        )

    def _on_info(self, name, message):
        """Take the size of a fluoroscope's images, which the drift watch needs."""
        size = message.width, message.height
        if self._sizes.get(name) != size:
            self._sizes = {**self._sizes, name: size}
            try:
                self._rigs = {
                    ids: rig._replace(watch=self._watch_of(rig.orientation))
                    for ids, rig in self._rigs.items()
                }
            except ValueError as error:  # DataError among them
                self._last_fault = f'no drift watch: {error}'
                self.get_logger().error(self._last_fault)

    # -- corrected observations

    def _on_undecodable(self, topic):
        name = topic.partition('/')[0]
        self._received[name] += 1
        self._refuse(
            Refused('undecodable', f'fluoroscope {name}: a message on {topic} cannot be decoded')
        )

    def _refuse(self, error):
        self._refused[error.kind] += 1
        self._last_fault = str(error)
        self.sentences.warn(f'frame refused: {error}')

    def _on_view(self, name, frame, info):
        """Take a corrected frame; once it is known what belongs to an exposure the points are
        intersected.
        """
        self._received[name] += 1
        try:
            check_corrected(name, frame)
        except Refused as error:
            self._refuse(error)
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

    def _rig_of(self, exposure):
        """The newest _Rig of just the calibrations with which the views of an exposure were
        corrected, or None.
        """
        rigs = self._rigs
        ids = tuple(
            exposure[name].frame.calibration_id if name in exposure else None
            for name in self._names
        )
        if len(exposure) == len(ids):
            return rigs.get(ids)
        return next(
            (
                rig
                for of_rig, rig in reversed(rigs.items())
                if all(own in (None, known) for own, known in zip(ids, of_rig))
            ),
            None,
        )

    def _reconstruct(self, rig, exposure):
        """Intersect the views of an exposure and publish the points."""
        views = [
            _corrected_view(exposure[name].frame) if name in exposure else None
            for name in self._names
        ]
        first = next(exposure[name] for name in self._names if name in exposure)
        self._newest = rig, first.stamp_ns
        found = intersect_views(views, rig.intersector)
        content = first.stamp_ns, first.frame.frame_number, rig, found.target_id, found.points
        self._outputs['points_with_covariance'].publish(points_bytes(*content))
        self._reconstructed += 1
        self._count(found.points)
        self._publish_views(content)
        if rig.watch is not None:
            watch_views(rig.watch, first.stamp_ns, views, found)

    def _count(self, points):
        """Count the points by status."""
        self._points['points'] += len(points.status)
        if points.status.any():
            for status, name in (
                (OUTSIDE, 'outside'),
                (REJECTED, 'rejected'),
                (FAILED, 'failed'),
                (SINGLE_VIEW, 'in a single view'),
            ):
                self._points[name] += int(np.count_nonzero(points.status == status))

    def _publish_views(self, content):
        """Publish the other forms of the points, the content of their message, where somebody
        listens.
        """
        cloud, markers, mocap = (
            self._outputs.get(name) for name in ('points', 'markers', 'mocap_markers')
        )
        wanted = [
            output is not None and output.get_subscription_count() > 0
            for output in (cloud, markers, mocap)
        ]
        if not any(wanted):
            return
        message = points_message(*content)
        good = np.flatnonzero(content[-1].status <= OUTSIDE)
        if wanted[0]:
            cloud.publish(cloud_message(message, good))
        if wanted[2]:
            mocap.publish(mocap_message(message, good.tolist()))
        now = time.monotonic_ns()
        if wanted[1] and now - self._drawn >= self._every_ns:
            self._drawn = now
            markers.publish(ellipsoids_message(message, good.tolist(), self._sigmas))

    # -- diagnostics

    def report(self):
        """Diagnostics of the reconstruction and of the drift watch."""
        unpaired, late = (
            sum(counts.values()) for counts in (self._pairer.unpaired, self._pairer.late)
        )
        rig = next(reversed(self._rigs.values()), None)
        values = {
            **{f'frames received of {name}': self._received[name] for name in self._names},
            'exposures': self._exposures,
            'exposures reconstructed': self._reconstructed,
            'exposures incomplete': self._pairer.incomplete,
            'exposures without orientation': self._without_orientation,
            'frames unpaired': unpaired,
            'frames late': late,
            'frames refused': self._refused.total(),
            **{f'refused: {kind}': self._refused[kind] for kind in KINDS},
            **{
                f'points {name}' if name != 'points' else name: self._points[name]
                for name in ('points', 'outside', 'rejected', 'failed', 'in a single view')
            },
            'last fault': self._last_fault,
            'orientation': rig.orientation_id if rig else '',
            'source of the orientation': rig.orientation.source if rig else '',
            **self._latencies.values(),
        }
        return [('reconstruction', *self._verdict(unpaired), values), *self._drift()]

    def _drift(self):
        """Publish the state of the drift watch; returns its diagnostics, none where nothing is
        watched.
        """
        newest = self._newest
        if not self._watching or newest is None:
            return []
        if newest[0].watch is None:
            silent = [name for name in self._names if name not in self._sizes]
            return [
                (
                    'drift',
                    support.WARN,
                    'nothing is watched: there is no camera_info of ' + ', '.join(silent),
                    {},
                )
            ]
        state = newest[0].watch.state
        message = drift_message(state, to_stamp(newest[1]), newest[0].orientation)
        self._outputs['drift'].publish(message)
        alarmed = state.level == DriftStatus.ERROR
        if alarmed and not self._alarmed:
            self.get_logger().error(state.message)
            if self._collect_on_drift and self._collect_anew.service_is_ready():
                self._collect_anew.call_async(Reset.Request())
            elif self._collect_on_drift:
                self.get_logger().error(
                    'nobody offers the service collect_anew: no exposures are collected'
                )
        self._alarmed = alarmed
        level = (support.OK, support.WARN, support.ERROR)[state.level]
        return [
            (
                'drift',
                level,
                state.message,
                {
                    'fluoroscope': state.fluoroscope,
                    'place': state.place,
                    'source': state.source,
                    'size [px]': f'{state.size:.2f}',
                    'sd [px]': f'{state.sd:.2f}',
                    'evidence': f'{state.evidence:.1f}',
                    'threshold of WARN': f'{state.threshold_warn:.1f}',
                    'threshold of ERROR': f'{state.threshold_error:.1f}',
                    'since [s]': f'{state.since_s:.1f}',
                    'observations': state.observations,
                },
            )
        ]

    def _verdict(self, unpaired):
        """Level and message of the diagnostics."""
        deaf = [
            sentence
            for reader in self.readers
            for sentence in support.deafness(reader, self.sentences).values()
        ]
        if deaf:
            return support.WARN, deaf[0]
        if not self._rigs:
            return support.WARN, self._last_fault or (
                'no orientation of the rig yet: calibrate with all fluoroscopes, '
                'or capture the phantom with the service orient'
            )
        if not self.readers:
            return support.WARN, 'the node is not active'
        silent = [
            n for n in self._names if self.count_publishers(f'{n}/corrected_observations') == 0
        ]
        if silent:
            return support.WARN, f'nobody publishes corrected observations of {", ".join(silent)}'
        if self._pairer.silent:
            return (
                support.WARN,
                f'nothing comes of {", ".join(sorted(self._pairer.silent))}, points are of the others',
            )
        if self._without_orientation:
            return support.WARN, (
                f'{self._without_orientation} exposures were corrected with calibrations to which no '
                'orientation of the rig belongs'
            )
        if self._refused:
            return support.WARN, f'{self._refused.total()} frames refused: {self._last_fault}'
        if unpaired:
            return support.WARN, f'{unpaired} frames without partner of the other fluoroscopes'
        if self._pairer.incomplete:
            return support.WARN, f'{self._pairer.incomplete} exposures without all fluoroscopes'
        return support.OK, 'reconstructing'


def _corrected_view(frame):
    """CorrectedView of a Corrected frame."""
    return CorrectedView(
        frame.target_id,
        np.array([frame.u, frame.v]).T,
        frame.sigma,
        frame.correction_sd,
        frame.status == OUTSIDE,
    )


def main(args=None):
    """Entry point."""
    support.run(ReconstructionNode, args)


if __name__ == '__main__':
    main()
