# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The calibration node's parameter describes a model that is added to the registry."""

from fluoro_calib_ros.correction import registry
from fluoro_calib_ros.correction.neighbours import KnnModel
from fluoro_calib_ros.nodes.calibration_node import PARAMETERS
from fluoro_calib_ros.nodes.runtime.parameters import descriptor_of, parameters_of


def test_the_parameter_model_lists_an_added_model(monkeypatch):
    class AddedModel(KnnModel):
        kind = 'added'

    monkeypatch.setitem(registry.MODELS, 'added', AddedModel)
    descriptor = descriptor_of(parameters_of(PARAMETERS)['model'])
    assert 'added' in descriptor.description and 'added' in descriptor.additional_constraints
