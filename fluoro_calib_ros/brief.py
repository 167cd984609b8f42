# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Short representations of results whose arrays would fill a console."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields
from typing import Any

import numpy as np

MAX_ITEMS = 4  # maximum number of shown items of an array or collection
MAX_TEXT = 60  # maximum number of shown characters of a text


def brief_repr(result: Any) -> str:
    """Return the representation of a dataclass: scalars in full, larger values by their size."""
    parts = (f'{field.name}={_brief(getattr(result, field.name))}' for field in fields(result))
    return f'<{type(result).__name__} {", ".join(parts)}>'


def _brief(value: object) -> str:
    if isinstance(value, np.ndarray):
        return _brief(value.tolist()) if value.size <= MAX_ITEMS else f'array{value.shape}'
    if isinstance(value, float):
        return f'{value:.6g}'
    if value is None or isinstance(value, (bool, int, str)):
        text = repr(value)
        return text if len(text) <= MAX_TEXT else f'{text[:MAX_TEXT]}...'
    if isinstance(value, Mapping):
        names = ', '.join(map(str, list(value)[:MAX_ITEMS]))
        return f'{{{names}{", ..." if len(value) > MAX_ITEMS else ""}}}'
    if isinstance(value, Sequence):
        if len(value) > MAX_ITEMS or any(hasattr(item, '__dict__') for item in value):
            return f'[{len(value)} {type(value[0]).__name__}]'
        return f'[{", ".join(map(_brief, value))}]'
    return type(value).__name__
