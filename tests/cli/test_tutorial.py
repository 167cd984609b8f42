# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The commands of docs/tutorial.md run exactly as written there."""

import csv
import re
import shlex
from pathlib import Path

import numpy as np
import pytest

from fluoro_calib_ros.cli import main

TEXT = (Path(__file__).parents[2] / 'docs' / 'tutorial.md').read_text()
OFFLINE = TEXT.partition('## 10. Live')[0]
COMMANDS = [shlex.split(line)[1:] for line in re.findall('^    (fluoro-calib .*)$', OFFLINE, re.M)]
RIG = re.search('```toml\n(.*?)```', TEXT, re.S)[1]


@pytest.mark.long
def test_commands_of_the_tutorial(tmp_path, monkeypatch, capsys):
    """From XMALab's tables to points; validate and report are slow and have their own tests."""
    monkeypatch.chdir(tmp_path)
    assert len(COMMANDS) == 14
    for command in COMMANDS:
        if command[0] == 'calibrate':
            Path('rig.toml').write_text(RIG)
            capsys.readouterr()
        if command[0] not in ('validate', 'report'):
            main(command)
        if command[0] in ('calibrate', 'adjust', 'orient'):
            assert 'change it with' not in capsys.readouterr().err  # rig.toml states unit and sd
    assert 'marker' in Path('walk_undistorted.csv').read_text()
    assert Path('points.png').stat().st_size and Path('points.c3d').stat().st_size
    assert len(list(Path('mayacam').iterdir())) == 2

    with open('points.csv') as file:
        found = {(int(r['frame']), int(r['target_id'])): r for r in csv.DictReader(file)}
    with open('lab/truth/markers.csv') as file:
        truth = {(int(r['frame']), int(r['target_id'])): r for r in csv.DictReader(file)}
    keys = sorted(found)
    ours, true = (
        np.array([[float(rows[key][axis]) for axis in axes] for key in keys])
        for rows, axes in ((found, 'xyz'), (truth, ('x_mm', 'y_mm', 'z_mm')))
    )
    # Compare distances: they do not depend on the frame, here that of exposure 1.
    first = [k for k, key in enumerate(keys) if key[0] == keys[0][0]]
    apart = [
        np.linalg.norm(points[first][:, None] - points[first][None], axis=2)
        for points in (ours, true)
    ]
    assert np.sqrt(np.mean((apart[0] - apart[1]) ** 2)) < 0.3
