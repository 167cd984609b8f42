# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Figures draw what the model predicts."""

from dataclasses import replace

import numpy as np
import pytest
from rigs import create_model
from scipy.spatial.transform import Rotation

from fluoro_calib_ros.bodies.body import BodyPoses, PoseStatus
from fluoro_calib_ros.bodies.joints import Joint, JointStatus, joint_motion
from fluoro_calib_ros.report.figures import (
    Scale,
    _field_on_grid,
    _round_down,
    common_scale,
    distortion_figure,
    png_bytes,
)
from fluoro_calib_ros.report.motion import body_figure, joint_figure, paths_figure

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


def motion():
    """A femur at rest and a tibia that turns about z and moves along x; the third pose is lost."""
    turn = np.array([0.2, 0.5, np.nan, 1.1])
    x = np.array([10.0, 12, np.nan, 18])
    covariance = np.tile(np.diag([0.1, 0.2, 0.3, 0.01, 0.02, 0.03]) ** 2, (4, 1, 1))

    def poses(body, turn, x):
        lost = np.isnan(x)
        rotation = Rotation.from_rotvec(np.outer(np.nan_to_num(turn), [0, 0, 1])).as_matrix()
        rotation[lost] = np.nan
        return BodyPoses(
            body,
            np.arange(1, 5),
            np.array([100, 300, 500, 700]) * 10**7,
            rotation,
            np.column_stack([x, 0 * x + 5, 0 * x - 7]),
            covariance_noise=covariance,
            covariance_fixed=0 * covariance,
            rig_root=np.zeros((4, 6, 2)),
            markers=np.where(lost, 0, 4),
            status=np.where(lost, PoseStatus.FAILED, PoseStatus.OK).astype(np.uint8),
        )

    return poses('femur', 0 * np.ones(4), np.ones(4)), poses('tibia', turn, x)


def drawn(panel):
    """Return times and values of a panel, and the limits of the first band."""
    times, values = panel.lines[0].get_data()
    corners = panel.collections[0].get_paths()[0].get_extents()
    return times, values, (corners.y0, corners.y1)


def test_poses_are_drawn_over_time_with_two_standard_deviations():
    """Rotations are relative to the first pose, in degrees; times without a marker are grey."""
    femur, tibia = motion()
    figure = body_figure(tibia)
    panels = figure.axes
    assert figure.get_figwidth() > figure.get_figheight()
    assert [panel.get_title()[-4:] for panel in panels] == 3 * ['[mm]'] + 3 * [' [°]']
    assert [len({panel.get_position().bounds[k] for panel in panels}) for k in (0, 1)] == [3, 2]
    times, x, band = drawn(panels[0])
    np.testing.assert_allclose(times, [0, 2, 4, 6])
    np.testing.assert_array_equal(x, tibia.position_mm[:, 0])
    assert band == pytest.approx((10 - 2 * 0.1, 12 + 2 * 0.1))
    _, turned, band = drawn(panels[5])
    np.testing.assert_allclose(turned, np.degrees([0, 0.3, np.nan, 0.9]), atol=1e-9)
    assert band == pytest.approx(np.degrees((-2 * 0.03, 0.3 + 2 * 0.03)))
    assert [len(panel.collections) for panel in panels] == 6 * [2]
    assert [len(panel.collections) for panel in body_figure(femur).axes] == 6 * [1]


def test_angles_of_a_joint_are_drawn_in_degrees_and_translations_in_mm():
    femur, tibia = motion()
    found = joint_motion(Joint('knee', 'femur', 'tibia', 'cardan_xyz'), femur, tibia)
    panels = joint_figure(found).axes
    assert [panel.get_title()[-4:] for panel in panels] == 3 * [' [°]'] + 3 * ['[mm]']
    for number, panel in enumerate(panels):
        scale = 180 / np.pi if number < 3 else 1.0
        values = np.hstack([found.angles, found.translations])[:, number]
        _, shown, band = drawn(panel)
        np.testing.assert_allclose(shown, scale * values)
        sd = found.sd[:2, number]
        low, high = (values[:2] - 2 * sd).min(), (values[:2] + 2 * sd).max()
        assert band == pytest.approx((scale * low, scale * high))
    assert np.nanmax(panels[2].lines[0].get_ydata()) == pytest.approx(np.degrees(1.1))


@pytest.mark.long
def test_paths_of_bodies_have_axes_where_they_are():
    femur, tibia = motion()
    figure = paths_figure((femur, tibia))
    assert figure.get_figwidth() > figure.get_figheight()
    (space,) = figure.axes
    path = np.array(space.lines[1].get_data_3d())
    np.testing.assert_array_equal(path, tibia.position_mm.T)
    length = 0.1 * 8 + 5  # a tenth of the distance that the tibia moves, plus 5
    ends = np.array([line.get_data_3d() for line in space.lines[-3:]])
    np.testing.assert_allclose(ends[:, :, 0], np.tile([18, 5, -7], (3, 1)))
    np.testing.assert_allclose(
        (ends[:, :, 1] - ends[:, :, 0]).T, length * tibia.rotation[3], atol=1e-12
    )


def test_only_times_without_a_marker_are_grey():
    """Neither ambiguous poses nor those near gimbal lock, in which markers were seen."""
    femur, tibia = motion()
    found = joint_motion(Joint('knee', 'femur', 'tibia', 'cardan_xyz'), femur, tibia)
    seen = np.full(len(found.status), JointStatus.GIMBAL, dtype=np.uint8)
    seen[0] = JointStatus.AMBIGUOUS
    panels = joint_figure(replace(found, status=seen)).axes
    assert [len(panel.collections) for panel in panels] == 6 * [1]
