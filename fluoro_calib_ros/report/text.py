# Copyright 2026 fluoro_calib_ros maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""Texts and numbers that figures, tables and the verdict have in common."""

from __future__ import annotations

import math

from ..distortion.base import CorrectionModel

TERMINAL_WIDTH = 100  # columns


def model_text(model: CorrectionModel) -> str:
    """A correction model in words."""
    if not model.corrects:
        return 'no correction model'
    return f'{model.kind}, k = {model.k}' if model.k else model.kind


def number_text(value: float, digits: int = 3) -> str:
    """A number with so many decimals, or a dash if it is not finite."""
    return f'{value:.{digits}f}' if math.isfinite(value) else '-'
