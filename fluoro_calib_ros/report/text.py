# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Texts and numbers that figures, tables and the verdict have in common."""

from __future__ import annotations

import math

from ..correction.base import CorrectionModel

TERMINAL_WIDTH = 100  # columns


def model_text(model: CorrectionModel) -> str:
    """A correction model in words."""
    if not model.corrects:
        return 'no correction model'
    return f'{model.kind}, k = {model.k}' if model.k else model.kind


def number_text(value: float, digits: int = 3) -> str:
    """A number with so many decimals, or a dash if it is not finite."""
    return f'{value:.{digits}f}' if math.isfinite(value) else '-'
