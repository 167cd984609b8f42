# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Layouts of Foxglove and PlotJuggler: everything that they show is published."""

import json
import re
from pathlib import Path
from xml.etree import ElementTree

ROOT = Path(__file__).parents[1]
NODES = (ROOT / 'docs' / 'nodes.md').read_text()
MESSAGES = {'calibration_status': 'CalibrationStatus', 'drift': 'DriftStatus'}


def assert_published(topic, field):
    """Check that docs/nodes.md lists the topic and that its message has the field."""
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
