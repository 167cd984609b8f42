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
