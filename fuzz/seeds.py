# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Valid files from which the fuzzer starts: small, and derived from a virtual rig."""

from __future__ import annotations

import functools
import io
import tempfile
import zipfile
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from fluoro_calib_ros.correction.fluoroscope_calibration import FluoroscopeCalibration
from fluoro_calib_ros.estimation.calibrate import calibrate
from fluoro_calib_ros.estimation.options import CalibrationOptions
from fluoro_calib_ros.exposures.frame import Frame
from fluoro_calib_ros.io.bags.metadata import known_definition, message_from_frame
from fluoro_calib_ros.io.bags.writer import write_bag
from fluoro_calib_ros.photogrammetry.rig_orientation import RigOrientation
from fluoro_calib_ros.simulation.rig import VirtualRig, simulate_exposures, virtual_rig

SEPARATOR = b'\n--- '  # precedes the name of a member of a flattened archive
TARGETS = 6


@functools.cache
def rig() -> VirtualRig:
    """Return the virtual rig of all seeds."""
    return virtual_rig(1)


@functools.cache
def frames() -> dict[str, list[Frame]]:
    """Return two exposures with few targets for each fluoroscope."""
    simulated = simulate_exposures(rig(), 2, 1).frames
    return {
        name: [
            replace(
                f,
                target_id=f.target_id[:TARGETS],
                uv=f.uv[:TARGETS],
                sigma=None if f.sigma is None else f.sigma[:TARGETS],
            )
            for f in of_one
        ]
        for name, of_one in simulated.items()
    }


def written(*writers: Callable[[Path], object]) -> list[bytes]:
    """Return the content of the file that each writer creates at the path passed to it."""
    contents = []
    for write in writers:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / 'file'
            write(path)
            contents.append(path.read_bytes())
    return contents


def flattened(content: bytes) -> bytes:
    """Return the members of a ZIP archive concatenated, each preceded by its name.

    Without checksums and compression, changing a byte changes the content.
    """
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        return b''.join(
            SEPARATOR + name.encode() + b'\n' + archive.read(name) for name in archive.namelist()
        )


def archive_of(flat: bytes) -> bytes:
    """Return the ZIP archive whose flattened form is given."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, 'w') as archive:
        for member in flat.split(SEPARATOR)[1:]:
            name, _, content = member.partition(b'\n')
            archive.writestr(zipfile.ZipInfo(name.decode('latin-1') or 'x'), content)
    return buffer.getvalue()


def bag_content(storage: str = 'mcap') -> bytes:
    """Return a bag file of the frames without compression and checksums."""
    from mcap.writer import CompressionType, Writer

    from fluoro_calib_ros.io.bags.metadata import PROFILES, TARGET_OBSERVATIONS, to_cdr, to_yaml

    buffer = io.BytesIO()
    writer = Writer(
        buffer,
        compression=CompressionType.NONE,
        enable_crcs=False,
        enable_data_crcs=False,
    )
    writer.start('ros2', 'fuzz')
    definition = known_definition(TARGET_OBSERVATIONS)
    schema = writer.register_schema(TARGET_OBSERVATIONS, 'ros2msg', definition.text.encode())
    for name, of_one in frames().items():
        channel = writer.register_channel(
            f'/{name}/target_observations',
            'cdr',
            schema,
            {
                'offered_qos_profiles': to_yaml([PROFILES['observations']]),
                'topic_type_hash': definition.type_hash,
            },
        )
        for frame in of_one:
            data = to_cdr(message_from_frame(frame), TARGET_OBSERVATIONS)
            writer.add_message(channel, frame.stamp_ns, data, frame.stamp_ns)
    writer.finish()
    return buffer.getvalue()


def bag_folder(path: Path) -> None:
    """Write the frames as a bag folder."""
    write_bag(path, frames())


def images() -> list[np.ndarray]:
    """Return small grey images of 8 and 16 bits."""
    ramp = np.add.outer(np.arange(12), np.arange(16))
    return [(8 * ramp).astype(np.uint8), (2000 * ramp).astype(np.uint16)]


def encoded_images(suffix: str) -> Sequence[bytes]:
    """Return the images encoded as files with this suffix."""
    return [cv2.imencode(suffix, image)[1].tobytes() for image in images()]


def in_folder(write: Callable[[Path], object], name: str = '*') -> bytes:
    """Return the content of the only file with this name that a function writes into a folder."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / 'out'
        write(out)
        return next(out.glob(name)).read_bytes()


def calibration(model: str = 'knn') -> FluoroscopeCalibration:
    """Return the calibration of a fluoroscope from a few exposures."""
    return _calibration(model)  # f() and f('knn') differ for a cache


@functools.cache
def _calibration(model: str) -> FluoroscopeCalibration:
    exposures = simulate_exposures(rig(), 3, 1).frames['a']
    few = [frame.rows(frame.target_id % 3 == 0) for frame in exposures]
    request = CalibrationOptions(model=model, k=5 if model == 'knn' else None, max_iterations=2)
    result = calibrate({'a': few}, rig().phantom, request)
    return result.calibrations['a']


def orientation() -> RigOrientation:
    """Return the orientation of a rig of two fluoroscopes."""
    return RigOrientation(
        ('a', 'b'),
        np.array([[511.5, 511.5, 4000.0]] * 2),
        np.array([np.eye(3)] * 2),
        np.array([[0.0, 0, -1000], [0, 1000, 0]]),
        np.eye(18) * 1e-6,
        'phantom',
        'joint calibration',
        ('id_a', 'id_b'),
        10**18,
        3,
        ('a_optical', 'b_optical'),
    )
