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

"""Formats of other programs: one module a format, all of them listed in `registry`.

A module reads a file into a `content.Content` and writes one from it. Inside, the conventions are
those of docs/architecture.md: pixel centres at integers from (0, 0), v downwards, millimetres,
rotation from the world to the sensor. What a format does differently is converted in its module
and nowhere else, and docs/formats.md says so.
"""
