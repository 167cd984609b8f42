# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Projects of XMALab; the fuzzer sees the files without the archive and its checksums."""

from __future__ import annotations

from pathlib import Path

from fluoro_calib_ros.io.formats import registry
from fluoro_calib_ros.io.formats.content import FileSettings

from ..harness import Target
from ..seeds import SEPARATOR, archive_of, encoded_images

SETTINGS = FileSettings(units='mm')


def _read(path: Path) -> None:
    registry.read(path, SETTINGS)


def _camera(folder: str) -> tuple[str, dict[str, bytes]]:
    """Return the XML element of a camera and its files."""
    data = f'{folder}/data/'
    files = {
        f'{folder}/image.png': encoded_images('.png')[0],
        data + 'matrix.csv': b'900, 0, 150\n0, 905, 120\n0, 0, 1\n',
        data + 'points.csv': b'1.5, 2\n3, 4\n5, 6\n',
        data + 'inlier.csv': b'1\n1\n0\n',
        data + 'rotation.csv': b'1, 0, 0\n0, 1, 0\n0, 0, 1\n',
        data + 'translation.csv': b'1.5\n-2.5\n90\n',
    }
    inside = ''.join(
        f'<{tag} Filename="{data}{name}.csv"/>'
        for tag, name in (
            ('PointsDetectedAll', 'points'),
            ('PointsDetected', 'points'),
            ('Inlier', 'inlier'),
            ('RotationMatrix', 'rotation'),
            ('TranslationVector', 'translation'),
        )
    )
    return (
        f'<Camera Name="{folder}" isLightCamera="0" isCalibrated="1" isOptimized="1" '
        f'isFlipped="0" CameraMatrix="{data}matrix.csv">'
        f'<CalibrationImage Filename="{folder}/image.png" isCalibrated="1">{inside}'
        '</CalibrationImage></Camera>'
    ), files


def _seed() -> bytes:
    files: dict[str, bytes] = {}
    elements = ''
    for folder in ('one', 'two'):
        element, more = _camera(folder)
        elements += element
        files |= more
    files['CalibrationObject/cube.csv'] = b'x y z\n0,0,1.5,p1\n1,0,0,p2\n0,1,0,q1\n'
    document = (
        '<?xml version="1.0" encoding="UTF-8"?><Project Version="1">'
        f'{elements}<CalibrationObject Filename="CalibrationObject/cube.csv" '
        'isCheckerboard="0" isPlanar="0"/></Project>'
    )
    members = {'project.xml': document.encode(), **files}
    return b''.join(SEPARATOR + n.encode() + b'\n' + c for n, c in members.items())


TARGET = Target('xmalab_project', 'project.xma', _read, lambda: [_seed()], archive_of)
