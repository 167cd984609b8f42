"""A verdict on a calibration from the exposures it was made of: pass, fail, or cannot tell.

Seven checks, each a number with a limit. How the limits were found, how often they are exceeded
without cause and what size of fault they find is in docs/verdict.md. `validate` recalibrates
parts of the exposures: two halves and FOLDS folds, so it takes some six times as long as the
calibration.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import chi2

from ..calibration.calibrate import CalibrationResult, adjust_with_calibrations, calibrate
from ..calibration.initial_network import MIN_EXPOSURES
from ..calibration.request import CalibrationRequest
from ..calibration.result import FluoroscopeCalibration
from ..errors import DataError
from ..exposures.frame import Frame
from ..exposures.phantom import Phantom
from .bead_check import distances, intersect
from .field_comparison import difference, place_name
from .residual_tests import common_trend, moved, residuals_of

FOLDS = 4
# of the calibration of a part: few exposures converge slowly, and by then no longer visibly
MAX_ROUNDS = 25
GOOD_EXPOSURES = 15  # with fewer, more of them are the first advice
MIN_BEADS = 10  # for distances
NAMED = 5  # beads named at most
# Limits of what has no null distribution of its own, from simulated rigs: docs/verdict.md,
# benchmarks/verdict.py.
HALVES_LIMIT = 1.9
HELD_OUT_MARGIN = (
    0.13  # over what is expected, at GOOD_EXPOSURES; it grows as the root of their number falls
)
EXPOSURE_LIMIT = 1.6
DISTANCES_LIMIT = 1.12
CLAIMED_SD = (
    3.0  # standard deviations of the correction by which the mean residual of an area may lie off
)
BEADS_ALARM = 2e-3  # chance that the survey of any bead of a good phantom is called wrong
BEADS_FACTOR = (
    1.1  # for the part of the orientations' and the calibration's errors that beads have in common
)


@dataclass(frozen=True)
class Check:
    """One check of a calibration.

    name; fluoroscope, '' where all take part; value and limit in unit, NaN where there is none;
    passed, None where it could not be made; sentence: what was found and, unless it passed, what
    to do; place (u, v) [px] or None.
    """

    name: str
    fluoroscope: str
    value: float
    limit: float
    unit: str
    passed: bool | None
    sentence: str
    place: tuple | None = None


@dataclass(frozen=True)
class Validation:
    """The verdict on the calibrations of a job.

    verdict 'pass', 'fail' or 'cannot tell'; checks; calibration_id by fluoroscope; seconds it
    took.
    """

    verdict: str
    checks: tuple
    calibration_id: dict
    seconds: float

    @property
    def findings(self):
        """A sentence for every check that failed, then for every one that could not be made."""
        return tuple(
            c.sentence for wanted in (False, None) for c in self.checks if c.passed is wanted
        )


@dataclass(frozen=True)
class _Scene:
    """What is validated: the request with the frames that are used, in order, and its result."""

    request: CalibrationRequest
    calibrations: Mapping[str, FluoroscopeCalibration]
    raise_if_cancelled: Callable[[], None] | None

    @property
    def frames(self) -> Mapping[str, Sequence[Frame]]:
        return self.request.frames

    @property
    def phantom(self) -> Phantom:
        return self.request.phantom

    @property
    def groups(self) -> list[tuple[str, ...]]:
        """Names of the fluoroscopes that are calibrated together."""
        return self.request.groups

    def part(
        self, names: Sequence[str], is_chosen: Callable[[int], bool]
    ) -> dict[str, list[Frame]]:
        """Return the frames of some fluoroscopes whose position in order is chosen."""
        return {
            name: [f for i, f in enumerate(self.frames[name]) if is_chosen(i)] for name in names
        }

    def calibrated(
        self, frames: Mapping[str, Sequence[Frame]]
    ) -> dict[str, FluoroscopeCalibration]:
        """Calibrate a part of the frames. Raises DataError where it does not suffice."""
        options = self.request.options
        distance = self.request.principal_distance
        if options.interior == 'fixed':  # the parts hold what the whole held
            distance = float(np.mean([self.calibrations[name].interior[2] for name in frames]))
        options = replace(options, max_iterations=min(options.max_iterations, MAX_ROUNDS))
        return calibrate(
            frames,
            self.phantom,
            options,
            self.request.joint,
            distance,
            raise_if_cancelled=self.raise_if_cancelled,
        ).calibrations

    def adjusted(
        self,
        frames: Mapping[str, Sequence[Frame]],
        calibrations: Mapping[str, FluoroscopeCalibration],
    ) -> CalibrationResult:
        """Adjust frames with calibrations held."""
        return adjust_with_calibrations(
            frames,
            self.phantom,
            calibrations,
            self.request.options.loss,
            raise_if_cancelled=self.raise_if_cancelled,
        )


def validate(
    request: CalibrationRequest,
    calibrations: Mapping[str, FluoroscopeCalibration],
    progress: Callable[[str, int, int], None] | None = None,
    raise_if_cancelled: Callable[[], None] | None = None,
) -> Validation:
    """Validate calibrations with the exposures that they were made from.

    Parameters
    ----------
    request : CalibrationRequest
        What the calibrations were made from.
    calibrations : mapping of str to FluoroscopeCalibration
        By fluoroscope.
    progress : callable, optional
        Called with the name of a step, the number of steps done and their total before each step.
    raise_if_cancelled : callable, optional
        Called before every step of an adjustment; may raise to stop.

    Returns
    -------
    Validation

    Raises
    ------
    DataError
        For frames that cannot be adjusted with the calibrations.
    """
    began = time.perf_counter()
    result = adjust_with_calibrations(
        request.frames,
        request.phantom,
        calibrations,
        request.options.loss,
        raise_if_cancelled=raise_if_cancelled,
    )
    frames = _used_frames(request.frames, result)
    scene = _Scene(replace(request, frames=frames), calibrations, raise_if_cancelled)
    steps = _Steps(progress, 1 + len(scene.groups) * (1 + FOLDS))
    steps('residuals and beads')
    residuals = {name: residuals_of(result, name, frames[name]) for name in frames}
    trends = {name: _trend_checks(scene, name, residuals[name]) for name in frames}
    has_trend = any(not t[0].passed for t in trends.values())
    beads = bead_checks(intersect(result, frames, request.phantom), has_trend)
    checks = []
    for names in scene.groups:
        halves = _halves_checks(scene, names, steps)
        held = _held_out_checks(scene, names, {n: trends[n][0] for n in names}, steps)
        for name in names:
            checks += [halves[name], *trends[name], *held[name]]
    checks += beads
    return Validation(
        verdict_of(checks),
        tuple(checks),
        {n: c.calibration_id for n, c in calibrations.items()},
        time.perf_counter() - began,
    )


def _used_frames(
    frames: Mapping[str, Sequence[Frame]], result: CalibrationResult
) -> dict[str, list[Frame]]:
    """Return the frames that an adjustment used, in the order of their numbers."""
    out = {}
    for name, of_fluoroscope in frames.items():
        used = {e.exposure for e in result.fluoroscopes[name].exposures}
        out[name] = sorted((f for f in of_fluoroscope if f.number in used), key=lambda f: f.number)
    return out


def validate_or_report(
    request: CalibrationRequest,
    calibrations: Mapping[str, FluoroscopeCalibration],
    progress: Callable[[str, int, int], None] | None = None,
    raise_if_cancelled: Callable[[], None] | None = None,
) -> Validation:
    """Validate, and give the verdict 'cannot tell' with its cause where that raises DataError."""
    try:
        return validate(request, calibrations, progress, raise_if_cancelled)
    except DataError as error:
        sentence = f'the validation could not be made: {error}'
        check = Check('validation', '', np.nan, np.nan, '', None, sentence)
        identities = {n: c.calibration_id for n, c in calibrations.items()}
        return Validation('cannot tell', (check,), identities, 0.0)


def verdict_of(checks):
    """'fail' where a check failed, else 'cannot tell' where one could not be made, else 'pass'."""
    passed = [c.passed for c in checks]
    return 'fail' if False in passed else 'cannot tell' if None in passed or not passed else 'pass'


class _Steps:
    """Tells progress."""

    def __init__(self, progress, total):
        self._progress = progress
        self._total = total
        self._done = 0

    def __call__(self, sentence):
        if self._progress is not None:
            self._progress(sentence, self._done, self._total)
        self._done += 1


def _more(count):
    """Advice on how many exposures to take, of count that are there."""
    return f'take {max(GOOD_EXPOSURES - count, 5)} more exposures (there are {count})'


def _where(uv, image_size):
    """Place of a pixel in words and numbers."""
    return f'the {place_name(uv, image_size)} of the image (about u {uv[0]:.0f}, v {uv[1]:.0f})'


def _judged(name, fluoroscope, value, limit, unit, found, advice, place=None, suspect=False):
    """Check with its sentence: what was found and, unless value is within limit, the advice;
    suspect: a trend in the residuals may be the cause, and comes first.
    """
    good = bool(value <= limit)
    if suspect:
        advice = 'look at it again when the residuals have no trend any more'
    return Check(
        name,
        fluoroscope,
        float(value),
        float(limit),
        unit,
        good,
        found if good else f'{found}: {advice}',
        None if place is None else tuple(float(x) for x in place),
    )


# -- two halves


def _halves_checks(scene, names, steps):
    """Check 'halves' {fluoroscope: Check} of the fluoroscopes of a group."""
    steps(f'{"+".join(names)}: two halves')
    fewest = min(len(scene.frames[name]) for name in names)
    if fewest < 2 * MIN_EXPOSURES:
        reason = f'{fewest} exposures are too few for two halves of {MIN_EXPOSURES} or more'
        return {name: _not_made('halves', name, reason, fewest) for name in names}
    try:
        halves = [scene.calibrated(scene.part(names, lambda i, h=h: i % 2 == h)) for h in (0, 1)]
    except DataError as error:
        return {
            name: _not_made(
                'halves', name, f'half of the exposures cannot be calibrated ({error})', fewest
            )
            for name in names
        }
    return {
        name: _halves_check(name, halves[0][name], halves[1][name], len(scene.frames[name]))
        for name in names
    }


def _not_made(name, fluoroscope, reason, count):
    return Check(
        name,
        fluoroscope,
        np.nan,
        np.nan,
        '',
        None,
        f'fluoroscope {fluoroscope}: check {name} could not be made, {reason}; {_more(count)}',
    )


def _halves_check(name, one, other, count):
    found = difference(one, other)
    if found is None:
        return _not_made(
            'halves',
            name,
            'two halves of the exposures cover too little of the image in common',
            count,
        )
    expected = float(np.sqrt(np.mean(found.sd**2)))
    return _judged(
        'halves',
        name,
        found.normalised,
        HALVES_LIMIT,
        'predicted sd',
        f'fluoroscope {name}: two halves of the exposures give corrections that differ by '
        f'{found.rms_px:.2f} px, where {expected:.2f} px is predicted, most at '
        f'{_where(found.worst, one.image_size)}',
        f'{_more(count)} that show beads there, and see that phantom and fluoroscope stand still in each',
        found.worst,
    )


# -- residuals


def _trend_checks(scene, name, residuals):
    """Checks 'whiteness', 'worst_area' and 'drift' of a fluoroscope."""
    calibration = scene.calibrations[name]
    count = len(scene.frames[name])
    size = calibration.image_size
    inliers = residuals.inliers(calibration.image_sd)
    common = common_trend(inliers, size)
    later = moved(inliers, size)
    where = _where(common.place, size)
    model = calibration.model
    # What the calibration says itself of the errors of its correction is no fault.
    everywhere = float(np.sqrt(np.mean(model.evaluate(inliers.uv).sd ** 2)))
    there = max(float(model.evaluate(common.place[None]).sd[0]), everywhere)
    white = _judged(
        'whiteness',
        name,
        common.size,
        np.hypot(common.limit, everywhere),
        'px',
        f'fluoroscope {name}: the residuals keep a trend of {common.size:.2f} px, most at {where}',
        _advice_on_trend(scene.request.options.model, model.kind, count),
        common.place,
    )
    area = _judged(
        'worst_area',
        name,
        common.cell_size,
        np.hypot(common.cell_limit, CLAIMED_SD * there),
        'px',
        f'fluoroscope {name}: the worst mean residual of an area, {common.cell_size:.2f} px, is at {where}',
        f'{_more(count)} that show beads there, or choose another model',
        common.place,
    )
    overall = later.size > later.limit or later.cell_size <= later.cell_limit
    value, limit = (later.size, later.limit) if overall else (later.cell_size, later.cell_limit)
    drift = _judged(
        'drift',
        name,
        value,
        limit,
        'px',
        f'fluoroscope {name}: earlier and later exposures differ by {later.size:.2f} px, most at '
        f'{_where(later.place, size)} by {later.cell_size:.2f} px',
        'the distortion has changed between the exposures; take them anew in one go, with nothing '
        'switched, moved or warming up',
        later.place,
        not white.passed,
    )
    return white, area, drift


def _advice_on_trend(wanted, kind, count):
    if kind == 'none':
        return 'calibrate with a correction model (--model auto), it was made without one'
    other = '' if wanted == 'auto' else ', or choose another model (--model auto)'
    return (
        f'the correction model {kind} does not follow the distortion there; {_more(count)} that show beads '
        f'there{other}'
    )


# -- held-out exposures


def _held_out_checks(scene, names, whiteness, steps):
    """Checks 'held_out' and 'exposures' {fluoroscope: (Check, Check)}; whiteness: that check by
    fluoroscope.
    """
    fewest = min(len(scene.frames[name]) for name in names)
    folds = min(FOLDS, fewest)
    sums = {name: [] for name in names}
    try:
        for k in range(FOLDS):
            steps(f'{"+".join(names)}: held-out exposures, part {k + 1} of {FOLDS}')
            if k < folds:
                _one_fold(scene, names, lambda i, k=k: i % folds == k, sums)
    except DataError as error:
        reason = f'a part of the exposures cannot be calibrated or adjusted alone ({error})'
        return {
            name: tuple(
                _not_made(check, name, reason, fewest) for check in ('held_out', 'exposures')
            )
            for name in names
        }
    return {
        name: _held_out(name, sums[name], whiteness[name], len(scene.frames[name]))
        for name in names
    }


def _one_fold(scene, names, out, sums):
    """Adds to sums, for every exposure held out: number, image points, squared residuals [px^2]
    out of sample and in sample, and the predicted variance of the correction. In sample, the same
    exposures are adjusted in the same way, so that what the adjustment takes from the residuals is
    the same.
    """
    held = scene.part(names, out)
    calibrations = scene.calibrated(scene.part(names, lambda i: not out(i)))
    jobs = [
        scene.adjusted(held, c) for c in (calibrations, {n: scene.calibrations[n] for n in names})
    ]
    for name in names:
        sd = scene.calibrations[name].image_sd
        outside, inside = (residuals_of(job, name, held[name]) for job in jobs)
        if not np.array_equal(outside.numbers, inside.numbers):
            raise DataError(
                f'fluoroscope {name}: an exposure does not fit a calibration without it'
            )
        predicted = 2 * calibrations[name].model.evaluate(outside.uv).sd ** 2
        for e, number in enumerate(outside.numbers):
            rows = outside.exposure == e
            sums[name].append(
                (
                    int(number),
                    rows.sum(),
                    outside.capped(sd)[rows].sum(),
                    inside.capped(sd)[rows].sum(),
                    predicted[rows].sum(),
                )
            )


def _held_out(name, sums, white, count):
    """Checks 'held_out' and 'exposures' from the sums of _one_fold; white: the check of whiteness."""
    number, n, outside, inside, predicted = (np.array(column) for column in zip(*sums))
    # What is left of a trend in sample is no noise.
    noise = np.maximum(inside - 2 * n * white.value**2, 0.05 * inside)
    value, expected = (
        float(np.sqrt(s.sum() / (2 * n.sum()))) for s in (outside, noise + predicted)
    )
    # An exposure in which something moved is as bad in sample: what is expected of it is what
    # others have.
    ratio = np.sqrt(outside / (n * np.median(noise / n) + predicted))
    worst = int(np.argmax(ratio))
    suspect = not white.passed
    limit = 1 + HELD_OUT_MARGIN * np.sqrt(GOOD_EXPOSURES / count)
    held = _judged(
        'held_out',
        name,
        value,
        limit * expected,
        'px',
        f'fluoroscope {name}: residuals of exposures held out are {value:.3f} px, {expected:.3f} px are '
        'expected',
        f'the calibration does not hold for exposures it has not seen; {_more(count)} in other poses',
        None,
        suspect,
    )
    return held, _judged(
        'exposures',
        name,
        ratio[worst],
        EXPOSURE_LIMIT,
        '1',
        f'fluoroscope {name}: exposure {number[worst]} fits the calibration of the others worst, by '
        f'{ratio[worst]:.2f} times what is expected',
        'look at it (phantom or fluoroscope moved, wrong ids), leave it out and calibrate again',
        None,
        suspect,
    )


# -- beads


def bead_checks(beads, suspect=False):
    """Checks 'beads' and 'distances' of Beads of all fluoroscopes together; suspect: where
    residuals have a trend.
    """
    if len(beads.target_id) < MIN_BEADS:
        reason = (
            f'only {len(beads.target_id)} beads are seen often enough to be found from the images alone: take '
            f'more exposures'
        )
        return [
            Check(name, '', np.nan, np.nan, '', None, f'check {name} could not be made, {reason}')
            for name in ('beads', 'distances')
        ]
    limit = BEADS_FACTOR**2 * chi2.ppf(1 - BEADS_ALARM / len(beads.target_id), 3)
    order = np.argsort(-beads.chi2)
    worst = order[0]
    wrong = order[beads.chi2[order] > limit]
    size = np.linalg.norm(beads.misclosure, axis=1)
    named = ', '.join(f'{beads.target_id[i]} is wrong by {size[i]:.1f} mm' for i in wrong[:NAMED])
    rest = f', and of {len(wrong) - NAMED} more' if len(wrong) > NAMED else ''
    check = _judged(
        'beads',
        '',
        size[worst],
        size[worst] * np.sqrt(limit / beads.chi2[worst]),
        'mm',
        f'the survey of bead {named}{rest}'
        if len(wrong) and not suspect
        else f'bead {beads.target_id[worst]} lies {size[worst]:.2f} mm from its survey, the worst of '
        f'{len(beads.target_id)}',
        'measure anew, or give a larger sd, and calibrate again',
        None,
        suspect,
    )
    return [check, _distances_check(beads.without(beads.target_id[wrong]), suspect)]


def _distances_check(beads, suspect):
    if len(beads.target_id) < MIN_BEADS:
        return Check(
            'distances',
            '',
            np.nan,
            np.nan,
            '',
            None,
            'check distances could not be made, too few beads agree with their survey',
        )
    found = distances(beads)
    return _judged(
        'distances',
        '',
        found.rmse_mm,
        DISTANCES_LIMIT * found.expected_mm,
        'mm',
        f'distances between beads differ from the survey by {found.rmse_mm:.3f} mm, {found.expected_mm:.3f} '
        f'mm are expected (scale {1 + found.scale:.6f}, sd {found.scale_sd:.6f})',
        'the survey is less precise than its sd says, or the calibration is wrong if other checks fail too; '
        'measure the phantom anew, or give a larger sd',
        None,
        suspect,
    )


__all__ = ['Check', 'Validation', 'validate', 'validate_or_report', 'verdict_of']
