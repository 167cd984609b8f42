# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Diagnostics of bodies and joints: conditions of each, the gravest first."""

from __future__ import annotations

from dataclasses import dataclass

from ..bodies.body import STATUS_NAMES, Body, PoseStatus
from ..bodies.joint_tracking import JointTracker
from .body_following import BodiesState, BodyFollower
from .runtime.diagnostics import OK, Health, RecentCounts, Status, health_of, warning


@dataclass(frozen=True)
class BodyState:
    """What the diagnostics of a body are decided by: its row in the state of all bodies."""

    body: Body
    state: BodiesState
    row: int
    untimed: int
    untimed_recently: int

    @property
    def status(self) -> PoseStatus:
        """How its last pose was obtained."""
        return PoseStatus(self.state.status[self.row])

    @property
    def unseen_s(self) -> float | None:
        """Time of the stream since an exposure showed a marker of it [s], None before."""
        seen = int(self.state.seen_ns[self.row])
        return None if seen < 0 else (self.state.stamp_ns - seen) * 1e-9


def exposures_without_time(state: BodyState) -> Health | None:
    """Exposures have the stamp of the one before."""
    count = state.untimed_recently
    text = f'{count} exposures in the last minute have the stamp of the one before'
    return warning(text if count else '')


def unseen_body(state: BodyState) -> Health | None:
    """No exposure has shown the body."""
    return warning('' if state.unseen_s is not None else 'not seen yet')


def lost_body(state: BodyState) -> Health | None:
    """The body is lost."""
    text = f'lost, its markers were last seen {state.unseen_s or 0:.1f} s ago'
    return warning(text if state.status == PoseStatus.FAILED else '')


def predicted_body(state: BodyState) -> Health | None:
    """No marker is seen, but the body is not lost yet."""
    text = f'no marker is seen for {state.unseen_s or 0:.2f} s: the pose is predicted'
    return warning(text if state.status == PoseStatus.FILLED else '')


def ambiguous_body(state: BodyState) -> Health | None:
    """Its markers fit in a second pose."""
    text = 'its markers fit in a second pose, too'
    return warning(text if state.status == PoseStatus.AMBIGUOUS else '')


def tracked_body(state: BodyState) -> Health:
    """Nothing is wrong."""
    return Health(OK, 'tracked')


BODY_CONDITIONS = (
    exposures_without_time,
    unseen_body,
    lost_body,
    predicted_body,
    ambiguous_body,
    tracked_body,
)


def failed_neutral(joint: JointTracker) -> Health | None:
    """The neutral trial has passed without a neutral position."""
    return warning('' if joint.error is None else f'no angles: {joint.error}')


def awaited_neutral(joint: JointTracker) -> Health | None:
    """The neutral trial has not passed."""
    return warning('no angles before the end of the neutral trial' if joint.needs_neutral else '')


def followed_joint(joint: JointTracker) -> Health:
    """Nothing is wrong."""
    return Health(OK, 'followed')


JOINT_CONDITIONS = (failed_neutral, awaited_neutral, followed_joint)


def statuses_of(follower: BodyFollower, counts: RecentCounts) -> list[Status]:
    """Return a status for each body and each joint, nothing before the first exposure."""
    state = follower.state
    if state is None:
        return []
    untimed = follower.untimed, counts.growth('bodies', untimed=follower.untimed)['untimed']
    bodies = [BodyState(body, state, row, *untimed) for row, body in enumerate(follower.bodies)]
    return [
        *(
            Status(f'body {one.body.name}', *health_of(one, BODY_CONDITIONS), _values(one))
            for one in bodies
        ),
        *(
            Status(f'joint {one.joint.name}', *health_of(one, JOINT_CONDITIONS))
            for one in follower.joints
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
