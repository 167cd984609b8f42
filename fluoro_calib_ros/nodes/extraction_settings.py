# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Parameters of the extraction node, and the followers that are made from the files they name."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from ..bodies.body import Body, declared_bodies
from ..errors import DataError
from ..exposures.angles import AngleOptions
from ..exposures.pairing import PairingOptions
from ..images.markers import FirstMarkers, MarkerOptions
from ..io.bodies import read_bodies
from ..io.calibration import load_orientation, orientation_path
from ..jobs.live_extraction import MakeFollower, PhantomSettings
from ..jobs.live_markers import MarkerSettings
from ..jobs.reconstruction import check_orientation
from ..jobs.sources import read_calibrations, read_source, read_survey
from ..options import option
from .image_node import INPUTS
from .runtime.logging import Logger, StartError
from .runtime.parameters import (
    READ_LIMITS,
    ManagedParameters,
    ParameterGroup,
    ParameterNode,
    expand_path,
)

MODES = ('phantom', 'markers')
LARGEST_PX = 2**14  # of an image, for points whose image is not known yet


@dataclass(frozen=True)
class ExtractionParameters(ManagedParameters):
    """Parameters of the extraction node."""

    mode: str = option('phantom', 'what is looked for in the images', choices=MODES)
    phantom: str = option(
        '',
        'file phantom.csv with the surveyed coordinates of the beads, and with a column diameter '
        'where their sizes differ',
        unit='mm',
    )
    markers: str = option(
        '',
        'for the mode markers: file with the ids of the markers and where they are in the first '
        'image, as for fluoro-calib extract --markers; until an image shows them there, the node '
        'waits',
    )
    calibration_directory: str = option(
        '',
        'for the mode markers: folder with the calibrations and the orientation of both '
        'fluoroscopes, whose views then decide together on ids that may have been exchanged; '
        'empty: each view by itself',
    )
    clusters: tuple[str, ...] = option(
        ('',),
        "for the mode markers and two views: rigid clusters, each a text such as 'tibia: 1001 "
        "1002 1003 1004'",
    )
    bodies: str = option(
        '',
        'for the mode markers and two views: bodies.csv with rigid bodies and the places of their '
        'markers, in the place of clusters; without the file markers, the shapes give the ids',
    )
    principal_distance: float = option(
        0.0,
        'principal distance, to some 10 %; 0: four times the width of the image, to 25 %',
        minimum=0.0,
        maximum=1e7,
        unit='px',
    )
    inputs: str = option(
        'both', 'topics to subscribe to; of a camera that offers both, choose one', choices=INPUTS
    )
    queue_size: int = option(
        32,
        'images of a fluoroscope that may wait; of more, the oldest exposure is shed; 1 for the '
        'least delay',
        minimum=1,
        maximum=10000,
    )

    def __post_init__(self) -> None:
        try:
            self.rigid_bodies()
        except ValueError as error:
            raise ValueError(f'clusters: {error}') from None
        if self.bodies and self.rigid_bodies():
            raise ValueError('bodies: the file names the markers of each body, as clusters do')

    def rigid_bodies(self) -> tuple[Body, ...]:
        """Return the bodies. Raises ValueError for a text that declares none."""
        return declared_bodies([text for text in self.clusters if text])


_NODE = ParameterGroup(ExtractionParameters)
_PAIRING = ParameterGroup(PairingOptions, {'tolerance_s': 'pair_tolerance'})
_FOLLOWING = ParameterGroup(
    MarkerOptions,
    {name: name for name in ('gate', 'shutter', 'lost_after', 'search_every')},
)
_ANGLES = ParameterGroup(AngleOptions)
PARAMETERS = (_NODE, _PAIRING, _FOLLOWING, _ANGLES, READ_LIMITS)


@dataclass(frozen=True)
class ExtractionSettings:
    """Values of the parameters, by group."""

    node: ExtractionParameters
    pairing: PairingOptions
    following: MarkerOptions
    angles: AngleOptions


def declare_settings(node: ParameterNode) -> ExtractionSettings:
    """Declare the parameters of a node. Raises StartError."""
    return ExtractionSettings(
        node=_NODE.declare(node),
        pairing=_PAIRING.declare(node),
        following=_FOLLOWING.declare(node),
        angles=_ANGLES.declare(node),
    )


def read_followers(settings: ExtractionSettings, logger: Logger) -> Sequence[MakeFollower]:
    """Return what makes the followers: one for each view, or one for both. Raises StartError."""
    mode = settings.node.mode
    path = settings.node.phantom if mode == 'phantom' else settings.node.markers
    by_shape = mode == 'markers' and settings.node.bodies and settings.node.calibration_directory
    if not path and not by_shape:
        example = 'phantom.csv' if mode == 'phantom' else 'with the markers'
        raise StartError(f'parameter {mode} is not set: it names the file {example}')
    try:
        if mode == 'phantom':
            return _of_phantom(expand_path(path), settings.node, logger)
        first = _first_markers(expand_path(path), settings.node.fluoroscopes) if path else {}
        if settings.node.calibration_directory:
            return [_of_pair(settings, first)]
        return [
            MarkerSettings({name: markers}, settings.following) for name, markers in first.items()
        ]
    except DataError as error:
        raise StartError(str(error)) from None


def _of_phantom(
    path: Path, parameters: ExtractionParameters, logger: Logger
) -> Sequence[MakeFollower]:
    """Return what makes the follower of each fluoroscope. Raises DataError."""
    survey = read_survey(path)
    for note in survey.notes:
        logger.warning(note)
    distance = parameters.principal_distance or None
    return [PhantomSettings(name, survey.phantom, distance) for name in parameters.fluoroscopes]


def _first_markers(path: Path, names: Sequence[str]) -> dict[str, FirstMarkers]:
    """Return ids and first places of the markers of each fluoroscope. Raises DataError."""
    size = (LARGEST_PX, LARGEST_PX)
    recording = read_source(path, image_size=size, fluoroscopes=names)
    out = {}
    for name, frames in recording.frames.items():
        first = min(frames, key=lambda frame: frame.number)
        out[name] = FirstMarkers(first.target_id, first.uv)
    return out


def _of_pair(settings: ExtractionSettings, first: Mapping[str, FirstMarkers]) -> MarkerSettings:
    """Read what two views need to be followed together. Raises DataError."""
    names = settings.node.fluoroscopes
    folder = expand_path(settings.node.calibration_directory)
    if len(names) != 2:
        raise DataError(
            f'calibration_directory: two fluoroscopes are followed together, not {len(names)} '
            f'({", ".join(names)})'
        )
    calibrations = read_calibrations(folder, names)
    orientation = load_orientation(orientation_path(folder)).subset(names)
    bodies = settings.node.rigid_bodies()
    if settings.node.bodies:
        bodies = read_bodies(expand_path(settings.node.bodies))
    pair = MarkerSettings(first, settings.following, calibrations, orientation, bodies=bodies)
    check_orientation(orientation, calibrations)
    pair()  # refuses what does not belong together before the node starts
    return pair
