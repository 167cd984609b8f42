# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What commands decide, print and pass on, for outcomes that are given."""

import argparse
import io
import json
from dataclasses import replace
from importlib.metadata import PackageNotFoundError
from pathlib import Path
from types import SimpleNamespace as Fake

import numpy as np
import pytest
from rigs import run

from fluoro_calib_ros.checks.check import Check
from fluoro_calib_ros.cli import (
    bag,
    bodies,
    calibrate,
    convert,
    extract,
    heal,
    output,
    parse_words,
    phantom,
    process,
)
from fluoro_calib_ros.cli import reconstruct as reconstruct_command
from fluoro_calib_ros.cli import report as report_command
from fluoro_calib_ros.cli import survey as survey_command
from fluoro_calib_ros.cli.arguments import angle_of, cluster_of, result_folder
from fluoro_calib_ros.cli.orient import exposure_numbers
from fluoro_calib_ros.cli.process import Done, Step, _option_words, trial_row
from fluoro_calib_ros.cli.survey import _distances, distance
from fluoro_calib_ros.errors import DataError
from fluoro_calib_ros.estimation.rounds import Round
from fluoro_calib_ros.exposures.names import Names
from fluoro_calib_ros.findings import Finding, Kind, Place, Severity
from fluoro_calib_ros.healing.diagnosis import Cause
from fluoro_calib_ros.io.bags.salvage import BagReport, Damage, TopicReport
from fluoro_calib_ros.io.phantom import read_phantom
from fluoro_calib_ros.jobs.extraction import make_picture_folder
from fluoro_calib_ros.jobs.reconstruction import ReconstructionOptions
from fluoro_calib_ros.jobs.scheduling import Cluster


class Wrong(Exception):
    """Raised instead of the exit of a parser on a wrong argument."""


def wrong(message):
    raise Wrong(message)


# ---- arguments


@pytest.mark.parametrize(
    ('text', 'expected'),
    [('7', {7}), ('1,4-6', {1, 4, 5, 6}), ('0-0', {0}), ('3-3,2', {2, 3})],
)
def test_numbers_of_exposures_are_single_or_ranges(text, expected):
    assert exposure_numbers(text) == expected


@pytest.mark.parametrize('text', ['', 'x', '6-4', '-1', '1-', '1,,2', f'0-{10**6}', f'0-{10**20}'])
def test_lists_of_exposures_that_are_none_are_refused(text):
    if text == '1-':
        assert exposure_numbers(text) == {1}
        return
    with pytest.raises(argparse.ArgumentTypeError):
        exposure_numbers(text)


def test_distances_are_between_beads_by_name_or_id():
    assert distance('1, 45 ,120.05,0.02') == ('1', '45', 120.05, 0.02)
    for text in ('1,2,3', '1,2,x,0.1', '1,2,3,4,5'):
        with pytest.raises(argparse.ArgumentTypeError):
            distance(text)
    given = Fake(distance=[('top', '7', 10.0, 0.1)], phantom='p.csv')
    (found,) = _distances(given, Names({'top': 3}))
    assert (found.first, found.second) == (3, 7)
    given.distance = [('top', 'nobody', 10.0, 0.1)]
    with pytest.raises(DataError, match='nobody'):
        _distances(given, Names({'top': 3}))


@pytest.mark.parametrize(
    ('text', 'expected'), [('45x30', (45, 30)), ('1X1000', (1, 1000)), ('0x3', None)]
)
def test_counts_of_places_are_within_their_limits(text, expected):
    convert_text = phantom.counts(2)
    if expected:
        assert convert_text(text) == expected
        return
    with pytest.raises(argparse.ArgumentTypeError, match='1000000 places'):
        phantom.counts(3)('1000x1000x1000')
    for one in (text, '3', '3x1001', '3x4x5', '3x-4'):
        with pytest.raises(argparse.ArgumentTypeError):
            convert_text(one)


def test_places_and_pitches_of_a_drawing():
    assert phantom.place('3,4') == (3, 4) and phantom.place('3,4,5') == (3, 4, 5)
    assert phantom.pitches('7') == (7, 7, 7) and phantom.pitches('7,8,9') == (7, 8, 9)
    for text, parse in (('3', phantom.place), ('3,x', phantom.place), ('1,2', phantom.pitches)):
        with pytest.raises(argparse.ArgumentTypeError):
            parse(text)
    given = Fake(file=None, out=Path('x'), picture=None)
    phantom.check(given, wrong)
    assert given.out == Path('x')
    for both in (Fake(file=None, out=None), Fake(file=Path('x'), out=Path('y'))):
        with pytest.raises(Wrong):
            phantom.check(both, wrong)


def test_folders_angles_and_clusters_of_arguments():
    assert result_folder(Fake(directory='x', calibration='y'), wrong) == 'x'
    assert result_folder(Fake(directory=None, calibration='y'), wrong) == 'y'
    with pytest.raises(Wrong):
        result_folder(Fake(directory=None, calibration=None), wrong)
    report_command.check(Fake(directory=Path('x.pdf'), calibration=None, pdf=False), wrong)
    with pytest.raises(Wrong):
        report_command.check(Fake(directory=Path('x.pdf'), calibration=None, pdf=True), wrong)
    assert angle_of(Fake(angle_deg=None)) is None
    assert angle_of(Fake(angle_deg=180.0)) == pytest.approx(np.pi)
    given = Fake(
        scheduler='tcp://127.0.0.1:1', tls_ca='', tls_cert='', tls_key='', trusted_network=True
    )
    assert isinstance(cluster_of(given), Cluster)
    given.scheduler = None
    assert cluster_of(given) is None


def calibrate_arguments(**changes):
    values = {
        'k': None,
        'model': 'auto',
        'relative_orientation': 'none',
        'joint': False,
        'known_orientation': [],
        'datum': 'survey',
        'interior_sd': None,
        'interior': 'estimated',
        'principal_distance': None,
    }
    return Fake(**{**values, **changes})


@pytest.mark.parametrize(
    ('changes', 'is_wrong'),
    [
        ({}, False),
        ({'k': 5}, True),
        ({'k': 5, 'model': 'knn'}, False),
        ({'relative_orientation': 'constant'}, True),
        ({'relative_orientation': 'constant', 'joint': True}, False),
        ({'known_orientation': ['f']}, False),
        ({'known_orientation': ['f'], 'datum': 'inner'}, True),
        ({'known_orientation': ['f'], 'relative_orientation': 'x', 'joint': True}, True),
        ({'interior_sd': (1, 1, 1)}, True),
        ({'interior_sd': (1, 1, 1), 'principal_distance': 900.0}, False),
        ({'interior_sd': (1, 1, 1), 'principal_distance': 900.0, 'interior': 'fixed'}, True),
    ],
)
def test_arguments_of_calibrate_that_exclude_each_other(changes, is_wrong):
    if not is_wrong:
        calibrate.check(calibrate_arguments(**changes), wrong)
        return
    with pytest.raises(Wrong):
        calibrate.check(calibrate_arguments(**changes), wrong)


def extract_arguments(**changes):
    values = {
        'cluster': [],
        'bodies': None,
        'cluster_shapes': None,
        'markers': None,
        'phantom': 'p.csv',
        'fluoroscope': ['a'],
        'calibration': None,
        'sources': ['x'],
    }
    return Fake(**{**values, **changes})


PAIR = {'fluoroscope': ['a', 'b'], 'calibration': 'r', 'markers': 'm.csv'}
CLUSTER = ['tibia: 1 2 3']


@pytest.mark.parametrize(
    ('changes', 'is_wrong'),
    [
        ({}, False),
        ({'phantom': None}, True),
        ({'fluoroscope': ['a', 'b']}, True),
        ({'cluster': CLUSTER}, True),
        ({'markers': 'm.csv', 'phantom': None}, False),
        ({'markers': 'm.csv', 'cluster': CLUSTER}, True),
        ({'bodies': 'b.csv'}, True),
        (PAIR, False),
        ({**PAIR, 'cluster': CLUSTER, 'sources': ['x', 'y']}, False),
        ({**PAIR, 'bodies': 'b.csv', 'markers': None}, False),
        ({**PAIR, 'bodies': 'b.csv', 'cluster': CLUSTER}, True),
        ({**PAIR, 'cluster_shapes': 's.csv'}, True),
        ({**PAIR, 'calibration': None}, True),
        ({**PAIR, 'sources': ['x', 'y', 'z']}, True),
        ({**PAIR, 'fluoroscope': ['a', 'b', 'c']}, False),
    ],
)
def test_arguments_of_extract_that_exclude_each_other(changes, is_wrong):
    if not is_wrong:
        extract.check(extract_arguments(**changes), wrong)
        return
    with pytest.raises(Wrong):
        extract.check(extract_arguments(**changes), wrong)


@pytest.mark.parametrize(
    ('clusters', 'no_drift_watch', 'source', 'is_wrong'),
    [
        (['tibia: 1 2 3'], False, 'bag', False),
        (['tibia: 1 2 3'], True, 'bag', True),
        (['tibia: 1 2 3'], False, 'points.csv', True),
        (['tibia'], False, 'bag', True),
        ([], True, 'points.csv', False),
    ],
)
def test_clusters_of_reconstruct_need_the_drift_watch_of_a_bag(
    tmp_path, clusters, no_drift_watch, source, is_wrong
):
    (tmp_path / 'bag').mkdir()
    (tmp_path / 'bag' / 'metadata.yaml').touch()
    (tmp_path / 'points.csv').touch()
    given = Fake(cluster=clusters, no_drift_watch=no_drift_watch, source=tmp_path / source)
    if is_wrong:
        with pytest.raises(Wrong):
            reconstruct_command.check(given, wrong)
        return
    reconstruct_command.check(given, wrong)
    assert [body.name for body in given.bodies] == ['tibia'] * len(clusters)


# ---- printed output


class Terminal(io.StringIO):
    def isatty(self):
        return True


def test_colours_are_for_terminals_without_no_color(monkeypatch):
    monkeypatch.delenv('NO_COLOR', raising=False)
    monkeypatch.setenv('TERM', 'xterm')
    assert output.styled('x', 'red', Terminal()) == '\033[31;1mx\033[0m'
    assert output.styled('pass', 'green', Terminal()) == '\033[32;1mpass\033[0m'
    assert output.styled('x', 'red', io.StringIO()) == output.styled('x', '', Terminal()) == 'x'
    monkeypatch.setenv('TERM', 'dumb')
    assert output.styled('x', 'red', Terminal()) == 'x'
    monkeypatch.setenv('TERM', 'xterm')
    monkeypatch.setenv('NO_COLOR', '1')
    assert output.styled('x', 'red', Terminal()) == 'x'


def test_result_is_text_with_the_next_command_or_json(capsys):
    output.print_result(Fake(json=False), {'a': 1}, 'text\n', ('correct', 'my points'))
    assert capsys.readouterr().out == "text\nNext: fluoro-calib correct 'my points'\n"
    output.print_result(Fake(json=False), {'a': 1}, 'text')
    assert capsys.readouterr().out == 'text\n'
    output.print_result(Fake(json=True), {'a': 1}, 'text', ('x',))
    assert json.loads(capsys.readouterr().out) == {'a': 1}


def test_findings_are_printed_warnings_first_and_errors_last(capsys):
    found = [
        Finding(Kind.FEW_TARGETS, name, severity=severity)
        for name, severity in (
            ('bad', Severity.ERROR),
            ('left out', Severity.NOTE),
            ('odd', Severity.WARNING),
        )
    ]
    output.print_findings(found, 'wrong: ')
    lines = capsys.readouterr().err.splitlines()
    assert [line.rstrip('.') for line in lines] == ['odd', 'not used: left out', 'wrong: bad']
    output.print_notes(['x', 'y', 'x'])
    assert capsys.readouterr().err == 'x\ny\n'
    output.print_unpaired(Path('s'), {'a': 0, 'b': 3})
    assert capsys.readouterr().err.endswith('not used: b 3\n')
    output.print_status('extracting')
    assert capsys.readouterr().err == 'extracting\n'
    output.print_unpaired(Path('s'), {'a': 0})
    assert capsys.readouterr().err == ''


def test_findings_of_one_kind_on_many_exposures_are_one_line(capsys):
    def on_exposures(numbers, fluoroscope):
        return [
            Finding(
                Kind.STRAY_POINTS,
                f'{n} points',
                Place((fluoroscope,), (n,)),
                severity=Severity.NOTE,
            )
            for n in numbers
        ]

    output.print_findings([*on_exposures(range(1, 5), 'a'), *on_exposures(range(8, 30), 'b')], '')
    *of_a, of_b = capsys.readouterr().err.splitlines()
    assert [line.split(': ')[1] for line in of_a] == [
        f'fluoroscope a, exposure {n}' for n in range(1, 5)
    ]
    assert of_b.startswith('not used: fluoroscope b, exposure 8: 8 points')
    assert of_b.endswith('21 more exposures: 9, 10, 11, 12, 13 and 16 more')


def test_steps_and_rounds_are_shown_on_a_terminal(monkeypatch):
    screen = Terminal()
    monkeypatch.setenv('NO_COLOR', '1')
    monkeypatch.setattr(output.sys, 'stderr', screen)
    output.print_step('halves', 3, 12)
    this = Round(4, 10.0, 2.0, {'a': 30, 'b': 20}, {'a': (0.25, 0.5)}, 1.0, 0.1)
    output.print_round('a', this)
    step, of_round = screen.getvalue().splitlines()
    assert step.split() == ['25', '%', 'halves']
    assert ' '.join(of_round.split()) == 'a: round 4 k 30 RMSE a: 0.250 0.500 px'
    this = replace(this, k={'a': 0})
    output.print_round('a', this)
    assert ' k ' not in screen.getvalue().splitlines()[-1]
    monkeypatch.delenv('NO_COLOR')
    monkeypatch.setenv('TERM', 'xterm')
    output.print_round('a', this)
    assert screen.getvalue().splitlines()[-1].startswith(f'\033[{output.STYLES["dim"]}m')
    monkeypatch.setattr(output.sys, 'stderr', quiet := io.StringIO())
    output.print_step('halves', 3, 12)
    output.print_round('a', this)
    assert quiet.getvalue() == ''


def outcome(verdict=None, orientation=None):
    validation = None if verdict is None else Fake(verdict=verdict)
    return Fake(validation=validation, orientation=orientation)


@pytest.mark.parametrize(
    ('given', 'command'),
    [
        (outcome(), 'validate'),
        (outcome('fail', 'rig'), None),
        (outcome('cannot tell'), None),
        (outcome('pass'), 'correct'),
        (outcome('pass', 'rig'), 'reconstruct'),
    ],
)
def test_next_step_of_a_calibration(given, command):
    found = calibrate._next_step(Fake(out='result'), given)
    assert (found[0] if found else None) == command and (not found or 'result' in found)


@pytest.mark.parametrize(
    ('verdict', 'fast', 'status'),
    [
        ('pass', False, True),
        ('fail', False, False),
        ('cannot tell', False, False),
        (None, True, True),
    ],
)
def test_calibrate_returns_whether_nothing_speaks_against_it(
    monkeypatch, tmp_path, verdict, fast, status
):
    asked = {}
    given = outcome(verdict)
    given.result = 'result'

    def run_calibration(request, **how):
        asked.update(how)
        return given

    def save_outcome(out, made, write_more):
        asked['saved'] = out
        write_more(tmp_path)

    jobs = 'fluoro_calib_ros.jobs'
    monkeypatch.setattr(f'{jobs}.calibration.run_calibration', run_calibration)
    monkeypatch.setattr(f'{jobs}.result_folder.save_outcome', save_outcome)
    monkeypatch.setattr('fluoro_calib_ros.io.folder.check_output_folder', lambda *_: None)
    monkeypatch.setattr(
        f'{jobs}.result_folder.write_covariances', lambda *words: asked.update(covariance=words)
    )
    monkeypatch.setattr(
        'fluoro_calib_ros.report.report_figures.write_figures',
        lambda *words: asked.update(figures=words),
    )
    monkeypatch.setattr(calibrate, '_request', lambda _: (None, {}))
    monkeypatch.setattr(calibrate, '_print', lambda *_: None)
    arguments = Fake(
        source='s',
        phantom='p',
        known_orientation=[],
        decisions=None,
        out='o',
        fast=fast,
        force=True,
        figures=fast,
        covariance=not fast,
    )
    assert calibrate.run(arguments) is status
    assert (asked['validate'], asked['force'], asked['saved']) == (not fast, True, 'o')
    assert asked.get('figures') == (('result', tmp_path / 'figures') if fast else None)
    assert asked.get('covariance') == (None if fast else (tmp_path, 'result'))


@pytest.mark.parametrize('widening', [1.0, 2.5])
def test_reconstruct_says_by_how_much_its_limit_was_widened(
    monkeypatch, tmp_path, capsys, widening
):
    made = Fake(
        frames=[],
        unpaired={},
        disagreement=None,
        widening=widening,
        drift=Fake(widening=None),
        lost_targets=[],
        noise=None,
        timing=None,
        plot=None,
    )
    monkeypatch.setattr('fluoro_calib_ros.jobs.reconstruction.reconstruct', lambda *_: made)
    monkeypatch.setattr('fluoro_calib_ros.io.bodies.write_reconstruction', lambda *_: None)
    monkeypatch.setattr('fluoro_calib_ros.io.folder.check_output_file', lambda *_: None)
    recording = Fake(notes=(), frames={}, names=Names())
    monkeypatch.setattr(
        reconstruct_command, 'read_oriented_source', lambda *_: (recording, {}, None)
    )
    asked = {}

    def options_of(kind, given, **values):
        assert kind is ReconstructionOptions and given is arguments
        asked.update(values)

    monkeypatch.setattr(reconstruct_command, 'options_of', options_of)
    monkeypatch.setattr(reconstruct_command, '_print', lambda *_: None)
    source = tmp_path / 'x.csv'
    source.touch()
    arguments = Fake(
        source=source,
        orientation=tmp_path / 'o',
        calibration='c',
        out='p.csv',
        decisions=None,
        figure=None,
        no_drift_watch=True,
        bodies=(),
        reject=4.0,
    )
    reconstruct_command.run(arguments)
    said = capsys.readouterr().err
    assert asked == {'drift_watch': False, 'bodies': (), 'has_stamps': False}
    if widening > 1:
        assert '2.5 times, to 10.0 standard deviations' in said
    else:
        assert said == ''


def test_survey_and_figure_do_not_overwrite_what_is_read(tmp_path):
    names = ('seen.csv', 'phantom.csv', 'decisions.csv', 'a.calibration.npz')
    seen, phantom, decisions, calibration = (tmp_path / name for name in names)
    for path in (seen, phantom, decisions, calibration):
        path.touch()
    given = {'source': seen, 'decisions': decisions}
    for out in (seen, phantom, decisions):
        with pytest.raises(DataError, match='overwritten'):
            survey_command.run(Fake(**given, phantom=phantom, out=out))
    out = tmp_path / 'points.csv'
    folder = {'calibration': tmp_path, 'orientation': None}
    for figure in (seen, decisions, calibration):
        with pytest.raises(DataError, match='overwritten'):
            reconstruct_command.run(Fake(**given, **folder, out=out, figure=figure))


def test_pictures_do_not_replace_the_images_that_they_show(tmp_path):
    for folder, names in (('images', ['a_0001.png', '0002.png']), ('pictures', ['a_0001.png'])):
        (tmp_path / folder).mkdir()
        for name in names:
            (tmp_path / folder / name).touch()
    images = tmp_path / 'images'
    for sources in ([images], [images / '0002.png', images / 'a_0001.png']):
        with pytest.raises(DataError, match='would be overwritten'):
            make_picture_folder(images, 'a', sources)
        make_picture_folder(images, 'b', sources)
        make_picture_folder(tmp_path / 'pictures', 'a', sources)


def test_shapes_are_learned_only_if_all_output_is_written(monkeypatch, tmp_path):
    def save_bodies(*_):
        raise DataError('the film cannot be written')

    learned = []
    recording = Fake(notes=(), frames={})
    fakes = {
        'jobs.bodies.track_bodies': lambda *_, **__: None,
        'jobs.bodies.save_bodies': save_bodies,
        'jobs.learning.learn_shapes': lambda *_, **__: 'learned',
        'io.bodies.read_bodies': lambda _: [],
        'io.folder.check_output_folder': lambda *_: None,
        'io.versions.write_learned_shapes': lambda *words: learned.append(words),
    }
    for name, fake in fakes.items():
        monkeypatch.setattr(f'fluoro_calib_ros.{name}', fake)
    monkeypatch.setattr(bodies, 'read_oriented_source', lambda *_: (recording, {}, None))
    parser = argparse.ArgumentParser()
    bodies.add_arguments(parser)
    words = ['x.csv', '--rate', '1', '--bodies', 'b', '--calibration', 'c', '--out', 'o']
    with pytest.raises(DataError, match='the film'):
        bodies.run(parser.parse_args([*words, '--learn']))
    assert learned == []


def test_convert_does_not_overwrite_what_it_reads(tmp_path):
    source = tmp_path / 'a.csv'
    for out in (source, tmp_path / 'x' / '..' / 'a.csv'):
        with pytest.raises(DataError, match='overwritten'):
            convert.run(Fake(source=source, calibration=None, out=out))
    with pytest.raises(DataError, match='overwritten'):
        convert.run(Fake(source=source, calibration=tmp_path / 'r', out=tmp_path / 'r'))
    convert.check(Fake(corrected=True, calibration='r'), wrong)
    convert.check(Fake(corrected=False, calibration=None), wrong)
    with pytest.raises(Wrong):
        convert.check(Fake(corrected=True, calibration=None), wrong)


def test_changes_of_a_healed_rig_are_told_with_their_units():
    value = np.array([1.0, 2, -3, 0.01, 0, 0, 0, 0, 0])
    sd = np.array([0.1] * 3 + [0.001] * 3 + [0.2, 0.3, 4.0])
    text = heal._change(value, sd)
    assert 'moved by 1.00 (sd 0.10), 2.00 (sd 0.10), -3.00 (sd 0.10) mm' in text
    assert '0.573 (sd 0.057)' in text and 'principal' not in text
    text = heal._change(np.array([0.0] * 6 + [5, -6, 7]), sd)
    assert text == (
        'principal point moved by 5.00 (sd 0.20), -6.00 (sd 0.30) px; '
        'principal distance changed by 7.0 (sd 4.0) px'
    )


def healing(changed=(), drift=(), verdict='pass', meanwhile=False, causes=(), **more):
    """Return the outcome of healing two fluoroscopes; `changed`: indices of those that moved."""
    changes, sd = np.zeros((2, 9)), np.full((2, 9), 0.5)
    changes[list(changed), 0] = 2.0
    healed = Fake(changes=changes, sd=sd, drift=dict.fromkeys(drift))
    values = {
        'healed': healed if changed or drift else None,
        'changed_meanwhile': meanwhile,
        'diagnosis': Fake(changes=[Fake(cause=cause) for cause in causes]),
        'orientation': Fake(fluoroscopes=('a', 'b')),
        'before': Fake(place_mm=0.5, scale=2e-4),
        'after': Fake(place_mm=0.04, scale=3e-5),
        'checks': [Fake(passed=True, sentence='good'), Fake(passed=None, sentence='unknown')],
        'common_motion': Fake(sentence='seen by no body'),
        'unseen_distortion': Fake(sentence='seen nowhere', passed=True),
        'verdict': verdict,
    }
    return Fake(**{**values, **more})


def test_healed_rig_is_told_by_fluoroscope_with_what_it_is_worth():
    causes = (Cause.ORIENTATION, Cause.DISTORTION)
    lines = heal._lines(Fake(out='healed'), healing([1], [0], causes=causes))
    assert lines[0] == 'a: its correction has changed'
    assert lines[1].startswith('b: source moved by 2.00 (sd 0.50), 0.00')
    assert lines[2] == (
        'points relative to each other: sd 0.040 mm, scale 30 ppm (as calibrated 0.500 mm, '
        'scale 200 ppm)'
    )
    unseen = ['seen by no body', 'seen nowhere']
    assert lines[3:] == ['written to healed', *unseen, 'unknown', 'Verdict: pass']


@pytest.mark.parametrize(
    ('causes', 'meanwhile', 'first'),
    [
        ((), False, 'no change of the rig is evident'),
        ((Cause.LOOSE,), False, 'no change of the rig is evident'),
        ((Cause.LOOSE, Cause.DISTORTION), False, 'the calibration stays'),
        ((), True, 'the rig changed during the recording'),
    ],
)
def test_rig_that_is_not_healed_stays_as_it_was_calibrated(causes, meanwhile, first):
    lines = heal._lines(Fake(out='healed'), healing(causes=causes, meanwhile=meanwhile))
    assert lines[0].startswith(first)
    assert lines[meanwhile].endswith('the calibration stays as it was, nothing is written')
    assert lines[meanwhile].startswith('no change') is (first.startswith('no change'))
    assert not any('healed' in line for line in lines)


@pytest.mark.parametrize(
    ('passed', 'force', 'is_written'),
    [(True, False, True), (None, False, True), (False, False, False), (False, True, True)],
)
def test_survey_that_fails_is_written_only_by_force(
    monkeypatch, tmp_path, capsys, passed, force, is_written
):
    check = Check(Kind.BEADS, 'x', value=1.0, limit={True: 2.0, False: 0.5, None: np.nan}[passed])
    outcome = Fake(
        findings=(), validation=Fake(checks=[check], verdict='x'), phantom='surveyed', beads=None
    )
    recording = Fake(notes=(), unpaired={}, frames={})
    given = Fake(notes=(), phantom='given', names=Names())
    written = []
    monkeypatch.setattr('fluoro_calib_ros.jobs.sources.read_survey', lambda *_, **__: given)
    monkeypatch.setattr('fluoro_calib_ros.jobs.sources.read_source', lambda *_, **__: recording)
    monkeypatch.setattr('fluoro_calib_ros.jobs.survey.survey', lambda *_: outcome)
    monkeypatch.setattr('fluoro_calib_ros.io.phantom.write_phantom', lambda *w: written.append(w))
    monkeypatch.setattr(survey_command, '_document', lambda outcome, path: {'out': path})
    monkeypatch.setattr(survey_command, '_text', lambda outcome, path: f'written to {path}')
    parser = argparse.ArgumentParser()
    parser.add_argument('--json', action='store_true')
    survey_command.add_arguments(parser)
    words = ['s.csv', '--phantom', 'p.csv', '--out', str(tmp_path / 'new.csv')]
    arguments = parser.parse_args(words + ['--force'] * force)
    arguments.rig_file = None
    if passed is False:
        with pytest.raises(DataError) as caught:
            survey_command.run(arguments)
        assert ('nothing is written' in str(caught.value)) is not force
    else:
        survey_command.run(arguments)
    out = capsys.readouterr().out
    assert ('Next: ' in out) is is_written
    assert written == [(tmp_path / 'new.csv', 'surveyed', Names())] * is_written


@pytest.mark.parametrize(
    ('words', 'full', 'blocked'),
    [
        (['--square', '5x4', '--blocked', '1,5'], 20, [5]),
        (['--hex', '5x4'], 20, []),
        (['--cube', '3x2x2', '--blocked', '2,1,2'], 12, [10]),
    ],
)
def test_phantom_is_written_with_its_picture(tmp_path, capsys, words, full, blocked):
    out = tmp_path / 'p.csv'
    command = ('phantom', *words, '--pitch', '10', '--diameter', '3')
    assert run(*command, '--out', out, '--json') == 0
    told = json.loads(capsys.readouterr().out)
    assert (told['targets'], told['blocked']) == (full - len(blocked), blocked)
    assert told['picture'] == str(tmp_path / 'p.svg') and (tmp_path / 'p.svg').exists()
    assert read_phantom(out).target_id.tolist() == sorted({*range(1, full + 1)} - {*blocked})
    for wrong_picture in ('p.gif', 'p.svg'):
        path = tmp_path / wrong_picture
        assert run(*command, '--out', tmp_path / 'p.svg', '--picture', path) == 2
        assert str(path) in capsys.readouterr().err


# ---- bags


def test_damage_of_a_bag_is_told_between_its_times():
    second = 10**9
    for start, end, when in (
        (None, None, 'the whole file'),
        (second, None, 'after 1970-01-01T00:00:01.000Z'),
        (None, 2 * second, 'before 1970-01-01T00:00:02.000Z'),
        (second, 2 * second, 'between 1970-01-01T00:00:01.000Z and'),
    ):
        text = bag._damage_text(Damage('f', 'cut', start, end, {'/a': 3}))
        assert when in text and text.endswith('(f: cut): /a 3')
    assert bag._damage_text(Damage('f', 'cut', None, None)).endswith('(f: cut)')
    assert bag._time(1_234_567_890) == '1970-01-01T00:00:01.234Z'
    assert bag._time(10**30) == f'{10**30} ns'


def test_information_about_a_bag_has_its_times_and_rates():
    one = TopicReport(
        'T', [10**9, 15 * 10**8, 2 * 10**9], [5 * 10**8, 10**9, 15 * 10**8], [1, 2, 3]
    )
    lone = TopicReport('U', [4 * 10**9])
    report = BagReport(['f', 'g'], {'/a': one, '/b': lone}, {}, (), {})
    lines = bag._info_text(report, []).splitlines()
    assert lines[0] == '4 messages in 2 files' and lines[1].endswith('(3.000 s)')
    assert '00:00:01.000Z to 1970-01-01T00:00:04.000Z' in lines[1]
    assert lines[2:] == [
        '  /a [T]: 3 messages, 2.0 Hz',
        '  /b [U]: 1 messages',
        'no faults found',
    ]
    assert bag._info_text(report, ['x']).splitlines()[-1] == 'fault: x'
    stopped = TopicReport('T', [10**9, 10**9])
    lines = bag._info_text(BagReport(['f'], {'/a': stopped}, {}, (), {}), []).splitlines()
    assert lines[2] == '  /a [T]: 2 messages' and lines[1].endswith('(0.000 s)')
    assert bag._topic_document(stopped)['rate_hz'] is None
    document = bag._topic_document(one)
    assert (document['rate_hz'], document['start_ns'], document['end_ns']) == (2, 10**9, 2 * 10**9)
    assert document['longest_gap_s'] == 0.5 and bag._topic_document(lone)['rate_hz'] is None


def test_bag_commands_become_nodes_with_their_parameters(monkeypatch):
    became = []
    monkeypatch.setattr(bag.os, 'execv', lambda program, words: became.append(words))
    arguments = Fake(
        source=Path('/x'),
        rate=2.0,
        loop=True,
        start_offset=3.0,
        start_paused=False,
        clock=0.0,
        topics=None,
    )
    bag._play(arguments)
    words = became[0]
    given = dict(word.split(':=') for word in words if ':=' in word)
    assert given == {
        'bag': '"/x"',
        'rate': '2.0',
        'loop': 'true',
        'start_offset': '3.0',
        'start_paused': 'false',
        'clock': '0.0',
    }
    assert 'player_node()' in words[2] and words.count('-p') == 6
    arguments.topics = ['/a']
    bag._play(arguments)
    assert 'topics:=["/a"]' in became[1]


# ---- process


def step(command='reconstruct', out='results/walk/points.csv'):
    return Step('walk', (command, 'x'), (), Path(out))


def test_steps_have_names_of_their_own():
    assert (step().name, step().key) == ('reconstruct', 'walk: reconstruct')
    one = step('convert', 'results/walk/points.trc')
    assert (one.name, one.document) == ('convert trc', Path('results/walk/convert_trc.json'))
    assert Step('', ('calibrate',), (), Path('r')).key == 'calibrate'
    assert [Done(status, {}).ok for status in (0, 3, 1, 2)] == [True, True, False, False]


@pytest.mark.parametrize(
    ('value', 'words'),
    [
        (True, ['--a-b']),
        (False, []),
        (2.5, ['--a-b=2.5']),
        ('x', ['--a-b=x']),
        ([1, 'y'], ['--a-b=1', '--a-b=y']),
    ],
)
def test_options_of_a_study_are_words_of_the_command(value, words):
    assert _option_words('a_b', value, wrong) == words
    with pytest.raises(Wrong):
        _option_words('a_b', {'x': 1}, wrong)


def document(**changes):
    values = {'frames': 5, 'points': 9, 'status': {'OK': 7}, 'widening': 1.0, 'drift': None}
    return {**values, 'lost_targets': [], **changes}


@pytest.mark.parametrize(
    ('changes', 'verdict', 'cause'),
    [
        ({}, 'pass', ''),
        ({'widening': 1.2}, 'fail', 'rays'),
        ({'lost_targets': [{'severity': 'warning', 'sentence': 's'}]}, 'cannot tell', 's'),
        ({'drift': {'kind': 'k', 'level': 'ok', 'message': 'm'}}, 'pass', ''),
        ({'drift': {'kind': 'k', 'level': 'warn', 'message': 'm'}}, 'fail', 'm'),
        ({'drift': {'kind': 'k', 'level': 'error', 'message': 'm'}}, 'fail', 'm'),
        ({'drift': {'kind': 'k', 'level': 'learning', 'message': 'm'}}, 'pass', ''),
    ],
)
def test_trial_that_contradicts_its_calibration_fails(changes, verdict, cause):
    row = trial_row('walk', 'pass', [(step(), Done(0, document(**changes))), (step(), None)])
    assert row['verdict'] == verdict and cause in row['cause']
    assert (row['frames'], row['points'], row['points_ok']) == (5, 9, 7)
    assert row['drift'] == ('k' if changes.get('drift') else '')


def test_trial_whose_command_failed_is_refused():
    row = trial_row('walk', 'pass', [(step(), Done(1, {}, 'no such file'))])
    assert (row['verdict'], row['cause']) == ('refused', 'no such file')


def test_trials_are_processed_on_all_cores():
    parser = argparse.ArgumentParser()
    process.add_arguments(parser)
    assert parser.parse_args(['x']).workers == process.os.cpu_count()
    assert parser.parse_args(['x', '--workers', '3']).workers == 3


def test_steps_are_digested_with_words_inputs_and_their_state(tmp_path):
    given = tmp_path / 'in'
    given.mkdir()
    (given / 'f').write_text('one')

    def digest(words=('reconstruct', 'x')):
        return process.digest_of(Step('walk', words, (given,), tmp_path / 'o'))

    first = digest()
    assert digest() == first != digest(('reconstruct', 'y'))
    (given / 'f').write_text('other')
    second = digest()
    assert second != first
    (given / 'g').write_text('')
    assert digest() != second
    log = tmp_path / 'log'
    log.write_text('one\ntwo\nthree\n\n')
    assert process._last_line(log) == 'three'
    log.write_text('the message of an earlier step\n$ fluoro-calib reconstruct x\n')
    assert 'without a message' in process._last_line(log)


def test_steps_of_a_program_that_is_not_installed_are_digested(monkeypatch):
    def version(_):
        raise PackageNotFoundError

    installed = process.digest_of(step())
    monkeypatch.setattr(process, 'version', version)
    assert process.digest_of(step()) == process.digest_of(step()) != installed


def test_steps_depend_on_the_rig_file_whose_defaults_they_use(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    study = Fake(path=tmp_path / 'study.toml')

    def digest():
        words = ['walk', 'walk.csv', '--calibration', 'result', 'points.csv']
        return process.digest_of(process._step(study, parse_words, 'reconstruct', {}, words))

    without = digest()
    (tmp_path / 'rig.toml').write_text('units = "cm"')
    first = digest()
    assert first == digest() != without
    (tmp_path / 'rig.toml').write_text('units = "mm"  # not cm')
    assert digest() not in (without, first)
