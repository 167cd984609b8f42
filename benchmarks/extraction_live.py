# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Images to points in space, live: `python -m benchmarks.extraction_live`.

Radiographs of a virtual rig go through the nodes: extraction, calibration, correction,
reconstruction. First the observations and the calibration are compared with those of the jobs
behind the commands extract and calibrate. Then the latency from two images to their points, and
the rate are measured for a phantom in a new pose each time, for one that moves slowly and is
followed, for one that is filmed at 30 Hz, and for 30 markers filmed at this rate.

`--chain SECONDS` measures the chain from images to poses instead: 30 markers in five bodies, two
views of 1024 x 1024 px and 8 bits at 30 Hz, whose images another process plays from a bag, with
`--times N` N times forwards and backwards.
The only inputs are bodies.csv and the calibrations. The output is lost exposures, latency, and CPU
time of each process; with `--parts`, how the milliseconds of an exposure are spent. `--folder`
keeps the rendered data. The profile for large messages is used with
`FASTRTPS_DEFAULT_PROFILES_FILE=config/large_images.xml`.
"""

from __future__ import annotations

import argparse
import os
import struct
import tempfile
import threading
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import groupby
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from fluoro_calib_msgs.msg import (
    BodyPoses,
    CalibrationStatus,
    CorrectedObservations,
    ReconstructedPoints,
    RigOrientation,
    TargetObservations,
)
from fluoro_calib_msgs.srv import Calibrate
from rclpy.node import Node
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import Image
from std_msgs.msg import Header

from fluoro_calib_ros.api import calibrate
from fluoro_calib_ros.bodies.body import Body
from fluoro_calib_ros.demo.assessment import NodeProcesses, isolate_ros_graph
from fluoro_calib_ros.estimation.options import CalibrationOptions, CalibrationRequest
from fluoro_calib_ros.exposures.frame import Frame
from fluoro_calib_ros.exposures.stamps import nanoseconds_from_stamp
from fluoro_calib_ros.images.codec import encode
from fluoro_calib_ros.images.marker_fit import MarkerMeasurement
from fluoro_calib_ros.images.marker_intensity import MarkerSearch
from fluoro_calib_ros.images.marker_motion import MarkerStates
from fluoro_calib_ros.images.marker_rays import MarkerBodies, MarkerRays
from fluoro_calib_ros.images.marker_views import JoinedViews
from fluoro_calib_ros.images.marker_watch import MarkerWatch
from fluoro_calib_ros.io.bags.reader import iterate_messages
from fluoro_calib_ros.io.bags.writer import BagWriter
from fluoro_calib_ros.io.bodies import read_bodies, write_bodies
from fluoro_calib_ros.io.calibration import load_orientation, orientation_path
from fluoro_calib_ros.io.observations import write_observations_csv
from fluoro_calib_ros.io.phantom import write_phantom
from fluoro_calib_ros.jobs.calibration import run_calibration
from fluoro_calib_ros.jobs.extraction import ExtractionRequest, run_extraction
from fluoro_calib_ros.jobs.followers import MarkerSettings
from fluoro_calib_ros.jobs.result_folder import save_outcome
from fluoro_calib_ros.jobs.simulation import SETTINGS, RenderedScene, Renderers
from fluoro_calib_ros.jobs.sources import read_calibrations
from fluoro_calib_ros.nodes.messages.image import ImageConverter, message_from_image
from fluoro_calib_ros.nodes.messages.observations import (
    stamp_from_nanoseconds,
)
from fluoro_calib_ros.nodes.runtime.topics import (
    images_qos,
    latched_qos,
    observations_qos,
    wait_for_readers,
    wait_until_acknowledged,
)
from fluoro_calib_ros.photogrammetry.rotations import matrix_from_vector
from fluoro_calib_ros.processes import one_core
from fluoro_calib_ros.simulation.marker_images import (
    FIRST_ID,
    MARKER_SETTINGS,
    MarkerScene,
    MarkerSequence,
    MovingMarkers,
)
from fluoro_calib_ros.simulation.rig import (
    Pose,
    VirtualRig,
    phantom_poses,
    simulate_exposures,
    virtual_rig,
)

NAMES = ('a', 'b')
SEED = 31
MODEL = 'local_linear'
TURN_RAD = np.deg2rad(1.0)  # rotation of the phantom between images
SHIFT_MM = 1.0
FILM_HZ = 30.0
FIRST_NS = 1_700_000_000_000_000_000
EXPOSURE_NS = 500_000_000
SHAPE_SD_MM = 0.05
WRONG_PX = 1.5
SETTLING_S = 2.0  # time in which a node also discovers the camera

Images = Sequence[Mapping[str, np.ndarray]]


@dataclass
class Latencies:
    """Stamps of published exposures, and arrival times of the points of some of them [s]."""

    published: dict[int, float] = field(default_factory=dict)
    came: dict[int, float] = field(default_factory=dict)

    def text(self) -> str:
        """Return rate and latencies as text."""
        seconds = [self.came[s] - self.published[s] for s in self.came if s in self.published]
        if len(seconds) < 2:
            return 'no points'
        times = sorted(self.came.values())
        rate = (len(times) - 1) / (times[-1] - times[0])
        p50, p95 = np.percentile(seconds, [50, 95])
        return (
            f'{len(seconds)} of {len(self.published)} exposures, {rate:.2f} a second, latency '
            f'median {p50:.2f} s, 95 % below {p95:.2f} s'
        )


class Camera(Node):
    """Publishes images and collects the resulting messages."""

    def __init__(self) -> None:
        super().__init__('camera')
        self.observed: dict[tuple[str, int], TargetObservations] = {}
        self.exposures: dict[str, int] = {}
        self.points: dict[int, int] = {}  # number of points, by stamp
        self.latencies = Latencies()
        self.extraction: dict[str, dict[str, str]] = {}
        self.orientations: list[RigOrientation] = []
        self._stamp_ns = FIRST_NS
        self._images = {
            name: self.create_publisher(Image, f'{name}/image_raw', images_qos()) for name in NAMES
        }
        for name in NAMES:
            self.create_subscription(
                TargetObservations,
                f'{name}/target_observations',
                lambda m, name=name: self.observed.update({(name, m.frame_number): m}),
                observations_qos(),
            )
            self.create_subscription(
                CalibrationStatus,
                f'{name}/calibration_status',
                lambda m, name=name: self.exposures.update({name: m.exposures}),
                10,
            )
        self.create_subscription(
            ReconstructedPoints,
            'reconstruction/points_with_covariance',
            self._on_points,
            observations_qos(),
        )
        self.create_subscription(
            RigOrientation, 'rig_orientation', self.orientations.append, latched_qos()
        )
        self.create_subscription(DiagnosticArray, '/diagnostics', self._on_diagnostics, 10)
        self.calibrate = self.create_client(Calibrate, 'calibrate')

    def _on_points(self, message: ReconstructedPoints) -> None:
        stamp = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
        self.points[stamp] = len(message.target_id)
        self.latencies.came[stamp] = time.monotonic()

    def _on_diagnostics(self, array: DiagnosticArray) -> None:
        for status in array.status:
            if status.name.startswith('/extraction_node'):
                values = {v.key: v.value for v in status.values}
                self.extraction[status.hardware_id] = values

    def wait(self, condition: Any, seconds: float = 600.0) -> bool:
        """Spin until a condition holds; return whether it does."""
        end = time.monotonic() + seconds
        while not condition():
            if time.monotonic() > end:
                return False
            rclpy.spin_once(self, timeout_sec=0.05)
        return True

    def ready(self) -> bool:
        """Return whether the nodes receive images and have been discovered."""
        return bool(self.exposures) and all(
            output.get_subscription_count() for output in self._images.values()
        )

    def publish(self, images: Mapping[str, np.ndarray], interval_ns: int = EXPOSURE_NS) -> int:
        """Publish the images of an exposure; return its stamp."""
        self._stamp_ns += interval_ns
        self.latencies.published[self._stamp_ns] = time.monotonic()
        for name, image in images.items():
            header = Header(
                stamp=stamp_from_nanoseconds(self._stamp_ns), frame_id=f'{name}_optical'
            )
            self._images[name].publish(message_from_image(header, image))
        return self._stamp_ns

    def show(self, images: Mapping[str, np.ndarray], number: int) -> None:
        """Publish the images of an exposure until both are extracted.

        A busy machine may lose images between publisher and subscriber.
        """
        interval_ns = EXPOSURE_NS
        missing = dict(images)
        while missing:
            self.publish(missing, interval_ns)
            interval_ns = 0
            self.wait(lambda: all((name, number) in self.observed for name in missing), 15)
            missing = {
                name: image
                for name, image in images.items()
                if (name, number) not in self.observed
            }


def rendered(rig: VirtualRig, poses: Sequence[Pose]) -> Images:
    """Render radiographs of the phantom in given poses."""
    renderers = Renderers(rig.fluoroscopes, SETTINGS['clean'])
    try:
        return [
            renderers.images(RenderedScene(rig.true_mm, pose, number))
            for number, pose in enumerate(poses)
        ]
    finally:
        renderers.close()


def moving(start: Pose, count: int) -> list[Pose]:
    """Return poses of a phantom that rotates and translates."""
    return [
        (
            matrix_from_vector([0, 0, TURN_RAD * number]) @ start[0],
            start[1] + [0, 0, SHIFT_MM * number],
        )
        for number in range(count)
    ]


def by_command(images: Images, rig: VirtualRig, folder: Path) -> dict[str, list[Frame]]:
    """Extract from image files as the command does."""
    frames = {}
    for name in NAMES:
        (folder / name).mkdir()
        for number, of_exposure in enumerate(images, 1):
            data = encode(of_exposure[name], '.png')
            (folder / name / f'{number:04d}.png').write_bytes(data)
        outcome = run_extraction(ExtractionRequest([folder / name], rig.phantom, name))
        frames[name] = outcome.frames
    return frames


def compare(camera: Camera, frames: Mapping[str, Sequence[Frame]], rig: VirtualRig) -> None:
    """Print the differences of observations and calibrations between nodes and command."""
    same = 0
    largest = 0.0
    count = 0
    for name, of_fluoroscope in frames.items():
        for frame in of_fluoroscope:
            message = camera.observed[name, frame.number]
            seen = dict(zip(message.target_id, zip(message.u, message.v)))
            common = [i for i in frame.target_id.tolist() if i in seen]
            count += len(frame.target_id)
            same += set(frame.target_id.tolist()) == set(seen)
            uv = np.array([seen[i] for i in common])
            difference = np.abs(uv - frame.uv[np.isin(frame.target_id, common)])
            largest = max(largest, float(difference.max()))
    images = sum(map(len, frames.values()))
    print(f'{count} observations of {images} images; the same targets in {same} images')
    print(f'largest difference of a coordinate {largest:.2g} px')
    future = camera.calibrate.call_async(Calibrate.Request())
    camera.wait(future.done)
    answer = future.result()
    print(f'node: {answer.message}')
    for number, name in enumerate(NAMES):
        request = CalibrationRequest(
            {name: list(frames[name])}, rig.phantom, CalibrationOptions(model=MODEL)
        )
        own = run_calibration(request).calibrations[name]
        live = np.array([answer.xp[number], answer.yp[number], answer.c[number]])
        identical = own.calibration_id == answer.calibration_id[number]
        print(
            f'{name}: the same calibration id: {identical}; xp, yp, c differ by '
            f'{np.abs(own.interior - live).max():.2g} px; RMSE after '
            f'{answer.rmse_after_u[number]:.4f}, {answer.rmse_after_v[number]:.4f} px'
        )


def measure_one_by_one(camera: Camera, images: Images, what: str) -> None:
    """Publish each exposure after the points of the previous one have arrived; print results."""
    camera.latencies = Latencies()
    for of_exposure in images:
        stamp = camera.publish(of_exposure)
        camera.wait(lambda stamp=stamp: stamp in camera.points, 30)
    print(f'{what}, one by one: {camera.latencies.text()}')


def measure_film(camera: Camera, images: Images, seconds: float, what: str) -> None:
    """Publish exposures at the rate of a camera, forwards and backwards; print results."""
    camera.latencies = Latencies()
    there_and_back = [*images, *reversed(images)]
    start = time.monotonic()
    number = 0
    while time.monotonic() < start + seconds:
        if camera.wait(lambda: time.monotonic() >= start + number / FILM_HZ):
            camera.publish(there_and_back[number % len(there_and_back)], round(1e9 / FILM_HZ))
            number += 1
    camera.wait(lambda: False, 3)
    values = camera.extraction['a']
    print(
        f'{what}, {FILM_HZ:g} Hz: {camera.latencies.text()}; {values["images shed"]} images of a '
        f'shed, {values["time of an image [ms]"]} ms an image in the mean'
    )


def measure_stream(
    camera: Camera,
    calibrated: Mapping[str, Any],
    extraction: Mapping[str, Any],
    shown: tuple[Images, float, str],
) -> None:
    """Start nodes with the saved calibrations and the shortest queue, and publish a film.

    Parameters
    ----------
    camera : Camera
    calibrated : mapping
        Parameters of the calibration node, whose folder has calibrations.
    extraction : mapping
        Parameters of the extraction node.
    shown : (Images, float, str)
        What is filmed, for how long [s], and its name.
    """
    folder = Path(calibrated['calibration_directory']).parent
    saved = {'calibration_directory': calibrated['calibration_directory']}
    with NodeProcesses(folder) as nodes:
        nodes.start('extraction_node', {**extraction, 'queue_size': 1})
        nodes.start('calibration_node', calibrated)
        nodes.start('correction_node', saved)
        nodes.start('reconstruction_node', saved)
        camera.exposures.clear()
        camera.wait(camera.ready)
        camera.points.clear()
        while not camera.points:
            camera.publish(shown[0][0])
            camera.wait(lambda: camera.points, 5)
        measure_film(camera, *shown)


def moving_markers(rig: VirtualRig, count: int) -> tuple[Images, dict[str, list[Frame]]]:
    """Return radiographs of moving markers, and the initial positions of the markers."""
    sequence = MarkerSequence(
        rig, MovingMarkers(MarkerScene(hidden=0.0), SEED), MARKER_SETTINGS, count, SEED
    )
    taken = list(sequence)
    first = {}
    for name, view in taken[0].items():
        ids = FIRST_ID + np.flatnonzero(view.seen)
        size = (view.image.shape[1], view.image.shape[0])
        first[name] = [Frame(name, 1, ids, view.uv[view.seen], size)]
    return [{name: view.image for name, view in views.items()} for views in taken], first


def run(exposures: int, steps: int, seconds: float, folder: Path) -> None:
    """Render, compare and measure."""
    rig = virtual_rig(SEED)
    poses = phantom_poses(np.random.default_rng(SEED), exposures)
    print('rendering', flush=True)
    still = rendered(rig, poses)
    film = rendered(rig, moving(poses[3], steps))
    frames = by_command(still, rig, folder)
    write_phantom(folder / 'phantom.csv', rig.phantom)
    rclpy.init(args=[])
    camera = Camera()
    phantom = {'phantom': folder / 'phantom.csv'}
    with NodeProcesses(folder) as nodes:
        extraction = nodes.start('extraction_node', phantom)
        calibrated = {**phantom, 'calibration_directory': folder / 'calibration', 'model': MODEL}
        nodes.start('calibration_node', calibrated)
        nodes.start('correction_node')
        nodes.start('reconstruction_node')
        camera.wait(camera.ready)
        camera.wait(lambda: False, SETTLING_S)
        start = time.monotonic()
        for number, of_exposure in enumerate(still, 1):
            camera.show(of_exposure, number)
        camera.wait(lambda: min(camera.exposures.values()) >= exposures, 120)
        print(f'{exposures} exposures extracted and collected in {time.monotonic() - start:.1f} s')
        compare(camera, frames, rig)
        camera.wait(lambda: camera.orientations)
        camera.wait(lambda: False, 3)  # time for the reconstruction to take up the orientation
        measure_one_by_one(camera, still[:8], 'other poses')
        measure_one_by_one(camera, film, 'slow motion')
        extraction.terminate()
        extraction.wait()
    calibrated['collect'] = 'request'
    measure_stream(camera, calibrated, phantom, (film, seconds, 'slow motion'))
    markers, first = moving_markers(rig, steps)
    write_observations_csv(folder / 'markers.csv', first)
    mode = {'mode': 'markers', 'markers': folder / 'markers.csv'}
    measure_stream(camera, calibrated, mode, (markers, seconds, 'markers'))
    camera.destroy_node()
    rclpy.shutdown()


# The whole chain, from images to poses.

CHAIN_SEED = 310
CHAIN_SETTINGS = replace(MARKER_SETTINGS, bits=8)
IMAGE_TYPE = 'sensor_msgs/msg/Image'
STAMP_AT = 4  # byte offset of the stamp in a serialized Image
WARM_UP_S = 3.0  # start of the bag, in which bodies are identified; excluded from the results
PLAYED = 'played.npy'  # stamps of the published exposures
TICKS = os.sysconf('SC_CLK_TCK')
# Steps of the processing of an exposure of two images in the process that follows markers.
PARTS: dict[str, tuple[tuple[type, str], ...]] = {
    'predict': ((MarkerStates, 'advance'), (JoinedViews, '_suggest')),
    'search': ((MarkerSearch, 'shadows'), (JoinedViews, '_search')),
    'fit': ((MarkerMeasurement, 'measure'),),
    'ids': (
        (JoinedViews, '_decide'),
        *((MarkerWatch, n) for n in ('shadows_met', 'recovered', 'other_shadows')),
        (MarkerWatch, 'moving_alone'),
    ),
    'rays and bodies': (
        (MarkerRays, 'intersect'),
        (MarkerBodies, 'update'),
        (MarkerBodies, 'learn'),
    ),
}


def write_chain(folder: Path, exposures: int, rate_hz: float = FILM_HZ) -> None:
    """Write calibration, bodies.csv, the truth, and a bag of images of moving bodies."""
    rig = virtual_rig(CHAIN_SEED)
    outcome = calibrate(simulate_exposures(rig, 15, CHAIN_SEED).frames, rig.phantom, joint=True)
    save_outcome(folder / 'calibration', outcome)
    markers = MovingMarkers(MarkerScene(), CHAIN_SEED)
    bodies = []
    for number in range(markers.scene.clusters):
        own = markers.cluster == number
        sd = np.full(np.count_nonzero(own), SHAPE_SD_MM)
        bodies.append(Body(f'bone_{number}', markers.target_id[own], markers.local_mm[own], sd))
    write_bodies(folder / 'bodies.csv', bodies)
    sequence = MarkerSequence(rig, markers, CHAIN_SETTINGS, exposures, CHAIN_SEED)
    truth: dict[str, list[np.ndarray]] = {name: [] for name in NAMES}
    with BagWriter(folder / 'images', overwrite=True) as bag:
        for number, views in enumerate(sequence):
            stamp_ns = FIRST_NS + round(number * 1e9 / rate_hz)
            for name, view in views.items():
                header = Header(stamp=stamp_from_nanoseconds(stamp_ns), frame_id=f'{name}_optical')
                data = serialize_message(message_from_image(header, view.image))
                bag.write(f'/{name}/image_raw', IMAGE_TYPE, data, stamp_ns)
                truth[name].append(np.where(view.seen[:, None], view.uv, np.nan))
    save_arrays(folder / 'truth.npz', {name: np.array(uv) for name, uv in truth.items()})


class BagCamera(Node):
    """Publishes the images of a bag at their times, stamped with the time of publication."""

    def __init__(self, bag: Path, times: int) -> None:
        super().__init__('bag_camera')
        outputs = {
            f'/{name}/image_raw': self.create_publisher(Image, f'{name}/image_raw', images_qos())
            for name in NAMES
        }
        wait_for_readers(self, outputs.values(), 1, threading.Event())
        by_time = groupby(iterate_messages(bag), key=attrgetter('log_time_ns'))
        exposures = [list(messages) for _, messages in by_time]
        start = time.monotonic()
        stamps = []
        for number in range(times * len(exposures)):
            time.sleep(max(0.0, start + number / FILM_HZ - time.monotonic()))
            stamp_ns = time.time_ns()
            stamps.append(stamp_ns)
            for message in exposures[_row(number, len(exposures))]:
                data = bytearray(message.data)
                struct.pack_into('<iI', data, STAMP_AT, stamp_ns // 10**9, stamp_ns % 10**9)
                outputs[message.topic].publish(bytes(data))
        wait_until_acknowledged(outputs.values(), threading.Event())
        np.save(bag.parent / PLAYED, stamps)


def _row(number: int, count: int) -> int:
    """Return the row of an exposure in a bag of `count` that is played forwards and backwards."""
    return min(number % (2 * count), -1 - number % (2 * count) + 2 * count)


class ChainReader(Node):
    """Records the publication time of each output, by the stamp of the images [ns]."""

    def __init__(self) -> None:
        super().__init__('chain_reader')
        self.came: dict[str, dict[int, int]] = {}
        self.observed: dict[str, list[TargetObservations]] = {name: [] for name in NAMES}
        self.tracked: dict[int, int] = {}  # number of bodies with a pose, by stamp
        for name in NAMES:
            self._listen(TargetObservations, f'{name}/target_observations')
            self._listen(CorrectedObservations, f'{name}/corrected_observations')
        self._listen(ReconstructedPoints, 'reconstruction/points_with_covariance')
        self._listen(BodyPoses, 'reconstruction/body_poses')
        self.extraction: dict[str, dict[str, str]] = {}
        self.create_subscription(DiagnosticArray, '/diagnostics', self._on_diagnostics, 10)

    def _listen(self, kind: Any, topic: str) -> None:
        came = self.came[topic] = {}

        def note(message: Any, info: Mapping[str, int]) -> None:
            stamp = nanoseconds_from_stamp(message.header.stamp)
            came.setdefault(stamp, info['source_timestamp'])  # retracted poses are published again
            if kind is TargetObservations:
                self.observed[topic.partition('/')[0]].append(message)
            if kind is BodyPoses:
                known = sum(s != BodyPoses.FAILED for s in message.status)
                self.tracked.setdefault(stamp, known)

        self.create_subscription(kind, topic, note, observations_qos())

    def _on_diagnostics(self, array: DiagnosticArray) -> None:
        for status in array.status:
            if status.name.startswith('/extraction_node'):
                self.extraction[status.hardware_id] = {v.key: v.value for v in status.values}


def cpu_seconds(pid: int) -> float:
    """Return the CPU time [s] that a process has used, summed over its threads."""
    fields = Path(f'/proc/{pid}/stat').read_text().rpartition(')')[2].split()
    return (int(fields[11]) + int(fields[12])) / TICKS


def processes_of(nodes: Mapping[str, int]) -> dict[str, list[int]]:
    """Return the process ids of nodes and of their workers."""
    out = {name: [pid] for name, pid in nodes.items()}
    for name, pid in nodes.items():
        children = [
            int(child)
            for task in Path(f'/proc/{pid}/task').iterdir()
            for child in (task / 'children').read_text().split()
        ]
        if children:
            out[f'{name}, its workers'] = children
    return out


def measure_chain(folder: Path, times: int) -> None:
    """Play the bag to the nodes `times` times; print losses, latencies and CPU times."""
    rclpy.init(args=[])
    reader = ChainReader()
    calibrated = {'calibration_directory': folder / 'calibration'}
    bodies = {**calibrated, 'bodies': folder / 'bodies.csv'}
    with NodeProcesses(folder) as programs:
        nodes = {
            'extraction_node': programs.start('extraction_node', {**bodies, 'mode': 'markers'}),
            'correction_node': programs.start('correction_node', calibrated),
            'reconstruction_node': programs.start('reconstruction_node', bodies),
        }
        wait_for_nodes(reader, len(nodes))
        play_bag = ('--play', str(folder / 'images'), '--times', str(times))
        camera = programs.run('benchmarks.extraction_live', *play_bag, log=folder / 'camera')
        counted: dict[str, float] = {}
        used: dict[str, float] = {}
        began = ended = 0
        last = 0.0
        while camera.poll() is None or time.monotonic() < last + 2:
            rclpy.spin_once(reader, timeout_sec=0.02)
            last = time.monotonic() if camera.poll() is None else last
            done = reader.came['reconstruction/body_poses']
            if not counted and len(done) > WARM_UP_S * FILM_HZ:
                began = max(done)
                ids = processes_of({name: p.pid for name, p in nodes.items()})
                counted = {n: sum(map(cpu_seconds, pids)) for n, pids in ids.items()}
            if counted and camera.poll() is None:
                used = {n: sum(map(cpu_seconds, pids)) for n, pids in ids.items()}
                ended = max(done)
    played = np.load(folder / PLAYED).tolist()
    stamps = [stamp for stamp in played if stamp > began]
    during = sum(stamp <= ended for stamp in stamps)
    print_chain(reader, stamps)
    total = 0.0
    for name, seconds in used.items():
        each = 1e3 * (seconds - counted[name]) / during
        total += each
        print(f'| {name} | {each:.1f} |')
    print(f'| together | {total:.1f} |', flush=True)
    number_of = {stamp: number for number, stamp in enumerate(played, 1)}
    save_arrays(
        folder / 'live.npz',
        {
            f'{name}_{number_of[nanoseconds_from_stamp(m.header.stamp)]:05d}': np.column_stack(
                [m.target_id, m.u, m.v, m.sigma]
            )
            for name, messages in reader.observed.items()
            for m in messages
        },
    )
    reader.destroy_node()
    rclpy.shutdown()


def wait_for_nodes(reader: ChainReader, count: int) -> None:
    """Wait until the outputs of all nodes are available."""
    topics = list(reader.came)
    end = time.monotonic() + 60
    while not all(map(reader.count_publishers, topics)) or len(reader.extraction) < 2:
        rclpy.spin_once(reader, timeout_sec=0.1)
        if time.monotonic() > end:
            raise RuntimeError(f'the {count} nodes do not publish: see their logs')


def print_chain(reader: ChainReader, stamps: Sequence[int]) -> None:
    """Print the lost exposures and the latencies [ms] of the others."""
    for topic, came in reader.came.items():
        late = 1e-6 * np.array([came[s] - s for s in stamps if s in came])
        p50, p95, p99 = np.percentile(late, [50, 95, 99])
        print(
            f'| {topic} | {len(stamps) - len(late)} of {len(stamps)} | {p50:.1f} | {p95:.1f} | '
            f'{p99:.1f} | {late.max():.1f} |'
        )
    came = reader.came['reconstruction/body_poses']
    tracked = np.array([reader.tracked[s] for s in stamps if s in came])
    print(f'bodies with a pose {tracked.mean():.3f} in the mean, at least {tracked.min()}')
    for name, values in reader.extraction.items():
        kept = ('images received', 'images extracted', 'images shed', 'lost at the input')
        print(name, {key: values[key] for key in kept if key in values}, flush=True)


def stopwatch(seconds: dict[str, float], part: str, owner: type, method: str) -> None:
    """Add the duration of calls of a method to the seconds of a part."""
    plain = getattr(owner, method)

    def timed(*arguments: Any, **keywords: Any) -> Any:
        began = time.thread_time()
        try:
            return plain(*arguments, **keywords)
        finally:
            seconds[part] += time.thread_time() - began

    setattr(owner, method, timed)


def measure_parts(folder: Path, exposures: int, pause_s: float) -> None:
    """Follow the images of the bag in this process, and print how the time is spent."""
    bodies = read_bodies(folder / 'bodies.csv')
    calibrations = read_calibrations(folder / 'calibration', NAMES)
    orientation = load_orientation(orientation_path(folder / 'calibration')).subset(NAMES)
    follower = MarkerSettings(
        {}, calibrations=calibrations, orientation=orientation, bodies=bodies
    )()
    seconds = dict.fromkeys((*PARTS, 'decode', 'all'), 0.0)
    for part, methods in PARTS.items():
        for owner, method in methods:
            stopwatch(seconds, part, owner, method)
    converter = ImageConverter('')
    warm = round(WARM_UP_S * FILM_HZ)
    out = {}
    images: dict[str, np.ndarray] = {}
    number = 0
    with one_core():
        for message in iterate_messages(folder / 'images'):
            name = message.topic.split('/')[1]
            time.sleep(pause_s)
            began = time.thread_time()
            images[name], _ = converter.decoded(deserialize_message(message.data, Image))
            seconds['decode'] += time.thread_time() - began
            if len(images) < len(NAMES):
                continue
            number += 1
            began = time.thread_time()
            found = follower.extract(images, number)
            seconds['all'] += time.thread_time() - began
            images = {}
            if number == warm:
                seconds.update(dict.fromkeys(seconds, 0.0))
            for view, of_view in found.items():
                out[f'{view}_{number:05d}'] = np.column_stack(
                    [of_view.target_id, of_view.uv, of_view.sigma]
                )
            if number == exposures:
                break
    for part, total in seconds.items():
        print(f'| {part} | {1e3 * total / (number - warm):.2f} |')
    save_arrays(folder / 'offline.npz', out)


def save_arrays(path: Path, found: Mapping[str, np.ndarray]) -> None:
    """Write arrays by name; those of images have rows of id, u, v, sigma."""
    arrays: dict[str, Any] = dict(found)
    np.savez(path, **arrays)


def compare_chain(folder: Path) -> None:
    """Print the differences between truth, live observations and observations of this process."""
    truth = np.load(folder / 'truth.npz')
    for source in ('offline', 'live'):
        if not (folder / f'{source}.npz').exists():
            continue
        wrong = measured = seen = 0
        errors = []
        with np.load(folder / f'{source}.npz') as found:
            for key in found.files:
                name, number = key.split('_')
                true = truth[name][_row(int(number) - 1, len(truth[name]))]
                rows = found[key]
                away = rows[:, 1:3] - true[rows[:, 0].astype(int) - FIRST_ID]
                distance = np.linalg.norm(away, axis=1)
                wrong += int(np.count_nonzero(distance > WRONG_PX))
                measured += int(np.isfinite(distance).sum())
                seen += int(np.isfinite(true[:, 0]).sum())
                errors.append(away[distance <= WRONG_PX])
        rmse = np.sqrt(np.mean(np.concatenate(errors) ** 2))
        print(
            f'{source}: {measured / seen:.2%} of {seen} visible markers measured, {wrong} further '
            f'than {WRONG_PX} px from their place, RMSE {rmse:.4f} px'
        )
    if (folder / 'live.npz').exists() and (folder / 'offline.npz').exists():
        with np.load(folder / 'live.npz') as live, np.load(folder / 'offline.npz') as own:
            pairs = [(live[key], own[key]) for key in live.files if key in own.files]
        same = [
            (one, other)
            for one, other in pairs
            if len(one) == len(other) and (one[:, 0] == other[:, 0]).all()
        ]
        away = np.concatenate([one[:, 1:3] - other[:, 1:3] for one, other in same])
        print(
            f'{len(same)} of {len(pairs)} images have the same ids live and offline, which began '
            f'with other images; their places differ by {np.sqrt(np.mean(away**2)):.1g} px (RMS)'
        )


def chain(folder: Path, seconds: float, parts: bool, times: int) -> None:
    """Render missing data, and measure the chain or the parts of an exposure."""
    exposures = round(seconds * FILM_HZ)
    if not (folder / 'truth.npz').exists():
        write_chain(folder, exposures)
    if parts:
        measure_parts(folder, exposures, 0.0)
    else:
        measure_chain(folder, times)
    compare_chain(folder)


def play(bag: Path, times: int) -> None:
    """Play a bag as a camera would publish it."""
    rclpy.init(args=[])
    BagCamera(bag, times)
    rclpy.shutdown()


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument('--exposures', type=int, default=15)
    parser.add_argument('--steps', type=int, default=15, help='images of the moving phantom')
    parser.add_argument('--seconds', type=float, default=20.0, help='length of the film')
    parser.add_argument('--chain', type=float, metavar='SECONDS', help='from images to poses')
    parser.add_argument('--parts', action='store_true', help='with --chain: parts of an exposure')
    parser.add_argument('--times', type=int, default=1, help='that the bag is played')
    parser.add_argument('--play', type=Path, metavar='BAG', help=argparse.SUPPRESS)
    parser.add_argument('--folder', type=Path, help='of images and logs, which are kept')
    arguments = parser.parse_args()
    if arguments.play:
        play(arguments.play, arguments.times)
        return
    isolate_ros_graph()
    with tempfile.TemporaryDirectory() as temporary:
        folder = arguments.folder or Path(temporary)
        folder.mkdir(exist_ok=True)
        if arguments.chain:
            chain(folder, arguments.chain, arguments.parts, arguments.times)
        else:
            run(arguments.exposures, arguments.steps, arguments.seconds, folder)


if __name__ == '__main__':
    main()
