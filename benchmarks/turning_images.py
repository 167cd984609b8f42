# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Image correction while a C-arm rotates, compared with the same images at a constant angle.

    python -m benchmarks.turning_images [--seconds 10] [--only NAME]     printed as the tables of
    docs/how_good/speed.md

Camera, image node and the reader (this process) share the machine. Cases at 30 Hz have one or two
fluoroscopes; in cases `fast`, the camera sends an image as soon as one of three in flight is
corrected. The arm rotates at 30 degrees per second back and forth, so each image needs another
map. A joint state comes with each image. Segments of shared memory of Fast DDS are large, as
described in docs/extraction.md. `correct` corrects a video and a stack, in this process.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import struct
import subprocess
import sys
import tempfile
import threading
import time
from array import array
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import IO, Any

import cv2
import numpy as np

from benchmarks.bead_images import bead_image
from fluoro_calib_ros.correction.fluoroscope_calibration import FluoroscopeCalibration
from fluoro_calib_ros.estimation.calibrate import calibrate
from fluoro_calib_ros.images.angle_maps import AngleMaps
from fluoro_calib_ros.jobs.image_correction import ImageCorrectionRequest, run_image_correction
from fluoro_calib_ros.simulation.rig import simulate_exposures, virtual_rig
from tools.sections import show_section

from .images import WIDE, _cpu, _stream_figures, wait
from .timing import table

NAMES = ('a', 'b')
CHANGE_PX = 3.0  # change at the rim
EXPOSURES = 15
RANGE = np.deg2rad(70)  # maximum angle, in either direction
TURN = np.deg2rad(30)  # rad/s
STILL = np.deg2rad(20)
DIFFERENT = 8  # distinct images, published in turn
IN_FLIGHT = 3  # images in flight per fluoroscope, if the camera is as fast as the node
VIDEO_FRAMES = 150
MAPS = 'maps made for angles'  # key in the diagnostics of the node
CASES = {  # name: (encoding, rate, names); rate 0: as fast as the node
    'mono8 30 Hz': ('mono8', 30.0, 'a'),
    'mono8 30 Hz, two': ('mono8', 30.0, 'ab'),
    'mono16 30 Hz': ('mono16', 30.0, 'a'),
    'mono16 30 Hz, two': ('mono16', 30.0, 'ab'),
    'mono8 fast': ('mono8', 0.0, 'a'),
    'mono8 fast, two': ('mono8', 0.0, 'ab'),
    'mono16 fast': ('mono16', 0.0, 'a'),
    'mono16 fast, two': ('mono16', 0.0, 'ab'),
}


def turned(uv: np.ndarray, angle: float, size: tuple[int, int]) -> np.ndarray:
    """Return the change (n, 2) [px] of the distortion at pixels uv (n, 2) for an angle [rad]."""
    x, y = ((uv - (np.asarray(size) - 1) / 2) / (max(size) / 2)).T
    spiral = (x * x + y * y)[:, None] * np.column_stack([-y, x])
    bend = np.column_stack([x * x, -y * y]) * y[:, None]
    return CHANGE_PX * (np.cos(angle) * spiral + np.sin(angle) * bend)


def calibrations_of_a_turning_rig() -> dict[str, FluoroscopeCalibration]:
    """Calibrate both fluoroscopes from exposures at angles over the range."""
    rig = virtual_rig(1)
    angles = np.random.default_rng(3).permutation(np.linspace(-RANGE, RANGE, EXPOSURES))
    out = {}
    for name, frames in simulate_exposures(rig, EXPOSURES, 1).frames.items():
        at_angles = []
        for frame, angle in zip(frames, angles):
            uv = frame.uv + turned(frame.uv, angle, frame.image_size)
            on = ((uv > 0) & (uv < np.asarray(frame.image_size) - 1)).all(axis=1)
            sigma = None if frame.sigma is None else frame.sigma[on]
            at_angles.append(
                replace(
                    frame,
                    target_id=frame.target_id[on],
                    uv=uv[on],
                    sigma=sigma,
                    angle=float(angle),
                )
            )
        out[name] = calibrate({name: at_angles}, rig.phantom).calibrations[name]
        assert out[name].angle_field is not None
    return out


# ---- maps


def accuracy(calibration: FluoroscopeCalibration, repeats: int = 40) -> dict[str, float]:
    """Measure CPU time of a new map [ms], and distances of corrected sources from pixels [px]."""
    cv2.setNumThreads(1)
    maps = AngleMaps(calibration)
    times = []
    for number in range(repeats):
        began = time.process_time()
        maps.at((number - repeats // 2) * maps.step)
        times.append(time.process_time() - began)
    within, beyond = [], []
    for angle in np.linspace(-0.95, 0.95, 9) * RANGE:
        corrector = maps.at(angle)
        v, u = np.nonzero(corrector.mask)
        at_u, at_v = corrector.source[:, v, u].astype(float)
        x, y, *_ = calibration.correct_arrays(at_u, at_v, None, maps.rounded(angle))
        error = np.hypot(x - u, y - v)
        inside = corrector.status[v, u] == 0
        within.append(error[inside])
        beyond.append(error[~inside])
    inside, outside = np.concatenate(within), np.concatenate(beyond)
    return {
        'map_cpu_ms': 1e3 * float(np.median(times)),
        'step_deg': float(np.rad2deg(maps.step)),
        'within_rms_px': float(np.sqrt(np.mean(inside**2))),
        'within_max_px': float(inside.max()),
        'beyond_rms_px': float(np.sqrt(np.mean(outside**2))),
        'beyond_max_px': float(outside.max()),
    }


# ---- files


def on_files(calibration: FluoroscopeCalibration) -> dict[str, dict[str, float]]:
    """Measure `correct` on a stack and a video [ms per image], at one angle and rotating."""
    angles = {n + 1: float(_angle(n / 30.0, True)) for n in range(VIDEO_FRAMES)}
    frames = _pictures(np.uint8, NAMES[:1])['a']
    out = {}
    with tempfile.TemporaryDirectory() as folder:
        source = Path(folder) / 'trial.tif'
        cv2.imwritemulti(
            str(source),
            [frames[n % DIFFERENT] for n in range(VIDEO_FRAMES)],
            [cv2.IMWRITE_TIFF_COMPRESSION, 1],
        )
        for path in (_video(Path(folder), frames), source):
            for kind in ('constant', 'turning'):
                still = kind == 'constant'
                request = ImageCorrectionRequest(
                    path,
                    Path(folder) / f'{kind}{path.suffix}',
                    calibration.at_angle(STILL) if still else calibration,
                    angles=None if still else angles,
                )
                wall, cpu = time.perf_counter(), time.process_time()
                run_image_correction(request)
                out[f'{path.suffix[1:]}, {kind}'] = {
                    'ms': 1e3 * (time.perf_counter() - wall) / VIDEO_FRAMES,
                    'cpu_ms': 1e3 * (time.process_time() - cpu) / VIDEO_FRAMES,
                }
    return out


def _video(folder: Path, frames: Sequence[np.ndarray]) -> Path:
    """Write a grey FFV1 video of the images."""
    path = folder / 'trial.avi'
    size = frames[0].shape[::-1]
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*'FFV1'), 30.0, size, isColor=False)
    for number in range(VIDEO_FRAMES):
        writer.write(frames[number % DIFFERENT])
    writer.release()
    return path


# ---- live


def _angle(seconds: float, turns: bool) -> float:
    """Return the angle [rad] of the arm at a time; it rotates back and forth."""
    if not turns:
        return STILL
    path = (TURN * seconds) % (4 * RANGE)
    return float(path - RANGE if path < 2 * RANGE else 3 * RANGE - path)


def _pictures(dtype: type, names: Sequence[str]) -> dict[str, list[np.ndarray]]:
    """Return images of the phantom, several of each fluoroscope."""
    exposures = simulate_exposures(virtual_rig(1), DIFFERENT, 1).frames
    return {
        name: [
            bead_image(frame.uv, frame.image_size, dtype, seed=number)
            for number, frame in enumerate(exposures[name])
        ]
        for name in names
    }


@dataclass(frozen=True)
class _Show:
    """Images to show: encoding, rate [Hz], names, whether the arm rotates, duration [s]."""

    encoding: str
    rate: float
    names: str
    turns: bool
    seconds: float


def camera(show: _Show) -> None:
    """Publish images of all fluoroscopes, each after a joint state with the same stamp."""
    import rclpy
    from rclpy.serialization import serialize_message
    from sensor_msgs.msg import CameraInfo, Image, JointState

    from fluoro_calib_ros.nodes.messages.observations import stamp_from_nanoseconds
    from fluoro_calib_ros.nodes.runtime.streams import StreamReader
    from fluoro_calib_ros.nodes.runtime.topics import (
        images_qos,
        observations_qos,
        wait_for_readers,
        wait_until_acknowledged,
    )

    from .online import logged

    rclpy.init(args=[])
    node = rclpy.create_node('camera')
    exposures = simulate_exposures(virtual_rig(1), 1, 1).frames
    messages: dict[str, list[bytearray]] = {}
    dtype = np.uint8 if show.encoding == 'mono8' else np.uint16
    for name, pictures in _pictures(dtype, show.names).items():
        messages[name] = []
        for image in pictures:
            message = Image(
                height=image.shape[0],
                width=image.shape[1],
                encoding=show.encoding,
                step=image.shape[1] * image.itemsize,
                data=array('B', image.tobytes()),
            )
            message.header.frame_id = exposures[name][0].frame_id
            messages[name].append(bytearray(serialize_message(message)))
    outputs = {n: node.create_publisher(Image, f'{n}/image_raw', images_qos()) for n in show.names}
    states = node.create_publisher(JointState, 'joint_states', observations_qos())
    free = {name: threading.Semaphore(IN_FLIGHT) for name in show.names}
    reader = StreamReader(node, logged(node))
    if not show.rate:
        for name in show.names:
            reader.subscribe(
                CameraInfo,
                f'{name}/image_corrected/camera_info',
                partial(_release, free[name]),
                images_qos(),
                decode=bytes,
            )
    reader.start()
    ending = threading.Event()
    wait_for_readers(node, list(outputs.values()), 1, ending)
    wait_for_readers(node, [states], 1, ending)
    time.sleep(1.0)
    began = time.monotonic()
    lock = threading.Lock()
    sent = dict.fromkeys(show.names, 0)

    def publish(name: str, number: int) -> None:
        with lock:
            now = time.time_ns()
            state = JointState(
                name=['carm'], position=[_angle(time.monotonic() - began, show.turns)]
            )
            state.header.stamp = stamp_from_nanoseconds(now)
            states.publish(state)
        message = messages[name][number % DIFFERENT]
        struct.pack_into('<iI', message, 4, *divmod(now, 10**9))  # after the CDR header
        outputs[name].publish(bytes(message))
        sent[name] += 1

    def show_all(name: str, late: float) -> None:
        number = 0
        while time.monotonic() - began < show.seconds:
            if show.rate:
                time.sleep(max(0.0, began + late + number / show.rate - time.monotonic()))
            elif not free[name].acquire(timeout=1.0):
                continue
            publish(name, number)
            number += 1

    threads = [
        threading.Thread(target=show_all, args=(name, 0.5 * place / max(show.rate, 1.0)))
        for place, name in enumerate(show.names)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    wait_until_acknowledged(list(outputs.values()), ending)
    print(json.dumps(sent), flush=True)
    reader.stop()
    node.destroy_node()
    rclpy.shutdown()


def _release(free: threading.Semaphore, data: bytes, info: dict[str, int]) -> None:
    free.release()


class _Reader:
    """Publishes the calibrations and records the outputs of the node."""

    def __init__(self, calibrations: dict[str, FluoroscopeCalibration]) -> None:
        import rclpy
        from fluoro_calib_msgs.msg import FluoroscopeCalibration

        from fluoro_calib_ros.nodes.messages.fluoroscope_calibration import (
            message_from_calibration,
        )
        from fluoro_calib_ros.nodes.runtime.topics import latched_qos

        self.node = rclpy.create_node('reader')
        self._latched = []
        for name, calibration in calibrations.items():
            publisher = self.node.create_publisher(
                FluoroscopeCalibration, f'{name}/calibration', latched_qos()
            )
            publisher.publish(message_from_calibration(calibration))
            self._latched.append(publisher)

    def listen(self, names: str) -> tuple[dict[str, list[tuple[int, int]]], Any]:
        """Collect (stamp, latency) [ns] of the outputs; the caller must stop the reader."""
        from diagnostic_msgs.msg import DiagnosticArray
        from rclpy.qos import QoSProfile
        from sensor_msgs.msg import Image

        from fluoro_calib_ros.nodes.runtime.streams import StreamReader
        from fluoro_calib_ros.nodes.runtime.topics import images_qos

        from .online import logged

        came: dict[str, list[tuple[int, int]]] = {name: [] for name in names}
        maps: dict[str, int] = {}
        self.maps = maps

        def note(message: DiagnosticArray, info: dict[str, int]) -> None:
            for status in message.status:
                values = {value.key: value.value for value in status.values}
                if MAPS in values:
                    maps[status.name] = int(values[MAPS])

        def take(name: str, data: bytes, info: dict[str, int]) -> None:
            seconds, nanoseconds = struct.unpack_from('<iI', data, 4)
            stamp = seconds * 10**9 + nanoseconds
            came[name].append((stamp, info['source_timestamp'] - stamp))

        reader = StreamReader(self.node, logged(self.node))
        reader.subscribe(DiagnosticArray, '/diagnostics', note, QoSProfile(depth=10))
        for name in names:
            reader.subscribe(
                Image,
                f'{name}/image_corrected',
                partial(take, name),
                images_qos(),
                decode=bytes,
            )
        reader.start()
        return came, reader


def measured(reader: _Reader, show: _Show, log: IO[bytes]) -> dict[str, Any]:
    """Measure the node: rate per fluoroscope [Hz], losses, latencies [ms] and CPU time [ms]."""
    node = subprocess.Popen(
        [
            sys.executable,
            *['-m', 'fluoro_calib_ros.nodes.image_node', '--ros-args'],
            *['-p', f'fluoroscopes:=[{",".join(show.names)}]', '-p', 'angle_joint:=carm'],
            *['-p', 'inputs:=raw'],
        ],
        stdout=log,
        stderr=log,
    )
    came, stream = reader.listen(show.names)
    in_use = 'pixels of the corrected image are empty'
    path = Path(log.name)
    wait(lambda: path.read_text(errors='replace').count(in_use) == len(show.names), 60, 'the node')
    source = subprocess.Popen(
        [sys.executable, '-m', 'benchmarks.turning_images', '--camera', json.dumps(vars(show))],
        stdout=subprocess.PIPE,
        stderr=log,
    )
    try:
        wait(lambda: all(came.values()), 60, 'the first images')
        began = _cpu(node)
        first = sum(map(len, came.values()))
        stdout, _ = source.communicate(timeout=show.seconds + 60)
        sent = json.loads(stdout)
        used = _cpu(node) - began
        counted = sum(map(len, came.values())) - first
        time.sleep(1.5)  # wait for the last diagnostics
    finally:
        for process in (source, node):
            if process.poll() is None:
                process.send_signal(signal.SIGINT)
            process.wait(20)
        stream.stop()
    each = [_stream_figures(np.array(came[name]), sent[name]) for name in show.names]
    return {
        'rate': float(np.mean([f['rate'] for f in each])),
        'images': sum(f['images'] for f in each),
        'lost': sum(f['lost'] for f in each),
        'maps': sum(reader.maps.values()),
        'p50': float(np.mean([f['p50'] for f in each])),
        'p99': max(f['p99'] for f in each),
        'cpu_ms': 1e3 * used / max(counted, 1),
    }


def live(
    calibrations: dict[str, FluoroscopeCalibration], seconds: float, only: str = ''
) -> dict[str, dict[str, Any]]:
    """Return results of cases whose name contains `only`, at a constant angle and rotating."""
    import rclpy

    from fluoro_calib_ros.demo.assessment import isolate_ros_graph

    isolate_ros_graph()
    out = {}
    with tempfile.NamedTemporaryFile('w', suffix='.xml') as profile:
        profile.write(WIDE)
        profile.flush()
        os.environ['FASTRTPS_DEFAULT_PROFILES_FILE'] = profile.name
        rclpy.init(args=[])
        reader = _Reader(calibrations)
        for case, (encoding, rate, names) in CASES.items():
            if only not in case:
                continue
            for kind in ('constant', 'turning'):
                show = _Show(encoding, rate, names, kind == 'turning', seconds)
                with tempfile.NamedTemporaryFile('wb', suffix='.log') as log:
                    out[f'{case}, {kind}'] = measured(reader, show, log)
                print(f'{case}, {kind}', out[f'{case}, {kind}'], file=sys.stderr, flush=True)
        reader.node.destroy_node()
        rclpy.shutdown()
    return out


def text_of(
    cases: dict[str, dict[str, Any]], files: dict[str, dict[str, float]], maps: dict[str, float]
) -> tuple[str, str, str]:
    """Return the tables of live cases and files, and the accuracy of the maps."""
    rows = [
        [
            case,
            f'{f["rate"]:.1f}',
            str(f['images']),
            str(f['lost']),
            str(f['maps']),
            f'{f["p50"]:.1f}',
            f'{f["p99"]:.1f}',
            f'{f["cpu_ms"]:.1f}',
        ]
        for case, f in cases.items()
    ]
    head = [
        'live',
        'images/s',
        'images',
        'lost',
        'maps',
        'p50 [ms]',
        'p99 [ms]',
        'CPU per image [ms]',
    ]
    first = table(head, rows)
    rows = [[case, f'{f["ms"]:.1f}', f'{f["cpu_ms"]:.1f}'] for case, f in files.items()]
    second = table(['`correct`', 'per image [ms]', 'CPU per image [ms]'], rows)
    return first, second, '\n'.join(f'{k}: {v:.4f}' for k, v in maps.items())


if __name__ == '__main__':
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--seconds', type=float, default=10.0)
    parser.add_argument('--only', default='', help='live cases whose name contains this')
    parser.add_argument('--camera', default='', help='be the camera: what it shows, as JSON')
    parser.add_argument('--out', type=Path, help='page with the tables, docs/how_good/speed.md')
    options = parser.parse_args()
    if options.camera:
        camera(_Show(**json.loads(options.camera)))
    else:
        rig = calibrations_of_a_turning_rig()
        first, second, maps = text_of(
            live(rig, options.seconds, options.only), on_files(rig['a']), accuracy(rig['a'])
        )
        show_section(first, options.out, 'turning images, live')
        show_section(second, options.out, 'turning images, files')
        print(maps)
