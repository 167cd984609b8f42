# Copyright 2026 fluoro_calib_ros maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""Recordings of Phantom cameras."""

from __future__ import annotations

import struct
from pathlib import Path

from fluoro_calib_ros.files.image_reading import open_images

from ..harness import Target
from ..seeds import images


def _read(path: Path) -> None:
    for _ in open_images(path).images:
        pass


def _seed(bits: int) -> bytes:
    """Return a recording with the fields that are read, as docs/images.md says."""
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
