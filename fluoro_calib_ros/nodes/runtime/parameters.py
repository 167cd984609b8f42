# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Parameters of the nodes, created from options that dataclasses declare."""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from difflib import get_close_matches
from pathlib import Path
from typing import Any, Generic, TypeVar

import rclpy
from ament_index_python.packages import PackageNotFoundError, get_package_share_directory
from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy.callback_groups import CallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.exceptions import ParameterException
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.timer import Timer

from ...errors import DataError, printable, shortened
from ...io.documents import read_yaml
from ...limits import MAX_TEXT, ReadLimits, use_read_limits
from ...options import Option, declared, option
from .diagnostics import PrintableLogger, StartError

MAX_INTEGER = 2**63 - 1  # largest integer parameter in ROS
# A fluoroscope's name is part of file names and topics.
FLUOROSCOPE_NAME = re.compile('[A-Za-z_][A-Za-z0-9_]{0,99}')

# Parameters that ROS itself declares, some only when they are needed.
SIM_TIME = 'use_sim_time'
_OF_ROS = ('qos_overrides.', SIM_TIME, 'start_type_description_service')

T = TypeVar('T')
_GROUP = 'group'  # key in the metadata of a field of settings


@dataclass(frozen=True)
class RigParameters:
    """Parameters of every node of a rig."""

    fluoroscopes: tuple[str, ...] = option(('a', 'b'), 'names of the fluoroscopes')

    min_fluoroscopes = 1  # not a parameter: no annotation

    def __post_init__(self) -> None:
        check_fluoroscopes(self.fluoroscopes, self.min_fluoroscopes)


@dataclass(frozen=True)
class ManagedParameters(RigParameters):
    """Parameters of every managed node of a rig."""

    autostart: bool = option(
        True,
        'whether the node configures and activates itself; else a lifecycle manager does',
    )


@dataclass(frozen=True)
class CalibratedParameters(ManagedParameters):
    """Parameters of every node that uses calibrations."""

    calibration_directory: str = option(
        '',
        'folder whose calibrations are used until others arrive; empty: the node waits for them',
    )


class ParameterNode(Node):
    """Node that explains how to change a read-only parameter when one tries to set it.

    Texts of peers stay within their line of the log. Timers use a steady clock: /clock may stop,
    and setting use_sim_time must not silence the diagnostics.
    """

    failed = False  #: whether the process ends with exit status 1

    def get_logger(self) -> Any:
        """Return a logger that is safe for any text."""
        return PrintableLogger(super().get_logger())

    def fail(self, text: str) -> None:
        """Log a fatal fault of the node itself, and end it with exit status 1."""
        self.get_logger().fatal(text)
        self.failed = True
        rclpy.try_shutdown()

    def create_timer(
        self,
        timer_period_sec: float,
        callback: Callable[[], object],
        callback_group: CallbackGroup | None = None,
        clock: Clock | None = None,
        autostart: bool = True,
    ) -> Timer:
        """Create a timer of the steady clock, unless another clock is given."""
        clock = clock or Clock(clock_type=ClockType.STEADY_TIME)
        return super().create_timer(timer_period_sec, callback, callback_group, clock, autostart)

    def set_parameters_atomically(
        self, parameter_list: Sequence[Parameter]
    ) -> SetParametersResult:
        """Set all parameters or none; integers are accepted for floating-point parameters."""
        for parameter in parameter_list:
            reason = self._refusal_of(parameter)
            if reason:
                return SetParametersResult(successful=False, reason=reason)
        return super().set_parameters_atomically(list(map(self._as_declared, parameter_list)))

    def _refusal_of(self, parameter: Parameter) -> str:
        """Return why a parameter cannot be set to any value, or to one like this; else ''."""
        name = parameter.name
        if not self.has_parameter(name) and name != SIM_TIME:
            return f'there is no parameter {printable(shortened(name))}{_hint(self, name)}'
        if name == SIM_TIME or self.describe_parameter(name).read_only:
            return (
                f'parameter {name} is read when the node starts: set it in the parameter file or '
                f'with -p {name}:=VALUE, and start the node again'
            )
        text = str(parameter.value)
        if len(text) > MAX_TEXT or not text.isprintable():
            return f'parameter {name}: a value is printable text of at most {MAX_TEXT} characters'
        return ''

    def _as_declared(self, parameter: Parameter) -> Parameter:
        """Convert an integer to a float, and an empty list, to the type of the parameter."""
        declared_type = self.get_parameter(parameter.name).type_
        if parameter.type_ == Parameter.Type.INTEGER and declared_type == Parameter.Type.DOUBLE:
            return Parameter(parameter.name, value=float(parameter.value))
        is_empty_list = parameter.type_.name.endswith('_ARRAY') and not len(parameter.value)
        if is_empty_list and declared_type == Parameter.Type.STRING_ARRAY:
            return Parameter(parameter.name, declared_type, [])
        return parameter


@dataclass(frozen=True)
class ParameterGroup(Generic[T]):
    """Options of a dataclass as parameters of a node."""

    options: type[T]  #: frozen dataclass that declares them
    #: parameter names by option name, or options under their own names; empty: all of them
    names: Mapping[str, str] | Sequence[str] = ()
    #: names of the parameters that may change while the node runs, see follow(); all others are
    #: read-only
    settable: Sequence[str] = ()

    @property
    def _names(self) -> Mapping[str, str]:
        """Parameter names by option name."""
        if isinstance(self.names, Mapping):
            return self.names
        return {name: name for name in self.names or declared(self.options)}

    @property
    def declarations(self) -> dict[str, Option]:
        """Declared options by parameter name, in the order of `names`."""
        options = declared(self.options)
        return {new: replace(options[name], name=new) for name, new in self._names.items()}

    def declare(self, node: Node) -> T:
        """Declare the parameters on a node, return their values. Raises StartError if invalid."""
        values = {
            parameter: declare_parameter(node, declaration, parameter not in self.settable)
            for parameter, declaration in self.declarations.items()
        }
        try:
            return self._options_of(values)
        except ValueError as error:
            raise StartError(f'parameter {error}') from None

    def follow(self, node: Node, use: Callable[[T], None]) -> None:
        """Call use() with the new options whenever parameters of the group have been set.

        An invalid value is refused with one sentence, and nothing changes.
        """
        declarations = self.declarations

        def options_with(parameters: Iterable[Parameter]) -> T:
            values = {name: node.get_parameter(name).value for name in declarations}
            values.update((p.name, p.value) for p in parameters)
            return self._options_of(values)

        def check(parameters: Sequence[Parameter]) -> SetParametersResult:
            group_parameters = [p for p in parameters if p.name in declarations]
            try:
                options_with(group_parameters)
            except ValueError as error:
                return SetParametersResult(successful=False, reason=f'parameter {error}')
            return SetParametersResult(successful=True)

        def apply(parameters: Sequence[Parameter]) -> None:
            if any(p.name in declarations for p in parameters):
                use(options_with(()))

        node.add_on_set_parameters_callback(check)
        node.add_post_set_parameters_callback(apply)

    def _options_of(self, values: Mapping[str, Any]) -> T:
        """Return the options for parameter values. Raises ValueError."""
        declarations = self.declarations
        values = {name: _tuple_or_value(declarations[name], values[name]) for name in declarations}
        for name, declaration in declarations.items():
            declaration.validate(values[name])
        arguments = {name: values[parameter] for name, parameter in self._names.items()}
        try:
            return self.options(**arguments)
        except ValueError as error:  # names the options
            text = re.sub(r'\w+', lambda word: self._names.get(word[0], word[0]), str(error))
            raise ValueError(text) from None


def group(
    options: type[T], names: Mapping[str, str] | Sequence[str] = (), settable: Sequence[str] = ()
) -> Any:
    """Declare a field of a settings dataclass: the options of a `ParameterGroup`."""
    return field(metadata={_GROUP: ParameterGroup(options, names, settable)})


def groups_of(settings: type[Any]) -> dict[str, ParameterGroup[Any]]:
    """Return the groups of a settings dataclass by field."""
    return {setting.name: setting.metadata[_GROUP] for setting in fields(settings)}


def parameters_of_managed(settings: type[Any]) -> tuple[ParameterGroup[Any], ...]:
    """Return the parameter groups of a managed node with these settings."""
    return (*groups_of(settings).values(), READ_LIMITS)


def declare_groups(node: Node, settings: type[T]) -> T:
    """Declare the parameters of a settings dataclass; return their values. Raises StartError."""
    return settings(**{name: each.declare(node) for name, each in groups_of(settings).items()})


READ_LIMITS = ParameterGroup(ReadLimits)  # for every node that reads files or images


def declare_read_limits(node: Node) -> None:
    """Declare the parameters READ_LIMITS and use them in this process. Raises StartError."""
    use_read_limits(READ_LIMITS.declare(node))


def declare_parameter(node: Node, declaration: Option, read_only: bool = True) -> Any:
    """Declare a parameter and return its value. Raises StartError.

    Integers are accepted for floating-point parameters.
    """
    default = declaration.default
    given = node._parameter_overrides.get(declaration.name)  # rclpy has no public access to them
    if given is not None:
        if isinstance(default, float) and given.type_ == Parameter.Type.INTEGER:
            given = Parameter(declaration.name, value=float(given.value))
            node._parameter_overrides[declaration.name] = given
        _check_given(declaration, given)
    listed = list(default) if isinstance(default, tuple) else default
    descriptor = descriptor_of(declaration, read_only)
    try:
        return node.declare_parameter(declaration.name, listed, descriptor).value
    except ParameterException as error:
        raise StartError(f'parameter {declaration.name}: {error}') from None


# Name of a value in messages, by the type of the default.
_WORDS = {
    bool: 'true or false',
    int: 'an integer',
    float: 'a number',
    str: 'a text',
    tuple: 'a list of strings, such as [a, b]',
}


def _check_given(declaration: Option, parameter: Parameter) -> None:
    """Raise StartError for a value that is invalid for a parameter, in the words of its option."""
    name, default = declaration.name, declaration.default
    listed = list(default) if isinstance(default, tuple) else default
    empty = parameter.type_ == Parameter.Type.NOT_SET or parameter.value == []  # of any type
    if not empty and parameter.type_ != Parameter.Type.from_parameter_value(listed):
        value = printable(shortened(repr(parameter.value)))
        raise StartError(f'parameter {name} must be {_WORDS[type(default)]}, not {value}')
    try:
        declaration.validate(_tuple_or_value(declaration, parameter.value))
    except ValueError as error:
        raise StartError(f'parameter {error}') from None


def _tuple_or_value(declaration: Option, value: Any) -> Any:
    """Return the value of a parameter in the type of its option: a list as a tuple."""
    if isinstance(declaration.default, tuple):
        return tuple(value or ())  # an empty list has no type and counts as not set
    return value


def descriptor_of(declaration: Option, read_only: bool = True) -> ParameterDescriptor:
    """Return the descriptor of a parameter: description, range and choices."""
    descriptor = ParameterDescriptor(
        name=declaration.name, description=declaration.help, read_only=read_only
    )
    if declaration.choices:
        descriptor.additional_constraints = f'one of {", ".join(declaration.choices)}'
    low, high = declaration.minimum, declaration.maximum
    if low is None and high is None:
        return descriptor
    is_integer = isinstance(declaration.default, int)
    kind = IntegerRange if is_integer else FloatingPointRange
    number, most = (int, MAX_INTEGER) if is_integer else (float, sys.float_info.max)
    limits = kind(
        from_value=-most if low is None else number(low),
        to_value=most if high is None else number(high),
    )
    setattr(descriptor, 'integer_range' if is_integer else 'floating_point_range', [limits])
    return descriptor


def parameters_of(groups: Iterable[ParameterGroup[Any]]) -> dict[str, Option]:
    """Return all parameters of a node by name."""
    return {
        name: declaration for group in groups for name, declaration in group.declarations.items()
    }


def settable_parameters(groups: Iterable[ParameterGroup[Any]]) -> frozenset[str]:
    """Return the names of the parameters of a node that may change while it runs."""
    return frozenset(name for group in groups for name in group.settable)


def unknown_parameters(node: Node) -> list[str]:
    """Return a sentence for every given parameter that a node does not have.

    ROS ignores such parameters: a mistyped name would silently have no effect. Parameters of other
    nodes of a rig are not reported, because a file may set them for all nodes (/**).
    """
    return [
        f'there is no parameter {name}, it has no effect{_hint(node, name)}'
        for name in node._parameter_overrides  # rclpy has no public access to them
        if not (node.has_parameter(name) or name.startswith(_OF_ROS))
        and name not in _parameters_of_rig()
    ]


def _hint(node: Node, name: str) -> str:
    """Return which parameter was probably meant by a name that a node does not have."""
    matches = get_close_matches(name, node.get_parameters_by_prefix(''), 1)
    return f'; did you mean {matches[0]}?' if matches else '; --help lists the parameters'


def _parameters_of_rig() -> frozenset[str]:
    """Return the parameter names in the installed configuration, none if it is not installed."""
    try:
        share = get_package_share_directory(__name__.partition('.')[0])
        document = read_yaml(os.path.join(share, 'config', 'fluoro_calib.yaml'))
        return frozenset(name for node in document.values() for name in node['ros__parameters'])
    except (PackageNotFoundError, DataError):
        return frozenset()


def check_fluoroscopes(names: tuple[str, ...], minimum: int = 1) -> None:
    """Raise ValueError unless there are enough names, all different and valid in a topic."""
    if len(names) < minimum or len(set(names)) != len(names):
        more = f' ({minimum} or more)' if minimum > 1 else ''
        raise ValueError(f'fluoroscopes: {list(names)} is not a list of different names{more}')
    for name in names:
        if not FLUOROSCOPE_NAME.fullmatch(name):
            raise ValueError(
                f'fluoroscopes: {name!r} cannot be part of the name of a topic, which consists of '
                'letters, digits and _, and does not begin with a digit'
            )


def check_frame(name: str) -> None:
    """Raise ValueError for a name that tf2 does not accept for a frame."""
    if not name or name.startswith('/'):
        raise ValueError(f'rig_frame: {name!r} is no name of a frame: empty, or begins with a /')


def expand_path(text: str) -> Path:
    """Return a path with ~ expanded. Raises DataError for an unknown user."""
    try:
        return Path(text).expanduser()
    except RuntimeError:
        raise DataError(f'{text}: there is no such home folder') from None
