# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Analysis files of SLEAP (HDF5), one file a camera: points of skeletons in frames of a video.

Rows are frames from 0. Pixel centres are at integers from (0, 0), v downwards.
"""

from __future__ import annotations

import io
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ...errors import DataError
from ...exposures.frame import Frame, points_on_image
from ...exposures.names import Names, number_names
from ..access import check_safe_name, make_folder, write_bytes
from .content import Content, FileSettings, Format, Sample, Written
from .reader_process import HDF5, hdf5_arrays, require_h5py
from .tables import default_name, named_targets, with_sigma_of_likelihood

LEAST_SCORE = 1e-6  # below it a point weighs nothing beside the others
_OF_VIDEO = re.compile(r'.*\.\d{3}_(?P<video>.+)')  # <project>.<number of the video>_<video>


def read(path: Path, settings: FileSettings) -> Content:
    """Read image points of one camera, named after the file. Raises DataError."""
    arrays = hdf5_arrays('sleap', path)
    uv = arrays['uv']
    score = arrays['score']
    targets = _targets(path, arrays)
    if uv.shape != (*score.shape, 2) or score.shape[1] * score.shape[2] != len(targets):
        raise DataError(f'{path}: tracks, point_scores and node_names are of different sizes')
    uv = uv.reshape(len(uv), len(targets), 2)
    score = score.reshape(len(uv), len(targets))
    score = np.where(np.isnan(score), 1.0, score)  # labelled by hand
    size = settings.image_size_of(path)
    ids = number_names(targets, settings.names.targets)
    target_id = np.array([ids[name] for name in targets], dtype=np.int64)
    fluoroscope = _fluoroscope(path, settings)
    placed = np.isfinite(uv).all(axis=2)
    seen = placed & (score > LEAST_SCORE) & (score < 1 / LEAST_SCORE)
    frames = []
    for number in np.flatnonzero(seen.any(axis=1)):
        points = uv[number, seen[number]]
        if not points_on_image(points, size).all():
            raise DataError(
                f'{path}, frame {number}: a point is off the image of {size[0]} x {size[1]} px'
            )
        frames.append(
            Frame(
                fluoroscope,
                int(number),
                target_id[seen[number]],
                points,
                size,
                frame_id=f'{fluoroscope}_optical',
            )
        )
    likelihood = [score[frame.number, seen[frame.number]] for frame in frames]
    frames = with_sigma_of_likelihood(frames, likelihood)
    unsure = int(np.count_nonzero(placed & ~seen))
    return Content(
        observations={fluoroscope: frames} if frames else {},
        names=Names(named_targets({name: ids[name] for name in targets})),
        notes=(f'{path}: {unsure} points are not used, their score is 0 or no score',)
        if unsure
        else (),
    )


def _targets(path: Path, arrays: dict[str, np.ndarray]) -> list[str]:
    """Return the names of the points: nodes, of several tracks with the name of each."""
    nodes = arrays['nodes'].tolist()
    tracks = arrays['tracks'].tolist()
    count = arrays['uv'].shape[1]
    if count > 1:
        tracks = tracks if len(tracks) == count else [f'track_{k}' for k in range(count)]
        nodes = [f'{track} {node}' for track in tracks for node in nodes]
    if len(set(nodes)) < len(nodes):
        raise DataError(f'{path}: two points have the same name')
    return nodes


def _fluoroscope(path: Path, settings: FileSettings) -> str:
    """Return the fluoroscope of a file, <project>.000_<video>.analysis.h5: its video."""
    name = path.name.removesuffix(path.suffix).removesuffix('.analysis')
    found = _OF_VIDEO.fullmatch(name)
    return settings.fluoroscope_of(found['video'] if found else name, path)


def write(path: Path, content: Content, settings: FileSettings) -> Written:
    """Write a folder with a file <fluoroscope>.analysis.h5 each. Raises DataError."""
    observations = content.observations or {}
    for name in observations:
        check_safe_name(name, path)
    require_h5py(path)
    make_folder(path)
    named = content.names.target_names()
    written = tuple(str(path / f'{name}.analysis.h5') for name in observations)
    for file, frames in zip(written, observations.values()):
        write_bytes(file, _content_of(frames, named))
    return Written(written)


def _content_of(frames: Sequence[Frame], named: dict[int, str]) -> bytes:
    """Return an analysis file of one track, as SLEAP orders it, with scores of 1."""
    import h5py

    ids = sorted({int(i) for frame in frames for i in frame.target_id})
    count = 1 + max(frame.number for frame in frames)
    uv = np.full((1, 2, len(ids), count), np.nan)
    for frame in frames:
        uv[0, :, np.searchsorted(ids, frame.target_id), frame.number] = frame.uv
    seen = np.isfinite(uv[:, 0])
    score = np.where(seen, 1.0, np.nan)
    occupied = seen.any(axis=1)
    values = {
        'tracks': uv,
        'track_occupancy': occupied.T.astype(np.uint8),
        'point_scores': score,
        'instance_scores': np.where(occupied, 1.0, np.nan),
        'tracking_scores': np.where(occupied, 1.0, np.nan),
    }
    buffer = io.BytesIO()
    with h5py.File(buffer, 'w') as file:
        for name, array in values.items():
            file.create_dataset(name, data=array, compression='gzip')
        texts = {
            'node_names': [named.get(i, default_name(i)) for i in ids],
            'track_names': ['track_0'],
            'edge_names': [],
        }
        for name, names in texts.items():
            file.create_dataset(name, data=np.array([n.encode() for n in names], dtype='S'))
        file.create_dataset('edge_inds', data=np.zeros((0, 2), dtype=int))
        file['labels_path'] = file['video_path'] = ''
        file['video_ind'] = 0
        file['provenance'] = '{}'
    return buffer.getvalue()


def _is_hdf5(sample: Sample) -> bool:
    return sample.head.startswith(HDF5)


FORMAT = Format(
    'sleap',
    'SLEAP analysis points',
    parts=('observations',),
    recognise=_is_hdf5,
    read=read,
    write=write,
    looks_like='an HDF5 file with the datasets tracks, node_names and point_scores',
    one_camera=True,
)
