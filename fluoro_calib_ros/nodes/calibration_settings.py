# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Parameters of the calibration node, and the rig that they describe."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from ..errors import DataError
from ..estimation.options import CalibrationOptions
from ..exposures.angles import AngleOptions
from ..exposures.collector import StillOptions
from ..exposures.names import Names
from ..exposures.pairing import PairingOptions
from ..exposures.phantom import Phantom
from ..io.calibration import SUFFIX
from ..jobs.sources import read_survey
from ..limits import CollectLimits
from ..options import option
from .runtime.logging import StartError
from .runtime.parameters import (
    READ_LIMITS,
    ManagedParameters,
    ParameterGroup,
    ParameterNode,
    default_calibration_directory,
    expand_path,
)

COLLECT_MODES = ('still', 'request')


@dataclass(frozen=True)
class CalibrationParameters(ManagedParameters):
    """Parameters that only the calibration node has."""

    phantom: str = option(
        '',
        'file phantom.csv with the surveyed coordinates of the beads; without it the node only '
        'serves saved calibrations',
        unit='mm',
    )
    calibration_directory: str = option(
        '',
        'folder in which calibrations are saved, and from which they are loaded at the start; '
        'empty: fluoro_calib/<namespace> in $ROS_HOME or ~/.ros',
    )
    any_directory: bool = option(
        False,
        'whether save_calibration and load_calibration may name folders that are not below '
        'calibration_directory',
    )
    collect: str = option(
        'still',
        'when an exposure is collected: whenever the phantom stands still in a new pose, '
        'or on request by the service capture',
        choices=COLLECT_MODES,
    )
    joint: bool = option(False, 'whether all fluoroscopes are adjusted together')
    rig_frame: str = option(
        'rig', 'name of the rig frame, which is that of the phantom captured by orient'
    )
    capture_timeout: float = option(
        5.0,
        'longest wait of capture and orient where the request leaves it open',
        minimum=0.1,
        maximum=600.0,
        unit='s',
    )


_OF_REQUESTS = ('model', 'interior', 'loss', 'max_iterations', 'relative_orientation', 'datum')
_NODE = ParameterGroup(
    CalibrationParameters, settable=('collect', 'joint', 'rig_frame', 'capture_timeout')
)
_STILL = ParameterGroup(
    StillOptions,
    {'still_time_s': 'still_time', 'still_px': 'still_px', 'new_px': 'new_px'},
    settable=('still_time', 'still_px', 'new_px'),
)
_PAIRING = ParameterGroup(
    PairingOptions,
    {'pair_by': 'pair_by', 'tolerance_s': 'pair_tolerance'},
    settable=('pair_tolerance',),
)
_CALIBRATION = ParameterGroup(
    CalibrationOptions, {name: name for name in _OF_REQUESTS}, settable=_OF_REQUESTS
)
_ANGLES = ParameterGroup(AngleOptions)
_LIMITS = ParameterGroup(CollectLimits)
PARAMETERS = (_NODE, _STILL, _PAIRING, _CALIBRATION, _ANGLES, _LIMITS, READ_LIMITS)


@dataclass(frozen=True)
class CalibrationSettings:
    """Values of the parameters, by group."""

    node: CalibrationParameters
    still: StillOptions
    pairing: PairingOptions
    calibration: CalibrationOptions
    angles: AngleOptions
    limits: CollectLimits


def declare_settings(node: ParameterNode) -> CalibrationSettings:
    """Declare the parameters of a node. Raises StartError."""
    return CalibrationSettings(
        node=_NODE.declare(node),
        still=_STILL.declare(node),
        pairing=_PAIRING.declare(node),
        calibration=_CALIBRATION.declare(node),
        angles=_ANGLES.declare(node),
        limits=_LIMITS.declare(node),
    )


def follow_settings(
    node: ParameterNode,
    present: Callable[[], CalibrationSettings],
    use: Callable[[CalibrationSettings], None],
) -> None:
    """Call use() with new settings whenever parameters have been set."""
    _NODE.follow(node, lambda new: use(replace(present(), node=new)))
    _STILL.follow(node, lambda new: use(replace(present(), still=new)))
    _PAIRING.follow(node, lambda new: use(replace(present(), pairing=new)))
    _CALIBRATION.follow(node, lambda new: use(replace(present(), calibration=new)))


@dataclass(frozen=True)
class RigSetup:
    """The rig of a calibration node."""

    names: tuple[str, ...]  #: fluoroscopes
    phantom: Phantom | None  #: without one, the node only serves saved calibrations
    target_names: Names  #: of the beads
    directory: Path  #: folder of its calibrations
    settings: Callable[[], CalibrationSettings]  #: returns the present CalibrationSettings

    def required_phantom(self) -> Phantom:
        """Return the phantom. Raises DataError where there is none."""
        if self.phantom is None:
            raise DataError(
                'parameter phantom is not set: the node only serves saved calibrations'
            )
        return self.phantom


def read_rig(node: ParameterNode, settings: Callable[[], CalibrationSettings]) -> RigSetup:
    """Read the files that the parameters name. Raises StartError."""
    parameters = settings().node
    phantom: Phantom | None = None
    names = Names()
    try:
        directory = (
            expand_path(parameters.calibration_directory)
            if parameters.calibration_directory
            else default_calibration_directory(node.get_namespace())
        )
        if parameters.phantom:
            survey = read_survey(expand_path(parameters.phantom))
            phantom, names = survey.phantom, survey.names
            for note in survey.notes:
                node.get_logger().warning(note)
    except DataError as error:
        raise StartError(str(error)) from None
    if phantom is None and not any(directory.glob('*' + SUFFIX)):
        raise StartError(
            'parameter phantom is not set: it names the file phantom.csv, without which the node '
            f'only serves saved calibrations, and there are none in {directory}'
        )
    return RigSetup(parameters.fluoroscopes, phantom, names, directory, settings)
