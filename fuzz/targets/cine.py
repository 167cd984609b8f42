# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Recordings of Phantom cameras."""

from __future__ import annotations

import struct
from pathlib import Path

from fluoro_calib_ros.io.image_reading import open_images

from ..harness import Target
from ..seeds import images


def _read(path: Path) -> None:
    for _ in open_images(path).images:
        pass


def _seed(bits: int) -> bytes:
    """Return a recording with the fields that are read, as described in docs/extraction.md."""
    pixels = images()[0].tobytes() if bits == 8 else images()[1].astype('<u2').tobytes()
    height, width = images()[0].shape
    count = 2
    setup = bytearray(1024)
    setup[0:2] = struct.pack('<H', 500)
    setup[140:144] = b'ST' + struct.pack('<H', len(setup))
    setup[768:772] = struct.pack('<I', 500)
    table = 84 + len(setup)
    block = struct.pack('<II', 8, len(pixels)) + pixels
    offsets = [table + 8 * count + n * len(block) for n in range(count)]
    return b''.join(
        [
            b'CI' + struct.pack('<HHHiI', 44, 0, 1, 0, count),
            struct.pack('<iIIIIQ', 0, count, 44, 84, table, 0),
            struct.pack('<IiiHH', 40, width, height, 1, bits),
            struct.pack('<IIiiII', 0, 0, 0, 0, 0, 0),
            bytes(setup),
            struct.pack(f'<{count}q', *offsets),
            block * count,
        ]
    )


TARGET = Target('cine', 'trial.cine', _read, lambda: [_seed(8), _seed(16)])
