# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0
"""Exposures of a phantom that stands still count as one."""

from dataclasses import replace

import numpy as np

from fluoro_calib_ros.exposures.collector import without_repeats
from fluoro_calib_ros.exposures.frame import Frame
from fluoro_calib_ros.findings import Kind

SIZE = (1024, 1024)


def film(poses=4, repeats=3, sd=0.1, name='a', seed=1):
    """Return frames of a phantom that stands still for some frames in each pose."""
    rng = np.random.default_rng(seed)
    out = []
    for pose in range(poses):
        uv = rng.uniform(50, 950, (40, 2))
        for k in range(repeats):
            kept = np.sort(rng.permutation(40)[:35])
            noise = rng.normal(0, sd, (35, 2))
            out.append(Frame(name, pose * repeats + k + 1, kept, uv[kept] + noise, SIZE))
    return out


def test_frames_of_a_pose_are_joined_to_their_median():
    frames = film()
    joined, findings = without_repeats({'a': frames})
    assert [frame.number for frame in joined['a']] == [1, 4, 7, 10]
    for frame in joined['a']:
        group = frames[frame.number - 1 : frame.number + 2]
        assert set(frame.target_id) == set(np.concatenate([f.target_id for f in group]))
        target = group[0].target_id[0]
        seen = [f.uv[f.target_id == target][0] for f in group if target in f.target_id]
        np.testing.assert_allclose(frame.uv[frame.target_id == target][0], np.median(seen, axis=0))
    (finding,) = findings
    assert finding.kind is Kind.REPEATED_POSE and finding.numbers['exposures'] == 8
    assert finding.place.exposures == (2, 3, 5, 6, 8, 9, 11, 12)


def test_a_false_match_of_one_frame_does_not_pass_into_the_median():
    frames = film(sd=0.01)
    spoilt = frames[1].uv.copy()
    spoilt[0] += 200
    frames[1] = replace(frames[1], uv=spoilt)
    target = frames[1].target_id[0]
    clean, _ = without_repeats({'a': film(sd=0.01)})
    joined, _ = without_repeats({'a': frames})
    if sum(target in frame.target_id for frame in frames[:3]) == 3:
        row = joined['a'][0].target_id == target
        np.testing.assert_allclose(joined['a'][0].uv[row], clean['a'][0].uv[row], atol=0.1)
    assert len(joined['a']) == 4


def test_other_poses_other_angles_and_known_orientations_are_not_joined():
    frames = film()
    moved = [replace(f, uv=f.uv + 2.0 * f.number) for f in frames]
    assert without_repeats({'a': moved}) == ({'a': moved}, [])
    turned = [replace(f, angle=0.1 * f.number) for f in frames]
    assert len(without_repeats({'a': turned})[0]['a']) == 12
    assert without_repeats({'a': frames}, known=('a',)) == ({'a': frames}, [])


def test_a_pose_is_repeated_only_where_all_fluoroscopes_see_it_so():
    """Otherwise an exposure would lose its partner."""
    one, other = film(name='a'), film(name='b', seed=2)
    joined, _ = without_repeats({'a': one, 'b': other[1:]})
    assert [f.number for f in joined['a']] == [f.number for f in joined['b']] == [1, 4, 7, 10]
    moved = [replace(f, uv=f.uv + 5.0 * (f.number == 2)) for f in other]
    joined, _ = without_repeats({'a': one, 'b': moved})
    assert [f.number for f in joined['a']] == [f.number for f in joined['b']] == [1, 2, 4, 7, 10]
