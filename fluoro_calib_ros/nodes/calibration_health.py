# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Diagnostics of a calibration node: conditions of a fluoroscope, the gravest first."""

from __future__ import annotations

from dataclasses import dataclass

from .calibration_output import CalibrationOutput
from .messages.status import FluoroscopeProgress
from .runtime.conditions import (
    StreamState,
    inactive_node,
    incompatible_publisher,
    lost_messages,
    missing_publisher,
    overrun_input,
    refused_messages,
    unpaired_frames,
)
from .runtime.diagnostics import OK, Health, fault, warning
from .runtime.streams import publisher_conflict


@dataclass(frozen=True)
class FluoroscopeState(StreamState):
    """What the diagnostics of a fluoroscope are decided by."""

    progress: FluoroscopeProgress
    output: CalibrationOutput
    disagreement: str  #: about frames with the same number that are far apart in time, else ''
    angle: Health | None  #: where the angle of the C-arm is unknown


def several_nodes(state: FluoroscopeState) -> Health | None:
    """Another calibration node serves the same fluoroscope."""
    return fault(publisher_conflict(state.node, f'{state.stream.name}/calibration_status'))


def nothing_loaded(state: FluoroscopeState) -> Health | None:
    """The saved calibrations could not be loaded at the start."""
    reason = state.output.load_fault
    return fault(reason and f'no calibration loaded: {reason}')


def nothing_saved(state: FluoroscopeState) -> Health | None:
    """The calibration in use could not be saved."""
    return fault(state.output.save_fault)


def refused_calibration(state: FluoroscopeState) -> Health | None:
    """The last self-calibration gave no calibration."""
    reason = state.output.refused.get(state.stream.name, '')
    in_use = state.progress.calibration_id or 'no calibration'
    return fault(reason and f'the last calibration was refused: {reason}; {in_use} is in use')


def never_published(state: FluoroscopeState) -> Health | None:
    """Nobody publishes frames, or has done so."""
    return None if state.stream.received else missing_publisher(state)


def distant_stamps(state: FluoroscopeState) -> Health | None:
    """Frames of the same number are far apart in time."""
    return warning(state.disagreement)


def unknown_angle(state: FluoroscopeState) -> Health | None:
    """The angle of the C-arm is unknown."""
    return state.angle


def working(state: FluoroscopeState) -> Health:
    """Nothing is wrong."""
    progress = state.progress
    if progress.is_calibrating:
        last = progress.last_round
        return Health(OK, f'self-calibration running, round {last.iteration if last else 0}')
    return Health(OK, 'collecting exposures' if progress.calibration is None else 'calibrated')


CONDITIONS = (
    lost_messages,
    incompatible_publisher,
    several_nodes,
    nothing_loaded,
    nothing_saved,
    refused_calibration,
    inactive_node,
    never_published,
    overrun_input,
    unpaired_frames,
    refused_messages,
    distant_stamps,
    unknown_angle,
    working,
)
