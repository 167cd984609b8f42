"""Text of docs/accuracy.md: what was done, the figures, and what falls short, computed from
them.
"""

import os

import numpy as np

from .experiment import BEFORE, HELD, KNOWN, NOISE_PX
from .experiment_figures import curves
from .experiment_tables import (
    PAPER_INSIDE,
    PAPER_OUTSIDE,
    PAPER_REPROJECTION,
    Comparison,
    chosen,
    curve_table,
    joint_table,
    object_table,
    reprojection_table,
)

AIM = 1.04  # 3-D RMSE of object points over that of perfectly known distortion, 15 exposures
SYSTEMS = {
    'a': 'fluoroscopic system 1',
    'b': 'fluoroscopic system 2',
    'a+b': 'both systems in one adjustment',
}

INTRO = """# Validation

Written by `make validation` (`python -m benchmarks.validation`), not by hand: the experiment of Chow et al. (2018)
whole, with their figures beside ours, and comparisons that go beyond it. All of ours is of the virtual rig, where the
truth is known: two fluoroscopes, a phantom of 503 beads surveyed to 0.1 mm, {exposures} exposures of each, 130 to 160
beads found in each exposure, image noise {noise} px, 1 % false matches, distortion 15 px along the rim of the image and
26 to 35 px in its corners. Every {every}th exposure ({trained} in all) is for the calibration; the other {tested} are
adjusted with that calibration held (out of sample). Errors are root mean squares (RMSE) of differences to the truth.

| name | what it is |
| --- | --- |
| before | no correction, interior orientation held at its nominal value |
| after (kNN, interior held) | the paper's first variant: k nearest neighbours learn the interior orientation too |
| after w/ IOP (kNN), `knn` | the paper's second variant: interior orientation (IOP) estimated in the adjustment |
{models}| known distortion | the true distortion taken off the observations, interior orientation estimated: the floor |

Nothing that has to learn the distortion can be expected to do better than known distortion. The default of this package
is `{default}`. X, Y, Z are coordinates of the beads, Xo, Yo, Zo of the X-ray source in the
frame of the phantom.
"""

ABOUT = {
    'local_linear': 'tricube-weighted local planes on a cubic trend, interior orientation estimated',
    'parametric': 'additional parameters of the expert, estimated inside the adjustment',
    'hybrid': 'a few parametric terms inside the adjustment, local planes on what is left',
    'collocation': 'trend and correlated signal, estimated inside the adjustment',
    'auto': 'kind and size of the model chosen by cross-validation',
}

FIGURE_TEXT = {
    'figure 1': 'F is the weighted square sum of the residuals of the bundle adjustment, G that of the '
    'cross-validation of the regression (where the correction is part of the adjustment, that of its '
    'inliers), each in percent of its first value. In these two figures the survey counts fully.',
    'figure 2': 'The mean of both, with equal weights. Where the line is flat the calibration has converged.',
    'histogram': 'In-sample residuals of all image points in units of the standard deviation that the simulated noise '
    'gives them. Without distortion they follow the unit normal; wider is distortion that is left, '
    'narrower is noise that the model has learned along.',
    'position': 'In-sample residuals over the image. A line that leaves zero is distortion that the correction does '
    'not describe; crosses are image points that the adjustment took for outliers (at the rim of the panel '
    'if beyond it). The first panel has a scale of its own.',
    'map': 'The error of corrected coordinates at every pixel of the calibrated area (grey: outside of it), after the '
    'best projective map: shift, scale, rotation and tilt of the image plane belong to the orientation.',
    'curves': 'Every count is a recording of its own, the {tested} test exposures are the same.',
}


def picture(paths, key, document, caption):
    """Markdown of a picture with what it means."""
    if key not in paths:
        return ''
    link = os.path.relpath(paths[key], document.parent).replace(os.sep, '/')
    return f'![{key[0].upper() + key[1:]}]({link})\n\n{caption}\n'


# ------------------------------------------------------------------------------------------ the
# paper's experiment


def paper_section(plan, outcomes, paths, document):
    """Figures 1-10 and Tables 1-9."""
    datum = (
        ''
        if plan.paper_survey == 1
        else ' As in the paper, and in this section only, the surveyed coordinates fix the datum with a low weight '
        f'(their standard deviation is stated {plan.paper_survey:g} times too large): at full weight the survey '
        'holds the beads to 0.1 mm before any calibration, and hides most of what it improves.'
    )
    parts = [
        '## 1. The experiment of the paper\n',
        'The paper measured a real system and took an adjustment of all 300 images by an expert for its '
        'reference, we measure against the truth: the pattern can be compared, the sizes cannot.'
        + datum
        + '\n',
        '### 1.1 Convergence\n',
        picture(paths, 'figure 1', document, FIGURE_TEXT['figure 1']),
        picture(paths, 'figure 2', document, FIGURE_TEXT['figure 2']),
        convergence(plan, outcomes),
    ]
    for number, system in enumerate(SYSTEMS):
        first = 3 * number + 1
        parts.append(f'\n### 1.{number + 2} {SYSTEMS[system][0].upper() + SYSTEMS[system][1:]}\n')
        if system in 'ab':
            figure = 3 if system == 'a' else 7
            parts += [
                picture(paths, f'figure {figure}', document, FIGURE_TEXT['histogram']),
                picture(paths, f'figure {figure + 1}', document, ''),
                picture(paths, f'figure {figure + 2}', document, FIGURE_TEXT['position']),
                picture(paths, f'figure {figure + 3}', document, ''),
            ]
        parts += tables_of(plan, outcomes, system, first)
    return '\n'.join(parts)


def tables_of(plan, outcomes, system, first):
    """Three tables of a system, numbered as in the paper."""
    of = {v: outcomes[c] for v, c in plan.paper_cases(system).items()}
    name = SYSTEMS[system]
    return [
        f'**Table {first}: reprojection errors, {name}.** Cost: r^T C_r^-1 r with the robust weights, ours in '
        "units of the simulated noise. The paper's RMSE is of residuals times the square root of their robust "
        'weight, so ours stands beside it in the same way; raw: inliers without weights.\n',
        reprojection_table(of, PAPER_REPROJECTION[system]),
        f'\n**Table {first + 1}: in-sample errors, {name}**, {plan.trained} exposures each.\n',
        object_table(of, PAPER_INSIDE[system], 'inside'),
        f'\n**Table {first + 2}: out-of-sample errors, {name}**, {plan.exposures - plan.trained} exposures each.\n',
        object_table(of, PAPER_OUTSIDE[system], 'outside'),
        '\nChosen: '
        + '; '.join(f'{v}: {chosen(o)}' for v, o in of.items() if v not in (BEFORE, KNOWN))
        + '.\n',
    ]


def convergence(plan, outcomes):
    """How many rounds each calibration of system 1 took."""
    of = {v: outcomes[c] for v, c in plan.cost_cases().items()}
    said = [
        f'{v}: {o.rounds} rounds, {o.seconds:.1f} s{"" if o.converged else " (not converged)"}'
        for v, o in of.items()
        if not o.failed
    ]
    return (
        'The paper found the costs to level off after some 20 iterations and a minimum after about 30. Ours, '
        'system 1: ' + '; '.join(said) + '.\n'
    )


# ------------------------------------------------------------------------------------------------
# beyond the paper


def curve_section(plan, outcomes, paths, document):
    """Accuracy by number of training exposures."""
    tested = plan.exposures - plan.trained
    rigs = f'rig{"s" * (len(plan.curve_seeds) > 1)} {", ".join(map(str, plan.curve_seeds))}'
    return '\n'.join(
        [
            '## 2. How many exposures are enough\n',
            f'Fluoroscope a of {rigs}, out of sample. '
            + FIGURE_TEXT['curves'].format(tested=tested)
            + '\n',
            picture(
                paths,
                'curves',
                document,
                'Object points and source are 3-D errors after an adjustment of the test '
                'exposures with the calibration held; the third panel is the correction itself, compared with the '
                'true distortion.',
            ),
            '3-D RMSE of the object points [mm]:\n',
            curve_table(plan, outcomes, 0, 4),
            '\n3-D RMSE of the source [mm]:\n',
            curve_table(plan, outcomes, 1, 3),
            '\nRMSE of a coordinate of the correction over the image [px], after the best projective map:\n',
            curve_table(plan, outcomes, 2, 3),
        ]
    )


def rigs_section(comparisons, paths, document):
    """Comparison of the models over several rigs."""
    plan = comparisons[0].plan
    parts = [
        f'## 3. Over {len(plan.seeds)} rigs\n',
        'Fluoroscope a of rigs with different phantoms, orientations and distortions, out of sample. Ratios are '
        'to perfectly known distortion, rig by rig. `correction` is its RMSE over the area that the calibration '
        'claims to cover (`covers`, percent of the image), after the best projective map; beside it the same '
        'over the part that `knn` covers too, and its ratio to `knn` there. Time: median, with two '
        'calibrations at once.\n',
    ]
    for number, comparison in enumerate(comparisons):
        parts += [
            f'### 3.{number + 1} {comparison.setting.title}\n',
            comparison.table(),
            '\nRatio of the object points to known distortion, by rig:\n',
            comparison.by_rig(),
            '',
        ]
    parts.append(picture(paths, 'map', document, FIGURE_TEXT['map']))
    return '\n'.join(parts)


def joint_section(plan, outcomes):
    """Joint against separate calibration, and the relative orientation constraint."""
    text = [
        '## 4. Joint calibration and relative orientation\n',
        'Both fluoroscopes calibrated one after the other or in one adjustment with shared object points '
        f'(`{plan.default}`, {len(plan.joint_seeds)} rigs); all are then tested alike, with one '
        'adjustment of the test exposures of both. The paper saw no benefit in the joint calibration as such.\n',
        joint_table(plan, outcomes),
    ]
    if not plan.relative:
        text.append(
            '\nThis version has no relative orientation constraint; with one its rows appear here.\n'
        )
    return '\n'.join(text)


def summary_section(plan, comparisons):
    """The most important figures, first."""
    lines = ['## In short\n']
    for c in comparisons:
        if not c.seeds(plan.default):
            lines.append(f'- {c.setting.title}: `{plan.default}` failed on every rig.')
            continue
        ratios = ', '.join(
            f'{v} {c.ratios(v).mean():.3f}'
            for v in (*plan.models, BEFORE)
            if v != plan.default and c.seeds(v)
        )
        image = ', '.join(
            f'{v} {c.image_px(v):.3f} px'
            for v in ('knn', BEFORE)
            if v != plan.default and c.seeds(v)
        )
        lines.append(
            f'- {c.setting.title}: with `{plan.default}` the object points are within '
            f'{c.rms(plan.default, "points_mm"):.4f} mm (3-D RMSE), **{c.ratios(plan.default).mean():.3f}** '
            f'times known distortion ({ratios}); the source within {c.rms(plan.default, "source_mm"):.2f} mm, '
            f'{c.ratios(plan.default, "source_mm").mean():.2f} times; the correction within '
            f'{c.image_px(plan.default):.3f} px over the image ({image}).'
        )
    return '\n'.join(lines) + '\n'


# ------------------------------------------------------------------------------------------------
# what falls short


def shortcomings(plan, outcomes, comparisons):
    """Sentences on what is not as it should be; every one follows from the figures."""
    return [
        *_of_settings(plan, comparisons),
        *_of_paper(plan, outcomes),
        *_of_curves(plan, outcomes),
        *_of_costs(plan, outcomes),
        *_of_cases(outcomes),
    ]


def _of_settings(plan, comparisons):
    for c in comparisons:
        if not c.seeds(plan.default):
            continue
        ratio = c.ratios(plan.default)
        source = c.ratios(plan.default, 'source_mm')
        title = c.setting.title
        if ratio.mean() > AIM:
            yield (
                f'{title}: the object points of `{plan.default}` are {100 * (ratio.mean() - 1):.1f} % worse than '
                f'with known distortion, {100 * (ratio.max() - 1):.1f} % on the worst rig (aim: '
                f'{100 * (AIM - 1):.0f} %).'
            )
        if source.mean() > 1.25:
            yield f'{title}: the source is {source.mean():.2f} times as far off as with known distortion.'
        better = [
            v
            for v in plan.models
            if c.seeds(v) == c.seeds(plan.default) and c.ratios(v).mean() < ratio.mean() - 0.005
        ]
        if better:
            yield (
                f'{title}: better than `{plan.default}` were '
                + ', '.join(
                    f'`{v}` ({c.ratios(v).mean():.3f} against {ratio.mean():.3f})' for v in better
                )
                + '.'
            )
        covered = {
            v: np.mean([c[v, s].covered('a') for s in c.seeds(v)])
            for v in plan.models
            if c.seeds(v)
        }
        if covered[plan.default] < max(covered.values()) - 0.02:
            yield (
                f'{title}: `{plan.default}` covers {100 * covered[plan.default]:.0f} % of the image, other '
                f'models up to {100 * max(covered.values()):.0f} %.'
            )


def _of_paper(plan, outcomes):
    for system, name in SYSTEMS.items():
        of = {v: outcomes[c] for v, c in plan.paper_cases(system).items()}
        if any(of[v].failed for v in (BEFORE, 'knn', plan.default, KNOWN) if v in of):
            continue
        paper = np.array(PAPER_OUTSIDE[system])
        theirs = 100 * (1 - paper[2] / paper[0])
        ours = 100 * (1 - of['knn'].outside / of[BEFORE].outside)
        floor = 100 * (1 - of[KNOWN].outside / of[BEFORE].outside)
        if np.mean(ours[:3]) < np.mean(theirs[:3]):
            yield (
                f'{name[0].upper() + name[1:]}: kNN with estimated interior orientation improves X, Y, Z by '
                f'{np.mean(ours[:3]):.0f} % on average, in the paper by {np.mean(theirs[:3]):.0f} %. Known '
                f'distortion would improve them by {np.mean(floor[:3]):.0f} %: before the calibration our beads '
                f"are off by {of[BEFORE].outside[:3].mean():.2f} mm, the paper's were by "
                f'{paper[0][:3].mean():.2f} mm.'
            )


def _of_curves(plan, outcomes):
    values = {v: curves(plan, outcomes, v)[0] for v in (*plan.models, KNOWN)}
    ratio = values[plan.default] / values[KNOWN]
    late = [f'{count} ({r:.2f} times)' for count, r in zip(plan.curve, ratio) if r > AIM]
    if late:
        yield (
            f'The aim of {100 * (AIM - 1):.0f} % above known distortion is not met by `{plan.default}` with these '
            f'numbers of exposures (section 2): {", ".join(late)}.'
        )


def _of_costs(plan, outcomes):
    for variant, case in plan.cost_cases().items():
        if not len(outcomes[case].costs):
            continue
        f = outcomes[case].costs[0]
        lowest = int(np.argmin(f))
        if f[-1] > 1.1 * f[lowest]:
            yield (
                f'`{variant}`, system 1: the cost F does not fall all the way as in the paper: {f[lowest]:.1f} % of '
                f'its first value after {lowest} rounds, {f[-1]:.1f} % at the end (Figure 1).'
            )


def _of_cases(outcomes):
    failed = [c for c, o in outcomes.items() if o.failed]
    for case in failed:
        yield f'{_named(case)} failed: {outcomes[case].failed}'
    slow = [
        c for c, o in outcomes.items() if not o.failed and not o.converged and c.variant != HELD
    ]
    if slow:
        listed = '; '.join(map(_named, slow[:8])) + ('; ...' if len(slow) > 8 else '')
        yield (
            f'{len(slow)} of {len(outcomes)} calibrations had not converged in the largest number of rounds: '
            f'{listed}.'
        )
    held = [
        c for c, o in outcomes.items() if not o.failed and not o.converged and c.variant == HELD
    ]
    if held:
        yield (
            f'kNN with the interior orientation held did not converge in {held[0].rounds} rounds ({len(held)} '
            'calibrations): it chooses few neighbours, and these follow the noise.'
        )


def _named(case):
    settings = f', distortion times {case.strength:g}' if case.strength != 1 else ''
    count = f'{case.training} exposures, ' if case.training else ''
    return f'`{case.variant}` ({count}rig {case.seed}, {"+".join(case.fluoroscopes)}{", joint" * case.joint}{settings})'


def document_text(plan, outcomes, paths, document):
    """The whole text of docs/accuracy.md."""
    comparisons = [Comparison(plan, outcomes, setting) for setting in plan.settings]
    models = ''.join(
        f'| `{m}` | {ABOUT.get(m, "a model of this package")} |\n'
        for m in plan.models
        if m != 'knn'
    )
    short = shortcomings(plan, outcomes, comparisons)
    return '\n'.join(
        [
            INTRO.format(
                exposures=plan.exposures,
                noise=NOISE_PX,
                every=plan.every,
                trained=plan.trained,
                models=models,
                tested=plan.exposures - plan.trained,
                default=plan.default,
            ),
            summary_section(plan, comparisons),
            paper_section(plan, outcomes, paths, document),
            curve_section(plan, outcomes, paths, document),
            rigs_section(comparisons, paths, document),
            joint_section(plan, outcomes),
            '## 5. What falls short\n',
            '\n'.join(f'- {s}' for s in short) or 'Nothing of what is looked for here.',
            f'\n## 6. How it was made\n\n{len(outcomes)} calibrations with their tests, two at once, one thread each. The '
            'same command gives the same figures, but for the times of the calibrations.\n',
        ]
    )
