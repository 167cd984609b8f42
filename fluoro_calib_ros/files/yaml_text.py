# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""YAML of others, without aliases: a small text must not become a large value."""

from __future__ import annotations

import re
from typing import Any

import yaml

BRACKETS = re.compile(r'[\[\]{}]')
MAX_DEPTH = 100


class _Loader(yaml.SafeLoader):
    """Plain values only; a text with aliases may grow without bound."""

    def compose_node(self, parent: Any, index: Any) -> Any:
        if self.check_event(yaml.AliasEvent):
            mark = self.peek_event().start_mark
            raise yaml.constructor.ConstructorError(None, None, 'aliases are not allowed', mark)
        return super().compose_node(parent, index)


def _check_depth(text: str) -> None:
    """Raise yaml.YAMLError for deep nesting, for which the parser takes quadratic time."""
    depth = 0
    for bracket in BRACKETS.finditer(text):
        depth += 1 if bracket[0] in '[{' else -1
        if depth > MAX_DEPTH:
            raise yaml.YAMLError('nested too deeply')


def parse_yaml(text: str) -> Any:
    """Return the value of a YAML text. Raises yaml.YAMLError, also for aliases."""
    _check_depth(text)
    try:
        return yaml.load(text, Loader=_Loader)  # derived from the safe loader
    except RecursionError:
        raise yaml.YAMLError('nested too deeply') from None
    except (ValueError, OverflowError) as error:  # a date such as 2024-99-99
        raise yaml.YAMLError(str(error)) from None
