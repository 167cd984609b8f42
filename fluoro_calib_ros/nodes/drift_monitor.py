# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The drift watch of the reconstruction node: parameters, published state and alarms."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from fluoro_calib_msgs.action import Heal
from fluoro_calib_msgs.srv import Reset
from rclpy.action import ActionClient
from rclpy.client import Client
from rclpy.publisher import Publisher

from ..bodies.body import Body, declared_bodies
from ..checks.drift_charts import DriftOptions, DriftState
from ..checks.rig_watch import RigDriftWatch
from ..errors import ErrorsAt
from ..findings import Finding
from ..options import option
from ..photogrammetry.rig_orientation import RigOrientation
from .messages.status import ALARM, message_from_drift_state
from .runtime.diagnostics import ERROR, OK, WARN, Logger, Status

LEVELS = (OK, WARN, ERROR)  # diagnostic levels, indexed by the level of a DriftState


@dataclass(frozen=True)
class DriftParameters:
    """Parameters of the drift watch that the node handles."""

    drift_watch: bool = option(True, 'whether the stream is watched for drift of the calibration')
    drift_rate: float = option(
        120.0,
        'maximum rate of the exposures that the drift watch examines',
        minimum=1.0,
        maximum=10000.0,
        unit='Hz',
    )
    clusters: tuple[str, ...] = option(
        ('',),
        "rigid clusters of targets, each a text such as 'tibia: 1001 1002 1003'",
    )
    collect_on_drift: bool = option(
        False,
        'whether drift of level ERROR calls the service collect_anew of the calibration node',
    )
    heal_on_drift: bool = option(
        False,
        'whether drift of level ERROR starts the action heal of the calibration node',
    )

    def __post_init__(self) -> None:
        self.rigid_bodies()

    def rigid_bodies(self) -> tuple[Body, ...]:
        """Return the declared bodies. Raises DataError for a text that declares none."""
        with ErrorsAt('clusters'):
            return declared_bodies(filter(None, self.clusters))


class DriftMonitor:
    """Creates the drift watch of each orientation, and publishes the state of the newest."""

    def __init__(
        self,
        names: Sequence[str],
        parameters: DriftParameters,
        options: DriftOptions,
        logger: Logger,
    ) -> None:
        self._names = tuple(names)
        self._parameters = parameters
        self._options = options
        self._bodies = parameters.rigid_bodies()
        self._logger = logger
        self.reset()

    def use(self, parameters: DriftParameters, options: DriftOptions) -> bool:
        """Use new parameters and options; return whether the watches must be created anew."""
        previous = self._parameters, self._options
        self._parameters = parameters
        self._options = options
        self._bodies = parameters.rigid_bodies()
        actions = {
            name: getattr(parameters, name) for name in ('collect_on_drift', 'heal_on_drift')
        }
        return (replace(previous[0], **actions), previous[1]) != (parameters, options)

    def reset(self) -> None:
        """Discard image sizes, exposures and alarms."""
        self._sizes: dict[str, tuple[int, int]] = {}
        #: watch, orientation and stamp [ns] of the newest exposure; set by the stream's thread
        self.newest: tuple[RigDriftWatch | None, RigOrientation, int] | None = None
        self._alarmed = False

    def connect(self, publisher: Publisher, collect_anew: Client, heal: ActionClient) -> None:
        """Set the publisher of the state, and the clients of the calibration node for alarms."""
        self._publisher = publisher
        self._collect_anew = collect_anew
        self._heal = heal

    def set_image_size(self, name: str, size: tuple[int, int]) -> bool:
        """Set the image size of a fluoroscope; return whether it has changed."""
        if self._sizes.get(name) == size:
            return False
        self._sizes = {**self._sizes, name: size}
        return True

    def make_watch(self, orientation: RigOrientation) -> RigDriftWatch | None:
        """Return the watch of an orientation, None if it is disabled or image sizes are missing.

        Raises ValueError (including DataError) for an orientation that cannot be watched.
        """
        if not self._parameters.drift_watch or self._missing_sizes():
            return None
        return RigDriftWatch(
            orientation,
            self._sizes,
            self._options,
            self._bodies,
            self._parameters.drift_rate,
        )

    def publish_state(self) -> list[Status]:
        """Publish the state of the watch; return its diagnostics, empty without exposures."""
        newest = self.newest
        if not self._parameters.drift_watch or newest is None:
            return []
        watch, orientation, stamp_ns = newest
        if watch is None:
            missing = ', '.join(self._missing_sizes())
            return [Status('drift', WARN, f'drift is not watched: no camera_info of {missing}')]
        state = watch.state
        message = message_from_drift_state(state, stamp_ns, orientation)
        self._publisher.publish(message)
        is_alarm = state.level == ALARM
        if is_alarm and not self._alarmed:
            self._raise_alarm(state)
        self._alarmed = is_alarm
        values = _values(state, watch.widening)
        return [Status('drift', LEVELS[state.level], state.message, values)]

    def _missing_sizes(self) -> list[str]:
        return [name for name in self._names if name not in self._sizes]

    def _raise_alarm(self, state: DriftState) -> None:
        self._logger.error(state.message)
        if self._parameters.collect_on_drift:
            if self._collect_anew.service_is_ready():
                self._collect_anew.call_async(Reset.Request())
            else:
                self._logger.error(
                    'the service collect_anew is not available: no new exposures are collected'
                )
        if self._parameters.heal_on_drift:
            if self._heal.server_is_ready():
                self._heal.send_goal_async(Heal.Goal())
            else:
                self._logger.error('the action heal is not available: the rig is not healed')


def _values(state: DriftState, widening: Finding | None) -> dict[str, object]:
    return {
        'standard deviations': 'as calibrated' if widening is None else widening.sentence,
        'fluoroscope': state.fluoroscope,
        'place': state.place,
        'source': state.source,
        'size [px]': f'{state.size:.2f}',
        'sd [px]': f'{state.sd:.2f}',
        'evidence': f'{state.evidence:.1f}',
        'threshold of WARN': f'{state.threshold_warn:.1f}',
        'threshold of ERROR': f'{state.threshold_error:.1f}',
        'since [s]': f'{state.since_s:.1f}',
        'observations': state.observations,
    }
