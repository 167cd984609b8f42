"""Images of the virtual fluoroscope: dark beads where they are observed, on a smooth background,
with noise.
"""

import numpy as np

BEAD_PX = 3.0  # standard deviation of a blob
CONTRAST = 0.55  # part of the light that a bead takes
REACH = 5.5  # standard deviations to which a blob is drawn: what is left is not seen in 16 bits
BRIGHT = 0.78  # grey value in the middle of the field, as part of the largest one


def bead_image(
    uv,
    image_size=(1024, 1024),
    dtype=np.uint8,
    bead_px=BEAD_PX,
    contrast=CONTRAST,
    noise=0.01,
    seed=0,
):
    """Image (h, w) of uint8 or uint16 of beads at observed pixels uv (n, 2), of image_size (width,
    height) [px].

    bead_px: standard deviation of a blob [px]; contrast: part of the light that a bead takes;
    noise: standard deviation of a grey value, as part of the largest one. A bead multiplies what
    is behind it, so two of them in one place take more than one. Beads off the image are drawn as
    far as they reach into it; the same seed gives the same noise.
    """
    largest = np.iinfo(dtype).max
    image = background(image_size)
    for u, v in np.asarray(uv, dtype=float).reshape(-1, 2):
        _draw(image, u, v, bead_px, contrast)
    image *= largest
    if noise:
        image += np.float32(noise * largest) * np.random.default_rng(seed).standard_normal(
            image.shape, dtype=np.float32
        )
    return np.clip(np.rint(image, out=image), 0, largest, out=image).astype(dtype)


def background(image_size):
    """Light (h, w) float32 of 0 to 1 without any object: brighter in the middle, and darker to one
    side.
    """
    width, height = image_size
    x = np.linspace(-1, 1, width, dtype=np.float32)
    y = np.linspace(-1, 1, height, dtype=np.float32)[:, None]
    return BRIGHT * (1 - np.float32(0.22) * (x * x + y * y) + np.float32(0.05) * x)


def _draw(image, u, v, bead_px, contrast):
    """Take the light of one bead at u, v [px] off image (h, w)."""
    if not (np.isfinite(u) and np.isfinite(v)):
        return
    reach = REACH * bead_px
    rows, columns = (
        slice(max(0, int(np.ceil(at - reach))), max(0, int(np.floor(at + reach)) + 1))
        for at in (v, u)
    )
    part = image[rows, columns]
    if not part.size:
        return
    y, x = (np.arange(s.start, s.start + n) for s, n in zip((rows, columns), part.shape))
    along_u, along_v = (
        np.exp(-0.5 * ((axis - at) / bead_px) ** 2) for axis, at in ((x, u), (y, v))
    )
    part *= 1 - contrast * along_v[:, None] * along_u
