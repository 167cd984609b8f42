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

"""Layouts of Foxglove and PlotJuggler: what they show is published."""

import json
import re
from pathlib import Path
from xml.etree import ElementTree

ROOT = Path(__file__).parents[1]
NODES = (ROOT / 'docs' / 'nodes.md').read_text()
MESSAGES = {'calibration_status': 'CalibrationStatus', 'drift': 'DriftStatus'}


def assert_published(topic, field):
    """Check a topic against docs/nodes.md, and a field against its message."""
    relative = re.sub('^/[ab]/', '<f>/', topic).lstrip('/')
    assert f'| `{relative}` |' in NODES or f'| `/{relative}` |' in NODES, topic
    if field:
        name = MESSAGES[topic.rpartition('/')[2]]
        text = (ROOT / 'msg_defs' / 'msg' / f'{name}.msg').read_text()
        assert re.search(rf'^\w+ {field} ', text, re.M), f'{topic} {field}'


def test_foxglove_shows_what_is_published():
    layout = json.loads((ROOT / 'config' / 'foxglove.json').read_text())
    panels = layout['configById']
    for panel in panels.values():
        for path in panel.get('paths', []):
            assert_published(*path['value'].rsplit('.', 1))
        for topic in panel.get('topics', {}):
            assert_published(topic, '')
        for key in ('imageTopic', 'topicToRender'):
            topic = {**panel, **panel.get('imageMode', {})}.get(key)
            if topic:
                assert_published(topic, '')
    placed = re.findall(
        '"((?:3D|Image|Plot|DiagnosticSummary)![a-z]+)"', json.dumps(layout['layout'])
    )
    assert sorted(placed) == sorted(panels)


def test_plotjuggler_shows_what_is_published():
    curves = ElementTree.parse(ROOT / 'config' / 'plotjuggler.xml').iter('curve')
    names = [curve.get('name') for curve in curves]
    assert len(names) > 10
    for name in names:
        assert_published(*name.rsplit('/', 1))
