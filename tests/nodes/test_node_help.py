# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""--help of the nodes, and parameters that a node does not have."""

import importlib
import re
from importlib.machinery import ModuleSpec
from types import ModuleType, SimpleNamespace

import pytest

from fluoro_calib_ros.nodes import correction_node
from fluoro_calib_ros.nodes.runtime import main
from fluoro_calib_ros.nodes.runtime.main import (
    _description,
    asks_for_help,
    help_text,
    unused_arguments,
)
from fluoro_calib_ros.nodes.runtime.parameters import parameters_of, unknown_parameters
from fluoro_calib_ros.options import Option

NODES = (
    'bridge_node',
    'calibration_node',
    'correction_node',
    'extraction_node',
    'image_node',
    'player_node',
    'reconstruction_node',
    'recorder_node',
    'simulator_node',
)


@pytest.mark.parametrize('name', NODES)
def test_help_names_task_and_every_parameter(name):
    module = importlib.import_module(f'fluoro_calib_ros.nodes.{name}')
    text = help_text(module)
    assert text.startswith(f'usage: {name} ') and '\nNode that ' in text
    for parameter, declaration in parameters_of(module.PARAMETERS).items():
        assert f'\n  {parameter}' in text and declaration.description.split()[0] in text


def test_help_is_asked_for_in_front_of_the_arguments_of_ros():
    assert asks_for_help(['--help']) and asks_for_help(['-h', '--ros-args'])
    assert not asks_for_help(['--ros-args', '-p', 'x:=--help', '--help'])


def test_help_is_printed_without_starting_a_node(monkeypatch, capfd):
    monkeypatch.setattr(main, '_init', pytest.fail)
    with pytest.raises(SystemExit, match='0'):
        correction_node.main(['--help'])
    printed = capfd.readouterr()
    assert printed.out.startswith('usage: correction_node ') and printed.err == ''


def test_unknown_parameters_are_told_with_what_was_meant():
    given = dict.fromkeys(('phantm', 'collect', 'zzz', 'use_sim_time', 'qos_overrides./a.x'))
    known = {'phantom': None, 'collect': None}
    node = SimpleNamespace(
        _parameter_overrides=given,
        has_parameter=known.__contains__,
        get_parameters_by_prefix=lambda prefix: known,
    )
    given['still_px'] = None  # belongs to another node: a parameter file may set it for all nodes
    assert unknown_parameters(node) == [
        'there is no parameter phantm, it has no effect; did you mean phantom?',
        'there is no parameter zzz, it has no effect; --help lists the parameters',
    ]


@pytest.mark.parametrize(
    ('bounds', 'ends'),
    [
        ({'minimum': 1, 'maximum': 250.5}, ['1', '250.5']),
        ({'minimum': 1}, []),
        ({'maximum': 250.5}, []),
        ({}, []),
    ],
)
def test_help_tells_the_range_of_a_parameter(bounds, ends):
    text = _description(Option('rate', 7, 'frames', **bounds))
    assert re.findall(r'[\d.]+', text) == [*ends, '7']


@pytest.mark.parametrize(
    ('name', 'shown'),
    [('__main__', 'other_node'), ('fluoro_calib_ros.nodes.own_node', 'own_node')],
)
def test_help_has_the_name_that_is_typed(name, shown):
    """A module that runs as __main__ has its name only in its module specification."""
    module = ModuleType(name, 'Node that does nothing.')
    module.__spec__ = ModuleSpec('fluoro_calib_ros.nodes.other_node', None)
    module.PARAMETERS = ()
    assert help_text(module).split()[:2] == ['usage:', shown]


def test_arguments_that_are_not_of_ros_are_told():
    """Without --ros-args, parameters would silently have no effect."""
    (told,) = unused_arguments(['-p', 'phantom:=x.csv', '--ros-args', '-r', '__ns:=/rig'])
    assert told == (
        'arguments without effect: -p phantom:=x.csv; parameters and names follow --ros-args'
    )
    assert unused_arguments(['--ros-args', '-p', 'phantom:=x.csv']) == []
    assert unused_arguments([]) == []
    (told,) = unused_arguments(['\n' * 10_000])
    assert told.isprintable() and len(told) < 2000
