# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The report of a calibration as one HTML file."""

import base64
import html.parser
import json
import re
import shutil
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from rigs import calibrated, exposures, rig, run, turning

from fluoro_calib_ros.errors import DataError
from fluoro_calib_ros.estimation.options import CalibrationOptions, CalibrationRequest
from fluoro_calib_ros.exposures.names import Names
from fluoro_calib_ros.images.codec import encode
from fluoro_calib_ros.io.calibration_request import write_radiographs, write_request
from fluoro_calib_ros.jobs.calibration import CalibrationOutcome, run_calibration
from fluoro_calib_ros.jobs.report import read_report_input
from fluoro_calib_ros.jobs.result_folder import save_outcome, save_result
from fluoro_calib_ros.report import figures
from fluoro_calib_ros.report import html as html_report
from fluoro_calib_ros.report.figures import common_scale, new_figure, svg_bytes
from fluoro_calib_ros.report.residuals import position_figure
from fluoro_calib_ros.report.rig_geometry import beams, phantom_distance
from fluoro_calib_ros.simulation.rig import simulate_exposures, virtual_rig

OPTIONS = {'max_iterations': 2}
MAX_BYTES = 5_000_000
MAX_VECTORS = 20  # few marks are drawn fast


@pytest.fixture(scope='module')
def folder(tmp_path_factory):
    """Result folder of fluoroscope a whose targets have names."""
    path = tmp_path_factory.mktemp('report') / 'result'
    names = Names({f'<bead> {i}': i for i in rig().phantom.target_id.tolist()})
    result = calibrated('a', 6, **OPTIONS)
    save_result(path, result)
    frames = {'a': exposures()['a'][:6]}
    options = CalibrationOptions(**OPTIONS)
    write_request(path, CalibrationRequest(frames, rig().phantom, options, names=names))
    return path


@pytest.fixture
def without_pictures(monkeypatch):
    """Do not render pictures, but draw them."""
    monkeypatch.setattr(html_report, 'svg_text', lambda figure: '')


@pytest.fixture
def text_only(without_pictures, monkeypatch):
    """Do not even draw the pictures of fluoroscopes."""
    monkeypatch.setattr(html_report, '_figures', lambda *_: [])


class Page(html.parser.HTMLParser):
    """Collect the open elements, the attributes that load something, and the text."""

    def __init__(self):
        super().__init__()
        self.open = []
        self.loads = []
        self.text = []

    def handle_starttag(self, tag, attributes):
        if tag not in ('meta', 'br', 'img'):
            self.open.append(tag)
        self.loads += [v for name, v in attributes if name in ('src', 'href') and v]

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text.append(data)


def page_of(path):
    page = Page()
    text = path.read_text()
    page.feed(text)
    assert page.open == []
    return page, text


def write_verdict(folder, verdict, sentence, **changes):
    given = read_report_input(folder)
    document = {
        'verdict': verdict,
        'findings': [sentence],
        'checks': [
            {'name': 'halves', 'fluoroscope': 'a', 'value': 2.0, 'limit': 1.0, 'unit': 'px'}
            | {'passed': verdict == 'pass', 'sentence': sentence, 'place': None}
        ],
        'calibration_id': {n: c.calibration_id for n, c in given.calibrations.items()},
        'seconds': 1.0,
    }
    (folder / 'validation.json').write_text(json.dumps({**document, **changes}))


@pytest.mark.long
def test_report_needs_nothing_else(folder, capsys):
    """It is one file below 5 MB with pictures inside and no address; names are never markup."""
    assert run('report', folder) == 0
    path = folder / 'report.html'
    page, text = page_of(path)
    assert path.stat().st_size < MAX_BYTES
    assert page.loads and all(load.startswith('data:image/svg+xml;base64,') for load in page.loads)
    without_pictures = re.sub(r'base64,[^"]+', '', text)
    assert not re.search(r'https?:|//[a-z]|@import|url\(', without_pictures)
    assert '<bead>' not in without_pictures and '&lt;bead&gt;' in without_pictures
    assert str(path) in capsys.readouterr().out


def test_distortion_of_an_outcome_is_a_figure(folder):
    request = CalibrationRequest({'a': exposures()['a'][:6]}, rig().phantom)
    outcome = CalibrationOutcome(request, calibrated('a', 6, **OPTIONS))
    assert 'Fluoroscope a: estimated distortion' in outcome.plot('a').get_suptitle()
    assert outcome.summary().startswith('Fluoroscope') and 'Verdict' not in outcome.summary()


def test_distortion_is_drawn_to_the_scale_of_the_largest(folder, monkeypatch, without_pictures):
    given = read_report_input(folder)
    model = given.calibrations['a'].model
    scales = []
    draw = html_report.distortion_figure

    def drawn(*arguments):
        scales.append(arguments[-1])
        return draw(*arguments)

    monkeypatch.setattr(html_report, 'distortion_figure', drawn)
    html_report.report_html(given)
    (scale,) = scales
    largest = np.hypot(*model.train_duv.T).max()
    assert scale.magnitude_px == pytest.approx(largest, rel=0.3)
    assert scale == common_scale([(model, given.calibrations['a'].image_size)])


def test_many_marks_are_pixels_and_few_are_vectors(monkeypatch):
    monkeypatch.setattr(figures, 'MAX_VECTORS', MAX_VECTORS)
    figure = new_figure(4, 3, 'marks')
    axes = figure.subplots()
    axes.plot(np.arange(MAX_VECTORS), '.')
    assert b'<image' not in svg_bytes(figure) and svg_bytes(figure) == svg_bytes(figure)
    axes.plot(np.arange(MAX_VECTORS + 1), '.')
    text = svg_bytes(figure)
    assert text.count(b'<image') == 1 and b'data:image/png;base64' in text
    for number, count in ((0, MAX_VECTORS), (1, MAX_VECTORS + 1)):
        for draw in ('scatter', 'quiver', 'vlines'):
            figure = new_figure(4, 3, 'marks')
            x = np.arange(count)
            more = {'scatter': (x,), 'quiver': (x, x, x), 'vlines': (x - 1, x)}[draw]
            getattr(figure.subplots(), draw)(x, *more)
            assert svg_bytes(figure).count(b'<image') == number, draw


def test_report_shows_the_residuals_of_the_adjustment(folder):
    """They are recomputed from the files; their RMS is that of the calibration."""
    given = read_report_input(folder)
    residuals = html_report._residuals(given, 'a')
    entry = given.result['fluoroscopes']['a']
    assert len(residuals.uv) == entry['observations']
    rms = np.sqrt(np.mean(residuals.after[residuals.inlier] ** 2, axis=0))
    np.testing.assert_allclose(rms, entry['rmse_px']['after'], rtol=0.1)


def test_standard_deviation_of_a_correction_is_that_at_the_angles_of_the_exposures(
    folder,
):
    """It is not that of an unknown angle, which includes the changes with the angle."""
    given = read_report_input(folder)
    turned = [replace(f, angle=0.1 * i) for i, f in enumerate(given.frames['a'])]
    given = replace(
        given,
        calibrations={'a': turning(given.calibrations['a'])},
        frames={'a': turned},
    )
    residuals = html_report._residuals(given, 'a')
    calibration = given.calibrations['a']
    unknown = np.median(calibration.correction(residuals.uv).sd)
    at_angles = np.median(calibration.correction(residuals.uv, residuals.angle).sd)
    assert at_angles < 0.5 * unknown
    assert html_report._fluoroscope(given, 'a', residuals)['correction_sd'] == at_angles


@pytest.mark.parametrize(
    ('verdict', 'sentence'),
    [
        ('pass', 'This calibration can be used.'),
        ('fail', 'Do not use this calibration.'),
        ('cannot tell', 'The checks cannot decide whether'),
    ],
)
def test_verdict_and_what_to_do_come_first(folder, tmp_path, text_only, verdict, sentence):
    copy = shutil.copytree(folder, tmp_path / 'copy')
    write_verdict(copy, verdict, 'Record <5> more exposures.')
    assert run('report', copy) == 0
    page, source = page_of(copy / 'report.html')
    text = ' '.join(page.text)
    assert f'class="verdict {verdict.replace(" ", "-")}"' in source
    place = text.index(f'Verdict: {verdict}')
    assert place < text.index(sentence) < text.index('Record <5> more') < text.index('In short')


@pytest.mark.parametrize(
    ('verdict', 'findings', 'recommended'),
    [('pass', [], True), ('pass', ['one bead is wrong'], False), ('fail', [], False)],
)
def test_only_a_calibration_without_findings_is_recommended(verdict, findings, recommended):
    given = SimpleNamespace(
        validation={'verdict': verdict, 'findings': findings},
        edited=None,
        result={},
        rig_note=None,
    )
    shown = html_report._verdict(given)['findings']
    assert shown[: len(findings)] == findings
    assert any('Correct and reconstruct with it' in text for text in shown) is recommended


def test_verdict_on_another_calibration_is_not_shown(folder, tmp_path, text_only):
    copy = shutil.copytree(folder, tmp_path / 'copy')
    write_verdict(copy, 'pass', 'good', calibration_id={'a': 'another'})
    assert run('report', copy) == 0
    page, _ = page_of(copy / 'report.html')
    assert 'This calibration has not been validated.' in ' '.join(page.text)


def test_folder_without_calibration_is_refused(folder, tmp_path, text_only, capsys):
    assert run('report', tmp_path) == 1
    assert 'there is no calibration in this folder' in capsys.readouterr().err
    copy = shutil.copytree(folder, tmp_path / 'copy')
    result = json.loads((copy / 'result.json').read_text())
    del result['fluoroscopes']['a']['interior']
    (copy / 'result.json').write_text(json.dumps(result))
    (copy / 'report.html').write_text('earlier')
    assert run('report', copy) == 1
    assert 'this is not the result of a calibration' in capsys.readouterr().err
    assert (copy / 'report.html').read_text() == 'earlier'


def test_first_screen_is_in_mm(tmp_path, text_only):
    """Points in space, distances, beams and fields of view, for a rig without distortion."""
    straight = virtual_rig(1, strength=0.0)
    frames = {
        name: [replace(f, target_id=f.target_id[::3], uv=f.uv[::3]) for f in of_one]
        for name, of_one in simulate_exposures(straight, 6, 1).frames.items()
    }
    request = CalibrationRequest(frames, straight.phantom, CalibrationOptions(model='none'))
    save_outcome(tmp_path / 'result', run_calibration(request))
    given = read_report_input(tmp_path / 'result')
    page = Page()
    page.feed(html_report.report_html(given))
    text = ' '.join(''.join(page.text).split())
    space = given.space
    assert 0 < space.sd_point_mm < 1 and np.all(space.sd_mm < space.sd_point_mm)
    assert 0.5 < space.distance_rms_mm / space.distance_sd_mm < 1.5
    for value in (*space.sd_mm, space.sd_point_mm, space.distance_rms_mm):
        assert f'{value:.3f}' in text
    ((_, degrees, between),) = beams(given.orientation)
    assert f'{degrees:.1f}, {between:.0f}' in text
    for name, calibration in given.calibrations.items():
        entry = given.result['fluoroscopes'][name]
        true = np.median([np.linalg.norm(e['position_mm']) for e in entry['exposures']])
        distance = phantom_distance(given.result, name)
        assert distance == pytest.approx(true, rel=0.02)
        width = calibration.image_size[0] * distance / calibration.interior[2]
        assert f'{width:.0f} ×' in text
        rmse = entry['rmse_px']['before'][0]
        assert f'{rmse:.3f} ({rmse * distance / calibration.interior[2]:.3f})' in text


def test_checks_have_their_sentence_and_mm(folder, tmp_path, text_only):
    copy = shutil.copytree(folder, tmp_path / 'copy')
    write_verdict(copy, 'fail', 'two halves differ')
    given = read_report_input(copy)
    (check,) = html_report._verdict(given)['checks']
    distance = phantom_distance(given.result, 'a')
    assert check['mm'] == pytest.approx(2.0 * distance / given.calibrations['a'].interior[2])
    assert check['sentence'] == 'two halves differ'


def test_exposures_are_there_to_be_looked_at_one_by_one(folder):
    given = read_report_input(folder)
    residuals = {'a': html_report._residuals(given, 'a')}
    of_one = html_report._arrows(given, residuals)['a']['exposures']
    assert len(of_one) == 6 and sum(map(len, of_one.values())) == len(residuals['a'].uv)
    number = int(residuals['a'].exposure[0])
    u, v, du, dv, used = of_one[number][0]
    np.testing.assert_allclose((u, v), residuals['a'].uv[0], atol=0.051)
    np.testing.assert_allclose((du, dv), residuals['a'].after[0], atol=0.0051)
    assert bool(used) == residuals['a'].inlier[0]


def jpeg(grey):
    return encode(np.full((60, 80), grey, np.uint8), '.jpg', 80)


def test_radiographs_are_embedded(folder, tmp_path, text_only):
    copy = shutil.copytree(folder, tmp_path / 'result')
    numbers = sorted(f.number for f in read_report_input(copy).frames['a'])
    write_radiographs(copy, {'a': {n: jpeg(n % 250) for n in (*numbers[:2], 999)}})
    given = read_report_input(copy)
    assert sorted(given.radiographs['a']) == numbers[:2], 'those of exposures of the calibration'
    text = html_report.report_html(given)
    for number in numbers[:2]:
        assert base64.b64encode(jpeg(number % 250)).decode() in text
    assert 'Circles are the beads' in text and 'with the largest residuals' in text
    assert 'Circles are the beads' not in html_report.report_html(read_report_input(folder))


def test_radiographs_of_the_largest_residuals_fit_the_bound(folder, monkeypatch):
    given = read_report_input(folder)
    residuals = {'a': html_report._residuals(given, 'a')}
    by_rms = sorted(residuals['a'].of_exposures(), key=lambda row: -row[3])
    size = len(jpeg(1))
    given = replace(given, radiographs={'a': {row[0]: jpeg(1) for row in by_rms}})
    monkeypatch.setattr(html_report, 'MAX_RADIOGRAPHS_BYTES', 2 * size + 1)
    chosen = html_report._radiographs(given, residuals)['a']
    assert list(chosen) == [row[0] for row in by_rms[:2]]


@pytest.mark.parametrize('content', [b'<svg onload="alert()">', jpeg(1) + bytes(2**20)])
def test_what_is_no_small_jpeg_is_refused(folder, tmp_path, content):
    copy = shutil.copytree(folder, tmp_path / 'result')
    number = read_report_input(copy).frames['a'][0].number
    write_radiographs(copy, {'a': {number: content}})
    with pytest.raises(DataError, match=f'a_{number}.jpg: this is not a '):
        read_report_input(copy)


def test_beads_are_compared_with_their_survey(folder, without_pictures):
    """A shift is the adjusted minus the surveyed place; the largest shifts come first, by name."""
    given = read_report_input(folder)
    beads = html_report._bead_picture(given)
    survey = dict(zip(given.phantom.target_id.tolist(), given.phantom.xyz_mm))
    names = given.names.target_names()
    shifts = {
        names[t['target_id']]: np.array(t['xyz_mm']) - survey[t['target_id']]
        for t in given.result['targets']
    }
    for name, shift, _ in beads['largest']:
        np.testing.assert_allclose(shift, shifts[name])
    lengths = [np.linalg.norm(shift) for _, shift, _ in beads['largest']]
    assert lengths == sorted(lengths, reverse=True)
    assert lengths[0] == pytest.approx(max(np.linalg.norm(s) for s in shifts.values()))


def test_outliers_have_names_and_residuals(folder):
    given = read_report_input(folder)
    all_used = html_report._residuals(given, 'a')
    exposure, target = int(all_used.exposure[7]), int(all_used.target_id[7])
    point = {'exposure': exposure, 'target_id': target}
    point |= {'fluoroscope': 'a', 'value': 9.0, 'critical': 3.0}
    result = {**given.result, 'outliers': {'image_points': [point]}}
    given = replace(given, result=result)
    residuals = {'a': html_report._residuals(given, 'a')}
    (row,) = html_report._outliers(given, residuals)['rows']
    assert row['target'] == f'<bead> {point["target_id"]}'
    assert np.flatnonzero(~residuals['a'].inlier).tolist() == [7]
    assert row['px'] == pytest.approx(np.hypot(*residuals['a'].after[7]))


def test_sides_without_beads_are_named(folder):
    given = read_report_input(folder)
    residuals = html_report._residuals(given, 'a')
    width, _ = given.calibrations['a'].image_size
    left = residuals.uv[:, 0] < width / 2
    half = replace(
        residuals,
        **{
            name: getattr(residuals, name)[left]
            for name in ('exposure', 'target_id', 'uv', 'before', 'after', 'inlier', 'angle')
        },
    )
    missing = html_report._fluoroscope(given, 'a', half)['missing']
    right = {'in the upper right corner', 'at the right edge', 'in the lower right corner'}
    assert set(missing[:3]) == right  # the emptiest first


def test_exterior_orientations_have_the_names_of_their_exposures(folder):
    """The result may hold their numbers as numbers or as texts."""
    given = read_report_input(folder)
    entry = given.result['fluoroscopes']['a']
    listed = [e['exposure'] for e in entry['exposures']]
    names = Names({}, {f'pose <{n}>': int(n) for n in listed[1:]}, {'<left>': 'a'})
    as_text = [{**e, 'exposure': str(e['exposure'])} for e in entry['exposures']]
    for listed_so in (entry['exposures'], as_text):
        result = {**given.result, 'fluoroscopes': {'a': {**entry, 'exposures': listed_so}}}
        one = replace(given, result=result, names=names)
        numbers = html_report._fluoroscope(one, 'a', html_report._residuals(given, 'a'))
        shown = [name for name, _ in numbers['exterior']]
        assert shown == [listed_so[0]['exposure'], *(f'pose <{n}>' for n in listed[1:])]
        assert [e for _, e in numbers['exterior']] == listed_so
        assert numbers['label'] == '<left>'
        assert [row[0] for row in numbers['exposures']] == [int(n) for n in listed]
        assert [row[1] for row in numbers['exposures']] == [int(listed[0]), *shown[1:]]


def test_panels_of_residuals_are_two_coordinates_by_three_scales():
    rng = np.random.default_rng(1)
    uv = rng.uniform(0, 1000, (200, 2))
    before, after = (rng.normal(0, sd, (200, 2)) for sd in (2.0, 0.1))
    after[0] = 50.0
    good = np.arange(200) > 0
    figure = position_figure('', uv, (before, good), (after, good), (1000, 800))
    assert len(figure.axes) == 6
    limits = np.array([axes.get_ylim()[1] for axes in figure.axes]).reshape(2, 3)
    assert (limits[:, 0] == limits[:, 1]).all() and (limits[:, 2] < limits[:, 1] / 5).all()
    for k, axes in enumerate(figure.axes):
        row, column = divmod(k, 3)
        assert axes.get_xlim() == (-0.5, (1000, 800)[row] - 0.5)
        dots, crosses = axes.lines[:2]
        shown = (before, after, after)[column][:, row]
        np.testing.assert_array_equal(dots.get_ydata(), shown[good])
        np.testing.assert_array_equal(dots.get_xdata(), uv[good, row])
        if column:  # points beyond the panel are drawn at its border
            assert crosses.get_ydata()[0] == pytest.approx(0.97 * limits[row, column])
        rmse = np.sqrt(np.mean(shown[good] ** 2))
        assert f'{rmse:.3f} px, 1 of 200' in axes.get_title()


@pytest.mark.parametrize('count', [0, 1, 2, 3])
def test_picture_of_beads_needs_two_of_them(folder, without_pictures, count):
    given = read_report_input(folder)
    few = replace(given, result={**given.result, 'targets': given.result['targets'][:count]})
    beads = html_report._bead_picture(few)
    assert (beads is None) is (count < 2)
    if beads is not None:
        assert len(beads['largest']) == count
