"""Convergence: random rigs, bad start values and false matches; no wrong answer may be called
converged.
"""

import argparse
import multiprocessing
import sys
import time
from pathlib import Path

import numpy as np

from benchmarks.precision import QUANTITIES, errors_of
from fluoro_calib_ros.calibration.calibrate import calibrate
from fluoro_calib_ros.calibration.options import CalibrationOptions
from fluoro_calib_ros.errors import DataError
from fluoro_calib_ros.simulation.rig import simulate_exposures, virtual_rig

# A mean normalised squared error beyond which an answer is wrong. A single coordinate is off by
# more than 5 standard deviations once in a million; sources and attitudes of one calibration err
# together, object points hardly.
LIMITS = {'xp': 25.0, 'yp': 25.0, 'c': 25.0, 'T': 9.0, 'q': 9.0, 'object points': 1.6}


def random_case(seed):
    """Strength of the distortion, number of exposures, share of false matches and start of the
    principal distance.
    """
    rng = np.random.default_rng([seed, 77])
    return {
        'strength': rng.uniform(0, 2),
        'exposures': int(np.exp(rng.uniform(np.log(5), np.log(61)))),
        'false_matches': rng.uniform(0, 0.2),
        'off': rng.choice([0.8, 1.2]),
    }


def outcome(seed):
    """One case: its values, 'converged', 'not converged' or 'refused', the normalised errors, and
    what is wrong.
    """
    case = random_case(seed)
    rig = virtual_rig(seed, case['strength'])
    simulated = simulate_exposures(
        rig, case['exposures'], seed, false_matches=case['false_matches']
    )
    start = case['off'] * rig.fluoroscopes[0].interior[2]
    try:
        job = calibrate(
            {'a': simulated.frames['a']},
            rig.phantom,
            CalibrationOptions(),
            principal_distance=start,
        )
    except DataError as error:
        return {**case, 'seed': seed, 'end': 'refused', 'wrong': [], 'said': str(error)}
    errors = errors_of(job, rig, simulated)
    wrong = [name for name in QUANTITIES if not errors[name] <= LIMITS[name]]
    return {
        **case,
        'seed': seed,
        'end': 'converged' if job.converged else 'not converged',
        'wrong': wrong,
        **errors,
    }


TEXT = """# Convergence

Written by `make convergence` (`python -m benchmarks.convergence`): {count} random rigs; strength of the distortion 0 to
2 (up to 70 px), 5 to 60 exposures, 0 to 20 % false matches, start value of the principal distance 20 % too large or too
small. An answer is wrong where an error exceeds what is claimed for it by far: the mean normalised squared error
is above {limits}.

{table}

Among the converged ones the mean normalised squared errors have median and largest value:

{spread}
{cases}"""


def main(arguments=None):
    """Entry point; exit status 1 where a wrong answer was called converged."""
    parser = argparse.ArgumentParser(prog='python -m benchmarks.convergence', description=__doc__)
    parser.add_argument('--count', type=int, default=200, help='number of rigs (default: 200)')
    parser.add_argument(
        '--first', type=int, default=5000, help='seed of the first rig (default: 5000)'
    )
    parser.add_argument(
        '--out', type=Path, default=Path('docs/convergence.md'), help='file to write'
    )
    options = parser.parse_args(arguments)
    began = time.monotonic()
    results = []
    with multiprocessing.get_context('spawn').Pool(2) as pool:
        for result in pool.imap_unordered(
            outcome, range(options.first, options.first + options.count)
        ):
            results.append(result)
            print(
                f'{len(results)} of {options.count}: seed {result["seed"]} {result["end"]} {result["wrong"]}',
                file=sys.stderr,
            )
    text = report(sorted(results, key=lambda r: r['seed']))
    options.out.write_text(text)
    print(text)
    print(f'{time.monotonic() - began:.0f} s', file=sys.stderr)
    sys.exit(any(r['end'] == 'converged' and r['wrong'] for r in results))


def report(results):
    """The document of all outcomes."""
    lines = ['| end | cases | right | wrong |', '|---|---:|---:|---:|']
    for end in ('converged', 'not converged', 'refused'):
        these = [r for r in results if r['end'] == end]
        wrong = sum(bool(r['wrong']) for r in these)
        right = '-' if end == 'refused' else str(len(these) - wrong)
        lines.append(f'| {end} | {len(these)} | {right} | {"-" if end == "refused" else wrong} |')
    good = [r for r in results if r['end'] == 'converged']
    spread = ['| quantity | median | largest |', '|---|---:|---:|'] + [
        f'| {name} | {np.median([r[name] for r in good]):.2f} | {max(r[name] for r in good):.2f} |'
        for name in QUANTITIES
    ]
    odd = [
        f'- seed {r["seed"]}: {r["end"]}, {r["exposures"]} exposures, strength {r["strength"]:.2f}, '
        f'{100 * r["false_matches"]:.0f} % false matches'
        + (f'; wrong: {", ".join(r["wrong"])}' if r['wrong'] else '')
        + (f'; {r["said"]}' if 'said' in r else '')
        for r in results
        if r['end'] != 'converged' or r['wrong']
    ]
    cases = (
        '\nThe cases that did not converge, were refused or are wrong:\n\n' + '\n'.join(odd) + '\n'
        if odd
        else ''
    )
    limits = ', '.join(f'{value:g} ({name})' for name, value in LIMITS.items())
    return TEXT.format(
        count=len(results),
        limits=limits,
        table='\n'.join(lines),
        spread='\n'.join(spread),
        cases=cases,
    )


if __name__ == '__main__':
    main()
