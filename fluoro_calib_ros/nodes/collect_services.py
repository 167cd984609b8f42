# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The services of a calibration node that collect exposures and discard them."""

from __future__ import annotations

from fluoro_calib_msgs.srv import Capture, Reset
from rclpy.parameter import Parameter

from ..errors import DataError
from .calibration_output import CalibrationOutput
from .calibration_settings import RigSetup
from .exposure_input import ExposureInput
from .runtime.lifecycle import StreamNode
from .runtime.parameters import check_timeout
from .runtime.services import Requests, ServiceEntry, within

NOT_ACTIVE = 'the node is not active, so no frames come in'


class CollectServices:
    """The services capture, reset and collect_anew."""

    def __init__(
        self,
        node: StreamNode,
        rig: RigSetup,
        exposures: ExposureInput,
        output: CalibrationOutput,
        requests: Requests,
    ) -> None:
        self._node = node
        self._rig = rig
        self._exposures = exposures
        self._output = output
        self._requests = requests
        self.services = (
            ServiceEntry('capture', Capture, self._on_capture),
            ServiceEntry('reset', Reset, self._on_reset),
            ServiceEntry('collect_anew', Reset, self._on_collect_anew),
        )

    async def _on_capture(
        self, request: Capture.Request, response: Capture.Response
    ) -> Capture.Response:
        timeout = request.timeout_sec or self._rig.settings().node.capture_timeout
        try:
            self._check(timeout)
        except ValueError as error:  # DataError among them
            response.message = str(error)
            return response
        captured = self._exposures.capture()
        with self._requests.one():
            found = await within(
                self._node, timeout, captured, lambda: self._exposures.give_up(captured)
            )
        response.success = found is not None
        if found is not None:
            number, response.exposures = found
            response.message = f'frame {number} captured, {response.exposures} exposures now'
        else:
            names = self._rig.names
            streams = self._exposures.streams.values()
            received = ', '.join(f'{stream.name} {stream.received}' for stream in streams)
            response.exposures = self._exposures.collected(names[0]).exposures
            response.message = self._exposures.capture_refusal or (
                f'no frame of all fluoroscopes ({", ".join(names)}) came within {timeout:g} s; '
                f'frames received: {received}'
            )
        return response

    def _check(self, timeout_s: float) -> None:
        """Raise ValueError, DataError among them, where nothing can be captured."""
        self._rig.required_phantom()
        check_timeout(timeout_s)
        if not self._node.readers:
            raise DataError(NOT_ACTIVE)
        waiting = self._requests.waiting
        if waiting >= self._rig.settings().limits.max_waiting:
            raise DataError(
                f'{waiting} requests wait for their answers, as many as max_waiting allows'
            )

    def _on_reset(self, _: Reset.Request, response: Reset.Response) -> Reset.Response:
        count = self._exposures.reset()
        self._output.refused.clear()
        response.success = True
        response.message = f'{count} exposures discarded, the calibration stays in use'
        return response

    def _on_collect_anew(self, request: Reset.Request, response: Reset.Response) -> Reset.Response:
        self._node.set_parameters([Parameter('collect', value='still')])
        self._on_reset(request, response)
        response.message += (
            '; new exposures are collected whenever the phantom stands still in a new pose'
        )
        self._node.get_logger().info(response.message)
        return response
