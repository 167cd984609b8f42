# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""One image of a sheet before each detector, and one of a cube, calibrate a rig."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import rigs
from rigs import cube, kinds, refused, sheet

from benchmarks.bead_images import bead_image
from fluoro_calib_ros.cli import main
from fluoro_calib_ros.errors import DataError
from fluoro_calib_ros.estimation.options import CalibrationRequest
from fluoro_calib_ros.exposures.frame import Frame
from fluoro_calib_ros.exposures.phantom import Drawing
from fluoro_calib_ros.findings import Kind
from fluoro_calib_ros.images.lattice import NOT_MARKED
from fluoro_calib_ros.io.phantom import read_phantom, write_phantom
from fluoro_calib_ros.jobs.calibration import run_calibration
from fluoro_calib_ros.jobs.extraction import ExtractionRequest, run_extraction
from fluoro_calib_ros.photogrammetry.rotations import matrix_from_vector
from fluoro_calib_ros.reconstruction.intersection import Intersector
from fluoro_calib_ros.reconstruction.reconstruct import reconstruct_exposure


def test_parts_have_ids_of_their_own_and_are_read_as_written(tmp_path):
    whole = cube(8).with_part(cube(120))
    np.testing.assert_array_equal(whole.target_id, [*range(1, 9), *range(11, 131)])
    third = whole.with_part(sheet())
    assert third.target_id[-1] == 1000 + 23 * 23
    assert [len(part.target_id) for part in third.parts()] == [8, 120, 529]
    assert len(cube().parts()) == 1
    sized = replace(cube(8), diameter_mm=np.full(8, 3.0))
    assert sized.with_part(cube()).diameter_mm is None
    both = sized.with_part(sized)
    write_phantom(tmp_path / 'both.csv', both)
    read = read_phantom(tmp_path / 'both.csv')
    assert read.equals(both)
    np.testing.assert_array_equal(read.part, both.part)
    np.testing.assert_array_equal(read.diameter_mm, both.diameter_mm)


@pytest.mark.parametrize('part', [[1, 1, 1, 1, 1, 1, 2, 2], [1, 2]])
def test_a_part_needs_targets(part):
    with pytest.raises(DataError, match='part'):
        replace(cube(8), part=np.array(part))


@pytest.mark.long
def test_a_sheet_and_a_cube_give_corrections_and_orientation():
    frames, phantom = rigs.sheet_and_cube()
    outcome = run_calibration(CalibrationRequest(frames, phantom), validate=True)
    assert outcome.result.converged
    assert outcome.validation.verdict == 'cannot tell'
    made = {check.kind for check in outcome.validation.checks if check.passed is not None}
    compare = {Kind.HALVES, Kind.WHITENESS, Kind.DRIFT, Kind.VARIATION, Kind.ORIENTATION}
    assert made.isdisjoint({*compare, Kind.PRECISION})
    assert Kind.PAIRS_CONTRADICT not in kinds(outcome.result.findings)
    assert outcome.orientation.exposures == 1
    for calibration in outcome.result.calibrations.values():
        # Nothing tells the noise from the errors of targets that are seen once.
        assert rigs.FINE_NOISE_PX / 2 < calibration.image_sd < 4 * rigs.FINE_NOISE_PX
    assert shape_error_mm(outcome.result.calibrations, outcome.orientation) < 0.2


def shape_error_mm(calibrations, orientation) -> float:
    """Return the RMS error of reconstructed points, after a motion of all of them."""
    xyz = np.random.default_rng(8).uniform(-60, 60, (50, 3))
    frames = {}
    for fluoroscope in rigs.rig().fluoroscopes:
        uv = fluoroscope.distortion.distort(fluoroscope.ideal(xyz))
        name = fluoroscope.name
        frames[name] = Frame(
            name, 1, np.arange(50), uv, (1024, 1024), np.full(50, rigs.FINE_NOISE_PX)
        )
    points = reconstruct_exposure(frames, calibrations, Intersector(orientation)).points
    found = points.xyz_mm[np.isfinite(points.xyz_mm).all(axis=1)]
    assert len(found) == 50
    found, true = found - found.mean(axis=0), xyz - xyz.mean(axis=0)
    u, _, v = np.linalg.svd(found.T @ true)
    rotation = u @ np.diag([1, 1, np.linalg.det(u @ v)]) @ v
    return float(np.sqrt(np.mean(np.sum((found @ rotation - true) ** 2, axis=1))))


@pytest.mark.parametrize('which', [0, 1])
def test_two_exposures_of_one_target_are_too_few(which):
    frames, phantom = rigs.sheet_and_cube()
    (name, shown), *_ = frames.items()
    repeated = [shown[which], replace(shown[which], number=9, uv=shown[which].uv + 5.0)]
    with refused(Kind.FEW_EXPOSURES, exposures=2, needed=3):
        run_calibration(CalibrationRequest({name: repeated}, phantom))


SIZE = 400
SMALL = 40  # beads of the small cube


def picture(xyz: np.ndarray, turn: list[float], depth: float) -> tuple[np.ndarray, np.ndarray]:
    """Return a small image of beads, and their true centres."""
    x = xyz @ matrix_from_vector(turn).T + (0, 0, depth)
    uv = 1600 * x[:, :2] / x[:, 2:] + (SIZE - 1) / 2
    return bead_image(uv, (SIZE, SIZE), np.uint8, 2.0, 0.6, 0.01), uv


@pytest.mark.long
def test_each_image_shows_one_of_the_parts(tmp_path):
    solid = cube(SMALL, 120.0)
    flat = Drawing(13, 13, pitch_mm=(18.0, 18.0, 18.0)).phantom()
    phantom = solid.with_part(flat)
    images = [
        (solid.xyz_mm, [0.3, 0.2, -0.1], 900.0),
        (flat.xyz_mm - flat.xyz_mm.mean(axis=0), [0.02, 0.03, 0.2], 1200.0),
        (solid.xyz_mm, [-0.2, 0.5, 0.4], 900.0),
    ]
    for number, image in enumerate(images, 1):
        cv2.imwrite(str(tmp_path / f'{number}.png'), picture(*image)[0])
    outcome = run_extraction(ExtractionRequest([tmp_path], phantom, 'a', workers=1))
    assert [frame.number for frame in outcome.frames] == [1, 2, 3]
    assert NOT_MARKED in outcome.notes
    for frame, image in zip(outcome.frames[::2], images[::2]):
        assert len(frame.uv) > 0.7 * SMALL
        true = picture(*image)[1][frame.target_id - 1]
        assert np.abs(frame.uv - true).max() < 0.5
    grid = outcome.frames[1]
    assert len(grid.uv) > 100
    assert (grid.target_id > 100).all()
    # The offset of an unmarked grid is arbitrary: neighbours are neighbours.
    _, true = picture(*images[1])
    away = np.linalg.norm(grid.uv[:, None] - true, axis=2)
    row, column = np.divmod(grid.target_id - 101, 13)
    true_row, true_column = np.divmod(away.argmin(axis=1), 13)
    assert away.min(axis=1).max() < 0.5
    steps = np.column_stack([row, column, np.ones(len(row))])
    places = np.column_stack([true_row, true_column])
    fitted = steps @ np.linalg.lstsq(steps, places, rcond=None)[0]
    np.testing.assert_allclose(fitted, places, atol=1e-6)


def test_a_drawing_is_added_to_a_phantom(tmp_path, capsys):
    write_phantom(tmp_path / 'cube.csv', cube())
    drawing = ['--hex', '9x9', '--pitch', '7', '--add-to', str(tmp_path / 'cube.csv')]
    main(['phantom', *drawing, str(tmp_path / 'both.csv')])
    assert '100 more than the picture' in capsys.readouterr().out
    both = read_phantom(tmp_path / 'both.csv')
    np.testing.assert_array_equal(np.unique(both.part), [1, 2])
    assert both.target_id[-1] == 100 + 81
