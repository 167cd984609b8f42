# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Process images of a trial to joint angles by commands: `python -m benchmarks.offline_trial`.

Ten seconds of two views of 1024 x 1024 px and 8 bits at 250 Hz, 30 markers in five bodies, in a
bag. `fluoro-calib extract` follows the markers, with ids from the shapes of the bodies,
`fluoro-calib bodies` gives poses and joint angles, and `fluoro-calib convert` the poses as C3D.
Prints the time of each command, and the errors of the poses. `--folder` keeps the rendered
data.
"""

from __future__ import annotations

import argparse
import csv
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from fluoro_calib_ros.simulation.marker_images import MarkerScene, MovingMarkers

from .extraction_live import CHAIN_SEED, write_chain

RATE_HZ = 250.0
SECONDS = 10.0
TARGET_S = 90.0
JOINTS = """
[[joint]]
name = "knee"
proximal = "bone_0"
distal = "bone_1"
convention = "cardan_yxz"

[[joint]]
name = "ankle"
proximal = "bone_2"
distal = "bone_3"
convention = "cardan_zxy"
"""


def run(command: list[str]) -> float:
    """Run a command of the package; print and return its duration in seconds."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    began = time.perf_counter()
    subprocess.run([sys.executable, '-m', 'fluoro_calib_ros.cli', *command], check=True)
    seconds = time.perf_counter() - began
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    print(f'{command[0]}: {seconds:.1f} s, {cpu:.1f} s of CPU', flush=True)
    return seconds


def compare(poses: Path, exposures: int) -> None:
    """Print the number of poses, and the errors of the rotations between them.

    Rotations are relative to the first exposure with a pose, so the rig frame does not matter.
    """
    markers = MovingMarkers(MarkerScene(), CHAIN_SEED)
    true = [markers.poses(number) for number in range(1, exposures + 1)]
    with poses.open(newline='') as file:
        rows = [row for row in csv.DictReader(file) if row['x_mm']]
    print(f'{len(rows)} poses of {exposures * markers.scene.clusters}')
    errors = []
    for number in range(markers.scene.clusters):
        own = [row for row in rows if row['body'] == f'bone_{number}']
        found = Rotation.from_quat(
            [[float(row[q]) for q in ('qx', 'qy', 'qz', 'qw')] for row in own]
        )
        at = [int(row['exposure']) - 1 for row in own]
        known = Rotation.from_matrix([true[row][number][0] for row in at])
        # A rotation about the axes of the body is the same in every rig frame.
        turned = (found[0].inv() * found).inv() * (known[0].inv() * known)
        errors.append(turned[1:].magnitude())
    rms = np.degrees(np.sqrt(np.mean(np.concatenate(errors) ** 2)))
    print(f'turns from the first exposure are off by {rms:.3f} degrees (RMS)')


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument('--seconds', type=float, default=SECONDS, help='length of the trial')
    parser.add_argument('--folder', type=Path, help='of images and results, which are kept')
    arguments = parser.parse_args()
    exposures = round(arguments.seconds * RATE_HZ)
    with tempfile.TemporaryDirectory() as temporary:
        folder = arguments.folder or Path(temporary)
        folder.mkdir(exist_ok=True)
        if not (folder / 'truth.npz').exists():
            write_chain(folder, exposures, RATE_HZ)
        (folder / 'joints.toml').write_text(JOINTS)
        known = ['--calibration', f'{folder}/calibration', '--bodies', f'{folder}/bodies.csv']
        points = f'{folder}/points.csv'
        seconds = run(
            ['extract', f'{folder}/images', '--fluoroscopes', 'a,b', *known, '--out', points]
        )
        seconds += run(
            [
                *('bodies', points, *known, '--joints', f'{folder}/joints.toml'),
                *('--rate', f'{RATE_HZ}', '--out', f'{folder}/motion'),
            ]
        )
        poses = folder / 'motion' / 'poses.csv'
        c3d = ['--to', 'c3d', '--rate', f'{RATE_HZ}', '--out', f'{folder}/poses.c3d']
        seconds += run(['convert', f'{poses}', *c3d])
        print(f'together {seconds:.1f} s; the target is {TARGET_S:.0f} s for {SECONDS:.0f} s')
        compare(poses, exposures)


if __name__ == '__main__':
    main()
