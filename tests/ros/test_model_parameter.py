# Copyright 2026 fluoro_calib_ros maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""A model that is added to the registry is described by the calibration node's parameter."""

from fluoro_calib_ros.distortion import registry
from fluoro_calib_ros.distortion.knn import KnnModel
from fluoro_calib_ros.nodes.calibration_node import PARAMETERS
from fluoro_calib_ros.nodes.runtime.parameters import descriptor_of, parameters_of


def test_the_parameter_model_lists_an_added_model(monkeypatch):
    class AddedModel(KnnModel):
        kind = 'added'

    monkeypatch.setitem(registry.MODELS, 'added', AddedModel)
    descriptor = descriptor_of(parameters_of(PARAMETERS)['model'])
    assert 'added' in descriptor.description and 'added' in descriptor.additional_constraints
