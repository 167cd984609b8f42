# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Services that answer a request that cannot be handled, instead of ending the node.

rclpy raises from its own services where a transition does not fit the state of a managed node, and
where a parameter has an unknown type. Without a guard one such request of any peer ends the node.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rcl_interfaces.msg import SetParametersResult
from rcl_interfaces.srv import SetParameters, SetParametersAtomically
from rclpy.node import Node

from .errors import one_line

Callback = Callable[[Any, Any], Any]


def guard_services(node: Node) -> None:
    """Let all present services of a node refuse the requests at which their callback raises."""
    for service in node.services:
        service.callback = _guarded(node, service.srv_name, service.callback)


def _guarded(node: Node, name: str, callback: Callback) -> Callback:
    def guarded(request: Any, response: Any) -> Any:
        try:
            return callback(request, response)
        except Exception as error:  # a request may contain anything
            reason = one_line(error)
            node.get_logger().error(f'service {name}: request refused: {reason}')
            return _refused(request, type(response)(), reason)

    return guarded


def _refused(request: Any, response: Any, reason: str) -> Any:
    """Return the response that says that nothing was done; its flags are false by default."""
    refusal = SetParametersResult(successful=False, reason=reason)
    if isinstance(request, SetParameters.Request):
        response.results = [refusal] * len(request.parameters)
    elif isinstance(request, SetParametersAtomically.Request):
        response.result = refusal
    elif hasattr(response, 'message'):
        response.message = reason
    return response
