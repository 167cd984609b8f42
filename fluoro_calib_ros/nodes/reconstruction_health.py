# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Diagnostics of the reconstruction: conditions of all its streams, the gravest first."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from ..exposures.pairing import Pairer
from ..reconstruction.mismatch import RecentMisses
from .rig_input import RigInput
from .runtime.conditions import (
    InputState,
    inactive_node,
    incompatible_publisher,
    lost_messages,
    overrun_input,
    refused_messages,
    unpaired_frames,
)
from .runtime.diagnostics import OK, WARN, Health, fault, health_of, warning
from .runtime.stream import Stream

NO_ORIENTATION = (
    'no orientation of the rig yet: calibrate with all fluoroscopes, '
    'or capture the phantom with the service orient'
)


@dataclass(frozen=True)
class ReconstructionState(InputState):
    """What the diagnostics of the reconstruction are decided by."""

    streams: Mapping[str, Stream]  #: by fluoroscope
    rigs: RigInput
    pairer: Pairer
    misses: RecentMisses


def no_orientation(state: ReconstructionState) -> Health | None:
    """The orientation of the rig is not known yet."""
    if state.rigs.newest is not None:
        return None
    return warning(state.refusals.last_fault or NO_ORIENTATION)


def stalled_streams(state: ReconstructionState) -> Health | None:
    """Streams have stopped; what else is wrong with the streams follows."""
    found = {name: stream.stalled() for name, stream in state.streams.items()}
    stalled = [f'{name}: {message}' for name, message in found.items() if message]
    if not stalled:
        return None
    level, message = health_of(state, STREAM_CONDITIONS)
    more = [] if level == OK else [message]
    return Health(max(level, WARN), '; '.join([*stalled, *more]))


def missing_publishers(state: ReconstructionState) -> Health | None:
    """Nobody publishes the frames of a fluoroscope."""
    published = map(state.node.has_publisher, state.topics)
    missing = ', '.join(name for name, there in zip(state.streams, published) if not there)
    return warning(missing and f'no publisher of corrected observations of {missing}')


def missed_rays(state: ReconstructionState) -> Health | None:
    """The rays of the views do not meet."""
    misses = state.misses.message()
    disagreement = state.pairer.stamps.disagreement()
    return fault('; '.join(filter(None, (misses, disagreement))) if misses else '')


def silent_fluoroscopes(state: ReconstructionState) -> Health | None:
    """Fluoroscopes have stopped, and are not waited for any more."""
    silent = ', '.join(sorted(state.pairer.silent))
    return warning(
        silent and f'no frames of {silent}, points are reconstructed from the other fluoroscopes'
    )


def foreign_calibrations(state: ReconstructionState) -> Health | None:
    """Views were corrected with calibrations of no known orientation."""
    count = state.recent['without_orientation']
    corrected = (
        f'{count} exposures in the last minute were corrected with calibrations to which no '
        'orientation of the rig belongs'
    )
    return warning(corrected if count else '')


def distant_stamps(state: ReconstructionState) -> Health | None:
    """Frames of the same number are far apart in time."""
    return warning(state.pairer.stamps.disagreement())


def incomplete_exposures(state: ReconstructionState) -> Health | None:
    """Exposures have some of the views only."""
    count = state.recent['incomplete']
    text = f'{count} exposures without all fluoroscopes in the last minute'
    return warning(text if count else '')


def reconstructing(state: ReconstructionState) -> Health:
    """Nothing is wrong."""
    return Health(OK, 'reconstructing')


STREAM_CONDITIONS = (
    missing_publishers,
    missed_rays,
    silent_fluoroscopes,
    foreign_calibrations,
    refused_messages,
    distant_stamps,
    overrun_input,
    unpaired_frames,
    incomplete_exposures,
    reconstructing,
)
CONDITIONS = (
    lost_messages,
    incompatible_publisher,
    no_orientation,
    inactive_node,
    stalled_streams,
    *STREAM_CONDITIONS,
)
