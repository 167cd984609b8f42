# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Parts of the nodes against hostile peers: ids of messages, log lines, limits."""

import os
import subprocess
import sys
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import rigs
from rigs import create_model
from scipy.spatial.transform import Rotation

from fluoro_calib_ros.errors import DataError
from fluoro_calib_ros.findings import Kind
from fluoro_calib_ros.nodes.calibration_settings import check_folders
from fluoro_calib_ros.nodes.exposure_input import ExposureInput
from fluoro_calib_ros.nodes.messages.fluoroscope_calibration import (
    calibration_from_message,
    message_from_calibration,
)
from fluoro_calib_ros.nodes.messages.observations import decode_target_observations
from fluoro_calib_ros.nodes.messages.rig_orientation import (
    message_from_orientation,
    orientation_from_message,
)
from fluoro_calib_ros.nodes.runtime.diagnostics import MAX_LINE, PrintableLogger, RateLimitedLogger
from fluoro_calib_ros.photogrammetry.rig_orientation import RigOrientation

FORGED = 'a\n[FATAL] forged\x1b[2J'
SPECIAL = [
    np.eye(3),
    *(
        Rotation.from_euler('xyz', angles, degrees=True).as_matrix()
        for angles in ([90, 0, 0], [0, 90, 0], [0, 0, 180], [90, 90, 0], [120, 0, 0])
    ),
]


def orientation(rng, special=False):
    """Return a random orientation of two fluoroscopes; special: equal quaternion components."""
    rotation = [
        SPECIAL[rng.integers(len(SPECIAL))] if special else Rotation.random(random_state=rng)
        for _ in range(2)
    ]
    rotation = [r if isinstance(r, np.ndarray) else r.as_matrix() for r in rotation]
    root = rng.normal(size=(18, 18)) * 10.0 ** rng.uniform(-6, 1, (18, 1))
    return RigOrientation(
        fluoroscopes=('a', 'b'),
        interior=rng.normal(500, 100, (2, 3)),
        rotation=np.array(rotation),
        position_mm=rng.normal(0, 10.0 ** rng.uniform(-3, 4), (2, 3)),
        covariance=root @ root.T,
        frame_id='rig',
        source='capture',
        calibration_ids=('x', 'y'),
        stamp_ns=5,
    )


# ---- ids


@pytest.mark.parametrize('special', [False, True])
def test_orientation_keeps_its_id_through_a_message(special):
    """Metres and quaternions differ in the last bits, but both sides round to the same values."""
    rng = np.random.default_rng(3)
    for _ in range(100):
        sent = orientation(rng, special).rounded()
        assert sent.rounded().orientation_id == sent.orientation_id
        message = message_from_orientation(sent)
        assert message.orientation_id == sent.orientation_id
        assert orientation_from_message(message).orientation_id == sent.orientation_id


def test_rounding_changes_less_than_any_standard_deviation():
    exact = orientation(np.random.default_rng(5))
    rounded = exact.rounded()
    np.testing.assert_allclose(rounded.position_mm, exact.position_mm, rtol=1e-12)
    np.testing.assert_allclose(rounded.rotation, exact.rotation, atol=1e-12)
    np.testing.assert_allclose(rounded.covariance, exact.covariance, rtol=1e-11)


@pytest.mark.parametrize('field', ['x', 'qw', 'c', 'covariance'])
def test_changed_orientation_is_refused(field):
    message = message_from_orientation(orientation(np.random.default_rng(1)))
    values = getattr(message, field)
    values[0] *= 1 + 1e-9
    with pytest.raises(DataError, match=r'does not match its id|not symmetric'):
        orientation_from_message(message)


@pytest.mark.parametrize('field', ['x', 'qw', 'c', 'covariance'])
@pytest.mark.parametrize('length', [0, 1])
def test_array_of_another_length_is_refused(field, length):
    message = message_from_orientation(orientation(np.random.default_rng(1)))
    setattr(message, field, getattr(message, field)[:length])
    with rigs.refused(Kind.DATA):
        orientation_from_message(message)


@pytest.mark.parametrize(
    'field, value',
    [
        *(('c', 4000.0), ('interior_estimated', False), ('exposures', 99), ('nu', 3.0)),
        *(('converged', False), ('rmse_after_u', 0.0), ('iterations', 3), ('inliers', 1)),
    ],
)
def test_changed_calibration_is_refused(field, value):
    calibration = rigs.calibrated('a', 5, model='none').calibrations['a']
    message = message_from_calibration(calibration)
    assert calibration_from_message(message).calibration_id == calibration.calibration_id
    setattr(message, field, value)
    with pytest.raises(DataError, match='does not match its id'):
        calibration_from_message(message)


@pytest.mark.parametrize('changed', [False, True])
def test_id_of_earlier_versions_is_refused(changed):
    """The earlier id ignores changes of fields that do not determine the correction."""
    calibration = rigs.calibrated('a', 5, model='none').calibrations['a']
    message = message_from_calibration(calibration)
    message.calibration_id = calibration.earlier_id
    message.converged ^= changed
    with pytest.raises(DataError, match='does not match its id'):
        calibration_from_message(message)


@pytest.mark.filterwarnings('error')
@pytest.mark.parametrize(
    'change, sentence',
    [
        ({'image_size': (2**32 - 1, 1)}, 'image_size holds a value beyond 32000'),
        ({'image_size': (32000, 32000)}, 'more than 64 megapixels'),
        ({'image_sd': 1e308}, 'image_sd holds a value beyond'),
        ({'interior': np.array([1.0, 1.0, -1.0])}, 'principal distance is -1 px'),
        ({'model': (2000, 3000)}, 'model_k holds a value beyond 1000'),
        ({'model': (5, 1001)}, 'training points coincide in the image'),
    ],
)
def test_hostile_calibration_with_a_valid_id_is_refused(change, sentence):
    """A peer can compute the id of changed content: what would take much memory is refused."""
    calibration = rigs.calibrated('a', 5, model='none').calibrations['a']
    if 'model' in change:
        k, count = change['model']
        uv = np.full((count, 2), 500.0) + (np.arange(count)[:, None] if k > 1000 else 0)
        model = create_model('knn', k, uv, np.zeros((count, 2)), 0.1, 0.0)
        change = {'model': model, 'train_exposure': np.zeros(count, np.int64)}
    message = message_from_calibration(replace(calibration, **change))
    with pytest.raises(DataError, match=sentence):
        calibration_from_message(message)


def test_calibrated_area_with_too_many_corners_is_refused():
    """Each pixel is compared with every corner."""
    message = message_from_calibration(rigs.calibrated('a', 5, model='none').calibrations['a'])
    angle = np.linspace(0, 2 * np.pi, 1100, endpoint=False)
    message.train_u = 500 + 400 * np.cos(angle)
    message.train_v = 500 + 400 * np.sin(angle)
    message.train_du = message.train_dv = np.zeros(1100)
    message.train_exposure = np.zeros(1100, np.uint32)
    with pytest.raises(DataError, match='the calibrated area has 1100 corners'):
        calibration_from_message(message)


# ---- lines of the log


class Lines:
    """A logger that keeps its messages."""

    def __init__(self):
        self.lines = []

    def __getattr__(self, _):
        return self.lines.append


@pytest.mark.parametrize('level', ['debug', 'info', 'warning', 'error', 'fatal'])
def test_log_line_cannot_be_forged(level):
    inner = Lines()
    getattr(PrintableLogger(inner), level)(FORGED + 'x' * 10**6)
    (line,) = inner.lines
    assert line.startswith('a\\n[FATAL] forged\\x1b[2J') and len(line) <= MAX_LINE + 10


def test_traceback_keeps_its_lines_which_are_marked():
    from fluoro_calib_ros.nodes.runtime.diagnostics import RefusalLog

    inner = Lines()
    log = RefusalLog('frame', RateLimitedLogger(PrintableLogger(inner)))
    try:
        raise KeyError(FORGED)
    except KeyError as error:
        log.fail('a/topic', error)
    first, *more = inner.lines[0].split('\n')
    assert 'lost by an internal error' in first and len(more) > 2
    assert all(line.startswith('  | ') and '\x1b' not in line for line in more)


@pytest.mark.parametrize('kind', ['source', 'phantom'])
def test_command_line_cannot_print_forged_lines(tmp_path, capsys, kind):
    path = tmp_path / (FORGED.replace('/', '') + '.csv')
    path.write_text('nonsense\n')
    source, phantom = (
        (path, 'bags/phantom.csv') if kind == 'source' else ('bags/calibration', path)
    )
    out = tmp_path / 'out'
    arguments = ('calibrate', source, '--phantom', phantom, '--out', out)
    assert rigs.run(*arguments, '--image-size', '9x9') == 1
    error = capsys.readouterr().err
    assert error.count('\n') == 1 and '\x1b' not in error and 'a\\n[FATAL] forged' in error


# ---- arguments and limits


@pytest.mark.parametrize(
    'arguments, sentence',
    [
        (['--nonsense'], "unknown arguments after --ros-args: ['--nonsense']"),
        (['--params-file', 'PIPE'], 'this is a pipe, device or socket, not a file'),
    ],
)
def test_wrong_arguments_of_ros_are_told_in_a_sentence(tmp_path, arguments, sentence):
    """The second set of arguments would otherwise make the node wait forever."""
    os.mkfifo(tmp_path / 'pipe')
    words = [str(tmp_path / 'pipe') if word == 'PIPE' else word for word in arguments]
    command = [sys.executable, '-m', 'fluoro_calib_ros.nodes.correction_node', '--ros-args']
    done = subprocess.run([*command, *words], capture_output=True, text=True, timeout=60)
    assert done.returncode == 1
    assert sentence in done.stderr and 'Traceback' not in done.stderr


def test_exposures_are_limited():
    """Each new exposure is compared with all others: unlimited, a peer could stop the stream."""
    frames = rigs.exposures()
    settings = SimpleNamespace(limits=SimpleNamespace(max_exposures=0))
    exposures = ExposureInput.__new__(ExposureInput)
    inner = Lines()
    exposures._settings, exposures._names = settings, ('a',)
    exposures._collector = SimpleNamespace(exposures=[])
    exposures._limited_logger = RateLimitedLogger(PrintableLogger(inner))
    exposures._waits = []
    exposures._collect({'a': frames['a'][0]})
    assert 'as many as max_exposures allows' in exposures.capture_refusal
    assert inner.lines == [exposures.capture_refusal]


@pytest.mark.parametrize(
    'place, allowed',
    [('x', True), ('x/y', True), ('x/y/z', False), ('old', True), ('..', True)],
)
def test_folders_that_peers_can_make_are_limited(tmp_path, place, allowed):
    base = tmp_path / 'rig'
    (base / 'old').mkdir(parents=True)
    if allowed:
        check_folders(base / place, base, 3)
        return
    with pytest.raises(DataError, match='as many folders as max_folders allows'):
        check_folders(base / place, base, 3)


# ---- found by fuzzing


def test_string_with_a_zero_ends_there_as_in_rclpy():
    data = bytes.fromhex('0001000000000000000000080300000061001100') + bytes(40)
    assert decode_target_observations(data).frame_id == 'a'
