# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Common parts of all fuzz targets: the property that is checked, and the driver of atheris.

A target reads bytes as a file. The property: the reader returns a result, or raises DataError with
a message of one line of limited length. It raises no other exception and no RuntimeWarning.
"""

from __future__ import annotations

import os
import sys
import tempfile
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fluoro_calib_ros.errors import DataError

MAX_MESSAGE = 1000  # characters, including the path
MAX_INPUT = 65536  # bytes; largest input that atheris generates
SECONDS_EACH = 20  # per input; a longer time is a finding
MEMORY_MB = 3000  # of the process; more is a finding
CORPUS = Path('.fuzz') / 'corpus'
INSTRUMENTED = ['fluoro_calib_ros', 'fuzz', 'mcap', 'rosbags']


@dataclass(frozen=True)
class Target:
    """A reader that is fuzzed.

    Attributes
    ----------
    name : str
    file_name : str
        The reader may select the format by the suffix.
    read : callable
        Reads the file at a path.
    seeds : callable
        Returns valid inputs.
    prepare : callable
        Returns the content of the file for an input of the fuzzer, such as an archive with correct
        checksums around it; by default, the input itself.
    """

    name: str
    file_name: str
    read: Callable[[Path], Any]
    seeds: Callable[[], Sequence[bytes]]
    prepare: Callable[[bytes], bytes] = bytes


class Broken(AssertionError):
    """The property is violated."""


def both(*readers: Callable[[], Any]) -> None:
    """Call all readers with one input. Raise DataError if any of them did."""
    refusal = None
    for read in readers:
        try:
            read()
        except DataError as error:
            check_message(str(error))
            refusal = error
    if refusal is not None:
        raise refusal


def check_message(text: str) -> None:
    """Raise Broken unless an error message is one printable line of limited length."""
    if len(text) > MAX_MESSAGE:
        raise Broken(f'a message of {len(text)} characters: {text[:200]!r}')
    if not text or not text.isprintable():
        raise Broken(f'a message that is not one line of printable text: {text[:500]!r}')


def check(target: Target, data: bytes, folder: Path) -> bool:
    """Read an input; return whether it was accepted. Raise if the property is violated."""
    path = folder / target.file_name
    path.write_bytes(target.prepare(data))
    with warnings.catch_warnings():
        warnings.simplefilter('ignore')
        warnings.simplefilter('error', RuntimeWarning)
        try:
            target.read(path)
        except DataError as error:
            check_message(str(error))
            return False
    return True


def write_corpus(target: Target) -> Path:
    """Write the seeds of a target as files, and return their folder."""
    folder = CORPUS / target.name
    folder.mkdir(parents=True, exist_ok=True)
    for number, seed in enumerate(target.seeds()):
        (folder / f'seed{number}').write_bytes(seed)
    return folder


def fuzz(load: Callable[[], Target], arguments: Sequence[str]) -> None:
    """Run atheris with the arguments of libFuzzer. This function does not return.

    load imports the target, so that its modules and those of the project are instrumented.
    """
    import atheris

    with atheris.instrument_imports(include=INSTRUMENTED):
        target = load()
    corpus = write_corpus(target)
    temporary = tempfile.TemporaryDirectory(dir='/dev/shm' if os.path.isdir('/dev/shm') else None)
    folder = Path(temporary.name)
    options = [
        f'-max_len={MAX_INPUT}',
        f'-timeout={SECONDS_EACH}',
        f'-rss_limit_mb={MEMORY_MB}',
        f'-artifact_prefix={CORPUS.parent}/{target.name}-',
        '-print_final_stats=1',
    ]

    def test_one_input(data: bytes) -> None:
        check(target, data, folder)

    atheris.Setup([sys.argv[0], *options, *arguments, str(corpus)], test_one_input)
    atheris.Fuzz()
