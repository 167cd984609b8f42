# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What the figures draw is what the model says."""

import numpy as np
import pytest

from fluoro_calib_ros.correction.registry import create_model
from fluoro_calib_ros.report.figures import (
    Scale,
    _field_on_grid,
    _round_down,
    common_scale,
    distortion_figure,
    png_bytes,
)

SIZE = (400, 300)


@pytest.fixture(scope='module')
def model():
    """A correction of du = u / 100 in the left half of an image."""
    uv = np.random.default_rng(1).uniform((0, 0), (200, 300), (400, 2))
    return create_model('local_linear', 8, uv, uv * [0.01, 0.0], 0.1, 0.0)


def test_cells_of_the_figure_are_in_their_places(model):
    (columns, rows), field = _field_on_grid(model, SIZE, 40)
    assert (len(columns), len(rows)) == (40, 30)
    assert columns[[0, -1]] == pytest.approx([4.5, 394.5])
    assert rows[[0, -1]] == pytest.approx([4.5, 294.5])
    duv = field.duv.reshape(30, 40, 2)
    np.testing.assert_allclose(duv[15, 3:17, 0], columns[3:17] / 100, atol=1e-6)


def test_figure_shows_size_and_sd_where_targets_were_seen(model):
    scale = Scale(3.0, 0.2)
    figure = distortion_figure(model, 'a', SIZE, interior_estimated=True, scale=scale)
    for axes, limit in zip(figure.axes, (3.0, 0.2)):
        mesh = axes.collections[0]
        shown = mesh.get_array()
        assert mesh.get_clim() == (0, limit)
        rows, columns = shown.shape
        assert columns / rows == pytest.approx(400 / 300, rel=0.05)
        hidden = np.ma.getmaskarray(shown)
        assert (
            hidden[:, columns // 2 + 2 :].all()
            and not hidden[rows // 2, 4 : columns // 2 - 4].any()
        )
    field = figure.axes[0].collections[0].get_array()
    rows, columns = field.shape
    at = np.arange(4, columns // 2 - 4)
    expected = (-0.5 + (at + 0.5) * 400 / columns) / 100
    np.testing.assert_allclose(field[rows // 2, at], expected, atol=1e-3)
    assert png_bytes(figure)[:4] == b'\x89PNG'


def test_common_scale_is_that_of_the_largest_field(model):
    other = create_model('local_linear', 8, model.train_uv, 3 * model.train_duv, 0.3, 0.0)
    alone, together = common_scale([(model, SIZE)]), common_scale([(model, SIZE), (other, SIZE)])
    assert 1.5 < alone.magnitude_px < 2.6
    assert together.magnitude_px == pytest.approx(3 * alone.magnitude_px, rel=0.1)
    assert together.sd_px > 2 * alone.sd_px


@pytest.mark.parametrize(
    ('value', 'round_value'), [(1.0, 1), (7.3, 7), (19.0, 15), (23.0, 20), (0.499, 0.3)]
)
def test_arrows_are_magnified_by_round_numbers(value, round_value):
    assert _round_down(value) == pytest.approx(round_value)
