"""From frames to a network: checks, start values and what has to be left out."""

from dataclasses import dataclass

import numpy as np

from ..errors import DataError
from ..exposures.frame import validate_frame
from ..photogrammetry.network import Network
from ..photogrammetry.resection import principal_distance_of, resect, robust_dlt
from ..photogrammetry.rotations import rotation_angle
from ..photogrammetry.unknowns import Parameters

MIN_EXPOSURES = 3
MIN_TARGETS_OF_EXPOSURE = 12
ONE_POSE_RAD = np.deg2rad(2.0)
ONE_POSE_MM = 20.0
MISFIT = 8.0  # an exposure whose resection is that many times worse than the median does not fit


@dataclass(frozen=True)
class Measured:
    """A network with what it was made from.

    network; start values; fluoroscopes and image_size (F); frames: the frame of every exposure
    row; target_id (n,) of the object points; left_out: one sentence for every frame that was not
    used.
    """

    network: Network
    start: Parameters
    fluoroscopes: tuple
    image_size: tuple
    frames: tuple
    target_id: np.ndarray
    left_out: tuple


def nominal_interior(image_size, principal_distance):
    """Interior orientation (3,) with the principal point in the middle of the image [px]."""
    return np.array([(image_size[0] - 1) / 2, (image_size[1] - 1) / 2, principal_distance])


def measured_network(
    frames,
    phantom,
    principal_distance=None,
    interior=None,
    interior_free=True,
    corrections=None,
    min_exposures=MIN_EXPOSURES,
    raise_if_cancelled=None,
):
    """Network, start values and index of the frames of one or more fluoroscopes.

    frames: {fluoroscope: [Frame, ...]}; principal_distance: start value [px], None: from the
    observations; interior: {fluoroscope: (3,)} known orientations, used instead of start values;
    corrections: {fluoroscope: uv (n, 2) -> duv (n, 2)} applied for the resection;
    raise_if_cancelled(): called for every exposure. Raises DataError for wrong frames, too few
    exposures or targets, and exposures that show one pose only.
    """
    used = []
    orientations = []
    interiors = []
    left_out = []
    for name, of_fluoroscope in frames.items():
        ordered, skipped = _usable_frames(name, of_fluoroscope, phantom, min_exposures)
        correct = (corrections or {}).get(name, np.zeros_like)
        known = None if interior is None else np.asarray(interior[name])
        found, start, misfits = _resect_all(
            ordered, phantom, principal_distance, known, correct, raise_if_cancelled
        )
        if min_exposures > 1:
            _refuse_one_pose(name, found)
        used += [frame for frame, orientation in zip(ordered, found) if orientation is not None]
        orientations += [
            (f, orientation)
            for f, orientation in zip([len(interiors)] * len(found), found)
            if orientation is not None
        ]
        if sum(o is not None for o in found) < min_exposures:
            raise DataError(
                f'fluoroscope {name}: only {sum(o is not None for o in found)} of {len(found)} '
                f'exposures fit the phantom, {min_exposures} are needed; the first that does not: '
                f'{(skipped + misfits)[0]}'
            )
        interiors.append(start)
        left_out += skipped + misfits
    network, target_id = _index(
        used, [f for f, _ in orientations], phantom, len(interiors), interior_free
    )
    start = Parameters(
        np.array(interiors),
        np.array([o.rotation for _, o in orientations]),
        np.array([o.position_mm for _, o in orientations]),
        network.survey_mm.copy(),
    )
    sizes = tuple(next(f.image_size for f in used if f.fluoroscope == name) for name in frames)
    return Measured(network, start, tuple(frames), sizes, tuple(used), target_id, tuple(left_out))


def _usable_frames(name, frames, phantom, min_exposures):
    """The frames in order of their number, those with too few targets left out, and a sentence for
    each.
    """
    ordered = []
    left_out = []
    for frame in sorted((f.sorted() for f in frames), key=lambda f: f.number):
        validate_frame(frame, phantom, frames[0].image_size)
        if ordered and ordered[-1].number == frame.number:
            raise DataError(f'fluoroscope {name}: exposure {frame.number} is there twice')
        if len(frame.target_id) < MIN_TARGETS_OF_EXPOSURE:
            left_out.append(
                f'fluoroscope {name}, exposure {frame.number}: {len(frame.target_id)} targets are '
                f'too few, {MIN_TARGETS_OF_EXPOSURE} are needed'
            )
        else:
            ordered.append(frame)
    if len(ordered) < min_exposures:
        few = f', {len(left_out)} more have too few targets' if left_out else ''
        raise DataError(
            f'fluoroscope {name}: {len(ordered)} exposures are too few, '
            f'{min_exposures} are needed{few}'
        )
    return ordered, left_out


def _resect_all(frames, phantom, principal_distance, known, correct, raise_if_cancelled):
    """Resections (None where one fails), interior orientation (3,) and a sentence for every
    failure.
    """
    pairs = [(phantom.xyz_mm[phantom.index(f.target_id)], f.uv - correct(f.uv)) for f in frames]
    projections = []
    sentences = []
    for frame, (xyz, uv) in zip(frames, pairs):
        if raise_if_cancelled is not None:
            raise_if_cancelled()
        try:
            projections.append(robust_dlt(xyz, uv, seed=0))
        except DataError as error:
            projections.append(None)
            sentences.append(f'fluoroscope {frame.fluoroscope}, exposure {frame.number}: {error}')
    if known is None:
        distances = [principal_distance_of(p) for p in projections if p is not None]
        if not distances:
            raise DataError(sentences[0])
        known = nominal_interior(
            frames[0].image_size, principal_distance or float(np.median(distances))
        )
    found = []
    for frame, projection, (xyz, uv) in zip(frames, projections, pairs):
        try:
            found.append(None if projection is None else resect(xyz, uv, known, projection))
        except DataError as error:
            found.append(None)
            sentences.append(f'fluoroscope {frame.fluoroscope}, exposure {frame.number}: {error}')
    typical = np.median([f.scale for f in found if f is not None]) if any(found) else np.inf
    for i, (frame, orientation) in enumerate(zip(frames, found)):
        if orientation is not None and orientation.scale > MISFIT * typical:
            sentences.append(
                f'fluoroscope {frame.fluoroscope}, exposure {frame.number}: the image points do not '
                f'fit the phantom, their residuals are about {orientation.scale:.0f} px'
            )
            found[i] = None
    return found, known, sentences


def _refuse_one_pose(name, resections):
    """Raise DataError where all exposures show the phantom in one pose."""
    found = [r for r in resections if r is not None]
    if len(found) < 2:
        return
    turn = max(rotation_angle(r.rotation @ found[0].rotation.T) for r in found)
    places = np.array([-r.rotation @ r.position_mm for r in found])
    # Along the axis a distance is known an order worse than across it.
    shift = np.max(np.abs(places - places[0]) / (1, 1, 10))
    if turn < ONE_POSE_RAD and shift < ONE_POSE_MM:
        raise DataError(
            f'fluoroscope {name}: all {len(found)} exposures show the phantom in one pose (turned by at '
            f'most {np.rad2deg(turn):.1f} degrees); turn and move it between the exposures'
        )


def _index(frames, fluoroscope, phantom, n_fluoroscopes, interior_free):
    """The network of frames that are in order, and the target ids (n,) of its object points."""
    counts = [len(f.target_id) for f in frames]
    rows = phantom.index(np.concatenate([f.target_id for f in frames]))
    used, point = np.unique(rows, return_inverse=True)
    sigma = np.concatenate(
        [np.ones(len(f.target_id)) if f.sigma is None else f.sigma for f in frames]
    )
    network = Network(
        np.concatenate([f.uv for f in frames]),
        sigma,
        np.repeat(np.arange(len(frames)), counts),
        point,
        np.array(fluoroscope),
        phantom.xyz_mm[used],
        phantom.sd_mm[used],
        np.full(n_fluoroscopes, bool(interior_free)),
    )
    return network, phantom.target_id[used]
