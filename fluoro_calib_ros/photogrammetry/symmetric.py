# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

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
