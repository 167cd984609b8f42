# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Options, each declared once with its default, choices, range, unit and description.

A frozen dataclass declares its fields by `option`. The command line, the parameters of the nodes,
config/ and docs/ are generated from `declared`, or tested against it.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Collection, Iterable
from typing import Any

_KEY = 'option'


@dataclasses.dataclass(frozen=True)
class Option:
    """One option of an options class."""

    name: str
    default: Any
    description: str  #: one phrase, without unit, range and choices
    choices: tuple[str, ...] = ()  #: empty if any value in the range is allowed
    minimum: float | None = None  #: end of the range, included
    maximum: float | None = None  #: end of the range, included
    unit: str = ''  #: such as 's' or 'px'; empty for a number without a unit
    length: int | None = None  #: number of components of a tuple

    @property
    def help(self) -> str:
        """Description with unit and choices, for a command line or a parameter descriptor."""
        unit = f' [{self.unit}]' if self.unit else ''
        choices = f': {", ".join(self.choices)}' if self.choices else ''
        return f'{self.description}{unit}{choices}'

    def validate(self, value: Any) -> None:
        """Raise ValueError, starting with the name of the option, for an invalid value."""
        if self.choices:
            if value not in self.choices:
                raise ValueError(
                    f'{self.name} must be one of {", ".join(self.choices)}, not {value!r}'
                )
        elif value is not None and (self.minimum is not None or self.maximum is not None):
            values = value if isinstance(value, tuple) else (value,)
            if not all(self._in_range(v) for v in values):
                raise ValueError(f'{self.name} must be {self._range()}, not {value!r}')

    def _in_range(self, value: float) -> bool:
        above = self.minimum is None or value >= self.minimum
        below = self.maximum is None or value <= self.maximum
        return bool(above and below)  # False for NaN

    def _range(self) -> str:
        if self.minimum is None:
            return f'at most {self.maximum:g}'
        if self.maximum is None:
            return f'at least {self.minimum:g}'
        return f'between {self.minimum:g} and {self.maximum:g}'


def option(
    default: Any,
    description: str,
    *,
    choices: Iterable[str] | Callable[[], Iterable[str]] = (),
    minimum: float | None = None,
    maximum: float | None = None,
    unit: str = '',
    length: int | None = None,
) -> Any:
    """Declare a field of an options dataclass; see `Option` for the arguments.

    choices may be a function, which is called whenever the options are declared, so that a growing
    registry is always up to date.
    """
    limits = (minimum, maximum, unit, length)
    declaration = Option('', default, description, choices, *limits)  # type: ignore[arg-type]
    return dataclasses.field(default=default, metadata={_KEY: declaration})


def declared(options: type | object) -> dict[str, Option]:
    """Return the options that a dataclass declares, by name, in the order of declaration."""
    out = {}
    for field in dataclasses.fields(options):  # type: ignore[arg-type]
        if _KEY in field.metadata:
            declaration = field.metadata[_KEY]
            choices = declaration.choices
            choices = tuple(choices() if callable(choices) else choices)
            out[field.name] = dataclasses.replace(declaration, name=field.name, choices=choices)
    return out


def validate_options(options: object, except_for: Collection[str] = ()) -> None:
    """Raise ValueError for the first option of an instance with an invalid value.

    except_for: names of options that are validated elsewhere.
    """
    for name, declaration in declared(options).items():
        if name not in except_for:
            declaration.validate(getattr(options, name))
