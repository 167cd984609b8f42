# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Relative orientation, datum, weights of the interior orientation and outliers, from calibration
to the command line.
"""

import json
from dataclasses import replace

import numpy as np
import pytest
import rigs

from fluoro_calib_ros.cli import main
from fluoro_calib_ros.errors import DataError
from fluoro_calib_ros.estimation.calibrate import calibrate
from fluoro_calib_ros.estimation.constraints import paired_exposures, with_constraints
from fluoro_calib_ros.estimation.initial_network import measured_network
from fluoro_calib_ros.estimation.options import CalibrationOptions
from fluoro_calib_ros.estimation.pair_scatter import functions_of_angles
from fluoro_calib_ros.findings import Kind
from fluoro_calib_ros.io.documents import json_text
from fluoro_calib_ros.io.observations import write_observations_csv
from fluoro_calib_ros.io.phantom import write_phantom
from fluoro_calib_ros.io.result_document import result_document
from fluoro_calib_ros.photogrammetry.rotations import matrix_from_quaternion

PHANTOM = rigs.rig().phantom
FRAMES = {name: frames[:6] for name, frames in rigs.exposures().items()}
PLAIN = dict(model='none')


@pytest.fixture(scope='module')
def jobs():
    return {
        way: calibrate(
            FRAMES,
            PHANTOM,
            CalibrationOptions('local_linear', max_iterations=2, relative_orientation=way),
            joint=True,
        )
        for way in ('none', 'soft', 'hard')
    }


@pytest.mark.long
def test_result_contains_the_relative_orientation(jobs):
    found = {way: result_document(job)['relative_orientation'] for way, job in jobs.items()}
    a, b = rigs.rig().fluoroscopes
    rotation = b.rotation @ a.rotation.T
    length = np.linalg.norm(b.position_mm - a.position_mm)
    for way, document in found.items():
        assert (
            document['constraint'] == way
            and document['fluoroscopes'] == ['a', 'b']
            and document['exposures'] == 6
        )
        turn = matrix_from_quaternion(document['quaternion_wxyz']) @ rotation.T
        assert (
            np.rad2deg(np.arccos((np.trace(turn) - 1) / 2)) < 10
        )  # up to the gauge of the correction
        assert np.linalg.norm(document['translation_mm']) == pytest.approx(length, abs=2)
        assert np.all(np.array(document['sd_mm']) > 0) and np.all(np.array(document['sd_rad']) > 0)
        json.loads(json_text(result_document(jobs[way])))
    assert np.all(found['hard']['sd_mm'] < found['none']['sd_mm'])
    assert np.all(found['hard']['scatter_mm'] < 1e-4) and np.all(
        found['none']['scatter_mm'] > 0.01
    )
    for way in ('none', 'soft'):
        off = np.abs(np.array(found[way]['translation_mm']) - found['hard']['translation_mm'])
        assert np.all(off < 3 * np.array(found[way]['sd_mm']))


def test_separate_calibrations_have_no_relative_orientation():
    job = calibrate(FRAMES, PHANTOM, CalibrationOptions(**PLAIN))
    assert result_document(job)['relative_orientation'] is None
    with pytest.raises(ValueError, match='joint'):
        calibrate(FRAMES, PHANTOM, CalibrationOptions(relative_orientation='hard', **PLAIN))


def test_exposures_are_paired_by_number():
    frames = {'a': FRAMES['a'], 'b': [replace(f, number=f.number + 2) for f in FRAMES['b']]}
    measured = measured_network(frames, PHANTOM)
    pairs = paired_exposures(measured, 1)
    assert [(measured.frames[i].number, measured.frames[j].number) for i, j in pairs] == [
        (n, n) for n in range(3, 7)
    ]
    network = with_constraints(measured, CalibrationOptions(relative_orientation='soft')).network
    assert len(network.relative[0].pairs) == 4 and network.relative[0].sd_mm == 0.5
    other = {'a': FRAMES['a'], 'b': [replace(f, number=f.number + 100) for f in FRAMES['b']]}
    with pytest.raises(DataError, match='fluoroscopes a and b: 0 exposures have the same number'):
        calibrate(
            other, PHANTOM, CalibrationOptions(relative_orientation='soft', **PLAIN), joint=True
        )
    with pytest.raises(DataError, match='needs two fluoroscopes'):
        calibrate(
            {'a': FRAMES['a']},
            PHANTOM,
            CalibrationOptions(relative_orientation='soft', **PLAIN),
            joint=True,
        )


@pytest.mark.long
@pytest.mark.parametrize('model', ['none', 'collocation', 'local_linear'])
def test_free_network_is_calibrated(model):
    """Its shape is that of the phantom; undetermined targets are excluded and reported."""
    job = calibrate(
        FRAMES,
        PHANTOM,
        CalibrationOptions(
            model=model, datum='inner', max_iterations=4, relative_orientation='soft'
        ),
        joint=True,
    )
    assert Kind.FEW_RAYS in rigs.kinds(job.findings)
    points = job.targets.xyz_mm - rigs.rig().true_mm[job.targets.target_id - 1]
    good = np.sqrt(np.trace(job.targets.covariance, axis1=1, axis2=2)) < 1.0
    assert good.mean() > 0.9 and len(good) > 300
    if model == 'collocation':
        assert np.median(np.linalg.norm(points[good], axis=1)) < 0.2


def test_prior_of_the_interior_orientation_has_weight():
    free, weighted = (
        calibrate(
            {'a': FRAMES['a']},
            PHANTOM,
            CalibrationOptions(interior_sd=sd, **PLAIN),
            principal_distance=4000.0,
        )
        for sd in (None, (0.1, 0.1, 0.1))
    )
    assert weighted.fluoroscopes['a'].interior[2] == pytest.approx(4000, abs=1)
    assert np.all(weighted.fluoroscopes['a'].interior_sd < 0.11)
    assert np.all(free.fluoroscopes['a'].interior_sd > 0.11)


@pytest.mark.parametrize(
    'options',
    [
        dict(relative_orientation='rigid'),
        dict(datum='free'),
        dict(interior_sd=(1, 2)),
        dict(interior_sd=(1, 2, -3)),
        dict(relative_sd=(0.5,)),
        dict(interior='fixed', interior_sd=(1, 1, 1)),
    ],
)
def test_invalid_options_are_refused(options):
    with pytest.raises(ValueError):
        CalibrationOptions(**options)


@pytest.mark.long
def test_false_matches_and_a_moved_bead_are_in_the_result(jobs):
    """Wrong ids: image points far from the truth are found, and hardly any others."""
    survey = PHANTOM.xyz_mm.copy()
    rays = np.bincount(
        np.concatenate([f.target_id for of in FRAMES.values() for f in of]), minlength=504
    )
    wrong = int(np.argmax(rays))
    survey[wrong - 1] += [1.2, -1.2, 1.0]
    job = calibrate(
        FRAMES,
        replace(PHANTOM, xyz_mm=survey),
        CalibrationOptions(model='collocation'),
        joint=True,
    )
    document = result_document(job)['outliers']
    assert [t['target_id'] for t in document['targets']] == [wrong]
    np.testing.assert_allclose(document['targets'][0]['offset_mm'], [-1.2, 1.2, -1.0], atol=0.6)
    points = document['image_points']
    assert 3 <= len(points) <= 40 and all(p['value'] > p['critical'] for p in points)
    assert not result_document(jobs['none'])['outliers']['targets']
    assert not any(p['target_id'] == wrong for p in points)


@pytest.mark.long
def test_correlations_are_in_the_result(jobs):
    found = result_document(jobs['hard'])['correlations']
    assert 0 < len(found) <= 20 and all(
        len(c['unknowns']) == 2 and abs(c['value']) > 0.95 for c in found
    )


@pytest.fixture
def files(tmp_path):
    write_observations_csv(tmp_path / 'o.csv', FRAMES)
    write_phantom(tmp_path / 'phantom.csv', PHANTOM)
    return [
        str(tmp_path / 'o.csv'),
        '--phantom',
        str(tmp_path / 'phantom.csv'),
        '--image-size',
        '1024x1024',
        '--out',
        str(tmp_path / 'out'),
    ], tmp_path / 'out'


@pytest.mark.parametrize(
    'arguments',
    [
        ['--relative-orientation', 'soft'],
        ['--relative-orientation', 'hard', '--separate'],
        ['--interior-sd', '1,1,1'],
        ['--interior-sd', '1,1', '--principal-distance', '4000'],
        ['--interior-sd', '1,1,1', '--principal-distance', '4000', '--interior', 'fixed'],
        ['--datum', 'none'],
        ['--relative-sd', '0,1'],
    ],
)
def test_wrong_usage_is_refused(files, arguments):
    with pytest.raises(SystemExit) as status:
        main(['calibrate', *files[0], *arguments])
    assert status.value.code == 2


def test_command_line_constrains_the_relative_orientation(files):
    main(
        [
            'calibrate',
            *files[0],
            '--joint',
            '--relative-orientation',
            'hard',
            '--model',
            'none',
            '--interior-sd',
            '50,50,200',
            '--principal-distance',
            '4000',
            '--fast',
        ]
    )
    document = json.loads((files[1] / 'result.json').read_text())
    assert document['relative_orientation']['constraint'] == 'hard'
    assert max(document['relative_orientation']['scatter_mm']) < 1e-3


@pytest.mark.parametrize(
    ('pairs', 'of_one', 'of_two'),
    [(3, 1, 1), (5, 1, 1), (6, 3, 1), (9, 3, 1), (10, 5, 5), (17, 5, 5), (18, 5, 9)],
)
def test_functions_of_the_angle_have_two_pairs_each(pairs, of_one, of_two):
    """One function is constant; each harmonic order adds two per independent angle."""
    angles = np.linspace(-1.0, 1.2, pairs)
    unknown = np.full(pairs, np.nan)
    for other, columns in ((angles, of_one), (angles**2 - 1, of_two), (unknown, of_one)):
        found = functions_of_angles([angles, other])
        assert found.shape == (pairs, columns)
        assert np.linalg.matrix_rank(found) == columns
        np.testing.assert_array_equal(found[:, 0], 1)
