# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The pathologies, one declaration each."""

from collections.abc import Callable
from dataclasses import dataclass, field

from . import phantoms
from .fields import BASE, Bumps, CurvedScreen, Magnetic, Step, ThinPlate, Waves
from .noise import (
    ByExposure,
    FalseMatches,
    Gaussian,
    Heteroscedastic,
    Overlapping,
    StudentT,
    WholePixels,
)


@dataclass(frozen=True)
class Case:
    """Differences of a case from the base rig.

    Attributes
    ----------
    name, group : str
    parts : tuple
        Parts of the distortion.
    phantom : callable
        Called with a random generator; returns the beads (n, 3) [mm].
    exposures, beads, tests : int
        Number of exposures, largest number of beads in each, number of test poses.
    noise, false : callable
        Noise and false matches of the image points.
    survey_sd, survey_factor : float
        Stated standard deviation of the survey [mm], and ratio of the true one to it.
    displaced : (int, float)
        Number of displaced beads, and their displacement [mm].
    face_mm : float
        Displacement of one side of the phantom in the survey.
    moved : (int, float)
        Number of exposures in which half of the beads move, and their motion [mm].
    short : float
        Relative error by which the survey is too short along one axis.
    exchanged_mm : float
        Distance of two beads that are exchanged in the survey, 0 for none.
    late : (float, float)
        Motion of the phantom before b takes its frame [mm], [rad].
    behind : int
        Lag of b in exposures, according to its frame numbers.
    repeats : int
        Frames of each pose, with mostly the same noise.
    magnified : (int, float)
        Number of exposures with another magnification, and its factor.
    side, c, principal, distance : int, float, (float, float), float
        Image side [px], principal distance over it, offset of the principal point [px of 1024],
        distance of the source [mm].
    poses, spread, min_seen : str, float, float
        'free', 'turntable' or 'narrow'; largest shift [mm]; least share of the beads in an image.
    wander : float
        Change of the distortion between exposures [px].
    arm : float
        Change of the distortion with the angle of the C-arm [px], which differs in every exposure.
    angle_known : bool
        Whether this angle is given for the exposures.
    blind : callable, optional
        True where the image, in coordinates 0 to 1, shows no beads.
    sigma_known : bool
        Whether the standard deviations of the image points are given.
    options : dict
        Options of the calibration.
    faulty : bool
        The verdict must not be 'pass', whatever the errors are.
    limited : bool
        The information does not allow a ratio of 1.15.
    both : bool
        Both fluoroscopes and the orientation of the rig are validated.
    """

    name: str
    group: str
    parts: tuple = BASE
    phantom: Callable = phantoms.frame
    exposures: int = 15
    beads: int = 132
    tests: int = 12
    noise: object = field(default_factory=Gaussian)
    false: object = field(default_factory=FalseMatches)
    survey_sd: float = 0.1
    survey_factor: float = 1.0
    displaced: tuple = (0, 0.0)
    face_mm: float = 0.0
    moved: tuple = (0, 0.0)
    short: float = 0.0
    exchanged_mm: float = 0.0
    late: tuple = (0.0, 0.0)
    behind: int = 0
    repeats: int = 1
    magnified: tuple = (0, 1.0)
    side: int = 1024
    c: float = 3.6
    principal: tuple = (0.0, 0.0)
    distance: float = 1300.0
    poses: str = 'free'
    spread: float = 75.0
    min_seen: float = 0.45
    wander: float = 0.0
    arm: float = 0.0
    angle_known: bool = True
    blind: Callable | None = None
    sigma_known: bool = False
    options: dict = field(default_factory=dict)
    faulty: bool = False
    limited: bool = False
    both: bool = False


def _cube(rng):
    return phantoms.cube(rng, 4, 180.0)


def _few(rng):
    return phantoms.cloud(rng, 30, 140.0)


CUBE = {'phantom': _cube, 'beads': 64, 'spread': 90.0}
BARREL = (CurvedScreen(-80), Magnetic(2), ThinPlate(9, 0.8))
SMOOTH = (CurvedScreen(9), Magnetic(2))

CASES = (
    # Rigs that should cause no problems.
    Case('base', 'base'),
    Case('turntable', 'base', poses='turntable'),
    Case('cloud', 'base', phantom=phantoms.cloud),
    Case('helix', 'base', phantom=phantoms.helix),
    Case('plates', 'base', phantom=phantoms.plates),
    Case('smooth field', 'base', parts=SMOOTH),
    Case('strong field', 'base', parts=(CurvedScreen(30), Magnetic(8), ThinPlate(12, 2.0))),
    Case('no distortion', 'base', parts=()),
    Case('sigma known', 'base', sigma_known=True),
    Case('sharp beads', 'base', noise=Overlapping(), beads=400, sigma_known=True),
    Case('long source', 'base', c=6.0, distance=2200.0),
    Case('short source', 'base', c=2.2, distance=800.0),
    Case('2048 px', 'base', side=2048, noise=Gaussian(0.4)),
    # Noise.
    Case('noise 0.05 px', 'noise', noise=Gaussian(0.05)),
    Case('noise 0.1 px', 'noise', noise=Gaussian(0.1)),
    Case('noise 0.5 px', 'noise', noise=Gaussian(0.5)),
    Case('noise 1 px', 'noise', noise=Gaussian(1.0)),
    Case('t noise', 'noise', noise=StudentT(0.2, 3.0)),
    Case('heavy t noise', 'noise', noise=StudentT(0.15, 2.0)),
    Case('whole pixels', 'noise', noise=WholePixels()),
    Case('noise grows to rim', 'noise', noise=Heteroscedastic()),
    Case('noise by exposure', 'noise', noise=ByExposure()),
    # False matches.
    Case('5 % false', 'matches', false=FalseMatches(0.05)),
    Case('20 % false', 'matches', false=FalseMatches(0.20)),
    Case('40 % near false', 'matches', false=FalseMatches(0.40)),
    Case('45 % anywhere', 'matches', false=FalseMatches(0.45, 'anywhere')),
    Case(
        'barrel 80 px, 45 % anywhere',
        'matches',
        parts=BARREL,
        false=FalseMatches(0.45, 'anywhere'),
    ),
    Case('20 % swapped', 'matches', false=FalseMatches(0.20, 'swapped')),
    Case('40 % swapped', 'matches', false=FalseMatches(0.40, 'swapped')),
    Case('cube 20 % false', 'matches', false=FalseMatches(0.20), **CUBE),
    # Fields.
    Case('barrel 80 px', 'fields', parts=BARREL),
    Case('ripples 60 px', 'fields', parts=(*SMOOTH, Bumps(60, 45, 0.8))),
    Case('waves 150 px', 'fields', parts=(*SMOOTH, Waves(150, 0.8))),
    Case('waves 80 px', 'fields', parts=(*SMOOTH, Waves(80, 0.6))),
    Case('seam 1 px sharp', 'fields', parts=(*SMOOTH, Step(1.0, 12))),
    Case('seam 3 px sharp', 'fields', parts=(*SMOOTH, Step(3.0, 20))),
    Case('seam 3 px soft', 'fields', parts=(*SMOOTH, Step(3.0, 70))),
    Case('one dent of 4 px', 'fields', parts=(*SMOOTH, Bumps(1, 40, 6.0))),
    Case('magnetic 15 px', 'fields', parts=(CurvedScreen(9), Magnetic(15))),
    Case('principal point 150 px', 'fields', principal=(150.0, -60.0)),
    # Geometry.
    Case('100 exposures', 'geometry', exposures=100, beads=132, tests=10),
    Case('30 exposures', 'geometry', exposures=30),
    Case('10 exposures', 'geometry', exposures=10),
    Case('6 exposures', 'geometry', exposures=6),
    Case('cube', 'geometry', **CUBE),
    Case('cube 6 exposures', 'geometry', exposures=6, limited=True, **CUBE),
    Case('cube 30 exposures', 'geometry', exposures=30, **CUBE),
    Case('30 beads', 'geometry', phantom=_few, beads=30, exposures=20),
    Case('40 targets an exposure', 'geometry', beads=40),
    Case('narrow poses', 'geometry', poses='narrow', both=True),
    Case('small shifts', 'geometry', spread=25.0),
    Case('256 px', 'geometry', side=256, noise=Gaussian(0.1)),
    Case('half the image blind', 'geometry', blind=lambda x: x[:, 0] + x[:, 1] > 1.15),
    Case(
        'hole in the middle',
        'geometry',
        blind=lambda x: ((x - 0.5) ** 2).sum(axis=1) < 0.03,
    ),
    # Distortion that varies between exposures, so that each differs from the corrected one.
    Case('varying 0.3 px', 'varying', wander=0.3),
    Case('varying 1 px', 'varying', wander=1.0, faulty=True),
    Case('varying 1 px 30 exposures', 'varying', wander=1.0, exposures=30, faulty=True),
    Case('varying 2 px', 'varying', wander=2.0, faulty=True),
    # Distortion that changes with the angle of the C-arm.
    Case('turning 1 px', 'turning', arm=1.0),
    Case('turning 3 px', 'turning', arm=3.0),
    Case('turning 3 px 30 exposures', 'turning', arm=3.0, exposures=30),
    Case('turning 1 px, angle unknown', 'turning', arm=1.0, angle_known=False),
    Case('turning 3 px, angle unknown', 'turning', arm=3.0, angle_known=False, faulty=True),
    # Survey and phantom.
    Case('survey 0.5 mm', 'survey', survey_sd=0.5),
    Case('survey 0.01 mm', 'survey', survey_sd=0.01),
    Case('survey twice its sd', 'survey', survey_factor=2.0, faulty=True),
    Case('3 beads 2 mm off', 'survey', displaced=(3, 2.0), faulty=True),
    Case('a face 1 mm off', 'survey', face_mm=1.0, faulty=True),
    Case('moved in an exposure', 'survey', moved=(1, 1.0), faulty=True),
    # Recordings and surveys that are plausible but wrong.
    Case('an axis 0.2 % short', 'confused', short=0.002, faulty=True),
    Case('two beads exchanged', 'confused', exchanged_mm=5.0, faulty=True),
    Case('b a frame late', 'confused', late=(1.5, 0.005), faulty=True, both=True),
    Case('b an exposure behind', 'confused', behind=1, faulty=True, both=True),
    Case('three frames a pose', 'confused', exposures=45, repeats=3),
    Case('two exposures magnified', 'confused', magnified=(2, 1.3)),
    Case(
        'lead disc of 140 px',
        'confused',
        blind=lambda x: ((x - [0.58, 0.45]) ** 2).sum(axis=1) < 0.0187,
    ),
    Case('one dent of 4 px, wide', 'confused', parts=(*SMOOTH, Bumps(1, 60, 6.0))),
    # Models other than auto.
    Case('local_linear', 'models', options={'model': 'local_linear'}),
    Case('knn', 'models', options={'model': 'knn'}),
    Case('hybrid', 'models', options={'model': 'hybrid'}),
    Case('parametric', 'models', options={'model': 'parametric'}),
)
