# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Parameters of the calibration node, the rig they describe, and the calibrations on disk."""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fluoro_calib_msgs.srv import LoadCalibration, SaveCalibration

from ..correction.fluoroscope_calibration import FluoroscopeCalibration
from ..errors import DataError, printable
from ..estimation.options import CalibrationOptions
from ..exposures.angles import AngleOptions
from ..exposures.collector import StillOptions
from ..exposures.names import Names
from ..exposures.pairing import PairingOptions
from ..exposures.phantom import Phantom
from ..io.calibration import PHANTOM as PHANTOM_FILE
from ..io.calibration import (
    SUFFIX,
    Verdict,
    disagreements,
    load_calibrations,
    load_orientation,
    orientation_path,
    stored_verdict,
)
from ..io.calibration_request import Radiographs, write_radiographs
from ..io.phantom import read_phantom
from ..jobs.calibration import CalibrationOutcome
from ..jobs.result_folder import belongs_to, kept_orientation, save_calibrations, save_outcome
from ..jobs.sources import read_survey
from ..limits import CollectLimits
from ..options import option
from ..photogrammetry.rig_orientation import RigOrientation
from .calibration_output import CalibrationOutput
from .runtime.diagnostics import Logger, StartError
from .runtime.parameters import (
    ManagedParameters,
    ParameterNode,
    check_frame,
    expand_path,
    group,
    parameters_of_managed,
)
from .runtime.services import telling_service

COLLECT_MODES = ('still', 'request')
MAX_HEAL_S = 60.0  # maximum collection time of heal: changes show within a few seconds


@dataclass(frozen=True)
class CalibrationParameters(ManagedParameters):
    """Parameters specific to the calibration node."""

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
        'longest wait of capture and orient where the request gives none',
        minimum=0.1,
        maximum=600.0,
        unit='s',
    )
    learn_bodies: str = option(
        '',
        'bodies.csv: bodies whose shapes are learned from the stream while the rig is healthy, '
        'for the action heal; coordinates of markers may be empty; empty: none are learned',
    )
    learn_time: float = option(
        30.0,
        'how long markers are seen before shapes are learned from them',
        minimum=0.1,
        maximum=600.0,
        unit='s of stream',
    )
    heal_time: float = option(
        5.0,
        'how long heal collects frames where the goal gives no time',
        minimum=0.1,
        maximum=MAX_HEAL_S,
        unit='s',
    )
    heal_accept: bool = option(
        False, 'whether a healed rig with the verdict pass is used without accept_healing'
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        check_frame(self.rig_frame)


_OF_REQUESTS = ('model', 'interior', 'loss', 'max_iterations', 'relative_orientation', 'datum')


@dataclass(frozen=True)
class CalibrationSettings:
    """Parameter values by group."""

    node: CalibrationParameters = group(
        CalibrationParameters,
        settable=(
            *('collect', 'joint', 'rig_frame', 'capture_timeout'),
            *('heal_time', 'heal_accept', 'learn_time'),
        ),
    )
    still: StillOptions = group(
        StillOptions,
        {'still_time_s': 'still_time', 'still_px': 'still_px', 'new_px': 'new_px'},
        settable=('still_time', 'still_px', 'new_px'),
    )
    pairing: PairingOptions = group(
        PairingOptions,
        {'pair_by': 'pair_by', 'tolerance_s': 'pair_tolerance'},
        settable=('pair_tolerance',),
    )
    calibration: CalibrationOptions = group(CalibrationOptions, _OF_REQUESTS, _OF_REQUESTS)
    angles: AngleOptions = group(AngleOptions)
    limits: CollectLimits = group(CollectLimits)


PARAMETERS = parameters_of_managed(CalibrationSettings)


@dataclass(frozen=True)
class RigSetup:
    """The rig of a calibration node."""

    names: tuple[str, ...]  #: fluoroscopes
    phantom: Phantom | None  #: if None, the node only serves saved calibrations
    target_names: Names  #: names of the beads
    directory: Path  #: folder of the calibrations
    settings: Callable[[], CalibrationSettings]  #: returns the current settings

    def required_phantom(self) -> Phantom:
        """Return the phantom. Raises DataError if there is none."""
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
        ).absolute()
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


def default_calibration_directory(namespace: str) -> Path:
    """Return the folder in which a calibration node of a namespace saves its calibrations.

    It is fluoro_calib/<namespace> in $ROS_HOME, or in ~/.ros if that is not set. Raises DataError
    if there is no home folder.
    """
    home = os.environ.get('ROS_HOME') or '~/.ros'
    return expand_path(home) / 'fluoro_calib' / namespace.strip('/')


class CalibrationFiles:
    """The services save_calibration and load_calibration, and the folder they use."""

    def __init__(self, rig: RigSetup, output: CalibrationOutput, logger: Logger) -> None:
        self._rig = rig
        self._output = output
        self._logger = logger
        self.services = (
            telling_service('save_calibration', SaveCalibration, 'not saved', self._save, logger),
            telling_service(
                'load_calibration',
                LoadCalibration,
                'not loaded, the calibration in use stays',
                self._load,
                logger,
            ),
        )

    def load_at_start(self) -> None:
        """Use the calibrations in the folder; log a fault and report it in the diagnostics."""
        directory = self._rig.directory
        if not any(directory.glob('*' + SUFFIX)):
            return
        try:
            loaded, orientation = self.load(directory)
            phantom, path = self._rig.phantom, directory / PHANTOM_FILE
            if phantom and path.exists() and not phantom.equals(read_phantom(path)):
                raise DataError(
                    f'{directory}: its calibrations were made with another phantom than '
                    f'{self._rig.settings().node.phantom}; use another calibration_directory, or '
                    'load them by the service load_calibration'
                )
        except (DataError, OSError) as error:
            self._output.load_fault = str(error)
            self._logger.error(f'no calibration loaded: {error}')
            return
        if loaded:
            self._output.publish(loaded, orientation, self._verdict(directory))
            self._logger.info(f'calibration of {", ".join(loaded)} loaded from {directory}')

    def save_outcome(
        self, outcome: CalibrationOutcome, radiographs: Radiographs
    ) -> tuple[RigOrientation | None, str]:
        """Save the outcome of a job, with radiographs for its report.

        Returns the orientation to use, and why saving failed ('' if it succeeded).

        The outcome of a costly calibration is used and published even if its folder cannot be
        written.
        """
        current_orientation = self._output.orientation
        try:
            saved_orientation = save_outcome(
                self._rig.directory,
                outcome,
                current_orientation,
                lambda folder: write_radiographs(folder, radiographs),
            )
            return saved_orientation, ''
        except DataError as error:
            orientation = kept_orientation(
                current_orientation, outcome.orientation, outcome.calibrations
            )
            return orientation, (
                f'the calibration is in use but not saved: {error}; save it by the service '
                'save_calibration'
            )

    def _save(self, request: SaveCalibration.Request) -> str:
        calibrations = self._output.calibrations
        directory = self._directory_of(request)
        if not calibrations:
            raise DataError('there is no calibration to save')
        check_folders(directory, self._rig.directory, self._rig.settings().limits.max_folders)
        save_calibrations(directory, calibrations, self._output.orientation)
        if directory == self._rig.directory:
            self._output.save_fault = ''
        return f'{", ".join(calibrations)} saved to {directory}'

    def _load(self, request: LoadCalibration.Request) -> str:
        directory = self._directory_of(request)
        loaded, orientation = self.load(directory)
        if not loaded:
            raise DataError(
                f'{directory}: there is no calibration of {", ".join(self._rig.names)}'
            )
        self._output.publish(loaded, orientation, self._verdict(directory))
        return f'{", ".join(loaded)} loaded from {directory}'

    def _directory_of(self, request: Any) -> Path:
        """Return the folder of a request. Raises DataError."""
        if not request.directory:
            return self._rig.directory
        directory = self._rig.directory / expand_path(request.directory)
        base = self._rig.directory.resolve()
        is_allowed = self._rig.settings().node.any_directory
        if not is_allowed and not directory.resolve().is_relative_to(base):
            raise DataError(
                f'{directory}: this folder is not below the calibration_directory {base}; the '
                'parameter any_directory allows it'
            )
        return directory

    def load(
        self, directory: Path
    ) -> tuple[dict[str, FluoroscopeCalibration], RigOrientation | None]:
        """Return the calibrations of the node's fluoroscopes in a folder, and their orientation.

        Raises DataError and OSError.
        """
        names = self._rig.names
        loaded = {n: c for n, c in load_calibrations(directory).items() if n in names}
        for disagreement in disagreements(directory, loaded):
            self._logger.warning(printable(str(disagreement)))
        path = Path(orientation_path(directory))
        if not loaded or not path.exists():
            return loaded, None
        orientation = load_orientation(path)
        if belongs_to(orientation, loaded):
            return loaded, orientation
        self._logger.warning(
            f'{path}: the orientation of the rig belongs to other calibrations, it is not used'
        )
        return loaded, None

    def _verdict(self, directory: Path) -> Verdict:
        """Return the verdict on the calibrations of a folder."""
        try:
            return stored_verdict(directory)
        except DataError:  # already reported by disagreements()
            return Verdict()


def check_folders(directory: Path, base: Path, limit: int) -> None:
    """Raise DataError if a folder named by a peer would exceed the limit of folders in base."""
    target = directory.resolve()
    if target.exists() or not target.is_relative_to(base.resolve()):
        return
    new_count = sum(not path.exists() for path in (target, *target.parents))
    # os.walk also yields the base, so subtract one.
    present_count = sum(1 for _ in itertools.islice(os.walk(base.resolve()), limit + 2)) - 1
    if max(present_count, 0) + new_count > limit:
        raise DataError(f'{directory}: {base} has as many folders as max_folders allows')
