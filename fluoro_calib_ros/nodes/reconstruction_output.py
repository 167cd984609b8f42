# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Publishers of points, bodies and joints in all their forms, and their diagnostics."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from fluoro_calib_msgs.msg import BodyPoses, JointAngles, ReconstructedPoints
from rclpy.publisher import Publisher
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import JointState
from tf2_msgs.msg import TFMessage
from visualization_msgs.msg import MarkerArray

from ..bodies.body import STATUS_NAMES, Body, PoseStatus
from ..exposures.pairing import Pairer
from ..findings import Finding, first_few
from ..reconstruction.intersection import FAILED, OUTSIDE, REJECTED, SINGLE_VIEW, IntersectedPoints
from .messages.bodies import (
    BODY_FORMS,
    FORMS,
    BodiesContent,
    joint_state,
    message_from_bodies,
    message_from_joints,
    transforms_of_bodies,
)
from .messages.points import (
    POINT_FORMS,
    PointsContent,
    ellipsoid_markers,
    encode_reconstructed_points,
)
from .retractions import BodyRetractions
from .rig_input import BodiesState, BodyFollower, RigInput
from .runtime import conditions
from .runtime.conditions import InputState, counted, fails, health_of, healthy, warns
from .runtime.diagnostics import OK, WARN, Health, RecentCounts, Status
from .runtime.lifecycle import Stream, StreamNode
from .runtime.topics import observations_qos

COUNTED_STATUSES = {
    'outside': OUTSIDE,
    'rejected': REJECTED,
    'failed': FAILED,
    'in a single view': SINGLE_VIEW,
}


class PointsCounter:
    """Counts points by status."""

    def __init__(self) -> None:
        self._counts: Counter[str] = Counter()

    def add(self, points: IntersectedPoints) -> None:
        """Add points to the counts."""
        self._counts['points'] += len(points.status)
        if points.status.any():
            for name, status in COUNTED_STATUSES.items():
                self._counts[name] += int(np.count_nonzero(points.status == status))

    def values(self) -> dict[str, object]:
        """Return the counts for the diagnostics."""
        return {
            'points': self._counts['points'],
            **{f'points {name}': self._counts[name] for name in COUNTED_STATUSES},
        }


Forms = Mapping[str, tuple[type, Callable[..., Any]]]


def _output(node: StreamNode, kind: type, name: str) -> Publisher:
    """Create the publisher of a topic below reconstruction/, or of one that begins with a /."""
    topic = name if name.startswith('/') else f'reconstruction/{name}'
    return node.create_output(kind, topic, observations_qos())


def _outputs(node: StreamNode, forms: Forms) -> list[tuple[Publisher, Callable[..., Any]]]:
    """Create publishers of message types by name; return each with the maker of its messages."""
    return [(_output(node, kind, name), make) for name, (kind, make) in forms.items()]


def _publish(forms: Iterable[tuple[Publisher, Callable[..., Any]]], *content: Any) -> None:
    """Publish the forms that have subscribers."""
    for publisher, make in forms:
        if publisher.get_subscription_count():
            publisher.publish(make(*content))


class PointsOutput:
    """Publishers of reconstructed points."""

    def __init__(self, node: StreamNode) -> None:
        self._points = _output(node, ReconstructedPoints, 'points_with_covariance')
        self._ellipsoids = _output(node, MarkerArray, 'markers')
        self._forms = _outputs(node, POINT_FORMS)
        self._ellipsoids_published_ns = 0

    def publish(self, content: PointsContent, sigmas: float, rate_hz: float) -> None:
        """Publish points with their covariance, then the other forms that have subscribers.

        sigmas: half axes of the ellipsoids. rate_hz: largest rate of the ellipsoids.
        """
        data = encode_reconstructed_points(content)
        self._points.publish(data)
        forms = [form for form in self._forms if form[0].get_subscription_count()]
        now = time.monotonic_ns()
        is_due = now - self._ellipsoids_published_ns >= round(1e9 / rate_hz)
        if is_due and self._ellipsoids.get_subscription_count():
            self._ellipsoids_published_ns = now
            forms.append((self._ellipsoids, partial(ellipsoid_markers, sigmas=sigmas)))
        if not forms:
            return
        message = deserialize_message(data, ReconstructedPoints)
        good = np.flatnonzero(content.points.status <= OUTSIDE)
        for publisher, make in forms:
            publisher.publish(make(message, good))


class BodiesOutput:
    """Publishers of bodies and joints.

    names: bodies. rig_frame: parent of the frames of the bodies.
    """

    def __init__(
        self, node: StreamNode, names: Sequence[str], has_joints: bool, rig_frame: str
    ) -> None:
        self._bodies = _output(node, BodyPoses, 'body_poses')
        self._joints = _output(node, JointAngles, 'joint_angles') if has_joints else None
        transforms = partial(transforms_of_bodies, parent=rig_frame)
        joint_forms = {'joint_states': (JointState, joint_state)} if has_joints else {}
        self._forms = _outputs(node, {'/tf': (TFMessage, transforms), **FORMS, **joint_forms})
        self._forms_of_bodies = [
            _outputs(node, {f'bodies/{name}/{form}': made for form, made in BODY_FORMS.items()})
            for name in names
        ]
        self.retractions = BodyRetractions(self.publish_own)  #: of the published poses

    def publish(self, content: BodiesContent) -> None:
        """Publish an exposure; standard message types only while they have subscribers."""
        message = self.publish_own(content)
        _publish(self._forms, content, message)
        for row in content.measured:
            _publish(self._forms_of_bodies[row], content, message, row)
        self.retractions.note(content)

    def publish_own(self, content: BodiesContent) -> BodyPoses:
        """Publish the messages that have a status field; return that of the poses."""
        message = message_from_bodies(content)
        self._bodies.publish(message)
        if self._joints is not None and content.joints:
            self._joints.publish(message_from_joints(content))
        return message


NO_ORIENTATION = (
    'no orientation of the rig yet: calibrate with all fluoroscopes, '
    'or capture the phantom with the service orient'
)


@dataclass(frozen=True)
class ReconstructionState(InputState):
    """State from which the health of the reconstruction is diagnosed."""

    streams: Mapping[str, Stream]  #: by fluoroscope
    rigs: RigInput
    pairer: Pairer
    misses: Finding | None  #: why most rays of recent exposures miss each other
    timing: Finding | None  #: fault of the timing of recent exposures


def stalled_streams(state: ReconstructionState) -> Health | None:
    """Warn if streams have stopped, and append other faults of the streams."""
    messages = {name: stream.stalled() for name, stream in state.streams.items()}
    stalled = [f'{name}: {message}' for name, message in messages.items() if message]
    if not stalled:
        return None
    level, message = health_of(state, STREAM_CONDITIONS)
    other_faults = [] if level == OK else [message]
    return Health(max(level, WARN), '; '.join([*stalled, *other_faults]))


def _missing_publishers(state: ReconstructionState) -> str:
    """Return a message if nobody publishes the frames of a fluoroscope."""
    published = map(state.node.has_publisher, state.topics)
    missing = ', '.join(name for name, live in zip(state.streams, published) if not live)
    return missing and f'no publisher of corrected observations of {missing}'


def _missed_rays(state: ReconstructionState) -> str:
    """Return a message if the rays of the views do not intersect."""
    found = (state.misses, state.pairer.stamps.disagreement()) if state.misses else ()
    return '; '.join(finding.sentence for finding in found if finding is not None)


def _silent_fluoroscopes(state: ReconstructionState) -> str:
    """Return a message if fluoroscopes have stopped, so that exposures do not wait for them."""
    silent = ', '.join(sorted(state.pairer.silent))
    return (
        silent and f'no frames of {silent}, points are reconstructed from the other fluoroscopes'
    )


def _distant_stamps(state: ReconstructionState) -> str:
    """Return a message if frames of a number are far apart, or stamps fit two exposures."""
    finding = state.pairer.tolerance.finding() or state.pairer.stamps.disagreement()
    return finding.sentence if finding else ''


STREAM_CONDITIONS = (
    warns(_missing_publishers),
    fails(_missed_rays),
    warns(lambda state: state.timing and state.timing.sentence),
    warns(_silent_fluoroscopes),
    counted(
        'without_orientation',
        '{count} exposures in the last minute were corrected with calibrations to which no '
        'orientation of the rig belongs',
    ),
    conditions.refused_messages,
    warns(_distant_stamps),
    conditions.overrun_input,
    conditions.unpaired_frames,
    counted('incomplete', '{count} exposures without all fluoroscopes in the last minute'),
    healthy('reconstructing'),
)
CONDITIONS = (
    conditions.lost_messages,
    conditions.incompatible_publisher,
    warns(lambda s: '' if s.rigs.newest else s.refusals.last_fault or NO_ORIENTATION),
    conditions.inactive_node,
    stalled_streams,
    *STREAM_CONDITIONS,
)


@dataclass(frozen=True)
class BodyState:
    """State from which the health of a body is diagnosed: its row in the state of all bodies."""

    body: Body
    state: BodiesState
    row: int
    untimed: int
    recent: Mapping[str, int]

    @property
    def status(self) -> PoseStatus:
        """How the last pose of the body was obtained."""
        return PoseStatus(self.state.status[self.row])

    @property
    def unseen_s(self) -> float | None:
        """Stream time since a marker of the body was last seen [s], None if never."""
        seen = int(self.state.seen_ns[self.row])
        return None if seen < 0 else (self.state.stamp_ns - seen) * 1e-9


def _rejected_markers(body: BodyState) -> str:
    """Return a message if markers do not fit the body in most of the recent exposures."""
    shares = body.state.rejected[body.row, : len(body.body.target_id)]
    ids = body.body.target_id[: len(shares)][shares > 0.5]
    return (
        ''
        if not len(ids)
        else (
            f'markers {first_few(ids)} do not fit in most exposures: they have migrated, or the '
            'coordinates of the body are mirrored, or those of another one'
        )
    )


# Messages about the last pose of a body that has been seen, by its status.
POSE_MESSAGES = {
    PoseStatus.FAILED: 'lost, its markers were last seen {0.unseen_s:.1f} s ago',
    PoseStatus.FILLED: 'no marker is seen for {0.unseen_s:.2f} s: the pose is predicted',
    PoseStatus.AMBIGUOUS: 'its markers also fit in a second pose',
}
BODY_CONDITIONS = (
    counted('untimed', '{count} exposures in the last minute have the stamp of the one before'),
    warns(lambda body: body.unseen_s is None and 'not seen yet'),
    warns(lambda body: POSE_MESSAGES.get(body.status, '').format(body)),
    warns(_rejected_markers),
    healthy('tracked'),
)
JOINT_CONDITIONS = (
    warns(lambda joint: joint.error and f'no angles: {joint.error}'),
    warns(lambda joint: joint.needs_neutral and 'no angles before the end of the neutral trial'),
    healthy('followed'),
)


def statuses_of(follower: BodyFollower, counts: RecentCounts) -> list[Status]:
    """Return a status for each body and each joint, none before the first exposure."""
    state = follower.state
    if state is None:
        return []
    untimed = follower.untimed, counts.growth('bodies', untimed=follower.untimed)
    bodies = [BodyState(body, state, row, *untimed) for row, body in enumerate(follower.bodies)]
    return [
        *(
            Status(f'body {body.body.name}', *health_of(body, BODY_CONDITIONS), _values(body))
            for body in bodies
        ),
        *(
            Status(f'joint {joint.joint.name}', *health_of(joint, JOINT_CONDITIONS))
            for joint in follower.joints
        ),
    ]


def _values(body: BodyState) -> dict[str, object]:
    unseen = body.unseen_s
    return {
        'status': STATUS_NAMES[body.status],
        'markers seen': int(body.state.markers[body.row]),
        'markers of the body': len(body.body.target_id),
        'chi-squared over expectation': f'{body.state.misfit[body.row]:.2f}',
        'since last seen [s]': '' if unseen is None else f'{unseen:.3f}',
        'exposures without a later stamp': body.untimed,
    }
