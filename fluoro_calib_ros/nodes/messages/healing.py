# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Heal.action: what has changed in a rig."""

from __future__ import annotations

from fluoro_calib_msgs.action import Heal

from ...findings import sentences
from ...jobs.healing import CHANGED_MEANWHILE, HealingOutcome
from ...photogrammetry.rig_orientation import RigOrientation


def fill_healing(result: Heal.Result, outcome: HealingOutcome, parent: RigOrientation) -> None:
    """Fill in the result of a diagnosis. parent: the orientation before."""
    result.success = True
    result.verdict = outcome.verdict
    result.parent_orientation_id = parent.orientation_id
    result.findings = sentences(outcome.findings)
    result.probability = [float(one) for one in outcome.diagnosis.probability]
    result.checks = [check.sentence for check in outcome.checks if not check.passed]
    result.exposures = outcome.exposures
    result.place_sd_mm = float(outcome.after.place_mm)
    result.scale_sd = float(outcome.after.scale)
    _fill_changes(result, outcome)
    what = list(result.findings)
    if outcome.changed_meanwhile:
        what.insert(0, CHANGED_MEANWHILE)
    result.message = '; '.join(
        [
            *(what or ['no change is evident']),
            outcome.common_motion.sentence,
            outcome.unseen_distortion.sentence,
            f'verdict: {outcome.verdict}',
        ]
    )


def healing_text(feedback: Heal.Feedback) -> str:
    """Return the feedback of a healing in one line, for people."""
    if feedback.stage == 'collecting':
        return f'healing: {feedback.frames} frames of markers'
    return f'healing: diagnosis, step {feedback.step} of {feedback.steps}'


def _fill_changes(result: Heal.Result, outcome: HealingOutcome) -> None:
    """Fill in the changes of the fluoroscopes that have changed."""
    healed = outcome.healed
    if healed is None:
        return
    result.orientation_id = outcome.orientation.orientation_id
    for f, name in enumerate(outcome.orientation.fluoroscopes):
        if not healed.changes[f].any() and f not in healed.drift:
            continue
        result.fluoroscope = [*result.fluoroscope, name]
        result.distortion = [*result.distortion, f in healed.drift]
        result.change = [*result.change, *healed.changes[f].tolist()]
        result.sd = [*result.sd, *healed.sd[f].tolist()]
