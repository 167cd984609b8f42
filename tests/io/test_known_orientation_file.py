# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Known orientations are checked when read, whatever program wrote K, R and t."""

import numpy as np
import pytest

from fluoro_calib_ros.errors import DataError
from fluoro_calib_ros.io.formats.native import read_known_orientations, write_known_orientations
from fluoro_calib_ros.photogrammetry.collinearity import project
from fluoro_calib_ros.photogrammetry.rig_orientation import KnownOrientation
from fluoro_calib_ros.photogrammetry.rotations import matrix_from_vector

K = np.array([[4000.0, 0, 500], [0, 4000, 520], [0, 0, 1]])
R = matrix_from_vector([0.3, -1.2, 0.4])
T = np.array([10.0, -20.0, 1500.0])

FILE = """
fluoroscopes:
  a:
    K: [[4000, 0, 500], [0, 4000, 520], [0, 0, 1]]
    R: [[1, 0, 0], [0, 0, -1], [0, 1, 0]]
    t_mm: [0, 0, 1500]
"""


def test_matrices_project_as_the_collinearity_condition():
    points = np.random.default_rng(0).uniform(-100, 100, (20, 3))
    homogeneous = (points @ R.T + T) @ K.T
    known = KnownOrientation.from_matrices(2 * K, R, T)
    n = len(points)
    found = project(
        np.broadcast_to(known.rotation, (n, 3, 3)),
        np.broadcast_to(known.position_mm, (n, 3)),
        points,
        known.interior,
    )
    np.testing.assert_allclose(found, homogeneous[:, :2] / homogeneous[:, 2:], atol=1e-9)


def test_what_is_written_is_read_again(tmp_path):
    known = {
        'a': KnownOrientation.from_matrices(K, R, T),
        'b': KnownOrientation.from_matrices(K, R, T, (1, 2, 3), (0.1, 1e-4)),
    }
    write_known_orientations(tmp_path / 'known.yaml', known)
    found = read_known_orientations(tmp_path / 'known.yaml')
    assert list(found) == ['a', 'b']
    assert found['a'].interior_sd is None and found['a'].exterior_sd is None
    assert found['b'].interior_sd == (1, 2, 3)
    assert found['b'].exterior_sd == (0.1, 1e-4)
    for name, one in known.items():
        for field in ('interior', 'rotation', 'position_mm'):
            np.testing.assert_allclose(getattr(found[name], field), getattr(one, field), rtol=1e-9)


WRONG = {
    'no YAML': ('{', 'row 2: this is not YAML'),
    'no entry': ('a: 1', 'there is no entry "fluoroscopes"'),
    'newer layout': ('format_version: 9' + FILE, 'layout version 9'),
    'unknown key': (FILE + '    c: 3\n', "'c' is unknown, an entry has K, R, t_mm"),
    'no t': (FILE.replace('    t_mm: [0, 0, 1500]\n', ''), 'fluoroscope a: t_mm is missing'),
    'text': (FILE.replace('1500', 'far'), 'a value is not a number'),
    'number as text': (FILE.replace('1500', '"1500"'), 'a value is not a number'),
    'sd as text': (FILE + '    exterior_sd: ["0.1", 1]\n', 'a value is not a number'),
    'K with a truth value': (FILE.replace('0, 0, 1]]', '0, 0, yes]]'), 'a value is not a number'),
    'NaN': (FILE.replace('1500', '.nan'), 'position_mm is not'),
    'ragged': (FILE.replace('[0, 0, 1]]', '[0, 1]]'), 'a value is not a number'),
    'transposed K': (
        FILE.replace(
            '[[4000, 0, 500], [0, 4000, 520], [0, 0, 1]]',
            '[[4000, 0, 0], [0, 4000, 0], [500, 520, 1]]',
        ),
        'transpose it',
    ),
    'reflection': (FILE.replace('[[1, 0, 0]', '[[-1, 0, 0]'), 'R is a reflection'),
    'no rotation': (FILE.replace('[[1, 0, 0]', '[[2, 0, 0]'), 'R is not a rotation'),
    'negative c': (FILE.replace('[[4000', '[[-4000'), 'diagonal of K must be above 0'),
    'sd of zero': (FILE + '    exterior_sd: [0, 1]\n', 'exterior_sd is not 2 numbers above 0'),
}


@pytest.mark.parametrize('kind', WRONG)
def test_a_wrong_file_is_refused_in_one_sentence(kind, tmp_path):
    text, sentence = WRONG[kind]
    path = tmp_path / 'known.yaml'
    path.write_text(text)
    with pytest.raises(DataError) as error:
        read_known_orientations(path)
    assert sentence in str(error.value)
    assert str(error.value).startswith(str(path))
    assert '\n' not in str(error.value)
