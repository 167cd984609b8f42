# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Results as JSON files."""

from __future__ import annotations

import json
import math
import os
import re
from collections.abc import Mapping
from typing import Any

import numpy as np
import yaml

from ..errors import DataError
from .access import read_text
from .atomic import write_text

# YAML of others, without aliases: a small text must not become a large value.

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


PathLike = str | os.PathLike[str]


def write_json(path: PathLike, document: Mapping[str, Any]) -> None:
    """Write a document; numbers that are not finite become null. Raises DataError."""
    write_text(path, json_text(document))


def json_text(document: Mapping[str, Any]) -> str:
    """Return a document as JSON, with an indentation of two blanks and the keys in order."""
    return (
        json.dumps(to_json_values(document), indent=2, allow_nan=False, ensure_ascii=False) + '\n'
    )


def read_json(path: PathLike) -> dict[str, Any]:
    """Read a document. Raises DataError that names the row of a fault."""
    text = read_text(path)
    try:
        document = json.loads(text)
    except json.JSONDecodeError as error:
        raise DataError(f'{path}, row {error.lineno}: this is not JSON ({error.msg})') from None
    except RecursionError:
        raise DataError(f'{path}: this is not a result, it is nested too deeply') from None
    if not isinstance(document, dict):
        raise DataError(
            f'{path}: this is not a result, it contains a {type(document).__name__} and no object'
        )
    return document


def to_json_values(value: Any) -> Any:
    """Return a value with lists for arrays, Python numbers, and None for what is not finite."""
    if isinstance(value, Mapping):
        return {str(key): to_json_values(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [to_json_values(item) for item in value]
    if isinstance(value, (np.ndarray, np.generic)):
        return to_json_values(value.tolist())
    return None if isinstance(value, float) and not math.isfinite(value) else value
