# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The covariance matrix of all unknowns in a result folder."""

import numpy as np
import pytest
import rigs

from fluoro_calib_ros.errors import DataError
from fluoro_calib_ros.estimation.calibrate import adjust_with_calibrations
from fluoro_calib_ros.io.result_document import read_covariance
from fluoro_calib_ros.jobs.result_folder import save_result


@pytest.mark.long
@pytest.mark.parametrize('model', ['parametric', 'none', 'held'])
def test_covariance_matrix_holds_the_precision_of_all_unknowns(model, tmp_path):
    """With or without unknowns of the correction, and with a fixed calibration."""
    result = rigs.calibrated('a', 6, model='none' if model == 'held' else model, max_iterations=2)
    if model == 'held':
        frames = {'a': rigs.exposures()['a'][6:10]}
        result = adjust_with_calibrations(frames, rigs.rig().phantom, result.calibrations)
    save_result(tmp_path / 'out', result, covariance=True)
    found = read_covariance(tmp_path / 'out' / 'a.covariance.npz')
    u = len(found.names)
    assert found.values.shape == (u,) and found.covariance.shape == (u, u) == (u, len(found.names))
    assert len(set(found.names)) == u
    np.testing.assert_allclose(found.covariance, found.covariance.T, atol=1e-9)
    variance = np.diagonal(found.covariance)
    assert (variance >= 0).all()
    assert (found.covariance**2 <= 1.001 * np.outer(variance, variance) + 1e-9).all()
    sd = dict(zip(found.names, np.sqrt(np.diagonal(found.covariance))))
    value = dict(zip(found.names, found.values))
    figures = result.fluoroscopes['a']
    for e in figures.exposures:
        for part, own, own_sd in zip('xyz', e.position_mm, e.sd_mm):
            name = f'exposure {e.exposure} of a: {part}'
            assert value[name] == pytest.approx(own) and sd[name] == pytest.approx(
                own_sd, rel=1e-3
            )
    for part, own_sd in zip(('xp', 'yp', 'c'), figures.interior_sd):
        assert sd[f'a: {part}'] == pytest.approx(own_sd, rel=1e-3)
    targets = result.targets
    for row in (0, len(targets.target_id) - 1):
        name = f'target {targets.target_id[row]}: z'
        assert value[name] == pytest.approx(targets.xyz_mm[row, 2])
        assert sd[name] == pytest.approx(np.sqrt(targets.covariance[row, 2, 2]), rel=1e-3)
    with pytest.raises(DataError, match='not a covariance file'):
        read_covariance(tmp_path / 'out' / 'result.json')
