# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Parameters are declared once, and are the same in the nodes, config/ and docs/."""

import dataclasses
import sys
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path

import pytest
import rclpy
import yaml
from rclpy.node import Node
from rclpy.parameter import Parameter

from fluoro_calib_ros.estimation.options import CalibrationOptions
from fluoro_calib_ros.limits import MAX_TEXT
from fluoro_calib_ros.nodes.calibration_settings import CalibrationParameters
from fluoro_calib_ros.nodes.reconstruction_node import ReconstructionParameters
from fluoro_calib_ros.nodes.runtime.diagnostics import StartError
from fluoro_calib_ros.nodes.runtime.parameters import (
    MAX_INTEGER,
    ParameterGroup,
    ParameterNode,
    descriptor_of,
    parameters_of,
)
from fluoro_calib_ros.nodes.runtime.services import MAX_TIMEOUT_S, check_timeout
from fluoro_calib_ros.options import declared, option
from tools import write_tables
from tools.sections import with_section

ROOT = Path(__file__).parents[2]


@pytest.mark.parametrize('node', write_tables.CONFIGURED)
def test_config_holds_every_parameter_with_its_default(node):
    config = yaml.safe_load((ROOT / 'config' / 'fluoro_calib.yaml').read_text())
    values = config[f'/**/{node}']['ros__parameters']
    expected = {
        name: list(declaration.default)
        if isinstance(declaration.default, tuple)
        else declaration.default
        for name, declaration in write_tables.parameters(node).items()
    }
    assert values == expected
    assert all(type(values[name]) is type(expected[name]) for name in expected)


def test_config_is_generated_from_the_declarations():
    """Comments are included; `python -m tools.write_tables` writes the file."""
    assert (ROOT / 'config' / 'fluoro_calib.yaml').read_text() == write_tables.yaml_text()


def test_tables_of_the_docs_are_generated_from_the_declarations():
    text = (ROOT / 'docs' / 'nodes.md').read_text()
    assert write_tables.docs_text(text) == text


def test_table_of_the_calibration_file_is_generated_from_its_record():
    text = (ROOT / 'docs' / 'files.md').read_text()
    table = write_tables.record_table()
    assert with_section(text, 'fields of a calibration', table) == text


def test_parameters_of_the_calibration_are_its_options():
    """Choices, range and description equal those of the command line."""
    parameters = write_tables.parameters('calibration_node')
    options = declared(CalibrationOptions)
    for name in ('model', 'interior', 'loss', 'max_iterations', 'relative_orientation', 'datum'):
        assert parameters[name] == options[name]


@pytest.mark.parametrize('node', write_tables.NODES)
def test_every_parameter_is_described(node):
    for declaration in write_tables.parameters(node).values():
        descriptor = descriptor_of(declaration)
        assert declaration.description in descriptor.description and descriptor.read_only
        number = isinstance(declaration.default, (int, float)) and not isinstance(
            declaration.default, bool
        )
        assert bool(descriptor.integer_range or descriptor.floating_point_range) == number
        assert all(choice in descriptor.additional_constraints for choice in declaration.choices)


def test_a_range_that_is_open_on_one_side_reaches_as_far_as_the_type():
    largest = sys.float_info.max
    for option_of, low, high in (
        (option(2, 'count', minimum=1), 1, MAX_INTEGER),
        (option(2, 'count', maximum=9), -MAX_INTEGER, 9),
        (option(2.0, 'length', minimum=1.0), 1.0, largest),
        (option(2.0, 'length', maximum=9.0), -largest, 9.0),
    ):
        one = dataclasses.make_dataclass('One', [('x', type(option_of.default), option_of)])
        descriptor = descriptor_of(declared(one)['x'])
        (found,) = [*descriptor.integer_range, *descriptor.floating_point_range]
        assert (found.from_value, found.to_value) == (low, high)
        assert bool(descriptor.integer_range) == isinstance(low, int)


def test_times_that_a_node_cannot_wait_are_refused():
    check_timeout(1e-3)
    check_timeout(MAX_TIMEOUT_S)
    for wrong in (0.0, -1.0, float('nan'), 1.001 * MAX_TIMEOUT_S, float('inf')):
        with pytest.raises(ValueError, match='timeout_sec must be a time in seconds'):
            check_timeout(wrong)


# ---- declaring them


@dataclass(frozen=True)
class Options:
    """Options of a test."""

    length_m: float = option(1.0, 'length', minimum=0.0, maximum=10.0, unit='m')
    count: int = option(2, 'count', minimum=1)
    kind: str = option('a', 'kind', choices=('a', 'b'))
    names: tuple[str, ...] = option(('x',), 'names')

    def __post_init__(self) -> None:
        if self.count == 13:
            raise ValueError('count: 13 brings bad luck')
        if self.length_m > 9:
            raise ValueError(f'length_m must not exceed count, but is {self.length_m:g}')


GROUP = ParameterGroup(
    Options, {'length_m': 'length', 'count': 'count', 'kind': 'kind', 'names': 'names'}
)


@pytest.fixture
def make_node():
    context = rclpy.Context()
    rclpy.init(args=[], context=context)
    nodes = []

    def make(**values):
        overrides = [Parameter(name, value=value) for name, value in values.items()]
        nodes.append(Node('test', context=context, parameter_overrides=overrides))
        return nodes[-1]

    yield make
    for node in nodes:
        node.destroy_node()
    rclpy.shutdown(context=context)


def test_a_group_becomes_an_options_object(make_node):
    assert GROUP.declare(make_node()) == Options()
    values = GROUP.declare(make_node(length=2.5, count=3, kind='b', names=['y', 'z']))
    assert values == Options(2.5, 3, 'b', ('y', 'z'))
    length = GROUP.declare(make_node(length=2)).length_m  # an integer
    assert length == 2.0 and isinstance(length, float)
    assert list(parameters_of([GROUP])) == ['length', 'count', 'kind', 'names']


@pytest.mark.parametrize(
    'values, sentence',
    [
        ({'length': 11.0}, 'parameter length must be between 0 and 10, not 11'),
        ({'length': 11}, 'parameter length must be between 0 and 10, not 11'),
        ({'length': 'abc'}, "parameter length must be a number, not 'abc'"),
        ({'count': 0}, 'parameter count must be at least 1, not 0'),
        ({'count': 1.5}, 'parameter count must be an integer, not 1.5'),
        ({'names': 'x'}, r"parameter names must be a list of strings, such as \[a, b\], not 'x'"),
        ({'count': 13}, 'parameter count: 13 brings bad luck'),
        ({'length': 9.5}, 'parameter length must not exceed count, but is 9.5'),
        ({'kind': 'c'}, "parameter kind must be one of a, b, not 'c'"),
    ],
)
def test_invalid_values_name_the_parameter(make_node, values, sentence):
    with pytest.raises(StartError, match=f'^{sentence}'):
        GROUP.declare(make_node(**values))


@pytest.mark.parametrize('kind', [CalibrationParameters, ReconstructionParameters])
@pytest.mark.parametrize('name, is_valid', [('', 0), ('/lab', 0), ('lab', 1), ('site/lab 2', 1)])
def test_rig_frame_is_a_name_that_tf2_accepts(make_node, kind, name, is_valid):
    group = ParameterGroup(kind)
    if is_valid:
        assert group.declare(make_node(rig_frame=name)).rig_frame == name
        return
    with pytest.raises(StartError, match=f'^parameter rig_frame: {name!r} is no name of a frame'):
        group.declare(make_node(rig_frame=name))


def test_shipped_rviz_and_aggregator_configurations_name_our_topics_and_nodes():
    config = ROOT / 'config'
    displays = yaml.safe_load((config / 'rig.rviz').read_text())['Visualization Manager']
    topics = {d['Topic']['Value'] for d in displays['Displays'] if 'Topic' in d}
    assert topics == {'reconstruction/points', 'reconstruction/markers'}
    assert (
        displays['Global Options']['Fixed Frame']
        == parameters_of(import_module('fluoro_calib_ros.nodes.reconstruction_node').PARAMETERS)[
            'rig_frame'
        ].default
    )
    groups = yaml.safe_load((config / 'diagnostics.yaml').read_text())['/**']['ros__parameters']
    nodes = {name for g in groups.values() if isinstance(g, dict) for name in g['contains']}
    kinds = ('extraction', 'calibration', 'correction', 'reconstruction', 'image')
    assert nodes == {f'{kind}_node' for kind in kinds}


# ---- setting them while the node runs


SETTABLE = ParameterGroup(
    Options, {'length_m': 'length', 'count': 'count'}, settable=('length', 'count')
)


class Settings(ParameterNode):
    """Node with settable parameters and one read-only parameter."""

    def __init__(self, context):
        super().__init__('test', context=context)
        self.used = []
        SETTABLE.declare(self)
        SETTABLE.follow(self, self.used.append)
        ParameterGroup(Options, {'kind': 'kind'}).declare(self)
        self.declare_parameter('note', '')
        self.declare_parameter('texts', ['x'])


@pytest.fixture
def settings():
    context = rclpy.Context()
    rclpy.init(args=[], context=context)
    node = Settings(context)
    yield node
    node.destroy_node()
    rclpy.shutdown(context=context)


def test_settable_parameters_are_used_at_once(settings):
    (done,) = settings.set_parameters([Parameter('length', value=2.5)])
    assert done.successful and settings.used == [Options(length_m=2.5)]
    done = settings.set_parameters_atomically(
        [Parameter('length', value=3.0), Parameter('count', value=7)]
    )
    assert done.successful and settings.used[-1] == Options(length_m=3.0, count=7)
    done = settings.set_parameters_atomically([Parameter('length', value=4)])  # an integer
    assert done.successful and settings.used[-1].length_m == 4.0


@pytest.mark.parametrize(
    'name, value, sentence',
    [
        ('length', 11.0, 'length'),
        ('length', 'x', 'type'),
        ('count', 13, 'parameter count: 13 brings bad luck'),
        ('count', None, 'cannot be'),  # undeclared
        (
            'kind',
            'b',
            'parameter kind is read when the node starts: set it in the parameter file or with '
            '-p kind:=VALUE, and start the node again',
        ),
    ],
)
def test_what_cannot_be_set_says_why_and_changes_nothing(settings, name, value, sentence):
    before = settings.get_parameter(name).value
    done = settings.set_parameters_atomically([Parameter(name, value=value)])
    assert not done.successful and sentence in done.reason and '\n' not in done.reason
    assert settings.get_parameter(name).value == before and not settings.used


def test_a_parameter_that_a_node_does_not_have_is_told_with_the_one_that_was_meant(settings):
    mistyped, other = (
        settings.set_parameters_atomically([Parameter(name, value=2.0)])
        for name in ('lenght', '\n' + 'x' * 5000)
    )
    assert not mistyped.successful
    assert mistyped.reason == 'there is no parameter lenght; did you mean length?'
    assert not other.successful and other.reason.endswith('--help lists the parameters')
    assert len(other.reason) < 900 and other.reason.isprintable()


@pytest.mark.parametrize('kind', ['BYTE_ARRAY', 'BOOL_ARRAY', 'INTEGER_ARRAY', 'STRING_ARRAY'])
def test_an_empty_list_has_no_type(settings, kind):
    """Tools send [] as a list of any type, such as ros2 param set with one of booleans."""
    done = settings.set_parameters_atomically([Parameter('texts', Parameter.Type[kind], [])])
    assert done.successful, done.reason
    assert settings.get_parameter('texts').value == []


def test_text_of_a_parameter_is_as_long_as_its_limit(settings):
    for length, is_taken in ((MAX_TEXT, True), (MAX_TEXT + 1, False)):
        done = settings.set_parameters_atomically([Parameter('note', value='x' * length)])
        assert done.successful is is_taken, done.reason
    assert len(settings.get_parameter('note').value) == MAX_TEXT


@pytest.mark.parametrize('node', write_tables.NODES)
def test_settable_parameters_are_declared_and_not_read_only(node):
    settable = write_tables.settable(node)
    assert settable <= set(write_tables.parameters(node))
    assert not settable & {'fluoroscopes', 'autostart', 'phantom', 'calibration_directory'}
