# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Requests that a node cannot handle, from any peer: the node refuses them and continues."""

from functools import partial
from pathlib import Path

import pytest
from fluoro_calib_msgs.srv import LoadCalibration, SaveCalibration
from lifecycle_msgs.msg import State, Transition
from lifecycle_msgs.srv import ChangeState, GetState
from rcl_interfaces.msg import Parameter, ParameterValue
from rcl_interfaces.srv import SetParameters, SetParametersAtomically
from ros_graph import BAGS

from fluoro_calib_ros.nodes.runtime.topics import services_qos

MANAGED = {
    'correction_node': {},
    'reconstruction_node': {},
    'image_node': {},
    'calibration_node': {'phantom': str(BAGS / 'phantom.csv')},
}
OTHERS = {
    'simulator_node': {},
    'player_node': {'bag': str(BAGS / 'calibration'), 'loop': 'true'},
}
FOLDERS = {SaveCalibration: 'save_calibration', LoadCalibration: 'load_calibration'}


@pytest.fixture(scope='module')
def client(module_graph, tmp_path_factory):
    """Client of a graph with all these nodes."""
    client = module_graph.client
    for node in (*MANAGED, *OTHERS):
        client.expect(SetParameters, f'{node}/set_parameters')
        client.expect(SetParametersAtomically, f'{node}/set_parameters_atomically')
        if node in MANAGED:
            client.expect(ChangeState, f'{node}/change_state')
            client.expect(GetState, f'{node}/get_state')
    client.burst = client.create_client(
        LoadCalibration, 'load_calibration', qos_profile=services_qos()
    )
    for kind, service in FOLDERS.items():
        client.expect(kind, service)
    client.logs = {}
    client.folder = tmp_path_factory.mktemp('rig') / 'calibrations'
    for node, parameters in {**MANAGED, **OTHERS}.items():
        if node == 'calibration_node':
            parameters = {**parameters, 'calibration_directory': str(client.folder)}
        process = module_graph.start(node, parameters, wait=False)
        client.logs[node] = partial(Path.read_text, process.path)
    for node in (*MANAGED, *OTHERS):
        client.wait_until_known_to(node)
    return client


@pytest.mark.parametrize('node', [*MANAGED, *OTHERS])
def test_parameter_of_unknown_type_is_refused(client, node):
    wrong = Parameter(name='fluoroscopes', value=ParameterValue(type=99))
    for _ in range(2):  # the second answer shows that the node has survived the first request
        found = client.call(SetParameters, f'{node}/set_parameters', parameters=[wrong, wrong])
        assert [one.successful for one in found.results] == [False, False]
        assert '99' in found.results[0].reason
    found = client.call(
        SetParametersAtomically, f'{node}/set_parameters_atomically', parameters=[wrong]
    )
    assert not found.result.successful


@pytest.mark.parametrize('node', MANAGED)
def test_transition_that_does_not_fit_the_state_is_refused(client, node):
    def change(**transition):
        return client.call(
            ChangeState, f'{node}/change_state', transition=Transition(**transition)
        ).success

    def state():
        return client.call(GetState, f'{node}/get_state').current_state.id

    assert state() == State.PRIMARY_STATE_ACTIVE
    for wrong in (0, 1, 2, 3, 10, 60, 99, 250):
        assert not change(id=wrong)
        assert state() == State.PRIMARY_STATE_ACTIVE
    assert not change(label='nonsense')
    assert change(id=Transition.TRANSITION_DEACTIVATE)
    assert not change(id=Transition.TRANSITION_DEACTIVATE)
    assert state() == State.PRIMARY_STATE_INACTIVE
    assert change(id=Transition.TRANSITION_ACTIVATE)


def test_every_request_of_a_burst_is_answered(client):
    request = LoadCalibration.Request()
    answers = [client.burst.call_async(request) for _ in range(50)]
    client.wait_until(lambda: all(answer.done() for answer in answers), what='50 answers')
    assert not any(answer.result().success for answer in answers)


@pytest.mark.parametrize('label', ['\n[FATAL] forged\x1b[2J', 'x' * 5_000_000])
@pytest.mark.parametrize('node', MANAGED)
def test_label_of_a_transition_cannot_forge_lines_of_the_log(client, node, label):
    log = client.logs[node]
    before = len(log())
    answer = client.call(ChangeState, f'{node}/change_state', transition=Transition(label=label))
    assert not answer.success
    client.wait_until(lambda: 'label is printable text' in log()[before:], what='the refusal')
    assert len(log()) - before < 1000 and 'forged' not in log()[before:]


@pytest.mark.parametrize('kind', FOLDERS)
def test_folders_elsewhere_are_refused(client, kind, tmp_path):
    link = client.folder / 'link'
    client.folder.mkdir(parents=True, exist_ok=True)
    if not link.is_symlink():
        link.symlink_to(tmp_path)
    for place in (tmp_path / 'new', '../new', 'below/../../new', '~/new', link / 'new'):
        answer = client.call(kind, FOLDERS[kind], directory=str(place))
        assert not answer.success
        assert 'is not below the calibration_directory' in answer.message
    below = client.call(kind, FOLDERS[kind], directory='below')
    assert 'is not below' not in below.message
    assert not list(tmp_path.iterdir())
