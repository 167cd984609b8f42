# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The page of fluoro-calib watch --web: what it shows of a rig, and whose requests it accepts."""

import base64
import json
import re
import urllib.error
import urllib.request
from contextlib import contextmanager
from http.cookiejar import CookieJar

import cv2
import numpy as np
import pytest
from dicom_files import dicom
from ros_graph import NAMES, Process, entry_point, standing
from sensor_msgs.msg import Image

from fluoro_calib_ros.images.overlay import UNEXPLAINED
from fluoro_calib_ros.nodes.messages.image import message_from_image
from fluoro_calib_ros.nodes.messages.observations import message_from_frame


class Browser:
    """A user who opens the printed address and sends further requests."""

    def __init__(self, address):
        self._base, self._token = address.split('/?')
        self._opener = urllib.request.build_opener(urllib.request.HTTPCookieProcessor(CookieJar()))

    def open(self, path, method='GET', headers=None):
        """Return status, content type and content."""
        request = urllib.request.Request(self._base + path, method=method, headers=headers or {})
        try:
            with self._opener.open(request, timeout=60) as answer:
                return answer.status, answer.headers.get_content_type(), answer.read()
        except urllib.error.HTTPError as error:
            return error.code, error.headers.get_content_type(), error.read()

    def enter(self):
        """Open the page with the token; return the final address."""
        with self._opener.open(f'{self._base}/?{self._token}', timeout=60) as answer:
            return answer.url.removeprefix(self._base), answer.read().decode()

    def json(self, path):
        status, kind, content = self.open(path)
        assert (status, kind) == (200, 'application/json'), content
        return json.loads(content)

    def ask(self, action, origin=None):
        return self.open(f'/request/{action}', 'POST', {'Origin': origin or self._base})


@contextmanager
def page(graph):
    """Run the command alongside the nodes of a graph; yield the command and a browser."""
    command = [*entry_point('cli'), 'watch', '--web', '--port', '0']
    command += ['--namespace', graph.namespace, '--dicom', str(graph.directory)]
    process = Process(command, graph.directory / 'watch.log', graph.environment)
    try:
        found = graph.client.wait_until(lambda: re.search(r'http://\S+', process.log))
        yield process, Browser(found[0])
    finally:
        process.end()


def test_only_who_has_the_token_is_answered_and_only_this_page_acts(graph):
    (graph.directory / 'a').mkdir()
    dicom(graph.directory / 'a' / '1.dcm', np.zeros((1, 8, 8), dtype=np.uint8), Exposure=3)
    with page(graph) as (process, browser):
        for path in ('/', '/state', '/space', '/report', '/fluoroscopes/a/radiograph'):
            assert browser.open(path)[0] == 403
        assert browser.open('/?token=wrong')[0] == 403
        assert browser.ask('reset')[0] == 403
        path, text = browser.enter()
        assert path == '/' and '<h1 id="word">' in text
        for path, kind in (('/page.js', 'text/javascript'), ('/style.css', 'text/css')):
            assert browser.open(path)[:2] == (200, kind)
        state = browser.json('/state')
        assert state['light']['word'] == 'No signal'
        assert state['doses'] == {'a': '1 DICOM file: 3 mAs'}
        assert browser.ask('reset', origin='http://elsewhere.example')[0] == 403
        assert browser.ask('explode')[0] == 404
        assert browser.ask('capture')[0] == 204
        assert 'capture: no calibration node answers' in browser.json('/state')['log'][-1]
        assert browser.open('/fluoroscopes/a/radiograph')[0] == 404  # no such fluoroscope
        status, _, reason = browser.open('/report')
        assert status == 404 and b'no result of a calibration' in reason
        process.interrupt()
        assert process.wait() == 0


def test_page_shows_what_the_rig_sees_and_has_measured(graph, calibrated, exposures, tracking):
    graph.whole_chain(calibrated, collect='request')
    client = graph.client
    frame = exposures['a'][0]
    with page(graph) as (_, browser):
        browser.enter()

        def state():
            return browser.json('/state')

        client.wait_until(lambda: len(state()['fluoroscopes']) == 2, what='both fluoroscopes')
        client.wait_until(lambda: state()['light']['word'] == 'OK', what='a calibrated rig')

        # A radiograph with the image points of the same exposure.
        ramp = np.tile(np.arange(1024, dtype=np.uint8), (1024, 1))
        message = message_from_frame(frame)
        images = client.create_publisher(Image, 'a/image_raw', 1)

        def radiograph():
            images.publish(message_from_image(message.header, ramp))
            client.publish_message('a', message)
            client.wait_until(lambda: True)
            return browser.json('/fluoroscopes/a/radiograph')

        shown = client.wait_until(
            lambda: (r := radiograph()) and r['jpeg'] and r['points'] and r, what='a radiograph'
        )
        assert (shown['width'], shown['height']) == (1024, 1024)
        assert [row[0] for row in shown['points']] == frame.target_id.tolist()
        assert np.abs(np.array(shown['points'])[:, 1:] - frame.uv).max() <= 0.051
        jpeg = base64.b64decode(shown['jpeg'].partition(',')[2])
        picture = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_GRAYSCALE)
        assert picture.shape == (768, 768)

        # Points in space, the sources, the residuals of the calibration and its report.
        client.stream(zip(tracking['a'], tracking['b']), rate=30.0)
        space = client.wait_until(
            lambda: (s := browser.json('/space')) and s['points'] and s['sources'] and s,
            what='points in space, and the sources',
        )
        assert [source['name'] for source in space['sources']] == ['a', 'b']
        assert all(np.linalg.norm(s['axis']) == pytest.approx(1) for s in space['sources'])
        assert {len(row) for row in space['points']} == {5}
        assert np.abs(np.array(space['points'])[:, 1:4]).max() < 2000
        client.end_stream()
        # The calibration node reports its folder once a second.
        client.wait_until(
            lambda: browser.open('/residuals')[0] == 200, what='the folder of the calibration'
        )
        residuals = browser.json('/residuals')['fluoroscopes']
        assert sorted(residuals) == ['a', 'b']
        rows = np.vstack(list(residuals['a']['exposures'].values()))
        assert len(rows) == sum(len(f.target_id) for f in exposures['a'])
        used = rows[rows[:, 4] == 1]
        assert 0.1 < np.sqrt(np.mean(used[:, 2:4] ** 2)) < 0.3
        status, kind, report = browser.open('/report')
        assert (status, kind) == (200, 'text/html') and b'Calibration report' in report

        # The page asks the rig, and the next pose is marked.
        streams = [standing(exposures[name][0], 10**6) for name in NAMES]
        client.stream(zip(*streams), rate=30.0)
        assert browser.ask('capture')[0] == 204
        client.wait_until(lambda: state()['fluoroscopes'][0]['exposures'] == 1, what='the capture')
        client.end_stream()
        png = client.wait_until(
            lambda: (c := browser.open('/fluoroscopes/a/coverage')) and c[0] == 200 and c[2],
            what='a picture of the coverage',
        )
        colours = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)
        framed = (colours == UNEXPLAINED).all(axis=2)
        assert 0.005 < framed.mean() < 0.1
