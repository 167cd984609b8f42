# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Rows of dataclasses of arrays: joined and chosen."""

from dataclasses import dataclass

import numpy as np

from fluoro_calib_ros.rows import chosen_rows, joined_rows


@dataclass(frozen=True)
class Table:
    name: str
    number: np.ndarray
    uv: np.ndarray


def test_rows_are_joined_and_chosen_and_common_fields_stay():
    table = Table('a', np.arange(3), np.arange(6.0).reshape(3, 2))
    both = joined_rows([table, chosen_rows(table, table.number > 1)])
    assert both.name == 'a' and both.number.tolist() == [0, 1, 2, 2]
    assert both.uv.tolist() == [[0, 1], [2, 3], [4, 5], [4, 5]]
    assert chosen_rows(table, slice(1)).uv.tolist() == [[0, 1]]
