# Copyright 2026 fluoro_calib_ros maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""The verdict on a calibration in the answer of a job that asks for it."""

import json

from fluoro_calib_msgs.srv import Calibrate
from ros_graph import SUCCEEDED
from test_jobs import rig  # noqa: F401  a fixture


def test_job_reports_the_verdict_on_request(rig):  # noqa: F811
    """A model that corrects nothing is published, its verdict is fail, with the reason."""
    client = rig.client
    done = client.result_of(
        client.goal(model='none', fluoroscopes=['b'], validate=True).get_result_async()
    )
    assert done.status == SUCCEEDED and done.result.verdict == 'fail'
    assert 'the residuals have a trend of' in done.result.findings[0]
    assert done.result.message.endswith('; verdict: fail')
    document = json.loads((rig.folder / 'validation.json').read_text())
    assert document['findings'] == list(done.result.findings)
    assert document['calibration_id'] == {'b': done.result.calibration_id[0]}

    answer = client.call(Calibrate, 'calibrate', model='none', fluoroscopes=['b'])
    assert answer.success and answer.verdict == '' and not answer.findings
    assert not (rig.folder / 'validation.json').exists(), (
        'that was the verdict on an earlier calibration'
    )
