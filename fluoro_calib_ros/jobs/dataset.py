"""A data set of the virtual rig on disk: bags, CSV, phantom and truth."""

from pathlib import Path

import numpy as np

from ..bags.writer import BagWriter
from ..exposures.frame import Frame
from ..exposures.phantom import Phantom
from ..files.access import make_folder
from ..files.atomic import write_text
from ..files.json_file import write_json
from ..files.observations import write_observations_csv
from ..files.phantom import write_phantom
from ..photogrammetry.rotations import quaternion_from_matrix

TRUE_SD_MM = 1e-6  # the file of the true coordinates has to name a standard deviation


def write_bag(path, frames):
    """Write {fluoroscope: [Frame, ...]} as a bag folder, in the order of the stamps."""
    with BagWriter(path, overwrite=True) as bag:
        for frame in sorted(
            (f for of_one in frames.values() for f in of_one), key=lambda f: f.stamp_ns
        ):
            bag.write_frame(frame)


def write_exposures(directory, name, rig, simulated):
    """Write exposures as NAME (bag) and NAME.csv, and their truth as truth/NAME_exposures.csv and
    truth/NAME_undistorted.csv: the observed points with perfectly known distortion taken off.
    """
    directory = Path(directory)
    write_bag(directory / name, simulated.frames)
    write_observations_csv(directory / f'{name}.csv', simulated.frames)
    perfect = {
        n: [
            Frame(f.fluoroscope, f.number, f.target_id, np.round(uv, 6), f.image_size)
            for f, uv in zip(frames, simulated.undistorted[n])
        ]
        for n, frames in simulated.frames.items()
    }
    write_observations_csv(directory / 'truth' / f'{name}_undistorted.csv', perfect)
    rows = ['fluoroscope,exposure,x_mm,y_mm,z_mm,qw,qx,qy,qz']
    for fluoroscope in rig.fluoroscopes:
        for frame, pose in zip(simulated.frames[fluoroscope.name], simulated.poses):
            rotation, position = fluoroscope.exterior(pose)
            numbers = [f'{x:.9f}' for x in (*position, *quaternion_from_matrix(rotation))]
            rows.append(','.join([fluoroscope.name, str(frame.number), *numbers]))
    write_text(directory / 'truth' / f'{name}_exposures.csv', '\n'.join(rows) + '\n')


def write_tracking(directory, tracking):
    """Write a recording of markers as tracking (bag), and their true positions as
    truth/markers.csv.
    """
    directory = Path(directory)
    write_bag(directory / 'tracking', tracking.frames)
    numbers = [frame.number for frame in next(iter(tracking.frames.values()))]
    rows = ['frame,target_id,x_mm,y_mm,z_mm']
    for number, points in zip(numbers, tracking.points_mm):
        rows += [
            f'{number},{i},{p[0]:.6f},{p[1]:.6f},{p[2]:.6f}'
            for i, p in zip(tracking.marker_id, points)
        ]
    write_text(directory / 'truth' / 'markers.csv', '\n'.join(rows) + '\n')


def write_rig(directory, rig, **made_with):
    """Write phantom.csv (the survey), truth/phantom.csv (the true coordinates) and truth/rig.json."""
    directory = Path(directory)
    make_folder(directory / 'truth')
    write_phantom(directory / 'phantom.csv', rig.phantom)
    write_phantom(
        directory / 'truth' / 'phantom.csv',
        Phantom(rig.phantom.target_id, rig.true_mm, np.full(len(rig.true_mm), TRUE_SD_MM)),
    )
    write_json(
        directory / 'truth' / 'rig.json',
        {
            'made_with': made_with,
            'fluoroscopes': {
                f.name: {
                    'interior': dict(zip(('xp', 'yp', 'c'), f.interior)),
                    'image_size': list(f.image_size),
                    'position_mm': f.position_mm,
                    'quaternion_wxyz': quaternion_from_matrix(f.rotation),
                    'distortion': {
                        'centre': f.distortion.centre,
                        'pincushion': f.distortion.pincushion,
                        's_shape': f.distortion.s_shape,
                        'spiral': f.distortion.spiral,
                        'ripples': f.distortion.ripples,
                    },
                }
                for f in rig.fluoroscopes
            },
        },
    )
