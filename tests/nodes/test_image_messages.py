# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Images in messages: byte order matters for 16-bit images only."""

import numpy as np
import pytest
from sensor_msgs.msg import Image

from fluoro_calib_ros.images.codec import raw_image


@pytest.mark.parametrize('big_endian', [False, True])
@pytest.mark.parametrize('encoding, kind', [('mono8', np.uint8), ('mono16', np.uint16)])
def test_image_has_the_values_of_the_message(encoding, kind, big_endian):
    values = np.random.default_rng(1).integers(0, np.iinfo(kind).max, (6, 8)).astype(kind)
    stored = values.astype(np.dtype(kind).newbyteorder('>' if big_endian else '<'))
    message = Image(
        height=6,
        width=8,
        encoding=encoding,
        step=8 * values.itemsize,
        is_bigendian=int(big_endian),
        data=stored.tobytes(),
    )
    image = raw_image(message)
    np.testing.assert_array_equal(image, values)
