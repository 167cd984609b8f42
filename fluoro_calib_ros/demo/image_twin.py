# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Radiographs of the recorded virtual rig for extraction, and a virtual knee that lands in it."""

from __future__ import annotations

import threading
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ..bodies.joints import JointMotion
from ..correction.fluoroscope_calibration import Calibrations
from ..exposures.stamps import nanoseconds_from_stamp
from ..io.access import make_folder, write_bytes
from ..io.bags.metadata import message_class
from ..io.bags.reader import IMAGE
from ..io.bags.writer import BagWriter, write_bag
from ..jobs.simulation import (
    BODIES,
    JOINTS,
    SETTINGS,
    TRUTH,
    RenderedScene,
    Renderers,
    write_knee,
)
from ..nodes.demo_client import DemoClient, DemoError
from ..report.figures import png_bytes
from ..report.motion import joint_figure
from ..report.tables import markdown_table
from ..simulation.knee import LANDING_HZ, LANDING_S, landing, simulate_knee, virtual_knee
from ..simulation.rig import VirtualRig, simulate_exposures
from .assessment import NodeProcesses, RecordedRig, calibration_errors

NAMESPACE = 'images'
EXPOSURES = 6  # number of exposures of the bag that are rendered
START_NS = 1_700_000_000_000_000_000
INTERVAL_NS = 500_000_000


class ImageTwin:
    """Renders radiographs for a copy of the calibration bag, in a thread.

    recorded: the virtual rig of the bags. out: bag to write.
    """

    def __init__(self, recorded: RecordedRig, out: Path) -> None:
        self.bag = out
        self._rig = recorded.rig
        exposures = recorded.exposures
        self._poses = simulate_exposures(self._rig, exposures, recorded.seed).poses
        self.numbers = np.unique(np.linspace(0, exposures - 1, EXPOSURES).astype(int))
        # A point source takes half the time to render.
        settings = replace(SETTINGS['clean'], bits=8, focal_spot_mm=0.0)
        self._renderers = Renderers(self._rig.fluoroscopes, settings)
        self._error: BaseException | None = None
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def __enter__(self) -> ImageTwin:
        return self

    def __exit__(self, *error: object) -> None:
        self._renderers.close()
        self._thread.join()

    def wait(self) -> None:
        """Wait until the bag is written. Raises DemoError."""
        self._thread.join()
        if self._error is not None:
            raise DemoError(f'no radiographs were rendered: {self._error}')

    def _run(self) -> None:
        try:
            _write_images(self.bag, self._rig, self._scenes(), self._renderers)
        except Exception as error:  # raised by wait()
            self._error = error
        finally:
            self._renderers.close()

    def _scenes(self) -> list[RenderedScene]:
        return [
            RenderedScene(self._rig.true_mm, self._poses[number], int(number))
            for number in self.numbers
        ]


def _write_images(
    path: Path, rig: VirtualRig, scenes: Sequence[RenderedScene], renderers: Renderers
) -> None:
    """Render scenes into a bag."""
    kind = message_class(IMAGE)
    header = message_class('std_msgs/msg/Header')
    time = message_class('builtin_interfaces/msg/Time')
    with BagWriter(path, overwrite=True) as bag:
        for number, scene in enumerate(scenes):
            stamp_ns = START_NS + number * INTERVAL_NS
            stamp = time(*divmod(stamp_ns, 10**9))
            for name, image in renderers.images(scene).items():
                height, width = image.shape
                message = kind(
                    header(stamp, f'{name}_optical'),
                    height,
                    width,
                    encoding='mono8',
                    is_bigendian=0,
                    step=width,
                    data=image.reshape(-1),
                )
                bag.write(f'/{name}/image_raw', IMAGE, message, stamp_ns)


def calibrate_from_images(
    twin: ImageTwin, bags: Path, out: Path, client: DemoClient
) -> Calibrations:
    """Play the rendered bag through the extraction node into another calibration node; calibrate.

    client: in the namespace of the images. Raises DemoError.
    """
    twin.wait()
    count = len(twin.numbers)
    rig: dict[str, Any] = {
        'fluoroscopes': f'[{",".join(client.names)}]',
        'phantom': bags / 'phantom.csv',
    }
    with NodeProcesses(out, NAMESPACE) as nodes:
        nodes.start('extraction_node', rig)
        nodes.start(
            'calibration_node', {**rig, 'calibration_directory': out / NAMESPACE / 'calibration'}
        )
        nodes.wait(client, lambda: bool(client.exposures), 60, 'the calibration node')
        nodes.start('player_node', {'bag': twin.bag})
        nodes.wait(
            client,
            lambda: min(client.exposures.values(), default=0) >= count,
            120,
            'the exposures from images',
        )
        message = client.self_calibrate(lambda line: None)
        print(f'    {message}')
        client.wait(lambda: len(client.calibrations) == len(client.names), 20, 'the calibrations')
    return client.calibrations


def comparison_table(recorded: RecordedRig, ways: Mapping[str, Calibrations]) -> str:
    """Return a table of the calibrations from coordinates and from images, against the truth."""
    head = [
        'fluoroscope',
        'from',
        'exposures',
        'image points',
        'RMSE [px]',
        'c [px]',
        'error of corrected markers [px]',
    ]
    rows = []
    for way, calibrations in ways.items():
        for name, error in calibration_errors(recorded, calibrations).items():
            calibration = calibrations[name]
            rows.append(
                [
                    name,
                    way,
                    str(calibration.exposures),
                    str(calibration.observations),
                    f'{np.hypot(*calibration.rmse_after) / np.sqrt(2):.3f}',
                    f'{calibration.interior[2]:.2f}',
                    f'{error:.3f}',
                ]
            )
    return markdown_table(head, sorted(rows))


PLAYED = 0.2  # speed relative to the recording, for a machine with two cores


class LiveKnee:
    """Bodies, joint and recording of a knee in the rig of the bags.

    recorded: the virtual rig of the bags. out: folder to write.
    """

    def __init__(self, recorded: RecordedRig, out: Path) -> None:
        self._knee = virtual_knee(recorded.seed)
        times_s = np.arange(round(LANDING_S * LANDING_HZ)) / LANDING_HZ
        self._truth = landing(self._knee, times_s)
        frames = simulate_knee(recorded.rig, self._knee, self._truth, recorded.noise_px).frames
        self.bag = out / 'landing'
        self.parameters = {'bodies': out / BODIES, 'joints': out / JOINTS}
        self.frames = {name: len(view_frames) for name, view_frames in frames.items()}
        make_folder(out / TRUTH)
        write_knee(out, self._knee)
        write_bag(self.bag, frames)

    def assess(self, messages: Sequence[Any], picture: Path) -> str:
        """Draw the live angles of JointAngles messages; return their accuracy as one line."""
        number = np.array([message.frame_number for message in messages])
        metres = np.repeat([1.0, 1e3], 3)
        covariance = np.array([message.covariance for message in messages]).reshape(-1, 6, 6)
        angles = np.array([message.angle for message in messages])
        motion = JointMotion(
            self._knee.joint,
            number,
            np.array([nanoseconds_from_stamp(message.header.stamp) for message in messages]),
            angles=angles,
            translations=1e3 * np.array([message.translation for message in messages]),
            covariance=covariance * metres * metres[:, None],
            status=np.array([message.status[0] for message in messages]),
            determined=np.isfinite(angles).all(axis=1),
        )
        write_bytes(picture, png_bytes(joint_figure(motion)))
        known = np.isfinite(motion.angles).all(axis=1)
        error = motion.angles[known] - self._truth.angles[number[known] - 1]
        normalised = np.mean((error / motion.sd[known, :3]) ** 2)
        rmse = np.degrees(np.sqrt(np.mean(error**2, axis=0)))
        rmse_text = ', '.join(
            f'{name.replace("_", " ")} {value:.2f}'
            for name, value in zip(motion.angle_names, rmse)
        )
        return (
            f'Knee that lands, live: {np.count_nonzero(known)} of {len(self._truth.angles)} '
            f'exposures; RMSE against the truth [degrees]: {rmse_text}; squared error over its '
            f'variance {normalised:.2f}; picture {picture}'
        )
