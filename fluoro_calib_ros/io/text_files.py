# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Results written as JSON files; `documents` reads them."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping
from typing import Any

import numpy as np

from .atomic import write_text

PathLike = str | os.PathLike[str]


def write_json(path: PathLike, document: Mapping[str, Any]) -> None:
    """Write a document; numbers that are not finite become null. Raises DataError."""
    write_text(path, json_text(document))


def json_text(document: Mapping[str, Any]) -> str:
    """Return a document as JSON, with an indentation of two blanks and the keys in order."""
    return (
        json.dumps(to_json_values(document), indent=2, allow_nan=False, ensure_ascii=False) + '\n'
    )


def to_json_values(value: Any) -> Any:
    """Return a value with lists for arrays, Python numbers, and None for what is not finite."""
    if isinstance(value, Mapping):
        return {str(key): to_json_values(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [to_json_values(item) for item in value]
    if isinstance(value, (np.ndarray, np.generic)):
        return to_json_values(value.tolist())
    return None if isinstance(value, float) and not math.isfinite(value) else value
