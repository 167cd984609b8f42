# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Work for a process that loads neither pytest nor what else the tests need."""

from __future__ import annotations

import os
import threading

from fluoro_calib_ros.errors import DataError
from fluoro_calib_ros.limits import read_limits


class OwnError(Exception):
    """An error that cannot be unpickled."""

    def __init__(self, one: int, other: int) -> None:
        super().__init__(f'{one} and {other}')


class Work:
    """A callable that counts its calls and does what its argument says."""

    def __init__(self) -> None:
        self.calls = 0

    def __call__(self, what: str, progress=None):
        self.calls += 1
        if what == 'data':
            raise DataError('a.csv: row 3 is damaged')
        if what == 'disk':
            raise OSError(28, 'no space left')
        if what == 'bug':
            raise ZeroDivisionError('by zero')
        if what == 'own':
            raise OwnError(1, 2)
        if what == 'exit':
            os._exit(3)
        if what == 'wait':
            threading.Event().wait()
        if what == 'rounds':
            for number in range(3):
                progress('a', number)
        if what == 'state':
            import cv2

            threads = cv2.getNumThreads()
            return os.nice(0), threads, read_limits().max_file_mb
        return self.calls
