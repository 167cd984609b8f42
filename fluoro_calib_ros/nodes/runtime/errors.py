# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Errors that a user can cause, as opposed to bugs."""

from __future__ import annotations

from rclpy.exceptions import NameValidationException, ParameterException

from ...errors import DataError, printable

MAX_LENGTH = 1000  # of an error message in one line


class StartError(RuntimeError):
    """Reason why a node cannot start, in one sentence."""


# Raised for invalid names, parameters and QoS overrides; rclpy's RCLError is a RuntimeError.
USER_ERRORS = (ParameterException, NameValidationException, RuntimeError, DataError)


def one_line(error: BaseException) -> str:
    """Return the message of an exception in one line, or its type where it has none."""
    return printable(' '.join(str(error).split())[:MAX_LENGTH]) or type(error).__name__
