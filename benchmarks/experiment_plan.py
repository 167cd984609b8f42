# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Cases of the validation experiment, and how they are run on two processes."""

from __future__ import annotations

import multiprocessing
import os
import sys
import time
from collections import defaultdict
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from typing import Any

from fluoro_calib_ros.estimation.options import CalibrationOptions

from .experiment import (
    BEFORE,
    HELD,
    KNOWN,
    Case,
    Outcome,
    available_models,
    available_relative,
    run_case,
)

PROCESSES = 2

Outcomes = dict[Case, Outcome]


@dataclass(frozen=True)
class Setting:
    """Conditions of a comparison over several rigs."""

    title: str
    training: int | None = None
    strength: float = 1.0
    false_matches: float = 0.01


@dataclass(frozen=True)
class Plan:
    """Size of the experiment.

    models: compared models; default: the default among them; relative: settings of the relative
    orientation constraint; exposures: number in a recording; every: step between those for the
    calibration; curve: counts of training exposures, with curve_seeds; seeds: rigs of the
    comparison under settings; joint_seeds: rigs of the comparison of joint and separate
    calibration; rounds: maximum number; paper_survey: factor on the stated standard deviation of
    the survey in the paper's tables.
    """

    models: tuple[str, ...]
    default: str
    relative: tuple[str, ...]
    exposures: int
    every: int
    curve: tuple[int, ...]
    curve_seeds: tuple[int, ...]
    seeds: tuple[int, ...]
    joint_seeds: tuple[int, ...]
    settings: tuple[Setting, ...]
    rounds: int
    paper_survey: float

    @property
    def trained(self) -> int:
        """Number of training exposures of the paper's experiment."""
        return len(range(0, self.exposures, self.every))

    def case(
        self,
        seed: int,
        variant: str,
        fluoroscopes: tuple[str, ...] = ('a',),
        training: int | None = None,
        **more: Any,
    ) -> Case:
        """Return a case of this size."""
        training = None if training == self.trained else training
        return Case(
            seed,
            variant,
            fluoroscopes,
            training,
            exposures=self.exposures,
            every=self.every,
            rounds=self.rounds,
            **more,
        )

    def paper_variants(self) -> tuple[str, ...]:
        """Variants of the paper's tables and additional ones, in order."""
        return (BEFORE, HELD, *self.models, KNOWN)

    def paper_cases(self, system: str) -> dict[str, Case]:
        """Return cases by variant of system 'a', 'b' or 'a+b' (joint)."""
        names = tuple(system.split('+'))
        return {
            v: self.case(
                self.seeds[0],
                v,
                names,
                joint=len(names) > 1,
                survey=self.paper_survey,
                detail=True,
            )
            for v in self.paper_variants()
        }

    def cost_cases(self) -> dict[str, Case]:
        """Return the cases of system 1 whose rounds are shown, by variant.

        The survey has full weight: with a low weight, C_r of a bead seen once or twice is nearly
        singular, and these few beads dominate G.
        """
        return {
            v: self.case(self.seeds[0], v, detail=True)
            for v in dict.fromkeys((HELD, 'knn', self.default))
        }

    def curve_cases(self) -> dict[tuple[str, int, int], Case]:
        """Return cases by variant, count of training exposures and seed."""
        return {
            (v, count, seed): self.case(seed, v, training=count)
            for v in (*self.models, KNOWN)
            for count in self.curve
            for seed in self.curve_seeds
        }

    def setting_cases(self, setting: Setting) -> dict[tuple[str, int], Case]:
        """Return cases by variant and seed."""
        return {
            (v, seed): self.case(
                seed,
                v,
                training=setting.training,
                strength=setting.strength,
                false_matches=setting.false_matches,
            )
            for v in (BEFORE, *self.models, KNOWN)
            for seed in self.seeds
        }

    def joint_cases(self) -> dict[tuple[str, int], Case]:
        """Return cases of the default model by label and seed."""
        kinds: dict[str, dict[str, Any]] = {'separate': {}, 'joint': {'joint': True}}
        kinds.update(
            {
                f'joint, relative orientation {r}': {'joint': True, 'relative': r}
                for r in self.relative
            }
        )
        return {
            (label, seed): self.case(seed, self.default, ('a', 'b'), **more)
            for label, more in kinds.items()
            for seed in self.joint_seeds
        }

    def cases(self) -> list[Case]:
        """Return all cases without duplicates."""
        listed = [c for system in ('a', 'b', 'a+b') for c in self.paper_cases(system).values()]
        listed += self.cost_cases().values()
        listed += self.curve_cases().values()
        listed += self.joint_cases().values()
        for setting in self.settings:
            listed += self.setting_cases(setting).values()
        return list(dict.fromkeys(listed))  # of equal cases, the first one has the details


def full_plan() -> Plan:
    """Return the experiment of docs/how_good/accuracy.md."""
    return Plan(
        available_models(),
        CalibrationOptions().model,
        available_relative(),
        150,
        10,
        (5, 10, 15, 30, 60),
        (1, 2, 3),
        (1, 2, 3, 4, 5),
        (1, 2, 3, 4, 5),
        (
            Setting('15 exposures'),
            Setting('5 exposures', training=5),
            Setting(
                '15 exposures, double distortion, 5 % false matches',
                strength=2.0,
                false_matches=0.05,
            ),
        ),
        60,
        # The paper defined its datum by surveyed coordinates with a low weight. With full weight,
        # the survey would fix the object points before any calibration and hide most of the
        # improvement.
        20.0,
    )


def quick_plan() -> Plan:
    """Return a small plan with every section; its numbers are not meaningful."""
    default = CalibrationOptions().model
    hard = Setting(
        '5 exposures, double distortion, 5 % false matches', strength=2.0, false_matches=0.05
    )
    return Plan(
        tuple(m for m in available_models() if m in ('knn', default)),
        default,
        available_relative()[:1],
        20,
        4,
        (6,),
        (1,),
        (1,),
        (1,),
        (Setting('5 exposures'), hard),
        2,
        1.0,
    )


# ------------------------------------------------------------------------------------------
# running


def run(cases: Sequence[Case], processes: int = PROCESSES) -> Outcomes:
    """Return outcomes by case. Run cases of one recording in one process, largest groups first."""
    groups = defaultdict(list)
    for case in cases:
        groups[case.scene, case.fluoroscopes].append(case)
    ordered = sorted(groups.values(), key=lambda group: -sum(map(_effort, group)))
    for name in ('OMP_NUM_THREADS', 'OPENBLAS_NUM_THREADS', 'MKL_NUM_THREADS'):
        os.environ[name] = '1'  # inherited by the worker processes started below
    out: Outcomes = {}
    began = time.monotonic()
    with ProcessPoolExecutor(processes, multiprocessing.get_context('spawn')) as pool:
        running = {pool.submit(_run_group, group): group for group in ordered}
        for done in as_completed(running):
            out.update(zip(running[done], done.result()))
            print(
                f'{len(out)} of {len(cases)} cases after {time.monotonic() - began:.0f} s',
                file=sys.stderr,
            )
    return out


def _run_group(group: Sequence[Case]) -> list[Outcome]:
    """Run cases and return their outcomes, reporting each on standard error."""
    outcomes = []
    for case in group:
        began = time.perf_counter()
        outcome = run_case(case)
        outcomes.append(outcome)
        result = outcome.failed or f'{outcome.points_mm():.4f} mm out of sample'
        print(
            f'rig {case.seed} {"+".join(case.fluoroscopes)}, '
            f'{case.training or case.exposures // case.every} exposures, '
            f'{case.variant}{", joint" * case.joint}: {result}, '
            f'{time.perf_counter() - began:.1f} s',
            file=sys.stderr,
        )
    return outcomes


def _effort(case: Case) -> float:
    """Return the approximate time of a case, relative to one fluoroscope with 15 exposures."""
    size = len(case.fluoroscopes)
    return size * size + size * (case.training or case.exposures / case.every) / 15
