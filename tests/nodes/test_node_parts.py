# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Parts of the nodes that need no graph: image layouts, invalid calibrations, requests."""

import re
import subprocess
import sys
import threading
from array import array
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import rigs
from fluoro_calib_msgs.srv import Calibrate
from rclpy.serialization import serialize_message
from rigs import create_model
from sensor_msgs.msg import Image

from fluoro_calib_ros.errors import DataError
from fluoro_calib_ros.exposures.names import Names
from fluoro_calib_ros.images.corrector import ImageCorrector
from fluoro_calib_ros.limits import CollectLimits
from fluoro_calib_ros.nodes import calibration_input, calibration_services, capture_services
from fluoro_calib_ros.nodes.calibration_input import CalibrationInput
from fluoro_calib_ros.nodes.calibration_output import CalibrationOutput
from fluoro_calib_ros.nodes.calibration_services import SelfCalibration
from fluoro_calib_ros.nodes.calibration_settings import CalibrationSettings, RigSetup
from fluoro_calib_ros.nodes.capture_services import OrientationService
from fluoro_calib_ros.nodes.exposure_input import PairWait
from fluoro_calib_ros.nodes.messages.fluoroscope_calibration import (
    calibration_from_message,
    message_from_calibration,
)
from fluoro_calib_ros.nodes.messages.image import ImageConverter
from fluoro_calib_ros.nodes.runtime.diagnostics import Refused, one_line
from fluoro_calib_ros.nodes.runtime.parameters import expand_path, groups_of
from fluoro_calib_ros.nodes.runtime.services import Requests, check_timeout

SIZE = (64, 48)
ROOT = Path(__file__).parents[2]


@pytest.fixture(scope='module')
def calibration():
    uv = np.stack(np.meshgrid(*(np.linspace(-0.5, s - 0.5, 8) for s in SIZE)), axis=-1).reshape(
        -1, 2
    )
    model = create_model('local_linear', 6, uv, np.ones_like(uv), 0.2, 0.0)
    return replace(
        rigs.calibrated('a', 5, model='none').calibrations['a'],
        fluoroscope='a',
        model=model,
        image_size=SIZE,
        train_exposure=np.zeros(len(uv), dtype=np.int64),
    )


# ---- images


@pytest.mark.parametrize('gap', [0, 1, 2, 7])
def test_rows_of_16_bits_may_begin_at_any_byte(calibration, gap):
    width, height = SIZE
    pixels = np.arange(width * height, dtype=np.uint16).reshape(height, width)
    rows = np.zeros((height, 2 * width + gap), np.uint8)
    rows[:, : 2 * width] = pixels.view(np.uint8)
    message = Image(
        width=width,
        height=height,
        encoding='mono16',
        step=rows.shape[1],
        data=array('B', rows.tobytes()),
    )
    image, _ = ImageConverter('a').to_array(message, calibration)
    corrector = ImageCorrector(calibration)
    assert np.array_equal(corrector.correct(image), corrector.correct(pixels))


def test_long_names_are_truncated_in_messages(calibration):
    """An error message goes to the log, and to the diagnostics every second."""
    width, height = SIZE
    message = Image(width=width, height=height, encoding='x' * 10**6, step=width)
    with pytest.raises(Refused) as refused:
        ImageConverter('a').to_array(message, calibration)
    assert 'its encoding' in str(refused.value) and len(str(refused.value)) < 600


# ---- calibrations


@pytest.mark.parametrize(
    'change, said',
    [
        ({'interior': np.array([np.nan, 0, 0])}, 'interior holds nan'),
        ({'image_sd': np.nan}, 'image_sd holds nan'),
        ({'image_sd': -1.0}, 'image_sd holds -1.0'),
        ({'image_size': (0, 48)}, 'image_size holds 0'),
    ],
    ids=lambda x: x if isinstance(x, str) else '',
)
def test_calibration_with_impossible_numbers_is_refused(calibration, change, said):
    """A message is refused for the same reasons as a file, although its id matches."""
    message = message_from_calibration(replace(calibration, **change))
    with pytest.raises(DataError, match=f'calibration of fluoroscope a: the array {said}'):
        calibration_from_message(message)


class Inbox:
    """A CalibrationInput that records its calls; preparation waits for .go and may raise a fault.

    fault: raised for all calibrations, or only for the stamp at_ns. put accepts messages of the
    last fluoroscope; putters has one such function per fluoroscope.
    """

    def __init__(self, fault=None, names=('a',), at_ns=None):
        self.taken = []
        self.refused = []
        self.go = threading.Event()
        self.began = threading.Semaphore(0)
        self._fault = fault
        self._at_ns = at_ns
        self.putters = {}
        self.most = 0
        self._now = 0
        self.ended = threading.Semaphore(0)
        node = SimpleNamespace(
            create_subscription=self._subscribe,
            destroy_subscription=lambda _: None,
            get_logger=lambda: SimpleNamespace(info=lambda _: None, error=lambda _: None),
            resolve_topic_name=lambda topic: topic,
            get_publishers_info_by_topic=lambda topic: self.publishers,
        )
        self.publishers = []
        self.calibrations = CalibrationInput(
            node,
            names,
            self._prepare,
            self._take,
            self._refuse,
        )

    def _subscribe(self, kind, topic, callback, qos, raw):
        assert raw
        self.put = lambda message: callback(serialize_message(message))
        self.putters[topic[0]] = self.put

    def _take(self, name, kept):
        self.taken.append(kept)
        self.ended.release()

    def _refuse(self, name, sentence):
        self.refused.append(sentence)
        self.ended.release()

    def _prepare(self, calibration):
        self._now += 1
        self.most = max(self.most, self._now)
        self.began.release()
        assert self.go.wait(60)
        self._now -= 1
        if self._fault is not None and self._at_ns in (None, calibration.stamp_ns):
            raise self._fault
        return calibration.stamp_ns


def test_calibrations_are_prepared_one_at_a_time_and_the_last_one_stays(calibration):
    inbox = Inbox()
    for number in range(50):
        inbox.put(message_from_calibration(replace(calibration, stamp_ns=number)))
        if number == 0:
            assert inbox.began.acquire(timeout=60)  # preparation of the first has begun
    inbox.go.set()
    assert all(inbox.ended.acquire(timeout=60) for _ in range(2))  # the last one came next
    assert inbox.taken == [0, 49] and inbox.most == 1 and inbox.calibrations.current('a') == 49
    inbox.put(message_from_calibration(replace(calibration, stamp_ns=99)))
    assert inbox.ended.acquire(timeout=60) and inbox.taken[-1] == 99


def test_calibrations_of_several_fluoroscopes_that_come_together_are_used_together(calibration):
    inbox = Inbox(names='ab')

    def put(name, stamp_ns):
        of_one = replace(calibration, fluoroscope=name, stamp_ns=stamp_ns)
        inbox.putters[name](message_from_calibration(of_one))

    put('a', 1)
    assert inbox.began.acquire(timeout=60)  # while a is being prepared,
    put('b', 2)
    inbox.go.set()
    assert inbox.ended.acquire(timeout=60)
    assert inbox.calibrations.current('a') == 1 and inbox.calibrations.current('b') == 2
    assert inbox.ended.acquire(timeout=60) and inbox.taken == [1, 2]
    put('b', 3)  # alone
    assert inbox.ended.acquire(timeout=60) and inbox.calibrations.current('b') == 3


def test_calibration_is_used_where_the_one_that_came_with_it_is_refused(calibration):
    inbox = Inbox(ValueError('not this one'), names='ab', at_ns=2)
    for name, stamp_ns in (('a', 1), ('b', 2)):
        of_one = replace(calibration, fluoroscope=name, stamp_ns=stamp_ns)
        inbox.putters[name](message_from_calibration(of_one))
        if name == 'a':
            assert inbox.began.acquire(timeout=60)
    inbox.go.set()
    assert all(inbox.ended.acquire(timeout=60) for _ in range(2))
    assert inbox.taken == [1] and inbox.refused == ['not this one']
    assert inbox.calibrations.current('a') == 1 and inbox.calibrations.current('b') is None


def test_calibration_that_comes_while_the_thread_before_it_ends_is_prepared(calibration):
    """The thread has found no further work but has not yet ended."""
    inbox = Inbox()
    inbox.go.set()
    inbox.calibrations._thread = threading.current_thread()
    inbox.calibrations._work()
    inbox.put(message_from_calibration(calibration))
    assert inbox.ended.acquire(timeout=60) and len(inbox.taken) == 1


def test_calibration_is_prepared_after_one_whose_use_failed(calibration, monkeypatch):
    """Such as by a publisher that cannot publish: the thread has ended with it."""
    inbox = Inbox()
    inbox.go.set()
    monkeypatch.setattr(threading, 'excepthook', lambda _: None)
    fail = threading.Event()

    def on_ready(name, kept):
        if not fail.is_set():
            fail.set()
            raise RuntimeError('cannot publish')
        inbox._take(name, kept)

    inbox.calibrations._on_ready = on_ready
    inbox.put(message_from_calibration(replace(calibration, stamp_ns=1)))
    assert fail.wait(60)
    inbox.calibrations._thread.join(60)
    inbox.put(message_from_calibration(replace(calibration, stamp_ns=2)))
    assert inbox.ended.acquire(timeout=60) and inbox.taken == [2]


def test_closing_does_not_wait_for_a_calibration_and_it_is_not_used(calibration):
    inbox = Inbox()
    inbox.put(message_from_calibration(calibration))
    assert inbox.began.acquire(timeout=60)
    thread = inbox.calibrations._thread
    inbox.calibrations.close()
    inbox.go.set()
    thread.join(60)
    assert not thread.is_alive() and not inbox.taken and not inbox.refused


@pytest.mark.parametrize('fault', [MemoryError(), IndexError('of some line')])
def test_calibration_that_cannot_be_prepared_is_refused(calibration, fault):
    inbox = Inbox(fault)
    inbox.go.set()
    inbox.put(message_from_calibration(calibration))
    assert inbox.ended.acquire(timeout=60)
    assert (
        inbox.refused == [one_line(fault)]
        and not inbox.taken
        and inbox.calibrations.current('a') is None
    )


def test_calibration_message_that_is_too_large_is_refused_undecoded(calibration, monkeypatch):
    """One byte is too many; a damaged message of the allowed size is refused after decoding."""
    message = message_from_calibration(calibration)
    size = len(serialize_message(message))
    for most, sentences in ((size - 1, 1), (size, 0)):
        monkeypatch.setattr(
            calibration_input,
            'read_limits',
            lambda most=most: SimpleNamespace(max_calibration_bytes=most),
        )
        inbox = Inbox()
        inbox.go.set()
        inbox.put(message)
        assert inbox.ended.acquire(timeout=60)
        assert len(inbox.refused) == sentences and len(inbox.taken) == 1 - sentences
    inbox.calibrations._on_data('a', b'\0\1\0\0damaged')
    (sentence,) = inbox.refused
    assert 'topic a/calibration ' in sentence and len(inbox.taken) == 1


def test_calibrations_wait_while_two_nodes_publish_them(calibration):
    """The newest calibration is used once only one node is left."""
    inbox = Inbox()
    inbox.go.set()
    one, other = (SimpleNamespace(node_namespace='/', node_name=name) for name in 'xy')
    inbox.publishers = [one, other]
    for number in (1, 2):
        inbox.put(message_from_calibration(replace(calibration, stamp_ns=number)))
    inbox.calibrations.release()
    assert not inbox.ended.acquire(timeout=0.2) and not inbox.taken
    assert 'x' in inbox.calibrations.conflict('a') and not inbox.refused
    inbox.publishers = [other]
    inbox.calibrations.release()
    assert inbox.ended.acquire(timeout=60) and inbox.taken == [2]


# ---- orientation, and what requests may ask


class Waits:
    """Exposures that have .wait, the last wait for pairs of frames."""

    def next_pairs(self, count):
        self.wait = PairWait(count, False)
        return self.wait


def output_of(calibrations):
    """Return the output of a calibration node of a and b with calibrations in use."""
    output = CalibrationOutput.__new__(CalibrationOutput)
    output._names = ('a', 'b')
    output._in_use = dict(calibrations)
    output.orientation = None
    return output


def orientation_service(output):
    """Return the service orient of a rig of a and b, and a request to it."""
    node = SimpleNamespace(
        create_timer=lambda *_, **__: None,
        destroy_timer=lambda _: None,
        check_active=lambda: None,
        executor=None,
        get_logger=lambda: None,
    )
    rig = SimpleNamespace(
        names=('a', 'b'),
        required_phantom=lambda: rigs.rig().phantom,
        settings=lambda: SimpleNamespace(
            node=SimpleNamespace(rig_frame='rig'), limits=CollectLimits(max_exposures=500)
        ),
    )
    parts = SimpleNamespace(
        node=node, rig=rig, exposures=Waits(), output=output, files=None, requests=Requests()
    )
    return OrientationService(parts), SimpleNamespace(timeout_sec=1.0, frames=1)


def test_orientation_of_outdated_calibrations_is_rejected(monkeypatch):
    """A self-calibration may end while a capture is being adjusted."""
    new, old = (
        {name: SimpleNamespace(calibration_id=f'{name}-{age}') for name in 'ab'}
        for age in ('new', 'old')
    )
    outcome = SimpleNamespace(
        orientation=SimpleNamespace(fluoroscopes=('a', 'b'), calibration_ids=('a-old', 'b-old'))
    )
    output = output_of(old)
    service, request = orientation_service(output)

    async def recalibrated():
        output._in_use.update(new)
        return outcome

    monkeypatch.setattr(capture_services, 'in_thread', lambda *_: (recalibrated(), None))
    capture = service._orient(request)
    capture.send(None)  # the capture waits for its frames
    wait = service._exposures.wait
    wait.pairs.append({name: SimpleNamespace(fluoroscope=name) for name in 'ab'})
    wait.done.set_result(None)
    with pytest.raises(DataError, match='the calibrations have changed meanwhile'):
        capture.send(None)


def test_orientation_from_too_many_frames_is_refused():
    service, request = orientation_service(output_of({}))
    request.frames = 4_000_000_000
    with pytest.raises(DataError, match='frames must be at most 500'):
        service._orient(request).send(None)


def test_a_rig_that_is_not_calibrated_is_refused_before_the_capture():
    output = output_of({'a': SimpleNamespace(calibration_id='a')})
    service, request = orientation_service(output)
    with pytest.raises(DataError, match='fluoroscope b is not calibrated yet'):
        service._orient(request).send(None)


@pytest.mark.parametrize(
    'end',
    [
        RuntimeError('the worker process ended with status -9'),
        OSError('no space'),
        calibration_services.Cancelled(),
    ],
)
def test_a_calibration_that_ends_without_result_is_a_fault_unless_it_was_cancelled(
    monkeypatch, tmp_path, end
):
    """Its process may have been killed, as by the kernel when the memory is full."""
    output = SimpleNamespace(calibrations={}, refused={})
    service = calibration_of(output, tmp_path / 'rig')

    async def ended():
        raise end

    monkeypatch.setattr(SelfCalibration, '_start', lambda *_: ended())
    with pytest.raises(type(end)):
        service._calibrate(Calibrate.Request(), None, print, lambda: False).send(None)
    is_fault = not isinstance(end, calibration_services.Cancelled)
    assert output.refused == (dict.fromkeys('ab', str(end)) if is_fault else {})
    assert service.running == ()


def test_a_folder_that_cannot_be_written_is_a_fault_of_the_fluoroscopes(tmp_path):
    (tmp_path / 'file').write_text('')
    output = SimpleNamespace(calibrations={}, refused={})
    service = calibration_of(output, tmp_path / 'file' / 'rig')
    with pytest.raises(DataError, match='is a file, not a folder'):
        service._calibrate(Calibrate.Request(), None, print, lambda: False).send(None)
    assert set(output.refused) == {'a', 'b'} and 'is a file' in output.refused['a']


def calibration_of(output, directory):
    """Return the service calibrate of a rig of a and b that saves in a folder."""
    settings = CalibrationSettings(
        **{name: group.options() for name, group in groups_of(CalibrationSettings).items()}
    )
    parts = orientation_service(output)[0]
    parts = SimpleNamespace(
        node=parts._node,
        rig=RigSetup(('a', 'b'), rigs.rig().phantom, Names(), directory, lambda: settings),
        exposures=SimpleNamespace(frames=lambda names=None: {'a': [], 'b': []}),
        output=output,
        files=None,
        requests=Requests(),
    )
    return SelfCalibration(parts)


@pytest.mark.parametrize(
    'seconds, said',
    [
        (0.0, 'seconds, not 0.0'),
        (-1.0, 'seconds, not -1.0'),
        (np.nan, 'seconds, not nan'),
        (1e10, 'seconds, at most 86400, not'),
        (1e300, 'at most 86400, not 1e[+]300'),
        (np.inf, 'at most 86400, not inf'),
    ],
)
def test_impossible_timeout_is_refused(seconds, said):
    with pytest.raises(ValueError, match=f'timeout_sec must be a time in .*{said}'):
        check_timeout(seconds)


def test_unknown_home_folder_is_refused():
    with pytest.raises(DataError, match=r'^~nobody_of_that_name/x: there is no such home folder$'):
        expand_path('~nobody_of_that_name/x')


# ---- the demonstration


@pytest.mark.long
def test_demo_runs_as_a_module():
    """It also works where the console script is not installed."""
    command = [sys.executable, '-m', 'fluoro_calib_ros.demo.demo', '--help']
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0 and '--bags' in done.stdout, done.stderr


def test_demo_leaves_ros_to_the_nodes():
    """The modules of the demo do not import ROS packages themselves."""
    for path in (ROOT / 'fluoro_calib_ros' / 'demo').glob('*.py'):
        imports = re.findall(r'^\s*(?:from|import) (\w+)', path.read_text(), re.MULTILINE)
        assert not [name for name in imports if name == 'rclpy' or name.endswith('_msgs')], path
