# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Images to points in space, live: `python -m benchmarks.extraction_live`.

Radiographs of a virtual rig go through the nodes: extraction, calibration, correction,
reconstruction. First the observations and the calibration are compared with those of the jobs
behind the commands extract and calibrate. Then the latency from two images to their points, and
the rate, are measured: for a phantom in ever other poses, for one that moves slowly and is
followed, for one that is filmed at 30 Hz, and for 30 markers that are filmed so.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from fluoro_calib_msgs.msg import (
    CalibrationStatus,
    ReconstructedPoints,
    RigOrientation,
    TargetObservations,
)
from fluoro_calib_msgs.srv import Calibrate
from rclpy.node import Node
from sensor_msgs.msg import Image
from std_msgs.msg import Header

from fluoro_calib_ros.demo.assessment import NodeProcesses, isolate_ros_graph
from fluoro_calib_ros.estimation.options import CalibrationOptions, CalibrationRequest
from fluoro_calib_ros.exposures.frame import Frame
from fluoro_calib_ros.images.codec import encode
from fluoro_calib_ros.io.observations import write_observations_csv
from fluoro_calib_ros.io.phantom import write_phantom
from fluoro_calib_ros.jobs.calibration import run_calibration
from fluoro_calib_ros.jobs.extraction import ExtractionRequest, run_extraction
from fluoro_calib_ros.jobs.simulation import SETTINGS, RenderedScene, Renderers
from fluoro_calib_ros.nodes.messages.image import message_from_image
from fluoro_calib_ros.nodes.messages.observations import stamp_from_nanoseconds
from fluoro_calib_ros.nodes.runtime.topics import images_qos, latched_qos, observations_qos
from fluoro_calib_ros.photogrammetry.rotations import matrix_from_vector
from fluoro_calib_ros.simulation.exposures import phantom_poses
from fluoro_calib_ros.simulation.marker_images import (
    FIRST_ID,
    MARKER_SETTINGS,
    MarkerScene,
    MarkerSequence,
    MovingMarkers,
)
from fluoro_calib_ros.simulation.rig import Pose, VirtualRig, virtual_rig

NAMES = ('a', 'b')
SEED = 31
MODEL = 'local_linear'
TURN_RAD = np.deg2rad(1.0)  # of the phantom from image to image
SHIFT_MM = 1.0
FILM_HZ = 30.0
FIRST_NS = 1_700_000_000_000_000_000
EXPOSURE_NS = 500_000_000
SETTLING_S = 2.0  # in which a node discovers the camera, too

Images = Sequence[Mapping[str, np.ndarray]]


@dataclass
class Latencies:
    """Exposures that were published, and when the points of some came [s]."""

    published: dict[int, float] = field(default_factory=dict)
    came: dict[int, float] = field(default_factory=dict)

    def text(self) -> str:
        """Return rate and latencies in words."""
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
    """Publishes images and hears what comes of them."""

    def __init__(self) -> None:
        super().__init__('camera')
        self.observed: dict[tuple[str, int], TargetObservations] = {}
        self.exposures: dict[str, int] = {}
        self.points: dict[int, int] = {}  # number of points by stamp
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
        """Spin until a condition holds; returns whether it does."""
        end = time.monotonic() + seconds
        while not condition():
            if time.monotonic() > end:
                return False
            rclpy.spin_once(self, timeout_sec=0.05)
        return True

    def ready(self) -> bool:
        """Return whether the nodes receive images, and are known."""
        return bool(self.exposures) and all(
            output.get_subscription_count() for output in self._images.values()
        )

    def publish(self, images: Mapping[str, np.ndarray], interval_ns: int = EXPOSURE_NS) -> int:
        """Publish the images of an exposure; returns its stamp."""
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

        A busy machine may lose images between writer and reader.
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
    """Take radiographs of the phantom in poses."""
    renderers = Renderers(rig.fluoroscopes, SETTINGS['clean'])
    try:
        return [
            renderers.images(RenderedScene(rig.true_mm, pose, number))
            for number, pose in enumerate(poses)
        ]
    finally:
        renderers.close()


def moving(start: Pose, count: int) -> list[Pose]:
    """Poses of a phantom that turns and goes."""
    return [
        (
            matrix_from_vector([0, 0, TURN_RAD * number]) @ start[0],
            start[1] + [0, 0, SHIFT_MM * number],
        )
        for number in range(count)
    ]


def by_command(images: Images, rig: VirtualRig, folder: Path) -> dict[str, list[Frame]]:
    """Extract images as the command does, from files."""
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
    """Print how observations and calibrations differ between nodes and command."""
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
    """Publish each exposure when the points of the one before have come, and print."""
    camera.latencies = Latencies()
    for of_exposure in images:
        stamp = camera.publish(of_exposure)
        camera.wait(lambda stamp=stamp: stamp in camera.points, 30)
    print(f'{what}, one by one: {camera.latencies.text()}')


def measure_film(camera: Camera, images: Images, seconds: float, what: str) -> None:
    """Publish exposures at the rate of a camera, forth and back, and print."""
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
    """Start nodes with the saved calibrations and the shortest queue, and film.

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
    """Return radiographs of markers in motion, and where they are in the first ones."""
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
    isolate_ros_graph()
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
        camera.wait(lambda: False, 3)  # the reconstruction takes the orientation
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


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--exposures', type=int, default=15)
    parser.add_argument('--steps', type=int, default=15, help='images of the moving phantom')
    parser.add_argument('--seconds', type=float, default=20.0, help='length of the film')
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        run(arguments.exposures, arguments.steps, arguments.seconds, Path(folder))


if __name__ == '__main__':
    main()
