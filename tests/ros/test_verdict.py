# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The verdict on a calibration in the answer of a job that requests it."""

import json
from html import escape

from fluoro_calib_msgs.srv import Calibrate, LoadCalibration
from ros_graph import SUCCEEDED, value_of
from test_jobs import rig  # noqa: F401  a fixture

from fluoro_calib_ros.nodes.dashboard.state import light
from fluoro_calib_ros.nodes.dashboard.watch import SessionClient
from fluoro_calib_ros.nodes.messages.self_calibration import feedback_text


def told(client):
    """Return what a late subscriber receives: the verdict and its findings."""
    watch = SessionClient(client.get_namespace(), client.context)
    client._spinner.add_node(watch)
    client.wait_until(lambda: watch.state().verdict, what='the verdict')
    state = watch.state()
    client._spinner.remove_node(watch)
    watch.destroy_node()
    assert light(state).word == 'Do not use'
    status = client.wait_for_diagnostics(
        'calibration_node', lambda s: value_of(s, 'verdict') == 'fail', 'b'
    )
    assert status.message.startswith('the calibration in use has failed its verdict: ')
    return state.verdict, list(state.findings)


def test_job_reports_the_verdict_on_request(rig):  # noqa: F811
    """A model that corrects nothing is published; its verdict is fail, with the reason."""
    client = rig.client
    done = client.result_of(
        client.goal(model='none', fluoroscopes=['b'], validate=True).get_result_async()
    )
    assert done.status == SUCCEEDED and done.result.verdict == 'fail'
    assert 'the residuals have a trend of' in done.result.findings[0]
    assert done.result.message.endswith('; verdict: fail')
    client.wait_until(
        lambda: any(f.stage and f.step == f.steps - 1 for f in client.feedback),
        what='the last feedback',
    )
    steps = [feedback for feedback in client.feedback if feedback.stage]
    assert [feedback.step for feedback in steps] == list(range(steps[0].steps))
    assert feedback_text(steps[-1]).startswith('verdict: 83 %, b: ')
    assert feedback_text(client.feedback[0]).startswith('fluoroscope b  round  1  RMSE ')
    document = json.loads((rig.folder / 'validation.json').read_text())
    assert document['findings'] == list(done.result.findings)
    assert document['calibration_id'] == {'b': done.result.calibration_id[0]}

    report = (rig.folder / 'report.html').read_text(encoding='utf-8')
    assert done.result.calibration_id[0] in report
    assert escape(done.result.findings[0]).partition(': ')[2][:60] in report

    assert told(client) == ('fail', document['findings'])
    assert client.call(LoadCalibration, 'load_calibration').success
    assert told(client) == ('fail', document['findings'])

    answer = client.call(Calibrate, 'calibrate', model='none', fluoroscopes=['b'])
    assert answer.success and answer.verdict == '' and not answer.findings
    client.wait_for_diagnostics('calibration_node', lambda s: not value_of(s, 'verdict'), 'b')
    for name in ('validation.json', 'report.html'):
        assert not (rig.folder / name).exists(), 'that is of an earlier calibration'
