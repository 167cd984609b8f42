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

"""Symmetric matrices of which one triangle is given."""

import numpy as np
from scipy.linalg import blas

BLOCK = 128  # rows and columns that are handled at once: they stay in the cache


def mirror_lower(matrix: np.ndarray) -> np.ndarray:
    """Copy the lower triangle of a matrix (n, n) to its upper one, in place; return the matrix."""
    n = len(matrix)
    for start in range(0, n, BLOCK):
        stop = min(start + BLOCK, n)
        matrix[start:stop, stop:] = matrix[stop:, start:stop].T
        block = np.tril(matrix[start:stop, start:stop])
        matrix[start:stop, start:stop] = block + np.tril(block, -1).T
    return matrix


def square_of_lower(factor: np.ndarray) -> np.ndarray:
    """L L^T (n, n) of a lower triangular matrix L; the upper triangle of factor is not used."""
    n = len(factor)
    out = np.zeros((n, n), order='F')
    for start in range(0, n, BLOCK):
        stop = min(start + BLOCK, n)
        columns = np.array(factor[start:, start:stop], order='F')
        columns[: stop - start] = np.tril(columns[: stop - start])
        out[start:, start:] += blas.dsyrk(1.0, columns, lower=1)
    return mirror_lower(out)
