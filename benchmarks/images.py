# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Speed of image correction: on one core, and in the live node compared with a plain relay.

    python -m benchmarks.images [--seconds 10] [--only NAME]      printed as the tables of
    docs/how_good/speed.md
    python -m benchmarks.images --picture docs/images/corrected_image.png

Camera, node and the reader (this process, or a separate one for another transport) share the
machine. An image without an output is lost; latency is from the stamp of the camera, set
just before it publishes, to the time stamp that DDS gives the output. A segment of shared memory
of Fast DDS is smaller than an image by default: the cases `wide` use one of 32 MB, as described in
docs/extraction.md.
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
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

import cv2
import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from scipy.ndimage import map_coordinates

from benchmarks.bead_images import bead_image
from fluoro_calib_ros.correction.fluoroscope_calibration import FluoroscopeCalibration
from fluoro_calib_ros.estimation.calibrate import calibrate
from fluoro_calib_ros.exposures.frame import Frame
from fluoro_calib_ros.images.corrector import ImageCorrector
from fluoro_calib_ros.simulation.rig import simulate_exposures, virtual_rig
from tools.sections import show_section

from .timing import table, timed

if TYPE_CHECKING:
    from fluoro_calib_ros.nodes.runtime.streams import StreamReader

TICK = os.sysconf('SC_CLK_TCK')
WIDE = """<?xml version="1.0" encoding="UTF-8"?>
<profiles xmlns="http://www.eprosima.com">
  <transport_descriptors>
    <transport_descriptor>
      <transport_id>wide</transport_id><type>SHM</type>
      <segment_size>33554432</segment_size><maxMessageSize>4194304</maxMessageSize>
    </transport_descriptor>
    <transport_descriptor><transport_id>udp</transport_id><type>UDPv4</type></transport_descriptor>
  </transport_descriptors>
  <participant profile_name="images" is_default_profile="true">
    <rtps>
      <userTransports><transport_id>wide</transport_id><transport_id>udp</transport_id></userTransports>
      <useBuiltinTransports>false</useBuiltinTransports>
    </rtps>
  </participant>
</profiles>
"""
CASES = {  # name: (encoding, rate, node)
    'mono8 120 Hz': ('mono8', 120, 'image_node'),
    'mono8 120 Hz, relay': ('mono8', 120, 'relay'),
    'mono16 60 Hz': ('mono16', 60, 'image_node'),
    'mono16 60 Hz, relay': ('mono16', 60, 'relay'),
}
CORNER = (744, 20, 260)  # left, top, side [px]
ORANGE = '#D55E00'
OUTPUTS = {'image_node': 'a/image_corrected', 'relay': 'a/relayed'}


def calibration_of_the_rig() -> tuple[FluoroscopeCalibration, list[Frame]]:
    """Return calibration and frames of fluoroscope a of the rig that the camera shows."""
    rig = virtual_rig(1)
    frames = simulate_exposures(rig, 15, 1).frames['a']
    return calibrate({'a': frames}, rig.phantom).calibrations['a'], frames


# ---- one core


def on_one_core(
    calibration: FluoroscopeCalibration, frames: Sequence[Frame], repeats: int = 200
) -> list[dict[str, Any]]:
    """Measure the correction alone, and scipy's map_coordinates with the same map.

    ms: median wall time; rate: images per second of CPU.
    """
    cv2.setNumThreads(1)
    out = []
    for interpolation, order in (('linear', 1), ('cubic', 3)):
        corrector, seconds = timed(lambda: ImageCorrector(calibration, interpolation))
        for dtype in (np.uint8, np.uint16):
            image = bead_image(frames[0].uv, calibration.image_size, dtype)
            into = np.empty_like(image)
            began = time.process_time()
            _, wall = timed(lambda: corrector.correct(image, into), repeats)
            cpu = (time.process_time() - began) / repeats
            source = np.nan_to_num(corrector.source)[::-1]
            _, of_scipy = timed(
                lambda: map_coordinates(image, source, order=order, mode='nearest'), 3
            )
            out.append(
                {
                    'depth': 8 * image.itemsize,
                    'interpolation': interpolation,
                    'ms': 1e3 * wall,
                    'cpu_ms': 1e3 * cpu,
                    'rate': 1 / cpu,
                    'scipy_ms': 1e3 * of_scipy,
                    'map_s': seconds,
                }
            )
    return out


# ---- live


class Reader:
    """Publishes the calibration and records the outputs of the nodes."""

    def __init__(self, calibration: FluoroscopeCalibration) -> None:
        import rclpy
        from fluoro_calib_msgs.msg import FluoroscopeCalibration

        from fluoro_calib_ros.nodes.messages.fluoroscope_calibration import (
            message_from_calibration,
        )
        from fluoro_calib_ros.nodes.runtime.topics import latched_qos

        self.node = rclpy.create_node('reader')
        self._latched = self.node.create_publisher(
            FluoroscopeCalibration, 'a/calibration', latched_qos()
        )
        self._latched.publish(message_from_calibration(calibration))
        self.came: list[tuple[int, int]] = []
        self._reader: StreamReader | None = None

    def listen(self, topic: str) -> None:
        """Collect (stamp, latency) [ns] of a topic without decoding the images."""
        from sensor_msgs.msg import Image

        from fluoro_calib_ros.nodes.runtime.streams import StreamReader
        from fluoro_calib_ros.nodes.runtime.topics import images_qos

        from .online import logged

        came: list[tuple[int, int]] = []
        self.came = came

        def take(data: bytes, info: dict[str, int]) -> None:
            seconds, nanoseconds = struct.unpack_from('<iI', data, 4)
            stamp = seconds * 10**9 + nanoseconds
            came.append((stamp, info['source_timestamp'] - stamp))

        reader = StreamReader(self.node, logged(self.node))
        reader.subscribe(Image, topic, take, images_qos(), decode=bytes)
        reader.start()
        self._reader = reader

    def stop(self) -> None:
        """Stop recording."""
        if self._reader is not None:
            self._reader.stop()


def wait(condition: Callable[[], Any], seconds: float, what: str) -> None:
    """Wait until condition() is true."""
    end = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > end:
            raise SystemExit(f'waited {seconds} s for {what}')
        time.sleep(0.02)


def _cpu(process: subprocess.Popen[Any]) -> float:
    """Return the CPU time [s] that a process has used, summed over its threads."""
    fields = Path(f'/proc/{process.pid}/stat').read_text().rpartition(')')[2].split()
    return (int(fields[11]) + int(fields[12])) / TICK


def _start(*command: str, log: IO[bytes], **parameters: Any) -> subprocess.Popen[Any]:
    arguments = [word for key, value in parameters.items() for word in ('-p', f'{key}:={value}')]
    return subprocess.Popen(
        [sys.executable, '-m', *command, '--ros-args', '-p', 'fluoroscopes:=[a]', *arguments],
        stdout=log,
        stderr=log,
    )


def measured(
    reader: Reader, encoding: str, rate: float, node: str, seconds: float, log: IO[bytes]
) -> dict[str, Any]:
    """Measure a node at a rate: losses, latencies [ms] and CPU time per image [ms]."""
    frames = round(rate * seconds)
    command = (
        ['fluoro_calib_ros.nodes.image_node']
        if node == 'image_node'
        else ['benchmarks.image_processes', 'relay']
    )
    under_test = _start(*command, log=log)
    reader.listen(OUTPUTS[node])
    path = Path(log.name)
    if node == 'image_node':
        wait(
            lambda: 'pixels of the corrected image are empty' in path.read_text(errors='replace'),
            60,
            'the calibration',
        )
    wait(lambda: reader.node.count_publishers(OUTPUTS[node]), 60, 'the node')
    camera = _start(
        'benchmarks.image_processes',
        'camera',
        log=log,
        encoding=encoding,
        rate=float(rate),
        frames=frames,
    )
    try:
        wait(lambda: reader.came, 60, 'the first image')
        began = _cpu(under_test)
        first = len(reader.came)
        wait(
            lambda: camera.poll() is not None or len(reader.came) >= frames,
            seconds * 2 + 30,
            'the stream',
        )
        used = _cpu(under_test) - began
        counted = len(reader.came) - first
        wait(lambda: camera.poll() is not None, 30, 'the end of the camera')
    finally:
        for process in (camera, under_test):
            if process.poll() is None:
                process.send_signal(signal.SIGINT)
            process.wait(20)
        reader.stop()
    return {
        **_stream_figures(np.array(reader.came), frames),
        'cpu_ms': 1e3 * used / max(counted, 1),
    }


def _stream_figures(came: np.ndarray, frames: int) -> dict[str, Any]:
    """Return losses, rate [Hz] and latencies [ms], given stamps and latencies (n, 2) [ns]."""
    latency = came[:, 1] * 1e-6
    span = (came[-1, 0] - came[0, 0]) * 1e-9
    return {
        'images': frames,
        'lost': int(frames - len(np.unique(came[:, 0]))),
        'rate': float((len(came) - 1) / span),
        'p50': float(np.percentile(latency, 50)),
        'p99': float(np.percentile(latency, 99)),
        'max': float(latency.max()),
    }


def live(
    calibration: FluoroscopeCalibration, seconds: float, only: str = ''
) -> dict[str, dict[str, Any]]:
    """Return results of the cases whose name contains `only`, with the current transports."""
    import rclpy

    from fluoro_calib_ros.demo.assessment import isolate_ros_graph

    isolate_ros_graph()
    rclpy.init(args=[])
    reader = Reader(calibration)
    out = {}
    for case, (encoding, rate, node) in CASES.items():
        if only in case:
            with tempfile.NamedTemporaryFile('wb', suffix='.log') as log:
                out[case] = measured(reader, encoding, rate, node, seconds, log)
    reader.node.destroy_node()
    rclpy.shutdown()
    return out


def live_wide(seconds: float, only: str = '') -> dict[str, dict[str, Any]]:
    """Return the same from another process, with large segments of shared memory."""
    with tempfile.NamedTemporaryFile('w', suffix='.xml') as profile:
        profile.write(WIDE)
        profile.flush()
        done = subprocess.run(
            [
                sys.executable,
                '-m',
                'benchmarks.images',
                '--live',
                '--seconds',
                str(seconds),
                '--only',
                only,
            ],
            env={**os.environ, 'FASTRTPS_DEFAULT_PROFILES_FILE': profile.name},
            stdout=subprocess.PIPE,
            check=True,
        )
    return {f'{case}, wide': figures for case, figures in json.loads(done.stdout).items()}


def run(
    seconds: float = 10.0, only: str = ''
) -> tuple[list[dict[str, Any]], dict[str, dict[str, Any]]]:
    """Return results on one core, and live results by case."""
    calibration, frames = calibration_of_the_rig()
    return on_one_core(calibration, frames), live(calibration, seconds, only) | live_wide(
        seconds, only
    )


def draw(path: str, lines: int = 25) -> None:
    """Draw a square bead pattern as observed and as corrected, with a magnified corner."""
    fluoroscope = virtual_rig(1).fluoroscopes[0]
    calibration = calibration_of_the_rig()[0]
    at = np.linspace(24, 999, lines)
    grid = np.stack(np.meshgrid(at, at), axis=-1).reshape(-1, 2)
    observed = fluoroscope.distortion.distort(grid)
    correction = calibration.correct(observed)
    seen = np.all((observed > 4) & (observed < 1019), axis=1) & (correction.status == 0)
    # Remove the gauge: a distortion is known up to a projective map, that is, a change of
    # orientation.
    plane = cv2.findHomography(grid[seen], correction.uv[seen])[0]
    straight = cv2.perspectiveTransform(grid[:, None], plane)[:, 0]
    image = bead_image(observed[seen], bead_px=4.5, contrast=0.8)
    corrected = ImageCorrector(calibration).correct(image)
    figure = Figure(figsize=(13.2, 3.9), dpi=100, layout='constrained')
    whole, *corners, difference = figure.subplots(1, 4)
    whole.imshow(image, cmap='gray', vmin=0, vmax=255, interpolation='antialiased')
    whole.set(title='observed', xlim=(-0.5, 1023.5), ylim=(1023.5, -0.5))
    left, top, side = CORNER
    whole.add_patch(Rectangle((left, top), side, side, fill=False, edgecolor=ORANGE, linewidth=2))
    for axes, name, shown, uv in zip(
        corners,
        ('observed', 'corrected'),
        (image, corrected),
        (observed, correction.uv),
    ):
        axes.imshow(shown, cmap='gray', vmin=0, vmax=255)
        for line in np.concatenate(
            [straight.reshape(lines, lines, 2), straight.reshape(lines, lines, 2).swapaxes(0, 1)]
        ):
            axes.plot(*line.T, color=ORANGE, linewidth=0.9)
        off = np.linalg.norm((uv - straight)[seen & _in_corner(straight)], axis=1)
        rms = np.sqrt(np.mean(off**2))
        axes.set_title(
            f'corner, {name}: {rms:.2f} px (RMS),\n{off.max():.1f} px at most off the lines'
        )
    difference.imshow(corrected.astype(float) - image, cmap='RdBu', vmin=-150, vmax=150)
    difference.set_title('corner: corrected minus observed\n(blue: brighter, red: darker)')
    for axes in (*corners, difference):
        axes.set(xlim=(left, left + side), ylim=(top + side, top))
    for axes in (whole, *corners, difference):
        axes.set(xticks=[], yticks=[])
    figure.savefig(path)


def _in_corner(uv: np.ndarray) -> np.ndarray:
    """Return whether points are in the magnified corner."""
    left, top, side = CORNER
    return np.all((uv > (left, top)) & (uv < (left + side, top + side)), axis=1)


def text_of(core: Sequence[dict[str, Any]], cases: dict[str, dict[str, Any]]) -> tuple[str, str]:
    """Return the tables of one core and of the live cases."""
    rows = [
        [
            f'mono{f["depth"]} {f["interpolation"]}',
            f'{f["ms"]:.1f}',
            f'{f["cpu_ms"]:.1f}',
            f'{f["rate"]:.0f}',
            f'{f["scipy_ms"] / f["ms"]:.0f}',
        ]
        for f in core
    ]
    first = table(
        [
            '1024 x 1024',
            'median [ms]',
            'CPU [ms]',
            'images per second and core',
            'speed-up over scipy',
        ],
        rows,
    )
    rows = [
        [
            case,
            str(f['images']),
            str(f['lost']),
            f'{f["p50"]:.1f}',
            f'{f["p99"]:.1f}',
            f'{f["max"]:.0f}',
            f'{f["cpu_ms"]:.1f}',
        ]
        for case, f in cases.items()
    ]
    second = table(
        ['live', 'images', 'lost', 'p50 [ms]', 'p99 [ms]', 'max [ms]', 'CPU per image [ms]'], rows
    )
    return first, second


if __name__ == '__main__':
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--seconds', type=float, default=10.0)
    parser.add_argument('--only', default='', help='live cases whose name contains this')
    parser.add_argument('--live', action='store_true', help='the live cases alone, as JSON')
    parser.add_argument(
        '--picture', metavar='FILE', help='only draw docs/images/corrected_image.png'
    )
    parser.add_argument('--out', type=Path, help='page with the tables, docs/how_good/speed.md')
    options = parser.parse_args()
    if options.picture:
        draw(options.picture)
    elif options.live:
        print(json.dumps(live(calibration_of_the_rig()[0], options.seconds, options.only)))
    else:
        first, second = text_of(*run(options.seconds, options.only))
        show_section(first, options.out, 'images, one core')
        show_section(second, options.out, 'images, live')
