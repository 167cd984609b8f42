# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Tables and figures of the report show the numbers of the data, as read from the axes."""

from dataclasses import replace
from types import SimpleNamespace as Fake

import matplotlib.pyplot as plt
import numpy as np
import pytest
import rigs
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure

from fluoro_calib_ros.correction.fluoroscope_calibration import NoiseProfile
from fluoro_calib_ros.exposures.collector import coverage_of
from fluoro_calib_ros.exposures.names import Names
from fluoro_calib_ros.exposures.phantom import Drawing, Phantom
from fluoro_calib_ros.photogrammetry.rotations import matrix_from_vector
from fluoro_calib_ros.reconstruction.intersection import OK, REJECTED
from fluoro_calib_ros.report import html, residuals
from fluoro_calib_ros.report.figures import (
    MARGIN,
    Scale,
    _figure,
    comparison_document,
    comparison_text,
    distortion_figure,
    phantom_figure,
    picture_bytes,
)
from fluoro_calib_ros.report.motion import MAX_NAMED, _draw_gaps, points_figure
from fluoro_calib_ros.report.report_figures import (
    bead_shifts,
    distribution,
    exposure_bars,
    residual_map,
)
from fluoro_calib_ros.report.residuals import (
    AFTER,
    BEFORE,
    STRIPES,
    Residuals,
    _plot_histogram,
    _plot_residuals,
    _plot_running_median,
    normalised_residuals,
    position_figure,
    residuals_of,
)
from fluoro_calib_ros.report.rig_geometry import (
    accuracy_in_space,
    beams,
    drawing,
    phantom_distance,
    phantom_in_sensor,
    uncalibrated_share,
)
from fluoro_calib_ros.report.tables import _noise_text

SIZE = (320, 160)


def axes():
    return Figure().subplots()


def some_residuals():
    """Six image points of exposures 4 and 9, one of them an outlier."""
    exposure = np.array([4, 4, 4, 9, 9, 9])
    before = np.array([[3.0, 4], [0, 2], [1, 1], [2, 0], [0, 0], [50, 60]])
    after = before / [[5], [2], [1], [2], [1], [1]]
    uv = np.array([[10.0, 20], [150, 30], [300, 150], [20, 100], [200, 80], [310, 10]])
    inlier = np.array([True] * 5 + [False])
    return Residuals(exposure, np.arange(6), uv, before, after, inlier, np.zeros(6))


def test_numbers_of_exposures_are_of_their_inliers():
    assert some_residuals().of_exposures() == [
        (4, 3, pytest.approx(np.sqrt(31 / 6)), pytest.approx(np.sqrt((1 + 1 + 2) / 6))),
        (9, 2, 1.0, 0.5),
    ]


def test_residuals_are_observed_and_corrected_minus_computed():
    """They exist for adjusted targets in used exposures only."""
    calibration = rigs.pincushion('a', (1024, 1024))
    frame = rigs.exposures(5)['a'][0]
    fluoroscope = rigs.rig().fluoroscopes[0]
    calibration = replace(calibration, interior=fluoroscope.interior)
    points = dict(zip(rigs.rig().phantom.target_id.tolist(), rigs.rig().phantom.xyz_mm))
    left_out, outlier = frame.target_id[[3, 8]].tolist()
    del points[left_out]
    pose = np.eye(3), np.array([0.0, 0.0, -900.0])
    frames = [frame, replace(frame, number=50)]
    found = residuals_of(calibration, frames, {1: pose}, points, {(1, outlier), (2, 7)})
    kept = frame.target_id != left_out
    assert np.array_equal(found.target_id, frame.target_id[kept])
    assert np.array_equal(found.uv, frame.uv[kept]) and set(found.exposure) == {1}
    assert found.target_id[~found.inlier].tolist() == [outlier]
    xyz = np.array([points[i] for i in found.target_id.tolist()]) + [0, 0, 900]
    xp, yp, c = calibration.interior
    computed = c * xyz[:, :2] / xyz[:, 2:] + [xp, yp]
    np.testing.assert_allclose(found.before, found.uv - computed, atol=1e-9)
    corrected = calibration.correct(found.uv, exact=True).uv
    np.testing.assert_allclose(found.after, corrected - computed, atol=1e-9)
    assert not len(residuals_of(calibration, frames, {7: pose}, points, set()).uv)


def test_running_median_is_that_of_each_stripe():
    drawn = axes()
    position = np.repeat(np.arange(STRIPES), 3) * 20.0 + 9.5
    residual = np.tile([-1.0, 0, 7], STRIPES) + np.repeat(np.arange(STRIPES), 3)
    _plot_running_median(drawn, position[3:], residual[3:], 320)
    x, y = drawn.lines[0].get_data()
    np.testing.assert_allclose(x, 20.0 * np.arange(STRIPES) + 9.5)
    np.testing.assert_allclose(y, [np.nan, *range(1, STRIPES)])


def test_outliers_are_drawn_at_the_border_of_the_panel():
    drawn = axes()
    inliers = np.array([True, True, False, False, False])
    values = np.array([0.5, -0.5, 9.0, -9.0, 1.5])
    _plot_residuals(drawn, np.arange(5.0), values, inliers, 2.0, 'red')
    dots, crosses = drawn.lines
    assert dots.get_ydata().tolist() == [0.5, -0.5] and dots.get_xdata().tolist() == [0, 1]
    assert crosses.get_ydata() == pytest.approx([1.94, -1.94, 1.5])
    assert crosses.get_xdata().tolist() == [2, 3, 4]


def test_residuals_are_normalised_by_what_the_unknowns_absorb():
    """Divisors: sigma, the root of the redundancy number, and the scale after the calibration."""
    rng = np.random.default_rng(3)
    sigma, redundancy = rng.uniform(0.2, 2.0, 50), rng.uniform(0.1, 0.9, 50)
    before, after = rng.normal(size=(2, 50, 2)) * (sigma * np.sqrt(redundancy))[:, None]
    rows = np.arange(5, 45)
    inliers = np.arange(50) % 7 > 0
    run = Fake(
        measured=Fake(network=Fake(sigma=sigma)),
        before=Fake(residuals=3 * before, inliers=~inliers),
        after=Fake(residuals=after, inliers=inliers),
    )
    found = normalised_residuals(run, rows, redundancy[rows])
    unit = (sigma * np.sqrt(redundancy))[:, None]
    used, out = rows[inliers[rows]], rows[~inliers[rows]]
    square = np.mean((after / unit)[used] ** 2, axis=1)
    scale = np.sqrt(np.sum(square * redundancy[used]) / np.sum(redundancy[used]))
    np.testing.assert_allclose(found[0], 3 * (before / unit)[out] / scale)
    np.testing.assert_allclose(found[1], (after / unit)[used] / scale)


def test_histogram_is_a_density_of_all_values():
    drawn = axes()
    values = np.array([-7.0, -1.1, 0.1, 0.2, 2.9, 3.5, 8, 9])
    _plot_histogram(drawn, values, 5.0, 'after')
    x, y = drawn.patches[0].get_xy().T
    assert (x.min(), x.max()) == (-5, 5)
    assert y.max() == pytest.approx(2 / 8 / 0.25)  # two of eight values in a bin of width 0.25
    assert drawn.patches[0].get_facecolor()[:3] == to_rgb(AFTER)
    _plot_histogram(drawn, values, 5.0, 'before')
    assert drawn.patches[1].get_facecolor()[:3] == to_rgb(BEFORE)
    label = drawn.patches[0].get_label()
    assert label.startswith(f'after: standard deviation {values.std():.1f}, 50.0 % within')
    assert label.endswith('37.5 % beyond the panel')


def test_histograms_are_compared_with_the_normal_distribution(monkeypatch):
    values = np.random.default_rng(1).normal(0, [1.0, 2.0], (500, 2))
    monkeypatch.setattr(
        residuals, 'normalised_residuals', lambda run, rows, r: (2 * values, values)
    )
    monkeypatch.setattr(residuals, 'model_text', str)
    figure = residuals.histogram_figure(Fake(models={'a': 'knn'}), 'a', np.arange(600), None)
    assert '500 of the 600' in figure.get_supxlabel() and len(figure.axes) == 2
    limit = np.clip(2.5 * (2 * values).std(), 4, residuals.MAX_HISTOGRAM_SD)
    for panel in figure.axes:
        x, y = panel.lines[-1].get_data()
        np.testing.assert_allclose(y, np.exp(-(x**2) / 2) / np.sqrt(2 * np.pi))
        assert panel.get_xlim() == pytest.approx((-limit, limit)) == (x[0], x[-1])
    plt.close('all')


def test_residuals_over_the_image_are_by_column_and_row():
    one = some_residuals()
    figure = position_figure('a', one.uv, (one.before, one.inlier), (one.after, one.inlier), SIZE)
    width, height = figure.get_size_inches()
    assert width > height
    panels = figure.axes
    for axis in (0, 1):
        before, after, own = panels[3 * axis : 3 * axis + 3]
        for panel, values in ((before, one.before), (after, one.after), (own, one.after)):
            x, y = panel.lines[0].get_data()
            assert np.array_equal(x, one.uv[:5, axis])
            assert np.array_equal(y, values[:5, axis])
            assert panel.get_xlim() == (-0.5, SIZE[axis] - 0.5)
            low, high = panel.get_ylim()
            assert low == -high < 0
            rmse = np.sqrt(np.mean(values[:5, axis] ** 2))
            assert f'RMSE {rmse:.3f} px, 1 of 6 outliers' in panel.get_title()
        assert before.get_ylim() == after.get_ylim()
        assert own.get_ylim()[1] == pytest.approx(
            1.1 * np.quantile(np.abs(one.after[:5, axis]), 0.999)
        )


def test_map_of_residuals_has_arrows_of_inliers_and_crosses():
    one = some_residuals()
    (drawn,) = residual_map(one, 'a', SIZE).axes
    assert drawn.get_xlim() == (-0.5, 319.5) and drawn.get_ylim() == (159.5, -0.5)
    assert drawn.images[0].get_extent() == [-0.5, 319.5, 159.5, -0.5]
    grey = drawn.images[0].get_array()
    shown = np.ma.getmaskarray(grey) | np.isnan(np.ma.getdata(grey))
    assert np.array_equal(shown, coverage_of(one.uv, SIZE).covered) and 0 < shown.mean() < 1
    arrows = drawn.collections[0]
    factor = arrows.U[0] / one.after[0, 0]
    assert factor > 1 and np.isclose(factor, float(f'{factor:.1g}'))
    np.testing.assert_allclose(np.column_stack([arrows.U, arrows.V]), factor * one.after[:5])
    np.testing.assert_allclose(arrows.XY, one.uv[:5])
    assert drawn.lines[0].get_xydata().tolist() == [[310.0, 10.0]]
    longest = np.quantile(np.hypot(*one.after[:5].T), 0.99)
    assert factor * longest == pytest.approx(0.03 * 320, rel=0.5)


def test_bars_of_exposures_are_rms_and_beads():
    figure = exposure_bars(some_residuals(), 'a')
    upper, lower = figure.axes
    assert figure.get_figwidth() > figure.get_figheight()  # wide enough for many exposures
    assert [bar.get_height() for bar in upper.patches] == pytest.approx([np.sqrt(2 / 3), 0.5])
    assert [bar.get_height() for bar in lower.patches] == [3, 2]
    median = (np.sqrt(2 / 3) + 0.5) / 2
    assert upper.lines[0].get_ydata() == pytest.approx([median, median])
    assert [label.get_text() for label in lower.get_xticklabels()] == ['4', '9']


def test_distribution_is_compared_with_the_normal_of_its_robust_deviation():
    values = np.random.default_rng(1).normal(0, 0.3, (500, 2))
    one = replace(some_residuals(), after=values, inlier=np.ones(500, bool))
    left, right = distribution(one, 'a').axes
    assert left.get_position().x1 < right.get_position().x0
    sd = 1.4826 * np.median(np.abs(values))
    x, y = left.lines[0].get_data()
    np.testing.assert_allclose(y, np.exp(-((x / sd) ** 2) / 2) / (np.sqrt(2 * np.pi) * sd))
    assert (x[0], x[-1]) == pytest.approx((-5 * sd, 5 * sd))
    quantile, sorted_values = right.lines[0].get_data()
    assert np.array_equal(sorted_values, np.sort(values.ravel()))
    assert quantile[[0, 500, -1]] == pytest.approx([-3.29, 0.00125, 3.29], abs=0.002)
    np.testing.assert_allclose(right.lines[1].get_ydata(), sd * quantile[[0, -1]])


def test_shifts_of_beads_are_relative_to_their_sd():
    shift = np.array([[0.3, 0, 0], [0, 0.6, 0], [0, 0, 0.9]])
    figure = bead_shifts(shift, np.array([0.1, 0.1, 0.3]))
    left, right = figure.axes
    assert figure.get_figwidth() > figure.get_figheight()
    assert left.get_position().x1 < right.get_position().x0  # side by side
    assert {text.get_text() for text in left.get_legend().get_texts()} == {'x', 'y', 'z'}
    assert max(step.get_xy()[:, 0].max() for step in left.patches) == pytest.approx(0.9)
    counts = np.array([bar.get_height() for bar in right.patches])
    left_edges = np.array([bar.get_x() for bar in right.patches])
    assert counts.sum() == 3 and counts[0] == 2  # 0.3 / 0.1 and 0.9 / 0.3, over the root of 3
    assert left_edges[0] == pytest.approx(np.sqrt(3)) and counts[-1] == 1


def test_noise_is_told_of_the_middle_and_of_the_border():
    profile = NoiseProfile(middle=0.9, rim=1.5, reach=1.0)
    assert _noise_text(Fake(image_sd=0.2, noise_profile=profile)) == '0.180; border 0.300'
    assert _noise_text(Fake(image_sd=0.2, noise_profile=None)) == '0.200'


def test_figure_of_a_distortion_keeps_the_shape_of_the_image():
    model = rigs.pincushion('a', (640, 200)).model
    figure = distortion_figure(model, 'a', (640, 200), True, Scale(4.0, 0.5))
    width, height = figure.get_size_inches()
    # Each of the two panels has a margin, which is twice as high below the image.
    assert width == 15
    assert height == pytest.approx(2 + 5.3 * (200 + 3 * MARGIN * 640) / (640 + 2 * MARGIN * 640))
    left = figure.axes[0]
    assert left.get_xlim() == pytest.approx((-MARGIN * 640, 640 + MARGIN * 640))
    assert left.get_ylim() == pytest.approx((200 + 2 * MARGIN * 640, -MARGIN * 640))
    arrows = next(c for c in left.collections if hasattr(c, 'U'))
    assert arrows.XY[-1] == pytest.approx([0, 200 + 0.13 * 640])
    assert (arrows.U[-1], arrows.V[-1]) == (3, 0)  # rounded down from 4 px
    at = arrows.XY[:-1]
    wanted = model.predict(at)
    np.testing.assert_allclose(np.column_stack([arrows.U, arrows.V])[:-1], wanted, atol=1e-9)
    assert [text.get_position() for text in left.texts if text.get_text() == '3 px'] == [
        pytest.approx((3 * 15 + 0.02 * 640, 200 + 0.13 * 640))
    ]
    assert 1 / arrows.scale == pytest.approx(15)  # 2 * 640 / 17 / 4 = 18.8, rounded down


@pytest.mark.parametrize('layers', [1, 2])
def test_drawing_of_a_phantom_has_its_places(layers):
    given = Drawing(3, 2, layers, (5.0, 10.0, 7.0), False, [(1, 2)], 2.0, 0.1)
    figure = phantom_figure(given)
    for layer, drawn in enumerate(figure.axes):
        assert drawn.get_title() == (f'z = {7 * layer} mm, seen along z' if layers > 1 else '')
        places = given.places_mm[6 * layer : 6 * layer + 6]
        labels = [text.get_text() for text in drawn.texts]
        assert labels == [str(6 * layer + k) for k in range(1, 7)]
        assert np.allclose([text.xy for text in drawn.texts], places[:, :2])
        blocked = len(drawn.lines)
        crosses = [line.get_xydata().tolist() for line in drawn.lines]
        assert crosses == [[places[1, :2].tolist()]] * (layer == 0)
        assert len(drawn.patches) + blocked == 6
        assert {patch.radius for patch in drawn.patches} == {1.0}
        low, high = places[:, :2].min(axis=0) - 4, places[:, :2].max(axis=0) + 4
        assert drawn.get_xlim() == pytest.approx((low[0], high[0]))
        assert drawn.get_ylim() == pytest.approx((high[1], low[1]))
    plt.close('all')


def test_every_place_of_a_drawing_has_room_for_its_id():
    wide, high = (
        phantom_figure(Drawing(*n, pitch_mm=(5.0, 5.0, 5.0))) for n in ((20, 2), (2, 20))
    )
    assert wide.get_figwidth() == pytest.approx(0.33 * (19 + 1.6) + 1)
    assert high.get_figheight() == pytest.approx(0.33 * (19 + 1.6) + 1.2)
    assert wide.get_figheight() == 5 and high.get_figwidth() == 6
    plt.close('all')


def test_drawing_without_diameter_shows_places_and_is_written_as_its_suffix_says():
    figure = phantom_figure(Drawing(4, 3, pitch_mm=(20.0, 10.0, 1.0)))
    (drawn,) = figure.axes
    assert {patch.radius for patch in drawn.patches} == {3.0}
    assert picture_bytes(figure, '.png')[:4] == b'\x89PNG'
    text = picture_bytes(figure, '.svg')
    assert b'<svg' in text and b'>12<' in text and picture_bytes(figure, '.svg') == text
    plt.close('all')


def comparison():
    uv = np.array([[10.0, 20], [100, 50], [200, 120], [300, 140]])
    duv = np.array([[3.0, 4], [0, 0.1], [0.1, 0], [0, 0]])
    size = np.hypot(*duv.T)
    return Fake(
        fluoroscope='a',
        image_size=SIZE,
        uv=uv,
        duv=duv,
        size=size,
        sd=np.full(4, 0.5),
        significant=size > 1,
        rms_px=2.5,
        largest=(5.0, (10.0, 20.0)),
        interior=np.array([1.0, -2, 30]),
        interior_sd=np.array([0.5, 0.6, 7]),
        interior_changed=True,
        field_changed=False,
    )


def test_comparison_is_told_in_pixels_and_mm():
    found = comparison_document(comparison(), 0.2)
    assert (found['rms_px'], found['rms_mm']) == (2.5, 0.5)
    assert (found['largest_px'], found['largest_mm'], found['largest_at']) == (5, 1, [10, 20])
    assert found['share_significant'] == 0.25
    assert found['interior_changed'] and not found['field_changed']
    assert np.isnan(comparison_document(comparison(), None)['rms_mm'])
    text = comparison_text(comparison(), 0.2)
    for part in ('2.500 px (0.500 mm', '5.000 px (1.000 mm', 'column 10, row 20', 'in 25 %'):
        assert part in text
    assert 'xp +1.00 (sd 0.50), yp -2.00 (sd 0.60), c +30.00 (sd 7.00): significant' in text
    assert 'mm at the phantom' not in comparison_text(comparison(), None)


def test_comparisons_of_fluoroscopes_are_side_by_side():
    other = comparison()
    other.fluoroscope = 'b'
    drawn = [axes for axes in _figure([comparison(), other]).axes if axes.get_title()]
    assert [axes.get_title()[:2] for axes in drawn] == ['a:', 'b:']
    one, two = (axes.get_position() for axes in drawn)
    assert one.y0 == pytest.approx(two.y0) and one.x1 < two.x0


def test_arrows_of_a_comparison_are_as_long_as_their_cells():
    drawn = _figure([comparison()]).axes[0]
    assert drawn.get_xlim() == (-0.5, 319.5) and drawn.get_ylim() == (159.5, -0.5)
    squares, arrows = drawn.collections
    assert squares.get_array().tolist() == comparison().size.tolist()
    assert drawn.lines[0].get_xydata().tolist() == [[10.0, 20.0]]
    assert arrows.U.max() == pytest.approx(9) and arrows.V.max() == pytest.approx(12)
    assert 'magnified 3 times' in drawn.get_title()  # 0.8 * 320 / 16 / 5 = 3.2, rounded down


# ---- the rig in mm


def result_of(*distances, centre=(0.0, 0.0, 0.0)):
    """A result with exposures of a at distances, whose phantom has its centroid at centre."""
    entries = [
        {'quaternion_wxyz': [1, 0, 0, 0], 'position_mm': [5, -7, -distance]}
        for distance in distances
    ]
    targets = [{'xyz_mm': np.add(centre, side)} for side in ([1, 2, 3], [-1, -2, -3])]
    return {'fluoroscopes': {'a': {'exposures': entries}}, 'targets': targets}


def test_distances_of_the_phantom_are_along_the_axis():
    assert phantom_in_sensor(result_of(900.0), 'a').tolist() == [[-5, 7, 900]]
    half = result_of(900.0, centre=(1.0, 2, 3))
    half['fluoroscopes']['a']['exposures'][0] |= {'quaternion_wxyz': [0, 1, 0, 0]}  # about x
    np.testing.assert_allclose(phantom_in_sensor(half, 'a'), [[-4, -9, -903]], atol=1e-12)
    assert phantom_distance(result_of(800.0, 1000.0, 1900.0), 'a') == 1000
    assert phantom_distance(result_of(800.0, centre=(0, 0, 200.0)), 'a') == 1000
    assert np.isnan(phantom_distance(result_of(), 'a'))


def test_beams_meet_at_their_angle():
    """The distances of the sources do not depend on the origin of the frame."""
    turned = [[0, 0, 1.0], [0, 1, 0], [-0.8, 0, 0.6]]
    orientation = Fake(
        fluoroscopes=('a', 'b', 'c'),
        rotation=np.array([np.eye(3), turned, np.diag([1.0, -1, -1])]),
        position_mm=np.array([[100.0, -200, 50], [130, -160, 50], [100, -200, 950]]),
    )
    names, degrees, between = zip(*beams(orientation))
    assert names == ('a and b', 'a and c', 'b and c')
    assert between == pytest.approx([50, 900, np.hypot(50, 900)])
    assert degrees == pytest.approx(np.degrees(np.arccos([0.6, -1, -0.6])))


@pytest.mark.filterwarnings('error')
def test_parallel_beams_have_an_angle_of_zero():
    """Rounding may make the product of two equal axes larger than 1."""
    for seed in range(20):
        turn = matrix_from_vector(np.random.default_rng(seed).normal(size=3))
        orientation = Fake(
            fluoroscopes=('a', 'b'), rotation=np.stack([turn, turn]), position_mm=np.eye(2, 3)
        )
        ((_, degrees, _),) = beams(orientation)
        assert degrees == pytest.approx(0, abs=1e-6)


def test_share_of_the_image_that_is_not_calibrated():
    whole = rigs.pincushion('a', (200, 100))
    assert uncalibrated_share(whole) == 0
    inner = whole.model.train_uv[:, 0] < 100
    part = rigs.create_model(
        'local_linear', 6, whole.model.train_uv[inner], whole.model.train_duv[inner], 0.2, 0.0
    )
    share = uncalibrated_share(replace(whole, model=part, train_exposure=np.zeros(72, int)))
    assert share == pytest.approx(1 - (whole.model.train_uv[inner, 0].max() + 0.5) / 200, abs=0.02)


def test_drawing_of_a_rig_is_in_its_frame():
    calibration = rigs.pincushion('a', SIZE)
    calibration = replace(calibration, interior=np.array([160.0, 80, 1000]))
    result = result_of(900.0)
    alone = drawing(result, {'a': calibration}, None)
    (one,) = alone['fluoroscopes']
    depth = 1.3 * 900
    half = np.array([0.16, 0.08, 1]) * depth
    corners = half * [[-1, -1, 1], [1, -1, 1], [1, 1, 1], [-1, 1, 1]]
    assert one['source'] == [0, 0, 0]
    np.testing.assert_allclose(one['corners'], corners)
    assert alone['places'] == [[-5, 7, 900]]
    turn = np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]])
    place = np.array([10.0, 20, 30])
    orientation = Fake(fluoroscopes=('a',), rotation=[turn], position_mm=[place])
    found = drawing(result, {'a': calibration}, orientation)
    assert found['fluoroscopes'][0]['source'] == [10, 20, 30]
    np.testing.assert_allclose(found['fluoroscopes'][0]['corners'], corners @ turn + place)
    np.testing.assert_allclose(found['places'], [turn.T @ [-5, 7, 900] + place])


def test_accuracy_in_space_is_of_distances_between_halves():
    """Of four known beads, the first two are compared with the last two."""
    phantom = Phantom(np.arange(1, 6), np.diag([1.0, 2, 3, 4, 5])[:, :3] * 10, np.full(5, 0.3))
    covariance = np.tile(np.diag([0.04, 0.01, 0.09]), (6, 1, 1))
    points = Fake(
        status=np.array([OK, OK, REJECTED, OK, OK, OK]),
        sd_mm=np.tile([0.2, 0.1, 0.3], (6, 1)),
        xyz_mm=np.vstack([phantom.xyz_mm + [0.5, 0, 0], [[9, 9, 9]]]),
        covariance_noise=covariance,
    )
    points.xyz_mm[3] += [0, 0, 2.0]
    frame = Fake(target_id=np.array([1, 2, 3, 4, 5, 77]), points=points)
    found = accuracy_in_space([frame], phantom)
    assert found.points == 4 and found.distances == 2
    assert found.sd_mm.tolist() == [0.2, 0.1, 0.3]
    assert found.sd_point_mm == pytest.approx(np.sqrt(0.14))
    measured = [np.linalg.norm([10, 0, -2]), 20.0]
    surveyed = [10.0, 20.0]
    assert found.distance_mm == pytest.approx(np.mean(measured))
    assert found.distance_rms_mm == pytest.approx(
        np.sqrt(np.mean(np.subtract(measured, surveyed) ** 2))
    )
    along = np.array([-10, 0, 2.0]) / measured[0]
    expected = [2 * (0.04 * along[0] ** 2 + 0.09 * along[2] ** 2), 2 * 0.01]
    assert found.distance_sd_mm == pytest.approx(np.sqrt(np.mean(expected) + 2 * 0.09))
    assert accuracy_in_space([replace_status(frame)], phantom) is None


def replace_status(frame):
    points = Fake(**{**vars(frame.points), 'status': np.full(6, REJECTED)})
    return Fake(target_id=frame.target_id, points=points)


# ---- numbers of the page


def given(**changes):
    calibration = replace(rigs.pincushion('a', SIZE), interior=np.array([160.0, 80, 1000]))
    values = {
        'calibrations': {'a': calibration},
        'result': result_of(800.0) | {'targets': []},
        'names': Names(),
    }
    return Fake(**{**values, **changes})


@pytest.mark.parametrize(
    ('check', 'mm'),
    [
        ({'value': 0.5, 'unit': 'px', 'fluoroscope': 'a'}, 0.4),
        ({'value': 0.5, 'unit': 'mm', 'fluoroscope': 'a'}, 0.5),
        ({'value': 0.5, 'unit': 'mm'}, 0.5),
        ({'value': 0.5, 'unit': 'px', 'fluoroscope': 'b'}, None),
        ({'value': 0.5, 'unit': '1', 'fluoroscope': 'a'}, None),
        ({'value': None, 'unit': 'px', 'fluoroscope': 'a'}, None),
    ],
)
def test_checks_are_told_in_mm_at_the_phantom(check, mm):
    assert html._check_mm(given(), check) == (None if mm is None else pytest.approx(mm))


def test_outliers_are_the_largest_first_with_their_residuals(monkeypatch):
    monkeypatch.setattr(html, 'MAX_ROWS', 2)
    points = [
        {'fluoroscope': 'a', 'exposure': e, 'target_id': t, 'value': value}
        for e, t, value in ((4, 0, 3.0), (9, 5, 8.0), (9, 70, 5.0))
    ]
    of = given(result={'outliers': {'image_points': points}})
    found = html._outliers(of, {'a': some_residuals()})
    assert (found['count'], found['of']) == (3, 6)
    assert [row['value'] for row in found['rows']] == [8.0, 5.0]
    assert [row['px'] for row in found['rows']] == [pytest.approx(np.hypot(50, 60)), None]


def test_arrows_of_the_page_are_rows_of_each_exposure(monkeypatch):
    found = html._arrows(given(), {'a': some_residuals()})['a']
    assert found['size'] == [320, 160] and set(found['exposures']) == {4, 9}
    assert found['exposures'][9][2] == [310.0, 10.0, 50.0, 60.0, 0.0]
    assert found['exposures'][4][0] == [10.0, 20.0, 0.6, 0.8, 1.0]
    monkeypatch.setattr(html, 'MAX_ARROWS', 5)
    assert html._arrows(given(), {'a': some_residuals()}) == {}


@pytest.mark.filterwarnings('error')
def test_largest_correction_and_correlations():
    assert html._largest(some_residuals()) == pytest.approx(4.0)
    matrix = np.array([[4.0, 1, 0], [1, 9, 0], [0, 0, 0]])
    found = np.array(html._correlation(matrix))
    assert found[0].tolist()[:2] == [1, pytest.approx(1 / 6)] and found[1, 1] == 1
    assert np.isnan(found[2]).all() and np.isnan(found[:, 2]).all()


def test_shifts_of_beads_are_named_by_their_significance(monkeypatch):
    monkeypatch.setattr(html, 'svg_text', lambda figure: '')
    phantom = Phantom(np.array([1, 2, 3, 4]), np.zeros((4, 3)), np.array([0.1, 0.5, 0.1, 1]))
    targets = [
        {'target_id': target, 'xyz_mm': xyz}
        for target, xyz in ((1, [0.1, 0, 0]), (2, [0, 0.8, 0]), (3, [0, 0, 0.3]), (9, [5, 5, 5]))
    ]
    of = given(phantom=phantom, result={'targets': targets}, names=Names({'corner': 3}))
    found = html._bead_picture(of)
    assert [row[0] for row in found['largest']] == ['corner', 2, 1]
    assert found['largest'][0][1:] == ([0, 0, 0.3], 0.1)
    assert found['rms'] == pytest.approx(np.array([0.1, 0.8, 0.3]) / np.sqrt(3))
    assert html._bead_picture(given(phantom=phantom)) is None


def test_pictures_are_those_that_there_is_something_to_show_for(monkeypatch):
    for name in ('distortion_figure', 'residual_map', 'exposure_bars', 'distribution'):
        monkeypatch.setattr(html, name, lambda *_: None)
    empty = {'model': rigs.no_correction(), 'train_exposure': np.zeros(0, dtype=int)}
    none = replace(rigs.pincushion('a', SIZE), **empty)
    scale = Scale(1.0, 1.0)
    titles = [title for title, _ in html._figures(given(), 'a', some_residuals(), scale)]
    assert len(titles) == 5 and titles[0].startswith('Distortion')
    without = given(calibrations={'a': none})
    assert [t for t, _ in html._figures(without, 'a', some_residuals(), scale)] == titles[1:]
    nothing = replace(some_residuals(), inlier=np.zeros(6, bool))
    assert [t for t, _ in html._figures(given(), 'a', nothing, scale)] == titles[:1]


# ---- points in space


def frame(number, found, stamp_s):
    count = len(found)
    points = Fake(
        status=np.where(found, OK, REJECTED),
        xyz_mm=np.full((count, 3), float(number)),
        sd_mm=np.tile([0.1, 0.2, 0.3], (count, 1)) * number,
    )
    return Fake(
        target_id=np.arange(count) + 5, points=points, stamp_ns=round(1e9 * stamp_s), number=number
    )


def test_figure_of_points_shows_when_each_was_found_and_its_sd():
    frames = [frame(n, [True, n != 2], 100 + 0.5 * n) for n in (1, 2, 3)]
    figure = points_figure(frames, {5: 'knee'})
    assert figure.get_figwidth() > figure.get_figheight()  # paths, visibility, accuracy
    seen, known = figure.subfigs[1].axes
    labels = [label.get_text() for label in seen.get_yticklabels()]
    assert labels == ['knee: 100 %', '6: 67 %']
    bars = [path.get_extents() for c in seen.collections for path in c.get_paths()]
    assert [bar.x0 for bar in bars] == pytest.approx([0, 0, 1])
    assert [bar.x1 for bar in bars] == pytest.approx([1.5, 0.5, 1.5])
    assert [bar.y0 for bar in bars] == pytest.approx([-0.4, 0.6, 0.6])
    widths = [patch.get_width() for patch in known.patches]
    assert widths == pytest.approx([0.2, 0.2, 0.4, 0.4, 0.6, 0.6])
    assert seen.get_ylim() == (1.5, -0.5) and seen.get_xlabel() == 'time [s]'
    paths = figure.subfigs[0].axes[0].lines
    assert paths[0].get_data_3d()[0].tolist() == [1, 2, 3]


def test_points_are_in_the_path_of_their_target():
    """A point is in the path of its target even if its frame has another first target."""
    every = [frame(n, [True, True, True], n) for n in (1, 2, 3)]
    late = every[1]
    late.target_id, late.points = late.target_id[1:], frame(2, [True, True], 2).points
    late.points.xyz_mm = np.array([[6.0, 6, 6], [7.0, 7, 7]])
    paths = points_figure(every, {}).subfigs[0].axes[0].lines
    x = np.array([path.get_data_3d()[0] for path in paths])
    np.testing.assert_array_equal(x, [[1, np.nan, 3], [1, 6, 3], [1, 7, 3]])


def test_frames_without_times_are_shown_by_number():
    frames = [frame(n, [True], 0) for n in (4, 5)]
    assert points_figure(frames, {}).subfigs[1].axes[0].get_xlabel() == 'frame'
    drawn = axes()
    _draw_gaps(drawn, np.array([4]), np.array([[True]]), ['x'])
    (bar,) = [path.get_extents() for c in drawn.collections for path in c.get_paths()]
    assert (bar.x0, bar.x1) == (4, 5)


@pytest.mark.parametrize('count', [MAX_NAMED, MAX_NAMED + 1])
def test_as_many_targets_are_named_as_have_room(count):
    drawn = axes()
    _draw_gaps(drawn, np.array([0.0, 1.0]), np.ones((2, count), bool), ['x'] * count)
    named = [label.get_text() for label in drawn.get_yticklabels()].count('x: 100 %')
    assert named == (count if count <= MAX_NAMED else 0)
