# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Representations of results in a console are short, whatever their arrays contain."""

from dataclasses import fields, is_dataclass

import numpy as np

import fluoro_calib_ros as fc


def test_arrays_are_shown_by_their_shape_and_scalars_as_they_are():
    phantom = fc.Phantom(np.arange(1, 504), np.zeros((503, 3)), np.full(503, 0.1))
    assert repr(phantom) == (
        '<Phantom target_id=array(503,), xyz_mm=array(503, 3), sd_mm=array(503,), '
        'diameter_mm=None, part=None>'
    )
    frame = fc.Frame('a', 7, np.array([1, 2]), np.array([[1 / 3, 2], [3, 4]]), (640, 480))
    shown = repr(frame)
    assert "fluoroscope='a', number=7, target_id=[1, 2], uv=[[0.333333, 2], [3, 4]]" in shown
    assert 'image_size=[640, 480]' in shown
    request = fc.CalibrationRequest({'a': [frame] * 15}, phantom)
    assert repr(request).startswith('<CalibrationRequest frames={a}, phantom=Phantom, ')
    survey = fc.Survey(phantom, fc.Names(), ('a', 'b', 'c', 'd', 'x' * 1000))
    assert 'notes=[5 str]' in repr(survey) and len(repr(survey)) < 200


def test_no_result_of_the_api_shows_its_arrays():
    """The default repr of a dataclass shows all fields: some four million characters here."""
    for name in dir(fc):
        kind = getattr(fc, name)
        if is_dataclass(kind) and any('rray' in str(field.type) for field in fields(kind)):
            assert not hasattr(kind.__repr__, '__wrapped__'), name
