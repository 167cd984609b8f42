# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A file system in memory that can be filled and made read-only."""

import os
import subprocess

import pytest

KILOBYTE = 1024


class Disk:
    """A small file system in memory."""

    def __init__(self, path, size_kb=4096):
        self.path = path
        path.mkdir()
        self._mount('-t', 'tmpfs', '-o', f'size={size_kb}k', 'tmpfs', path)

    def _mount(self, *words):
        try:
            subprocess.run(['mount', *words], check=True, capture_output=True)
        except (OSError, subprocess.CalledProcessError) as error:
            pytest.skip(f'a file system cannot be mounted here: {error}')

    def __enter__(self):
        return self

    def __exit__(self, *_):
        subprocess.run(['umount', '--lazy', self.path], check=True)

    def leave(self, free_kb):
        """Fill the disk until this many kB are free."""
        (self.path / 'filling').unlink(missing_ok=True)
        found = os.statvfs(self.path)
        with open(self.path / 'filling', 'wb') as file:
            file.write(bytes(found.f_bavail * found.f_frsize - free_kb * KILOBYTE))

    def make_read_only(self):
        self._mount('-o', 'remount,ro', self.path)

    def contents(self):
        """Return the bytes of all files, including hidden ones but not the filling."""
        return {
            str(p.relative_to(self.path)): p.read_bytes()
            for p in self.path.rglob('*')
            if p.is_file() and p.name != 'filling'
        }
