# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The validation experiment at a small size, end to end, with its figures."""

import os
import re
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from fluoro_calib_ros.correction.registry import no_correction
from fluoro_calib_ros.estimation.calibrate import adjust_with_calibrations, calibrate
from fluoro_calib_ros.simulation.rig import random_field

sys.path.append(str(Path(__file__).resolve().parents[2]))  # the benchmarks are not installed
from benchmarks import validation
from benchmarks.experiment import (
    BEFORE,
    HELD,
    KNOWN,
    Case,
    Outcome,
    Residuals,
    error_over_image,
    errors_of_test,
    options_of,
    projective_residuals,
    run_case,
    scene_of,
)
from benchmarks.experiment_figures import curves
from benchmarks.experiment_plan import full_plan, quick_plan
from benchmarks.experiment_tables import (
    PAPER_INSIDE,
    PAPER_OUTSIDE,
    PAPER_REPROJECTION,
    Comparison,
)
from benchmarks.experiment_text import document_text, shortcomings

pytestmark = pytest.mark.long

SMALL = {'exposures': 30, 'every': 5, 'rounds': 3}


@pytest.fixture(scope='module')
def experiment(tmp_path_factory):
    """Plan, outcomes and document of the small experiment."""
    document = tmp_path_factory.mktemp('docs') / 'accuracy.md'
    plan = quick_plan()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(validation, 'run', run_here)
        return plan, validation.make(plan, document), document


def run_here(cases):
    """Return the outcomes by case, computed in this process recording by recording."""
    ordered = sorted(cases, key=lambda case: (case.scene, case.fluoroscopes))
    return {case: run_case(case) for case in ordered}


def test_document_has_every_table_and_picture(experiment):
    """The document has Tables 1-9 with the paper's figures and ours, Figures 1-10 and all other
    sections; links lead to pictures.
    """
    plan, _, document = experiment
    text = document.read_text()
    for number in range(1, 10):
        assert text.count(f'**Table {number}: ') == 1
    for first, system in ((1, 'a'), (4, 'b'), (7, 'a+b')):
        for number, paper in zip(
            range(first, first + 3), (PAPER_REPROJECTION, PAPER_INSIDE, PAPER_OUTSIDE)
        ):
            table = text.split(f'**Table {number}: ')[1].split('\n\n')[1].splitlines()
            assert [row.split('|')[1].strip() for row in table[2:5]] == [
                'paper: before',
                'paper: after',
                'paper: after w/ IOP',
            ]
            assert len(table) == 2 + 3 + len(plan.paper_variants())
            printed = [float(cell) for cell in table[2].split('|')[3:5]]
            assert printed == pytest.approx(paper[system][0][1:3], abs=5e-4)
    links = re.findall(r'!\[[^]]+\]\(([^)]+)\)', text)
    assert len(links) == len(set(links)) == 12
    assert all((document.parent / link).is_file() for link in links)
    for heading in (
        '## Summary',
        '## 1. ',
        '## 2. ',
        '## 3. ',
        '## 4. ',
        '## 5. Shortcomings',
        '## 6. ',
    ):
        assert text.count(heading) == 1


def test_pictures_are_whole_and_small(experiment):
    """Every picture can be read and is not blank, and all together stay small."""
    folder = experiment[2].parent / 'images'
    names = sorted(os.listdir(folder))
    assert names == sorted(
        [f'validation_figure_{n}.png' for n in range(1, 11)]
        + ['validation_curves.png', 'validation_map.png']
    )
    for name in names:
        with Image.open(folder / name) as picture:
            assert picture.format == 'PNG' and all(300 <= side <= 1800 for side in picture.size)
            assert np.asarray(picture.convert('L')).std() > 10
    assert sum(os.path.getsize(folder / name) for name in names) < 1.5e6


def test_order_of_the_variants(experiment):
    """No correction beats known distortion, kNN beats none, and the default beats kNN."""
    plan, outcomes, _ = experiment
    assert not [o.failed for o in outcomes.values() if o.failed]
    for system in ('a', 'b', 'a+b'):
        of = {v: outcomes[c] for v, c in plan.paper_cases(system).items()}
        known = of[KNOWN].points_mm()
        assert all(o.points_mm() > 0.95 * known for o in of.values())
        assert of['knn'].points_mm() < 0.8 * of[BEFORE].points_mm()
        assert of['knn'].source_mm() < 0.3 * min(of[BEFORE].source_mm(), of[HELD].source_mm())
        assert of[plan.default].points_mm() < of['knn'].points_mm()
        for name in system.split('+'):
            assert (
                of[plan.default].image_px(name)
                < of['knn'].image_px(name)
                < of[BEFORE].image_px(name)
            )
            assert of['knn'].residuals[name].cost() < 0.2 * of[BEFORE].residuals[name].cost()


def test_comparison_counts_from_known_distortion(experiment):
    """Ratios refer to known distortion of the same rig; curves show the outcomes by count."""
    plan, outcomes, _ = experiment
    comparison = Comparison(plan, outcomes, plan.settings[0])
    assert comparison.ratios(KNOWN) == pytest.approx(1)
    seed = plan.seeds[0]
    assert comparison.ratios('knn')[0] == pytest.approx(
        comparison['knn', seed].points_mm() / comparison[KNOWN, seed].points_mm()
    )
    assert comparison.image_px('knn', 'knn') == comparison.image_px('knn')
    values = curves(plan, outcomes, 'knn')
    at = outcomes[plan.curve_cases()['knn', plan.curve[0], seed]]
    np.testing.assert_allclose(
        values[:, 0], [at.points_mm(), at.source_mm(), at.image_px('a')], rtol=1e-6
    )
    assert np.isnan(curves(plan, outcomes, KNOWN)[2]).all()


def test_failed_case_is_reported(experiment, tmp_path):
    """A failed calibration gives a dash in the tables, and its reason among the shortcomings."""
    plan, outcomes, _ = experiment
    broken = dict(outcomes)
    for cases in (
        plan.paper_cases('a'),
        plan.curve_cases(),
        plan.setting_cases(plan.settings[0]),
        plan.joint_cases(),
    ):
        for case in cases.values():
            if case.variant == plan.default:
                broken[case] = Outcome(failed='DataError: no such luck')
    comparisons = [Comparison(plan, broken, s) for s in plan.settings]
    assert any('no such luck' in sentence for sentence in shortcomings(plan, broken, comparisons))
    text = document_text(plan, broken, {}, tmp_path / 'accuracy.md')
    assert 'failed on every rig' in text and text.count('no such luck') >= 3


def test_out_of_sample_test_equals_adjust_with_calibrations():
    """The test of a calibration gives the numbers of adjust_with_calibrations."""
    case = Case(2, 'knn', ('a',), **SMALL)
    scene = scene_of(*case.scene)
    frames, _ = scene.training(None, False)
    job = calibrate({'a': frames['a']}, scene.rig.phantom, options_of(case))
    held_back = [f for i, f in enumerate(scene.recording.frames['a']) if i % case.every]
    user = adjust_with_calibrations({'a': held_back}, scene.rig.phantom, job.calibrations)
    expected = scene.errors(
        user.targets.target_id,
        user.targets.xyz_mm,
        [('a', e.exposure, e.position_mm) for e in user.fluoroscopes['a'].exposures],
        scene.recording,
    )
    np.testing.assert_allclose(errors_of_test(scene, case, job.calibrations), expected, rtol=5e-3)


def test_training_and_test_exposures_are_disjoint():
    """A training set of another size is a separate recording."""
    case = Case(2, 'knn', **SMALL)
    scene = scene_of(*case.scene)
    frames, _ = scene.training(None, False)
    used = {f.number for f in frames['a']}
    held_back = {f.number for f in scene.test_network(('a',), False).frames}
    assert len(used) == 6 and len(held_back) == 24 and not used & held_back
    own, simulated = scene.training(7, False)
    assert len(own['b']) == len(simulated.poses) == 7
    assert not np.array_equal(own['a'][0].uv, frames['a'][0].uv)
    known, _ = scene.training(None, True)
    moved = np.hypot(*(known['a'][0].uv - frames['a'][0].uv).T)
    assert 3 < moved.max() < 40


def test_impossible_case_is_an_outcome_with_a_reason():
    """Too few exposures give no numbers but a reason."""
    outcome = run_case(Case(2, 'knn', training=2, **SMALL))
    assert 'exposures' in outcome.failed and outcome.outside is None


def test_projective_map_is_removed():
    """Shift, scale, rotation and tilt leave no residual; noise keeps its size."""
    rng = np.random.default_rng(0)
    ideal = rng.uniform(0, 1023, (400, 2))
    h = np.array([[1.01, 0.02, 5.0], [-0.02, 0.99, -7.0], [2e-5, -1e-5, 1.0]])
    mapped = np.column_stack([ideal, np.ones(400)]) @ h.T
    seen = mapped[:, :2] / mapped[:, 2:]
    assert np.abs(projective_residuals(seen, ideal)).max() < 1e-8
    noise = rng.normal(0, 0.3, seen.shape)
    assert np.sqrt(np.mean(projective_residuals(seen + noise, ideal) ** 2)) == pytest.approx(
        0.3, rel=0.05
    )


def test_error_over_image_stays_in_the_calibrated_area():
    """Without a correction the error is the distortion; outside the image points it is NaN."""
    field = random_field(np.random.default_rng(3))
    training = np.array([[200, 200], [800, 200], [800, 800], [200, 800.0]])
    errors = error_over_image(no_correction(), field, training, (1024, 1024))
    inside = np.isfinite(errors[..., 0])
    assert 0.3 < inside.mean() < 0.36 and not inside[0].any() and not inside[:, -1].any()
    assert 0.3 < np.sqrt(np.nanmean(errors**2)) < 3
    half = error_over_image(no_correction(), lambda uv: field(uv) / 2, training, (1024, 1024))
    assert np.nanmean(half**2) < 0.3 * np.nanmean(errors**2)


def test_residual_figures():
    """The raw RMSE is that of the inliers; the reweighted RMSE and the cost use all points with
    their weights.
    """
    residual = np.array([[1.0, 0], [-1, 2], [10, 10]])
    one = Residuals(
        np.zeros((3, 2)),
        residual,
        np.full(3, 0.5),
        np.array([1, 1, 0.01]),
        np.array([True, True, False]),
    )
    np.testing.assert_allclose(one.raw(), [1, np.sqrt(2)])
    np.testing.assert_allclose(one.reweighted(), np.sqrt([1, 5 / 3]))
    assert one.cost() == pytest.approx(4 * (1 + 5 + 2))
    both = one.together(replace(one, inlier=np.array([False] * 3)))
    assert both.cost() == pytest.approx(2 * one.cost()) and both.inlier.sum() == 2


def test_full_plan_is_that_of_the_paper():
    """150 exposures of two fluoroscopes, every tenth for the calibration; no case runs twice."""
    plan = full_plan()
    cases = plan.cases()
    assert (plan.exposures, plan.trained, plan.default) == (
        150,
        15,
        options_of(cases[0]).__class__().model,
    )
    assert len(cases) == len(set(cases)) and {'knn', plan.default} <= set(plan.models)
    assert all(c.training is None for c in plan.paper_cases('a+b').values())
    assert {c.training for c in plan.curve_cases().values()} == {5, 10, None, 30, 60}
    assert options_of(plan.paper_cases('a')[HELD]).interior == 'fixed'
