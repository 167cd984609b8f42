# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Read TOML, YAML, JSON and XML files of any origin within a budget of time and memory.

A parser gets at most `limits.DOCUMENT_BYTES` of text. Structures for which its time or memory
grows faster than the text are refused: deep nesting, keys of many parts, aliases. Integers are
limited to 64 bits. Everything else is left to the parser of the library, whose time and memory are
then a multiple of the size of the text.
"""

from __future__ import annotations

import json
import math
import re
import sys
from collections.abc import Callable, Collection, Mapping
from typing import Any, NoReturn
from xml.etree import ElementTree

import numpy as np
import yaml
from numpy.typing import NDArray

from ..errors import DataError
from ..limits import DOCUMENT_BYTES, MAX_DEPTH
from .access import PathLike, read_text, write_text

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

MAX_DIGITS = 400  # maximum length of a YAML number, in characters
_NUMBERS = ('tag:yaml.org,2002:int', 'tag:yaml.org,2002:float')
# Brackets of nested lists and tables; brackets inside strings count, too.
_BRACKETS = re.compile(r'[\[\]{}]')
# Nested YAML lists on one line, without brackets.
_CHAIN = re.compile(rf'(?:[-?:][ \t]+){{{MAX_DEPTH}}}')
# Parts of TOML that are neither key nor bracket: strings and comments, also unterminated ones.
_TOML_TEXT = re.compile(
    r'"""(?:\\.|[^\\])*?(?:"""|\Z)'
    r"|'''.*?(?:'''|\Z)"
    r'|"(?:\\.|[^"\\\n])*"?'
    r"|'[^'\n]*'?"
    r'|#[^\n]*',
    re.DOTALL,
)
_TOML_KEY = re.compile(rf'(?<![\w-])(?:[\w-]+[ \t]*\.[ \t]*){{{MAX_DEPTH}}}')


def read_toml(path: PathLike) -> dict[str, Any]:
    """Read a TOML file. Raises DataError."""
    return parse_toml(read_text(path), path)


def parse_toml(text: str, where: object) -> dict[str, Any]:
    """Parse a TOML text. Raises DataError whose message begins with where."""
    _check_size('TOML', text, where)
    structure = _TOML_TEXT.sub('x', text)
    _check_depth('TOML', structure, where)
    if _TOML_KEY.search(structure):  # for each part of a key, the parser copies the others
        _fail_nested('TOML', where)
    return _parsed('TOML', where, lambda: tomllib.loads(text))


class _Loader(getattr(yaml, 'CSafeLoader', yaml.SafeLoader)):  # type: ignore[misc]
    """Load plain values only, and each once: with aliases a small text becomes a large value."""

    def construct_object(self, node: Any, deep: bool = False) -> Any:
        if node in self.constructed_objects or node in self.recursive_objects:
            self._refuse('aliases', node)
        if node.tag in _NUMBERS and len(node.value) > MAX_DIGITS:  # base 60: quadratic time
            self._refuse(f'numbers of more than {MAX_DIGITS} characters', node)
        return super().construct_object(node, deep)

    def flatten_mapping(self, node: Any) -> None:
        if any(key.tag == 'tag:yaml.org,2002:merge' for key, _ in node.value):
            self._refuse('merged keys', node)

    def _refuse(self, construct: str, node: Any) -> NoReturn:
        raise yaml.constructor.ConstructorError(
            None, None, f'{construct} are not allowed', node.start_mark
        )


def read_yaml(path: PathLike) -> Any:
    """Read a YAML file. Raises DataError."""
    return parse_yaml(read_text(path), path)


def parse_yaml(text: str, where: object) -> Any:
    """Parse a YAML text. Raises DataError whose message begins with where."""
    check_yaml(text, where)
    if _CHAIN.search(text):
        _fail_nested('YAML', where)
    return _parsed('YAML', where, lambda: yaml.load(text, Loader=_Loader))  # a safe loader


def read_json(path: PathLike) -> dict[str, Any]:
    """Read a JSON file of one object. Raises DataError that names the row of the error."""
    return parse_json(read_text(path), path)


def parse_json(text: str, where: object) -> dict[str, Any]:
    """Parse a JSON text; return its object. Raises DataError whose message begins with where."""
    _check_size('JSON', text, where)
    document = _parsed(
        'JSON', where, lambda: json.loads(text, parse_int=_whole, parse_constant=_not_finite)
    )
    if not isinstance(document, dict):
        raise DataError(
            f'{where}: this is not a result, it contains a {type(document).__name__} and no object'
        )
    return document


def parse_xml(text: str, where: object) -> ElementTree.Element:
    """Parse an XML text; return its root. Raises DataError whose message begins with where."""
    _check_size('XML', text, where)
    if '<!' in text.replace('<!--', ''):  # entities can expand a small text to a large one
        raise DataError(f'{where}: a document type, entities and CDATA are not read')
    return _parsed('XML', where, lambda: ElementTree.fromstring(text))


def check_yaml(text: str, where: object) -> None:
    """Raise DataError if a YAML text is too large, or nested too deeply."""
    _check_size('YAML', text, where)
    _check_depth('YAML', text, where)


def _check_size(kind: str, text: str, where: object) -> None:
    limit = DOCUMENT_BYTES[kind]
    if len(text) > limit:
        raise DataError(
            f'{where}: the {kind} text has {len(text) / 1e6:.1f} MB; the limit is '
            f'{limit / 1e6:g} MB'
        )


def _check_depth(kind: str, text: str, where: object) -> None:
    depth = 0
    for bracket in _BRACKETS.finditer(text):
        depth = max(depth + (1 if bracket[0] in '[{' else -1), 0)
        if depth > MAX_DEPTH:
            _fail_nested(kind, where)


def _fail_nested(kind: str, where: object) -> NoReturn:
    raise DataError(f'{where}: the {kind} text is nested too deeply')


def _parsed(kind: str, where: object, parse: Callable[[], Any]) -> Any:
    """Return the result of a parser; turn its exceptions into a DataError that names the row."""
    try:
        value = parse()
        if kind in ('TOML', 'YAML'):
            _check_whole(value)
        return value
    except RecursionError:
        _fail_nested(kind, where)
    except (ValueError, OverflowError, yaml.YAMLError, ElementTree.ParseError) as error:
        cause = getattr(error, 'msg', None) or getattr(error, 'problem', None) or error
        row = _row_of(error)
        raise DataError(f'{where}{row}: this is not {kind} ({cause})') from None


def _row_of(error: Exception) -> str:
    """Return the row of a syntax error in words, '' if the parser does not report it."""
    mark = getattr(error, 'problem_mark', None)
    row = mark.line + 1 if mark is not None else getattr(error, 'lineno', None)
    if isinstance(error, ElementTree.ParseError):
        row = error.position[0]
    return '' if row is None else f', row {row}'


def _check_whole(value: Any) -> None:
    """Raise ValueError for an integer beyond 64 bits anywhere in a value."""
    if isinstance(value, int):
        _whole(value)
    elif isinstance(value, dict):
        for key, item in value.items():
            _check_whole(key)
            _check_whole(item)
    elif isinstance(value, (list, tuple)):
        for item in value:
            _check_whole(item)


def _whole(value: str | int) -> int:
    # 64-bit integers have up to 19 digits; converting many more takes quadratic time.
    if (isinstance(value, str) and len(value) > 19) or abs(int(value)) > 2**63:
        raise ValueError('an integer is too large')
    return int(value)


def _not_finite(word: str) -> NoReturn:
    raise ValueError(f'{word} is not a number of JSON')


def numbers_of(
    where: object, table: Mapping[Any, Any], key: str, shape: tuple[int, ...] | None = None
) -> NDArray[np.float64]:
    """Return an entry of a document as an array of finite numbers, of this shape unless None.

    Raises DataError, whose message begins with where, also for a number that is written as text.
    """
    if key not in table:
        raise DataError(f'{where}: there is no {key}')
    is_numeric = are_numbers(table[key])
    if not is_numeric and not shape:
        raise DataError(f'{where}: {key} does not consist of numbers')
    try:
        array = np.array(table[key] if is_numeric else None, dtype=float)
    except ValueError:  # rows of different lengths
        array = np.array(np.nan)
    if shape is not None and array.shape != shape:
        raise DataError(f'{where}: {key} does not have {" x ".join(map(str, shape))} numbers')
    if not np.isfinite(array).all():
        raise DataError(f'{where}: {key} has a number that is not finite')
    return array


def are_numbers(value: Any) -> bool:
    """Return whether an entry of a document is a number, or lists of numbers; no text is one."""
    if isinstance(value, list):
        return all(map(are_numbers, value))
    return isinstance(value, int | float) and not isinstance(value, bool)


def check_keys(where: object, table: Mapping[Any, Any], keys: Collection[str]) -> None:
    """Raise DataError, whose message begins with where, for an unknown key."""
    for key in table:
        if key not in keys:
            raise DataError(f'{where}, key {key}: unknown, expected one of {", ".join(keys)}')


# Results written as JSON files.


def write_json(path: PathLike, document: Mapping[str, Any]) -> None:
    """Write a document as JSON; numbers that are not finite become null. Raises DataError."""
    write_text(path, json_text(document))


def json_text(document: Mapping[str, Any], ensure_ascii: bool = False) -> str:
    """Return a document as JSON text, indented by two spaces, keys in their given order."""
    values = to_json_values(document)
    return json.dumps(values, indent=2, allow_nan=False, ensure_ascii=ensure_ascii) + '\n'


def to_json_values(value: Any) -> Any:
    """Return a value of lists, Python numbers and texts; None for floats that are not finite."""
    if isinstance(value, Mapping):
        return {str(key): to_json_values(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [to_json_values(item) for item in value]
    if isinstance(value, (np.ndarray, np.generic)):
        return to_json_values(value.tolist())
    return None if isinstance(value, float) and not math.isfinite(value) else value
