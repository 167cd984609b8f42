# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The data sets: image points of identified targets and their surveyed coordinates."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from fluoro_calib_ros.exposures.frame import Frame, points_on_image
from fluoro_calib_ros.exposures.phantom import Phantom

from .sources import CUBE_TEST, CUBE_TRAIN, OPENCV_NUMBERS, PLANE_TEST, PLANE_TRAIN, PM, ZHANG

CAMERA = 'camera'
MIN_SURVEY_SD_MM = 1e-3
MIN_TARGETS = 12  # in an exposure for calibration or test
IDS_OF_BOARD = 1000
BOARD_SD_MM = 0.1  # for boards of unstated accuracy
INCH_MM = 25.4
ORPC_HEADER = 5
FISHEYE_RADIUS_PX = 280.0  # about 35 degrees off the axis
FISHEYE_PX = 380.0
AICON_STEP = 3  # use every third of 115 exposures
CHESSBOARD = (9, 6)
SQUARE_MM = 25.0  # the true size is not published and only scales the board


@dataclass(frozen=True)
class DataSet:
    """Image points of one camera.

    Attributes
    ----------
    name : str
    title : str
        Camera and target.
    solid : bool
        False for a flat target.
    frames : list of Frame
        Exposures with 12 targets or more, in the order of their numbers.
    phantom : Phantom
    principal_distance : float or None
        Initial value [px] for a lens whose distortion obscures it.
    """

    name: str
    title: str
    solid: bool
    frames: list[Frame]
    phantom: Phantom
    principal_distance: float | None = None

    @property
    def image_size(self) -> tuple[int, int]:
        """Width and height [px]."""
        return self.frames[0].image_size


def _data_set(
    name: str, title: str, solid: bool, frames: list[Frame], phantom: Phantom
) -> DataSet:
    """Return a set without outside or unsurveyed points and exposures with too few targets."""
    kept = []
    for frame in frames:
        good = points_on_image(frame.uv, frame.image_size)
        good &= phantom.index(frame.target_id) >= 0
        if good.sum() >= MIN_TARGETS:
            kept.append(
                Frame(
                    CAMERA, frame.number, frame.target_id[good], frame.uv[good], frame.image_size
                )
            )
    return DataSet(name, title, solid, kept, phantom)


def _numbers(line: str) -> list[float]:
    """Return the numbers of a line, or an empty list if it contains anything else."""
    try:
        return [float(word) for word in line.split()]
    except ValueError:
        return []


def _blocks(lines: Iterator[str]) -> Iterator[np.ndarray]:
    """Yield blocks of lines of numbers, separated by empty lines, as arrays of their rows."""
    block: list[list[float]] = []
    for line in lines:
        row = _numbers(line)
        if row:
            block.append(row)
        elif not line.strip():
            yield np.array(block) if block else np.zeros((0, 0))
            block = []


def photomodeler(path: Path, name: str, title: str, solid: bool, unit_mm: float) -> DataSet:
    """Read a text export of PhotoModeler.

    Blocks are separated by empty lines: one block for each photograph, then control points, object
    points (id, coordinates, standard deviations), and image points (photograph, id, column, row).
    Pixel centres are at 0.5.
    """
    lines = path.read_text(encoding='latin-1').splitlines()
    size = tuple(int(v) for v in lines[1].split()[2:4])
    last = max(i for i, line in enumerate(lines) if '\\' in line)  # path of the last photograph
    end = next(i for i in range(last, len(lines)) if not lines[i].strip())
    rest = lines[end + 1 :]
    # The interior orientation of the photograph follows the empty line, then comes another empty
    # line.
    start = next(i for i, line in enumerate(rest) if not line.strip())
    _, points, marks, *_ = _blocks(iter(rest[start + 1 :]))
    _, row, times = np.unique(points[:, 0], return_index=True, return_counts=True)
    points = points[row[times == 1]]  # an id with two positions is invalid
    phantom = Phantom(
        points[:, 0].astype(int),
        unit_mm * points[:, 1:4],
        np.maximum(unit_mm * np.sqrt(np.mean(points[:, 4:7] ** 2, axis=1)), MIN_SURVEY_SD_MM),
    )
    frames = []
    for number in np.unique(marks[:, 0]):
        rows = marks[marks[:, 0] == number]
        ids = rows[:, 1].astype(int)
        frames.append(Frame(CAMERA, int(number) + 1, ids, rows[:, 2:4] - 0.5, (size[0], size[1])))
    return _data_set(name, title, solid, frames, phantom)


def _boards(path: Path) -> list[np.ndarray]:
    """Return points (n, 3) [cm] of every board in a target description of BabelCalib."""
    boards: list[list[list[float]]] = []
    for line in path.read_text().splitlines():
        words = line.split(',')
        if len(words) == 2:  # second line of a board: the family of tags
            boards.append([])
        elif len(words) == 6:
            boards[-1].append([float(word) for word in words[3:]])
    return [np.array(board) for board in boards]


def _poses(path: Path) -> dict[int, np.ndarray]:
    """Return poses (3, 4) [mm] of boards by index, from a file of BabelCalib."""
    lines = [line for line in path.read_text().splitlines() if not line.startswith('#')]
    return {
        int(lines[i]): np.array([_numbers(line) for line in lines[i + 1 : i + 4]])
        for i in range(0, len(lines) - 3, 4)
    }


def _central(frame: Frame) -> Frame:
    """Return the middle of a fisheye frame: its rim, 60 degrees off the axis, maps to no plane."""
    middle = (np.array(frame.image_size) - 1) / 2
    near = np.linalg.norm(frame.uv - middle, axis=1) <= FISHEYE_RADIUS_PX
    return replace(frame, target_id=frame.target_id[near], uv=frame.uv[near])


def _corner_files(paths: list[Path], used: set[int]) -> list[Frame]:
    """Return frames from corner files of BabelCalib for the boards in use."""
    frames = []
    for number, path in enumerate(paths, 1):
        lines = path.read_text().splitlines()
        head = dict(line.split(': ') for line in lines[:ORPC_HEADER])
        rows = np.array([[float(v) for v in line.split(',')] for line in lines[ORPC_HEADER:]])
        rows = rows[np.isin(rows[:, 0], list(used))]
        ids = (IDS_OF_BOARD * rows[:, 0] + rows[:, 1]).astype(int)
        size = (int(head['width']), int(head['height']))
        frames.append(_central(Frame(CAMERA, number, ids, rows[:, 3:5], size)))
    return frames


def babelcalib_cube(folder: Path) -> DataSet:
    """Read three non-coplanar boards."""
    base = folder / 'ylochman/babelcalib/data/ov_cube'
    poses = _poses(base / 'ov_cube.tp')
    ids = []
    xyz = []
    for index, points in enumerate(_boards(base / 'ov_cube.dsc')):
        if index in poses:
            ids.append(IDS_OF_BOARD * index + np.arange(len(points)))
            xyz.append(10 * points @ poses[index][:, :3].T + poses[index][:, 3])
    found = np.concatenate(xyz)
    phantom = Phantom(np.concatenate(ids), found, np.full(len(found), BOARD_SD_MM))
    paths = [base / 'corners/train' / f'{name}.orpc' for name in CUBE_TRAIN]
    paths += [base / 'corners/test' / f'{name}.orpc' for name in CUBE_TEST]
    frames = _corner_files(sorted(paths, key=lambda p: p.name), set(poses))
    title = 'OmniVision fisheye, middle, three boards'
    found_set = _data_set('ov_cube', title, True, frames, phantom)
    return replace(found_set, principal_distance=FISHEYE_PX)


def babelcalib_plane(folder: Path) -> DataSet:
    """Read one board."""
    base = folder / 'ylochman/babelcalib/data/ov_plane'
    points = 10 * _boards(base / 'ov_plane.dsc')[0]
    phantom = Phantom(np.arange(len(points)), points, np.full(len(points), BOARD_SD_MM))
    stem = 'br0_cam01-2020-05-07-'
    paths = [base / 'corners/train' / f'{stem}{name}.orpc' for name in PLANE_TRAIN]
    paths += [base / 'corners/test' / f'{stem}{name}.orpc' for name in PLANE_TEST]
    frames = _corner_files(sorted(paths, key=lambda p: p.name), {0})
    title = 'OmniVision fisheye, middle, board'
    found = _data_set('ov_plane', title, False, frames, phantom)
    return replace(found, principal_distance=FISHEYE_PX)


def chessboards(folder: Path, side: str) -> DataSet:
    """Detect the corners in the sample images of OpenCV."""
    columns, rows = CHESSBOARD
    grid = np.array([[x, y, 0] for y in range(rows) for x in range(columns)]) * SQUARE_MM
    phantom = Phantom(np.arange(len(grid)), grid, np.full(len(grid), BOARD_SD_MM))
    frames = []
    stop = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 100, 1e-4)
    for number in OPENCV_NUMBERS:
        path = folder / f'opencv/opencv/samples/data/{side}{number:02d}.jpg'
        coded = np.frombuffer(path.read_bytes(), dtype=np.uint8)
        image = cv2.imdecode(coded, cv2.IMREAD_GRAYSCALE)
        found, corners = cv2.findChessboardCorners(image, CHESSBOARD)
        if found:
            refined = cv2.cornerSubPix(image, corners, (5, 5), (-1, -1), stop)
            size = (image.shape[1], image.shape[0])
            uv = refined.reshape(-1, 2).astype(float)
            frames.append(Frame(CAMERA, number, np.arange(len(grid)), uv, size))
    return _data_set(f'opencv_{side}', f'webcam ({side}), chessboard', False, frames, phantom)


def zhang(folder: Path) -> DataSet:
    """Read the views of Zhang: corners of 64 squares, in inches."""
    base = folder / 'imagingbook/imagingbook-calibrate' / ZHANG
    flat = np.array((base / 'Model.txt').read_text().split(), dtype=float).reshape(-1, 2)
    xyz = np.column_stack([flat, np.zeros(len(flat))]) * INCH_MM
    phantom = Phantom(np.arange(len(xyz)), xyz, np.full(len(xyz), BOARD_SD_MM))
    frames = []
    for number in range(1, 6):
        text = (base / f'data{number}.txt').read_text()
        uv = np.array(text.split(), dtype=float).reshape(-1, 2)
        frames.append(Frame(CAMERA, number, np.arange(len(uv)), uv, (640, 480)))
    return _data_set('zhang', 'PULNiX CCD, 64 squares', False, frames, phantom)


def aicon(folder: Path) -> DataSet:
    """Read AICON files: image points in mm from the middle of the image, y up."""
    base = folder / 'applied-geodesy/bundle-adjustment/JAICOV/example'
    last = (base / 'example.ior').read_text().split()[-4:]
    sensor = np.array([float(last[0]), float(last[1])])
    size = (int(last[2]), int(last[3]))
    survey = np.loadtxt(base / 'example.obc')
    phantom = Phantom(
        survey[:, 0].astype(int),
        survey[:, 1:4],
        np.maximum(np.sqrt(np.mean(survey[:, 4:7] ** 2, axis=1)), MIN_SURVEY_SD_MM),
    )
    marks = np.loadtxt(base / 'example.phc')
    marks = marks[marks[:, 9] > 0]
    uv = marks[:, 2:4] / sensor * [size[0], -size[1]] + (np.array(size) - 1) / 2
    frames = []
    for number in np.unique(marks[:, 0])[::AICON_STEP]:
        rows = marks[:, 0] == number
        frames.append(Frame(CAMERA, int(number), marks[rows, 1].astype(int), uv[rows], size))
    return _data_set('aicon', '50 megapixels, coded targets in space', True, frames, phantom)


def _photomodeler_of(
    name: str, title: str, file: str, solid: bool, unit_mm: float = 1e3
) -> Callable[[Path], DataSet]:
    """Return the reader of one network of DBAT."""
    return lambda folder: photomodeler(
        folder / 'niclasborlin/dbat' / file, name, title, solid, unit_mm
    )


# In the repository, the names of networks 2 and 3 are interchanged, as their photographs show.
READERS: dict[str, Callable[[Path], DataSet]] = {
    'camcal': _photomodeler_of(
        'camcal', 'Olympus C4040Z, sheet', f'{PM}/net1-C404Z-2d.txt', False
    ),
    'canon40d': _photomodeler_of(
        'canon40d', 'Canon 40D, sheet', f'{PM}/net3-canon7d-2d.txt', False
    ),
    'canon7d': _photomodeler_of('canon7d', 'Canon 7D, sheet', f'{PM}/net2-canon40d-2d.txt', False),
    'exom': _photomodeler_of(
        'exom',
        'eXom (drone), test field',
        'data/hamburg2017/stpierre/pmexports/camcal_exom-pmexport.txt',
        True,
    ),
    'canon7d_3d': _photomodeler_of(
        'canon7d_3d', 'Canon 7D, test field', f'{PM}/net4-canon7d-3d.txt', True
    ),
    'canon5d_3d': _photomodeler_of(
        # The unit is not stated; this one makes a facade of about ten metres.
        'canon5d_3d',
        'Canon 5D, facade, by hand',
        f'{PM}/net5-canon5d-3d.txt',
        True,
        1e4,
    ),
    'ov_cube': babelcalib_cube,
    'ov_plane': babelcalib_plane,
    'opencv_left': lambda folder: chessboards(folder, 'left'),
    'opencv_right': lambda folder: chessboards(folder, 'right'),
    'zhang': zhang,
    'aicon': aicon,
}
