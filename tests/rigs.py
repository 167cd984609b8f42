# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Shared fixtures: virtual rigs, cached calibrations of them and small networks."""

import contextlib
import functools
from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
import pytest

from benchmarks.targets import facing
from fluoro_calib_ros.cli import main
from fluoro_calib_ros.correction.angle_field import AngleField
from fluoro_calib_ros.correction.calibration_record import HARMONICS, SD_GRID, VARIANCES
from fluoro_calib_ros.correction.fluoroscope_calibration import FluoroscopeCalibration
from fluoro_calib_ros.correction.registry import model_type, no_correction
from fluoro_calib_ros.correction.series import Functions, Series
from fluoro_calib_ros.correction.terms import polynomial_powers
from fluoro_calib_ros.errors import DataError
from fluoro_calib_ros.estimation.calibrate import calibrate
from fluoro_calib_ros.estimation.options import CalibrationOptions
from fluoro_calib_ros.exposures.frame import Frame
from fluoro_calib_ros.exposures.phantom import Drawing, Phantom
from fluoro_calib_ros.io.bags.metadata import (
    TARGET_OBSERVATIONS,
    message_from_frame,
    observations_topic,
)
from fluoro_calib_ros.photogrammetry import elimination
from fluoro_calib_ros.photogrammetry.collinearity import project, project_with_jacobian
from fluoro_calib_ros.photogrammetry.network import Network
from fluoro_calib_ros.photogrammetry.rig_orientation import RigOrientation
from fluoro_calib_ros.photogrammetry.rotations import matrix_from_vector
from fluoro_calib_ros.photogrammetry.unknowns import Parameters
from fluoro_calib_ros.simulation.rig import (
    looking_at_origin,
    phantom_poses,
    simulate_exposures,
    virtual_rig,
)


def write_frame(bag, frame, topic=None, log_time_ns=None):
    """Write a frame to a bag, on the topic of its fluoroscope and at the time of its stamp."""
    topic = topic or observations_topic(frame.fluoroscope)
    time_ns = frame.stamp_ns if log_time_ns is None else log_time_ns
    bag.write(topic, TARGET_OBSERVATIONS, message_from_frame(frame), time_ns)


def create_model(kind, *arguments, **more):
    """Return a correction model of a kind."""
    return model_type(kind)(*arguments, **more)


@contextlib.contextmanager
def refused(kind, **numbers):
    """Check that a DataError of a kind is raised with a one-line message; yield the caught error.

    numbers: values that the first finding of this kind must have.
    """
    with pytest.raises(DataError) as caught:
        yield caught
    assert '\n' not in str(caught.value)
    found = [one for one in caught.value.findings if one.kind is kind]
    assert found, caught.value.findings
    assert numbers.items() <= found[0].numbers.items()


def kinds(findings):
    """Return the kinds of findings, in order."""
    return [found.kind for found in findings]


def adjusted(noise_px, **rmse):
    """Return what checks take of an adjustment of frames of two points each: result, calibrations,
    frames.

    noise_px: noise of the calibrations. rmse: {fluoroscope: (before, after)} of residuals [px].
    """
    names = [*rmse]
    frames = {
        n: [Frame(n, 1, np.array([3, 7]), np.full((2, 2), 500.0), (1024, 1024))] for n in names
    }
    table = SimpleNamespace(
        fluoroscope=np.repeat(names, 2),
        exposure=np.ones(2 * len(names), dtype=int),
        target_id=np.tile([3, 7], len(names)),
        residual=np.concatenate([np.full((2, 2), after) for _, after in rmse.values()]),
        outlier=np.zeros(2 * len(names), dtype=bool),
    )
    figures = {
        n: SimpleNamespace(rmse_before=np.full(2, before), rmse_after=np.full(2, after))
        for n, (before, after) in rmse.items()
    }
    noise = SimpleNamespace(
        noise_sd=lambda frame: np.full(2, noise_px) if frame.sigma is None else frame.sigma
    )
    return (
        SimpleNamespace(fluoroscopes=figures, residuals=table),
        dict.fromkeys(names, noise),
        frames,
    )


def values_by_exposure(terms):
    """Functions (N, 2, p) of ExposureTerms at the image points; those of other exposures are 0."""
    values, group = terms.functions.values, terms.functions.group
    out = np.zeros((len(group), 2, terms.exposures, values.shape[2]))
    out[np.arange(len(group)), :, group] = values
    return out.reshape(len(group), 2, -1)


@contextlib.contextmanager
def eliminating(exposures):
    """Eliminate exposures, or else points, whatever leaves the smaller system."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(elimination, 'eliminates_exposures', lambda network: exposures)
        yield


@functools.cache
def rig():
    """The virtual rig of the tests."""
    return virtual_rig(1)


@functools.cache
def exposures(count=15, seed=1):
    """Return {fluoroscope: [Frame, ...]} of the rig; cached, so do not modify the frames."""
    return simulate_exposures(rig(), count, seed).frames


FINE_NOISE_PX = 0.04
SURVEY_MM = 0.05


def cube(beads: int = 64, side: float = 150.0) -> Phantom:
    """Return a cube of beads at random."""
    xyz = np.random.default_rng(3).uniform(-side / 2, side / 2, (beads, 3))
    return Phantom(np.arange(1, beads + 1), xyz, np.full(beads, SURVEY_MM))


def sheet() -> Phantom:
    """Return a perforated sheet."""
    drawn = Drawing(23, 23, pitch_mm=(14.0, 14.0, 14.0), sd_mm=SURVEY_MM).phantom()
    return replace(drawn, xyz_mm=drawn.xyz_mm - drawn.xyz_mm.mean(axis=0))


@functools.cache
def sheet_and_cube() -> tuple[dict[str, list[Frame]], Phantom]:
    """Return exposures 0 of a cube and 1 of a sheet in front of each detector, no pair."""
    rng = np.random.default_rng(7)
    phantom = cube().with_part(sheet())
    true = [part.xyz_mm + rng.normal(0, SURVEY_MM, part.xyz_mm.shape) for part in phantom.parts()]
    turn = matrix_from_vector([0.4, -0.3, 0.5])
    frames = {}
    for fluoroscope in rig().fluoroscopes:
        frames[fluoroscope.name] = []
        shown = [(turn, np.zeros(3)), facing(fluoroscope, rng, 0.5, 300.0, 5.0)]
        for number, (part, xyz, (rotation, shift)) in enumerate(zip(phantom.parts(), true, shown)):
            uv = fluoroscope.distortion.distort(fluoroscope.ideal(xyz @ rotation.T + shift))
            inside = ((uv > 10) & (uv < 1013)).all(axis=1)
            uv = uv[inside] + rng.normal(0, FINE_NOISE_PX, (inside.sum(), 2))
            sigma = np.full(len(uv), FINE_NOISE_PX)
            frame = Frame(
                fluoroscope.name, number, part.target_id[inside], uv, (1024, 1024), sigma
            )
            frames[fluoroscope.name].append(frame)
    return frames, phantom


def calibrated(name='a', count=15, **options):
    """CalibrationResult of one fluoroscope of the rig from the first `count` of 15 exposures."""
    return _calibrated(name, count, CalibrationOptions(**options))


@functools.cache
def _calibrated(name, count, options):
    return calibrate({name: exposures()[name][:count]}, rig().phantom, options)


def short_calibration():
    """Return a quickly computed calibration of fluoroscope a; many tests share it."""
    return calibrated('a', 6, max_iterations=2).calibrations['a']


def true_calibrations(fluoroscopes, image_sd=0.25):
    """Return true calibrations by name for the fluoroscopes of a rig without distortion."""
    one = short_calibration()
    return {
        f.name: replace(
            one,
            fluoroscope=f.name,
            interior=f.interior,
            model=no_correction(),
            train_exposure=np.zeros(0, dtype=int),
            frame_id=f'{f.name}_optical',
            image_sd=image_sd,
        )
        for f in fluoroscopes
    }


def true_orientation(fluoroscopes, calibrations):
    """Return the true orientation of calibrated fluoroscopes, with a small covariance."""
    sd = np.tile([0.03] * 3 + [2e-5] * 3 + [0.1] * 3, len(fluoroscopes))
    return RigOrientation(
        tuple(f.name for f in fluoroscopes),
        np.stack([f.interior for f in fluoroscopes]),
        np.stack([f.rotation for f in fluoroscopes]),
        np.stack([f.position_mm for f in fluoroscopes]),
        np.diag(sd**2),
        'rig',
        'capture',
        tuple(calibrations[f.name].calibration_id for f in fluoroscopes),
    )


@dataclass(frozen=True)
class NetworkOptions:
    """Options of small_network: noise, survey, free interiors, fraction of targets seen."""

    noise_px: float = 0.3
    nu: float = np.inf
    survey_sd_mm: float = 0.1
    free: bool = True
    seen: float = 0.8


def small_network(exposures=4, targets=30, fluoroscopes=1, seed=0, **options):
    """Return a Network and true Parameters: targets in a 200 mm box, seen partly per exposure."""
    options = NetworkOptions(**options)
    rng = np.random.default_rng(seed)
    true_mm = rng.uniform(-100, 100, (targets, 3))
    survey = true_mm + rng.normal(0, options.survey_sd_mm, true_mm.shape)
    of_exposure = np.repeat(np.arange(fluoroscopes), exposures)
    source = np.array([0.0, -1500.0, 0.0])
    poses = [pose for _ in range(fluoroscopes) for pose in phantom_poses(rng, exposures)]
    rotation = np.array([looking_at_origin(source) @ r for r, _ in poses])
    position = np.array([r.T @ (source - shift) for r, shift in poses])
    interior = np.array([511.5, 505.5, 4000.0]) + rng.normal(0, 10, (fluoroscopes, 3))
    which = rng.random((len(poses), targets)) < options.seen
    which[0] |= ~which.any(axis=0)
    exposure, point = np.nonzero(which)
    truth = Parameters(interior, rotation, position, true_mm)
    sigma = rng.choice([1.0, 2.0], len(point))
    noise = rng.normal(0, options.noise_px, (len(point), 2))
    if np.isfinite(options.nu):
        noise /= np.sqrt(rng.chisquare(options.nu, len(point)) / options.nu)[:, None]
    network = Network(
        np.zeros((len(point), 2)),
        sigma,
        exposure,
        point,
        of_exposure,
        survey,
        np.full(targets, options.survey_sd_mm),
        np.full(fluoroscopes, options.free),
    )
    uv = project(*network.per_image_point(truth)) + sigma[:, None] * noise
    return replace(network, uv=uv), truth


def disturbed(parameters, seed=0, degrees=0.5, mm=5.0):
    """Return initial values: rotations, positions, points and interiors with errors."""
    rng = np.random.default_rng(seed)
    turn = matrix_from_vector(rng.normal(0, np.deg2rad(degrees), parameters.position_mm.shape))
    interior = parameters.interior + rng.normal(0, 5.0, parameters.interior.shape)
    return Parameters(
        interior,
        turn @ parameters.rotation,
        parameters.position_mm + rng.normal(0, mm, parameters.position_mm.shape),
        parameters.points_mm + rng.normal(0, 0.3, parameters.points_mm.shape),
    )


def moved(network, parameters, x):
    """Return parameters moved by x (u,): T and w of the exposures, points, free interiors."""
    m, n = network.n_exposures, network.n_points
    exterior = x[: 6 * m].reshape(m, 6)
    points = x[6 * m : 6 * m + 3 * n].reshape(n, 3)
    interior = parameters.interior.copy()
    interior[network.interior_free] += x[6 * m + 3 * n :].reshape(-1, 3)
    return Parameters(
        interior,
        matrix_from_vector(exterior[:, 3:]) @ parameters.rotation,
        parameters.position_mm + exterior[:, :3],
        parameters.points_mm + points,
    )


def design_matrix(network, parameters):
    """Return the dense derivatives (2N, u) of the image points, in the order of `moved`."""
    count = network.n_image_points
    m, n = network.n_exposures, network.n_points
    _, d_e, d_p, d_i = project_with_jacobian(*network.per_image_point(parameters))
    out = np.zeros((count, 2, network.n_unknowns))
    column = 6 * m + 3 * n + 3 * (np.cumsum(network.interior_free) - 1)
    for row, (e, p) in enumerate(zip(network.exposure, network.point)):
        out[row, :, 6 * e : 6 * e + 6] = d_e[row]
        out[row, :, 6 * m + 3 * p : 6 * m + 3 * p + 3] = d_p[row]
        f = network.fluoroscope[e]
        if network.interior_free[f]:
            out[row, :, column[f] : column[f] + 3] = d_i[row]
    return out.reshape(2 * count, -1)


def dense_normal_matrix(network, adjustment, factor=1.0):
    """Return the dense normal matrix (u, u), with the image weights multiplied by factor."""
    a = design_matrix(network, adjustment.parameters)
    weight = (
        factor
        * adjustment.noise.weight(adjustment.q)
        / (adjustment.noise.scale * network.sigma) ** 2
    )
    normal = a.T @ (np.repeat(weight, 2)[:, None] * a)
    m, n = network.n_exposures, network.n_points
    points = np.arange(6 * m, 6 * m + 3 * n)
    normal[points, points] += np.repeat(1 / network.survey_sd_mm**2, 3)
    return normal


def run(*arguments):
    """Run the command fluoro-calib in this process and return its exit status."""
    try:
        main([str(a) for a in arguments])
    except SystemExit as stop:
        return stop.code
    return 0


def pincushion(name: str, image_size: tuple[int, int]) -> FluoroscopeCalibration:
    """Return a calibration for images of any size: a pincushion distortion of some pixels."""
    places = np.meshgrid(*(np.linspace(-0.5, s - 0.5, 12) for s in image_size))
    uv = np.stack(places, axis=-1).reshape(-1, 2)
    x = (uv - 0.5 * np.array(image_size)) / (max(image_size) / 2)
    model = create_model(
        'local_linear', 6, uv, 4 * x * (x**2).sum(axis=1, keepdims=True), 0.2, 0.0
    )
    return replace(
        short_calibration(),
        fluoroscope=name,
        model=model,
        image_size=image_size,
        train_exposure=np.zeros(len(uv), dtype=np.int64),
    )


def smooth_pincushion(name: str, image_size: tuple[int, int]) -> FluoroscopeCalibration:
    """Return `pincushion` as a cubic, whose lookup grid takes a tenth of the time to make."""
    calibration = pincushion(name, image_size)
    functions = Functions(image_size, 3)
    radial = [((3, 0), (1, 2)), ((2, 1), (0, 3))]  # x r^2 and y r^2
    coefficients = np.array([[4.0 * (power in of) for power in functions.powers] for of in radial])
    series = Series(functions, coefficients, np.full((SD_GRID, SD_GRID), 0.05))
    old = calibration.model
    model = create_model('parametric', 0, old.train_uv, old.train_duv, 0.2, 0.0, series)
    return replace(calibration, model=model)


def turning(
    calibration: FluoroscopeCalibration,
    degrees: float = 60.0,
    size_px: float = 1.0,
    degree: int = 3,
) -> FluoroscopeCalibration:
    """Return a calibration whose correction also changes with an angle, as for a C-arm.

    The calibrated angles are up to +-degrees; size_px: deviation of coefficients per harmonic;
    degree: of the change.
    """
    rng = np.random.default_rng(5)
    field = AngleField(
        calibration.image_size,
        np.deg2rad(np.linspace(-degrees, degrees, 9)),
        rng.normal(0, size_px, (HARMONICS, 2, len(polynomial_powers(degree)))),
        rng.uniform(0, 1e-3, (VARIANCES, SD_GRID, SD_GRID)),
    )
    return replace(calibration, angle_field=field)
