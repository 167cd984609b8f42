# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The fields of a record in a message: flat sequences and single values."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from ...errors import DataError
from ...records import Field
from .observations import float64_field, uint32_field


def set_fields(message: Any, fields: Iterable[Field], values: Mapping[str, Any]) -> None:
    """Set the fields of a message to the values of a record."""
    for field in fields:
        value = values[field.name]
        names = field.message or (field.name,)
        parts = [value]
        if len(names) > 1:
            parts = list(np.moveaxis(np.asarray(value), _axis(field), 0))
        for name, part in zip(names, parts, strict=True):
            setattr(message, name, _to_wire(field, part))


def values_of_fields(where: str, message: Any, fields: Iterable[Field]) -> dict[str, Any]:
    """Return the values of a record from a message.

    Raises DataError, beginning with where, for sequences of a length that they cannot have.
    """
    return {field.name: _value(where, message, field) for field in fields}


def _axis(field: Field) -> int:
    """Axis of the value whose parts have a field of the message each."""
    return field.shape.index(len(field.message))


def _to_wire(field: Field, value: Any) -> Any:
    """Return a value, or a part of it, as rclpy takes it."""
    value = np.asarray(value)
    if not value.ndim:
        return value.item()
    return uint32_field(value) if field.dtype == 'int' else float64_field(value)


def _value(where: str, message: Any, field: Field) -> Any:
    names = field.message or (field.name,)
    parts = [getattr(message, name) for name in names]
    if not field.shape:
        return parts[0]
    if len(names) == 1:
        return _shaped(where, field, np.array(parts[0]))
    if len({np.size(part) for part in parts}) > 1:
        raise DataError(f'{where}: {" and ".join(names)} differ in length')
    return np.stack([np.array(part) for part in parts], axis=_axis(field))


def _shaped(where: str, field: Field, flat: np.ndarray) -> np.ndarray:
    """Return a flat sequence in the shape of its field."""
    if len(field.shape) == 1:
        return flat
    if not len(flat) and field.before is not None:
        return np.asarray(field.before)
    shape = [field.lengths[n] if isinstance(n, str) else n for n in field.shape]
    if len(flat) != np.prod(shape):
        raise DataError(
            f'{where}: {field.name} has {len(flat)} values, {np.prod(shape)} are expected'
        )
    return flat.reshape(shape)
