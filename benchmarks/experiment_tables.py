# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Tables of the validation experiment: Tables 1-9 of Chow et al.

with our rows, and further ones.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from fluoro_calib_ros.report.tables import markdown_table

from .experiment import BEFORE, HELD, KNOWN, Outcome
from .experiment_figures import curves
from .experiment_plan import Outcomes, Plan, Setting

AXES = ('X', 'Y', 'Z', 'Xo', 'Yo', 'Zo')
PAPER_ROWS = ('before', 'after', 'after w/ IOP')
# Tables 1, 4, 7: cost, RMSE x, RMSE y [px]
PAPER_REPROJECTION = {
    'a': ((4.72e4, 1.148, 1.070), (3.47e3, 0.346, 0.339), (2.48e3, 0.303, 0.283)),
    'b': ((4.62e4, 1.235, 1.203), (6.13e3, 0.505, 0.368), (3.78e3, 0.384, 0.323)),
    'a+b': ((1.139e5, 1.307, 1.152), (1.039e4, 0.451, 0.363), (6.805e3, 0.358, 0.314)),
}
# Tables 2, 5, 8: RMSE of X, Y, Z, Xo, Yo, Zo [mm]
PAPER_INSIDE = {
    'a': (
        (1.271, 0.848, 1.384, 18.382, 27.372, 16.2599),
        (0.223, 0.179, 0.215, 14.773, 14.565, 15.477),
        (0.148, 0.133, 0.153, 3.179, 3.280, 3.421),
    ),
    'b': (
        (1.973, 0.941, 1.295, 20.575, 20.121, 21.536),
        (0.450, 0.237, 0.467, 19.311, 19.749, 18.339),
        (0.405, 0.208, 0.434, 2.381, 2.431, 2.300),
    ),
    'a+b': (
        (1.161, 1.046, 1.025, 18.234, 20.844, 17.120),
        (0.369, 0.238, 0.291, 16.583, 16.881, 16.466),
        (0.315, 0.179, 0.215, 2.640, 2.717, 2.655),
    ),
}
# Tables 3, 6, 9
PAPER_OUTSIDE = {
    'a': (
        (0.938, 0.509, 0.926, 15.343, 23.221, 16.222),
        (0.152, 0.111, 0.162, 14.721, 15.499, 15.065),
        (0.069, 0.047, 0.072, 3.140, 3.485, 3.285),
    ),
    'b': (
        (0.669, 0.510, 0.708, 19.298, 16.010, 16.984),
        (0.150, 0.099, 0.131, 19.138, 18.966, 18.845),
        (0.121, 0.055, 0.096, 4.663, 1.825, 1.939),
    ),
    'a+b': (
        (0.674, 0.465, 0.683, 17.043, 19.608, 16.221),
        (0.135, 0.093, 0.141, 16.486, 16.806, 16.550),
        (0.095, 0.039, 0.091, 3.407, 2.528, 2.524),
    ),
}
NAMES = {
    BEFORE: 'ours: before',
    HELD: 'ours: after (kNN, interior fixed)',
    'knn': 'ours: after w/ IOP (kNN)',
}


def label_of(variant: str) -> str:
    """Return the first cell of one of our rows."""
    return NAMES.get(variant, f'ours: {variant}')


def gains(values: Iterable[float], first: Iterable[float]) -> list[str]:
    """Return the improvements [%] over the row `before` as text."""
    return [f'{100 * (1 - v / b):.1f}' for v, b in zip(values, first)]


def object_table(
    outcomes: Mapping[str, Outcome], paper: Sequence[Sequence[float]], which: str
) -> str:
    """Tables 2, 3, 5, 6, 8, 9: RMSE of object points and sources; which: 'inside' or 'outside'."""
    rows = []
    for label, values in zip(PAPER_ROWS, paper):
        rows.append(
            [
                f'paper: {label}',
                *(f'{v:.3f}' for v in values),
                *(['-'] * 6 if label == 'before' else gains(values, paper[0])),
            ]
        )
    first = getattr(outcomes[BEFORE], which)
    for variant, outcome in outcomes.items():
        if outcome.failed:
            rows.append([label_of(variant), *['-'] * 12])
            continue
        values = getattr(outcome, which)
        rows.append(
            [
                label_of(variant),
                *(f'{v:.4f}' for v in values[:3]),
                *(f'{v:.3f}' for v in values[3:]),
                *(['-'] * 6 if variant == BEFORE else gains(values, first)),
            ]
        )
    return markdown_table(['', *(f'{a} [mm]' for a in AXES), *(f'{a} [%]' for a in AXES)], rows)


def reprojection_table(outcomes: Mapping[str, Outcome], paper: Sequence[Sequence[float]]) -> str:
    """Return Tables 1, 4, 7: cost and RMSE of the in-sample residuals."""
    header = [
        '',
        'cost',
        'reweighted RMSE x [px]',
        'y [px]',
        'raw RMSE x [px]',
        'y [px]',
        'improvement: cost [%]',
        'reweighted x [%]',
        'y [%]',
        'raw x [%]',
        'y [%]',
    ]
    rows = []
    for label, values in zip(PAPER_ROWS, paper):
        gain = ['-'] * 3 if label == 'before' else gains(values, paper[0])
        rows.append(
            [
                f'paper: {label}',
                f'{values[0]:.2e}',
                *(f'{v:.3f}' for v in values[1:]),
                '-',
                '-',
                *gain,
                '-',
                '-',
            ]
        )
    first: list[float] = []
    for variant, outcome in outcomes.items():
        if outcome.failed:
            rows.append([label_of(variant), *['-'] * 10])
            continue
        values = reprojection(outcome)
        first = values if variant == BEFORE else first
        rows.append(
            [
                label_of(variant),
                f'{values[0]:.2e}',
                *(f'{v:.3f}' for v in values[1:]),
                *(['-'] * 5 if variant == BEFORE else gains(values, first)),
            ]
        )
    return markdown_table(header, rows)


def reprojection(outcome: Outcome) -> list[float]:
    """Return cost, reweighted and raw RMSE x, y [px] of all fluoroscopes of an outcome."""
    residuals = list(outcome.residuals.values())
    both = residuals[0]
    for more in residuals[1:]:
        both = both.together(more)
    return [both.cost(), *both.reweighted(), *both.raw()]


# ------------------------------------------------------------------------------------------
# beyond the paper


def curve_table(plan: Plan, outcomes: Outcomes, which: int, digits: int) -> str:
    """Tabulate a quantity by variant and number of training exposures.

    which: 0 points, 1 source, 2 correction.
    """
    rows = []
    for variant in (*plan.models, KNOWN):
        values = curves(plan, outcomes, variant)[which]
        rows.append([variant, *(f'{v:.{digits}f}' if np.isfinite(v) else '-' for v in values)])
    return markdown_table(['training exposures', *map(str, plan.curve)], rows)


class Comparison:
    """Results of a comparison over several rigs, by variant; failed cases are excluded."""

    def __init__(self, plan: Plan, outcomes: Outcomes, setting: Setting) -> None:
        self._outcomes = {key: outcomes[case] for key, case in plan.setting_cases(setting).items()}
        self.plan = plan
        self.setting = setting

    def __getitem__(self, key: tuple[str, int]) -> Outcome:
        return self._outcomes[key]

    def seeds(self, variant: str) -> list[int]:
        """Return the seeds for which neither this variant nor known distortion failed."""
        return [
            s for s in self.plan.seeds if not (self[variant, s].failed or self[KNOWN, s].failed)
        ]

    def rms(self, variant: str, figure: str) -> float:
        """Return the root mean square over the rigs of the result of a method of Outcome."""
        return float(
            np.sqrt(
                np.mean([getattr(self[variant, s], figure)() ** 2 for s in self.seeds(variant)])
            )
        )

    def ratios(self, variant: str, figure: str = 'points_mm') -> np.ndarray:
        """Return the ratios to known distortion, one per rig."""
        return np.array(
            [
                getattr(self[variant, s], figure)() / getattr(self[KNOWN, s], figure)()
                for s in self.seeds(variant)
            ]
        )

    def image_px(self, variant: str, within: str | None = None) -> float:
        """Return the RMSE [px] of the correction, as RMS over the rigs.

        within: variant whose calibrated area restricts the evaluation.
        """
        return float(
            np.sqrt(
                np.mean(
                    [
                        self[variant, s].image_px(
                            'a',
                            None
                            if within is None or self[within, s].failed
                            else self[within, s].error_map['a'],
                        )
                        ** 2
                        for s in self.seeds(variant)
                    ]
                )
            )
        )

    def table(self) -> str:
        """Return a table of means over the rigs, one row per variant."""
        header = [
            'model',
            'points 3-D [mm]',
            'ratio to known: mean',
            'minimum',
            'maximum',
            'source 3-D [mm]',
            'ratio to known',
            'correction [px]',
            'coverage [%]',
            'in the knn area [px]',
            'ratio to knn',
            'calibration [s]',
        ]
        return markdown_table(header, [self._row(v) for v in (BEFORE, *self.plan.models, KNOWN)])

    def _row(self, variant: str) -> list[str]:
        seeds = self.seeds(variant)
        if not seeds:
            return [variant, *['-'] * 11]
        ratio = self.ratios(variant)
        source = self.ratios(variant, 'source_mm')
        row = [
            variant
            if len(seeds) == len(self.plan.seeds)
            else f'{variant} ({len(seeds)} of {len(self.plan.seeds)})',
            f'{self.rms(variant, "points_mm"):.4f}',
            f'{ratio.mean():.3f}',
            f'{ratio.min():.3f}',
            f'{ratio.max():.3f}',
            f'{self.rms(variant, "source_mm"):.3f}',
            f'{source.mean():.2f}',
        ]
        if variant == KNOWN:
            row += ['-'] * 4
        else:
            same = self.image_px(variant, 'knn')
            row += [
                f'{self.image_px(variant):.3f}',
                f'{100 * np.mean([self[variant, s].covered("a") for s in seeds]):.0f}',
                f'{same:.3f}',
                f'{same / self.image_px("knn"):.2f}' if self.seeds('knn') else '-',
            ]
        return row + [
            '-'
            if variant == BEFORE
            else f'{np.median([self[variant, s].seconds for s in seeds]):.1f}'
        ]

    def by_rig(self) -> str:
        """Tabulate ratios to known distortion by rig and model, and the default's choice."""
        rows = []
        for s in self.plan.seeds:
            row = [str(s), '-' if self[KNOWN, s].failed else f'{self[KNOWN, s].points_mm():.4f}']
            for v in self.plan.models:
                failed = self[v, s].failed or self[KNOWN, s].failed
                row.append(
                    '-' if failed else f'{self[v, s].points_mm() / self[KNOWN, s].points_mm():.3f}'
                )
            rows.append(row + [chosen(self[self.plan.default, s])])
        return markdown_table(
            ['rig', 'known distortion [mm]', *self.plan.models, f'{self.plan.default}: model'],
            rows,
        )


def chosen(outcome: Outcome) -> str:
    """Describe kind, k and rounds of a calibration in words."""
    if outcome.failed:
        return 'failed'
    kinds = ', '.join(
        f'{kind}{f", k = {k}" if k else ""}' for kind, k in dict.fromkeys(outcome.model.values())
    )
    return f'{kinds}; {outcome.rounds} rounds{"" if outcome.converged else ", not converged"}'


def joint_table(plan: Plan, outcomes: Outcomes) -> str:
    """Compare separate and joint calibration in one test; gains over separate in percent."""
    cases = plan.joint_cases()
    rows = []
    base = None
    for label in dict.fromkeys(label for label, _ in cases):
        found = [outcomes[cases[label, seed]] for seed in plan.joint_seeds]
        if any(o.failed for o in found):
            rows.append([label, *['-'] * 7])
            continue
        values = joint_figures(found)
        base = base or values
        rows.append(
            [
                label,
                f'{values[0]:.4f}',
                f'{values[1]:.3f}',
                f'{values[2]:.3f}',
                *(['-'] * 3 if values is base else gains(values[:3], base)),
                f'{values[3]:.1f}',
            ]
        )
    return markdown_table(
        [
            'calibration',
            'points 3-D [mm]',
            'source 3-D [mm]',
            'correction [px]',
            'gain: points [%]',
            'source [%]',
            'correction [%]',
            'calibration [s]',
        ],
        rows,
    )


def joint_figures(found: Sequence[Outcome]) -> tuple[float, float, float, float]:
    """Return RMS over the rigs of 3-D points, source [mm] and correction [px]; mean time [s]."""

    def rms(values: Sequence[float]) -> float:
        return float(np.sqrt(np.mean(np.square(values))))

    return (
        rms([o.points_mm() for o in found]),
        rms([o.source_mm() for o in found]),
        rms([o.image_px(n) for o in found for n in o.error_map]),
        float(np.mean([o.seconds for o in found])),
    )
