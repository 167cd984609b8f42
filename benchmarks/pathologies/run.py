# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Run the pathologies, store each result as a JSON line at once, and write the page."""

import argparse
import json
import multiprocessing
import sys
import time
from dataclasses import replace
from pathlib import Path

from fluoro_calib_ros.checks.verdict import validate_or_report
from fluoro_calib_ros.errors import DataError
from fluoro_calib_ros.estimation.options import CalibrationOptions, CalibrationRequest
from fluoro_calib_ros.jobs.calibration import run_calibration

from .cases import CASES
from .measure import claims, ratios
from .oracle import interior_of_oracle
from .page import page
from .scene import NAMES, draw

RESULTS = Path('.build/pathologies.jsonl')
PAGE = Path('docs/how_good/pathologies.md')


def measured(case, seed, model=None, verdict=True):
    """Return the figures of one case with one seed; 'said' if the calibration is refused."""
    scene = draw(case, seed)
    options = CalibrationOptions(**{**case.options, **({'model': model} if model else {})})
    request = CalibrationRequest(scene.frames(), scene.phantom, options)
    out = {'case': case.name, 'seed': seed, 'model': model or case.options.get('model', 'auto')}
    began = time.process_time()
    try:
        outcome = run_calibration(request, validate=verdict and case.both)
    except DataError as error:
        return {**out, 'said': str(error), 'seconds': time.process_time() - began}
    out['seconds'] = time.process_time() - began
    result = outcome.result
    oracle = interior_of_oracle(scene)
    out |= ratios(scene, result, oracle, seed)
    out |= claims(scene, result)
    out |= {'converged': result.converged, 'kind': result.fluoroscopes['a'].model_kind}
    if verdict:
        out |= _verdict(outcome)
    return out


def _verdict(outcome):
    """Return the verdict on fluoroscope a, or on the whole rig if the case requires it."""
    name = NAMES[0]
    used = outcome.request.with_exposures(outcome.result.used_exposures)
    request = replace(used, frames={name: used.frames[name]})
    began = time.process_time()
    found = outcome.validation or validate_or_report(request, {name: outcome.calibrations[name]})
    return {
        'verdict': found.verdict,
        'failed': [check.name for check in found.checks if check.passed is False],
        'findings': list(map(str, found.findings)),
        'seconds_verdict': time.process_time() - began,
    }


def main(arguments=None):
    """Entry point."""
    parser = argparse.ArgumentParser(prog='python -m benchmarks.pathologies.run')
    parser.add_argument('--seeds', type=int, default=2, help='seeds of each case (default: 2)')
    parser.add_argument('--first', type=int, default=1, help='first seed (default: 1)')
    parser.add_argument(
        '--cases', nargs='+', default=[], help='names of cases or groups, or lists with commas'
    )
    parser.add_argument('--model', help='correction model of all cases')
    parser.add_argument('--no-verdict', action='store_true', help='do not validate')
    parser.add_argument('--processes', type=int, default=2)
    parser.add_argument('--results', type=Path, default=RESULTS, help='JSON lines of the results')
    parser.add_argument('--out', type=Path, default=PAGE, help='page to write')
    parser.add_argument('--resume', action='store_true', help='keep results that are there')
    parser.add_argument('--note', default='', help='a paragraph for the page')
    options = parser.parse_args(arguments)
    cases = chosen(options.cases)
    if not cases:
        parser.error(f'no case is called {options.cases}')
    options.results.parent.mkdir(parents=True, exist_ok=True)
    if not options.resume:
        options.results.write_text('')
    done = {(r['case'], r['seed']) for r in read(options.results)}
    jobs = [
        (index, seed, options.model, not options.no_verdict)
        for seed in range(options.first, options.first + options.seeds)
        for index, case in enumerate(CASES)
        if case in cases and (case.name, seed) not in done
    ]
    with multiprocessing.get_context('spawn').Pool(options.processes) as pool:
        for number, result in enumerate(pool.imap_unordered(_one, jobs), 1):
            with options.results.open('a') as file:
                file.write(json.dumps(result) + '\n')
            print(f'{number}/{len(jobs)} {summary(result)}', file=sys.stderr, flush=True)
    text = page(read(options.results), cases, options.note)
    if options.cases:
        print(text)
    else:
        options.out.write_text(text)


def chosen(texts):
    """Return cases by name, group or comma-separated list; names may contain commas, too."""
    known = {word for case in CASES for word in (case.name, case.group)}
    wanted = set()
    for text in texts:
        wanted |= {text} if text in known else {name.strip() for name in text.split(',')}
    return [case for case in CASES if not texts or {case.name, case.group} & wanted]


def read(path):
    """Read results from a file of JSON lines."""
    if not path.exists():
        return []
    return [json.loads(line) for line in path.read_text().splitlines()]


def summary(result):
    """Return a one-line summary of a result."""
    if 'said' in result:
        return f'{result["case"]} {result["seed"]}: refused: {result["said"]}'
    figures = ' '.join(
        f'{name} {result[name]:.3f}'
        for name in ('ratio', 'stereo', 'correction_nse', 'points_nse', 'sources_nse')
    )
    return (
        f'{result["case"]} {result["seed"]}: {figures} {result["kind"]} '
        f'{result.get("verdict", "")} {result.get("failed", "")} {result["seconds"]:.1f} s'
    )


def _one(job):
    index, seed, model, verdict = job
    return measured(CASES[index], seed, model, verdict)


if __name__ == '__main__':
    main()
