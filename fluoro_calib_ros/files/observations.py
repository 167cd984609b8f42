"""Observations as CSV: `fluoroscope,exposure,target_id,u,v[,sigma]`, u, v and sigma in pixels."""

import numpy as np

from ..errors import DataError
from ..exposures.frame import Frame, points_on_image
from .access import check_safe_name
from .atomic import atomic_file
from .csv_table import cell_of, read_blocks, write_rows

COLUMNS = ('fluoroscope', 'exposure', 'target_id', 'u', 'v')


def read_observations_csv(path, image_size=None):
    """Frames {fluoroscope: [Frame, ...]} of a CSV file, fluoroscopes by name and exposures by
    number.

    image_size (width, height) [px] of all fluoroscopes, which the file does not tell. The rows of
    a frame need not be together. An empty sigma is unknown: in all rows of a frame, or in none.
    Raises DataError that names the row and the cause: not a number, a point off the image, a
    target twice in a frame.
    """
    if image_size is None:
        raise DataError(
            f'{path}: a CSV file does not tell the size of the image, --image-size WxH is needed'
        )
    names = {}
    parts = []
    for block in read_blocks(path, COLUMNS):
        parts.append(_numbers_of(block, names, image_size))
    code, exposure, target, uv, sigma, lines = (np.concatenate(part) for part in zip(*parts))
    names = list(names)
    rank = np.argsort(np.argsort(names))  # fluoroscopes by name, whatever comes first in the file
    order = np.lexsort((exposure, rank[code]))  # stable: within a frame the file's order stays
    starts = np.flatnonzero(
        np.diff(code[order], prepend=-1) | np.diff(exposure[order], prepend=-1)
    )
    frames = {name: [] for name in sorted(names)}
    for rows in np.split(order, starts[1:]):
        frame = _frame(
            path, names[code[rows[0]]], exposure, target, uv, sigma, lines, rows, image_size
        )
        frames[frame.fluoroscope].append(frame)
    return frames


def write_observations_csv(path, frames):
    """Write frames, {fluoroscope: [Frame, ...]} or a sequence of Frames, to a CSV file.

    The column sigma is there where any frame has it. Raises DataError where the file cannot be
    written.
    """
    if isinstance(frames, dict):
        frames = [frame for of_one in frames.values() for frame in of_one]
    with_sigma = any(frame.sigma is not None for frame in frames)
    with atomic_file(path, 'w') as file:
        write_rows(file, [COLUMNS + ('sigma',) * with_sigma])
        for frame in frames:
            check_safe_name(frame.fluoroscope, path)
            write_rows(file, _rows_of(frame, with_sigma))


def _numbers_of(block, names, image_size):
    """Columns of a block as arrays; names {fluoroscope: code} grows by those it has."""
    texts = block.text('fluoroscope')
    for name in dict.fromkeys(texts):
        if name not in names:
            check_safe_name(name, f'{block.path}, row {block.lines[texts.index(name)]}')
            names[name] = len(names)
    uv = np.column_stack([block.floats('u'), block.floats('v')])
    on_image = points_on_image(uv, image_size)
    if not on_image.all():
        index = int(np.argmin(on_image))
        block.fail(
            index,
            f'the point ({uv[index, 0]:g}, {uv[index, 1]:g}) is off the image of '
            f'{image_size[0]} x {image_size[1]} px',
        )
    sigma = np.full(len(uv), np.nan)
    if 'sigma' in block:
        sigma = block.floats_or_nan('sigma')
        known = np.array([cell != '' for cell in block.text('sigma')])
        block.check(
            'sigma', ~known | (np.isfinite(sigma) & (sigma > 0)), 'not a finite number above 0'
        )
    code = np.array([names[name] for name in texts])
    return code, block.ids('exposure'), block.ids('target_id'), uv, sigma, block.lines


def _frame(path, name, exposure, target, uv, sigma, lines, rows, image_size):
    where = f'of fluoroscope {name}, exposure {exposure[rows[0]]}'
    order = np.argsort(target[rows], kind='stable')
    twice = np.flatnonzero(np.diff(target[rows][order]) == 0)
    if len(twice):
        first = rows[order[twice[0]]]
        second = rows[order[twice[0] + 1]]
        raise DataError(
            f'{path}, row {lines[second]}: target {target[second]} {where} is there already, '
            f'in row {lines[first]}'
        )
    unknown = np.isnan(sigma[rows])
    if unknown.any() and not unknown.all():
        row = rows[np.argmax(unknown)]
        raise DataError(
            f'{path}, row {lines[row]}: sigma of target {target[row]} {where} is empty, '
            f'but other targets of this exposure have one'
        )
    return Frame(
        name,
        int(exposure[rows[0]]),
        target[rows],
        uv[rows],
        tuple(int(s) for s in image_size),
        None if unknown.all() else sigma[rows],
        0,
        f'{name}_optical',
    )


def _rows_of(frame, with_sigma):
    columns = [
        np.asarray(frame.target_id).tolist(),
        *(map(repr, np.asarray(c, float).tolist()) for c in frame.uv.T),
    ]
    if with_sigma:
        sigma = np.full(len(frame.target_id), np.nan) if frame.sigma is None else frame.sigma
        columns.append(map(cell_of, sigma))
    return ([frame.fluoroscope, int(frame.number), *cells] for cells in zip(*columns))
