# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""kill -9 at random moments: every folder stays consistent, and no process keeps running.

Four programs are killed: calibrate and simulate while replacing an earlier result, bag record, and
the calibration node during a job; `extract` is killed to check its worker processes.
"""

from __future__ import annotations

import csv
import json
import os
import random
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from fluoro_calib_ros.errors import DataError
from fluoro_calib_ros.io.bags.reader import iterate_messages
from fluoro_calib_ros.io.bags.salvage import recover_bag
from fluoro_calib_ros.io.calibration import load_calibrations
from fluoro_calib_ros.io.calibration_request import read_request
from fluoro_calib_ros.jobs.simulation import SimulationOptions, simulate
from fluoro_calib_ros.nodes.messages.observations import decode_target_observations

from ..timing import section
from .calibrating import JobClient
from .processes import LEFT_S, Process, command, node

EXTRACT_KILLS = 10
SIZES = (5, 6)  # exposures of the two alternating calibrations
RECORD_S = 4.0  # time within which a recorder is killed
FLUSH_S = 1.0  # flush period; disk and scheduling add to the loss
RECORDED_HZ = 100.0


@dataclass
class Tally:
    """Results of killing one program.

    Attributes
    ----------
    states : Counter
        Content of the folder after each kill.
    faults : list of str
        Violations of the guarantees.
    hit : int
        Kills before the program had ended by itself.
    """

    states: Counter[str] = field(default_factory=Counter)
    faults: list[str] = field(default_factory=list)
    kills: int = 0
    hit: int = 0
    left: int = 0
    leftovers: int = 0

    def row(self, name: str) -> list[str]:
        states = ', '.join(f'{count} {state}' for state, count in sorted(self.states.items()))
        return [
            name,
            str(self.kills),
            str(self.hit),
            states,
            str(len(self.faults)),
            str(self.left),
            str(self.leftovers),
        ]


def run(folder: Path, count: int, seed: int) -> str:
    """Kill each program `count` times; return the section of the report."""
    kills: dict[str, Callable[[Path, int, random.Random], Tally]] = {
        'calibrate': kill_calibrate,
        'simulate': kill_simulate,
        'bag record': kill_recorder,
        'calibration_node, in a job': kill_node,
        'extract, its workers': kill_extract,
    }
    rows = []
    for name, kill in kills.items():
        work = folder / name.split()[0].strip(',')
        work.mkdir()
        tally = kill(work, count, random.Random(f'{seed} {name}'))
        rows.append(tally.row(name))
        for fault in tally.faults:
            print(f'{name}: {fault}', flush=True)
    return section(
        'Kills',
        'kill -9 at random moments. Hit: the program had not ended yet. States: what the folder '
        'held, read back with all its checks. Faults: neither old nor new. Left: processes that '
        f'ran {LEFT_S:g} s after the kill. Leftovers: hidden files and folders after the next '
        'complete run.',
        ('program', 'kills', 'hit', 'states', 'faults', 'processes left', 'leftovers'),
        rows,
    )


# -- folders of commands


def kill_repeatedly(
    commands: list[list[object]],
    folder: Path,
    state: Callable[[], str],
    count: int,
    rng: random.Random,
) -> Tally:
    """Run commands alternately that replace one folder, and kill them.

    state() returns which command's content the folder holds, and raises if it is neither's.
    """
    tally = Tally()
    seconds = []
    for words in commands:
        began = time.monotonic()
        with Process(words, folder / 'log') as process:
            if process.wait(300):
                raise SystemExit(process.output)
        seconds.append(time.monotonic() - began)
    for number in range(count):
        # Half of the kills fall in the last third, in which files are written.
        part = rng.uniform(0.0, 1.05) if number % 2 else rng.uniform(0.6, 1.05)
        with Process(commands[number % 2], folder / 'log') as process:
            time.sleep(part * min(seconds))
            tally.hit += process.running
            process.kill()
            tally.kills += 1
            tally.left += len(process.left())
        try:
            tally.states[state()] += 1
        except (DataError, OSError, ValueError) as error:
            tally.states['broken'] += 1
            tally.faults.append(str(error))
    with Process(commands[0], folder / 'log') as process:
        process.wait(300)
    tally.leftovers = len([n for n in os.listdir(folder) if n.startswith('.')])
    return tally


def kill_calibrate(folder: Path, count: int, rng: random.Random) -> Tally:
    simulate(folder / 'rig', SimulationOptions(1, max(SIZES), 0, 0.0))
    out = folder / 'result'
    commands = []
    for size in SIZES:
        source = folder / f'{size}.csv'
        _first_exposures(folder / 'rig' / 'calibration.csv', source, size)
        commands.append(
            command(
                *('calibrate', source, '--phantom', folder / 'rig' / 'phantom.csv'),
                *('--image-size', '1024x1024', '--out', out, '--model', 'none', '--fast'),
            )
        )
    return kill_repeatedly(commands, folder, lambda: whole_result(out), count, rng)


def whole_result(path: Path) -> str:
    """Return which calibration a result folder holds. Raise DataError or ValueError if invalid."""
    calibrations = load_calibrations(path)
    request = read_request(path, calibrations)  # checks that the sources match the calibrations
    document = json.loads((path / 'result.json').read_text())
    numbers = {len(each['exposures']) for each in document['fluoroscopes'].values()}
    numbers |= {len(frames) for frames in request.frames.values()}
    numbers |= {calibration.exposures for calibration in calibrations.values()}
    with open(path / 'exposures.csv', newline='') as file:
        numbers.add(len(list(csv.DictReader(file))) // len(calibrations))
    if len(numbers) > 1:
        raise ValueError(f'{path}: mixed, exposures: {sorted(numbers)}')
    return f'with {numbers.pop()} exposures'


def _first_exposures(source: Path, target: Path, size: int) -> None:
    lines = source.read_text().splitlines(keepends=True)
    kept = lines[:1] + [x for x in lines[1:] if int(x.split(',')[1]) <= size]
    target.write_text(''.join(kept))


def kill_simulate(folder: Path, count: int, rng: random.Random) -> Tally:
    out = folder / 'rig'
    whole = {}
    commands = []
    for seed in (1, 2):
        simulate(out, SimulationOptions(seed, 4, 2, 0.3))
        whole[f'of seed {seed}'] = contents(out)
        commands.append(
            command(
                *('simulate', '--out', out, '--seed', seed, '--exposures', 4),
                *('--test-exposures', 2, '--seconds', 0.3),
            )
        )

    def state() -> str:
        found = contents(out)
        for name, expected in whole.items():
            if found == expected:
                return name
        raise ValueError(f'{out}: a mixture, or not complete')

    return kill_repeatedly(commands, folder, state, count, rng)


def contents(path: Path) -> dict[str, bytes]:
    """Return the bytes of all files below a folder."""
    return {str(p.relative_to(path)): p.read_bytes() for p in path.rglob('*') if p.is_file()}


def kill_extract(folder: Path, count: int, rng: random.Random) -> Tally:
    """The workers of a killed command end; no output exists."""
    simulate(folder / 'rig', SimulationOptions(1, 6, 0, 0.0, images='clean'))
    out = folder / 'a.csv'
    words = command(
        *('extract', folder / 'rig' / 'images' / 'a', '--phantom', folder / 'rig' / 'phantom.csv'),
        *('--fluoroscope', 'a', '--out', out, '--workers', 2),
    )
    tally = Tally()
    for _ in range(min(count, EXTRACT_KILLS)):
        with Process(words, folder / 'log') as process:
            time.sleep(rng.uniform(0.5, 6.0))
            tally.hit += process.running
            process.kill()
            tally.kills += 1
            tally.left += len(process.left())
        tally.states['complete' if out.exists() else 'no output'] += 1
        out.unlink(missing_ok=True)
    tally.leftovers = len([n for n in os.listdir(folder) if n.startswith('.')])
    return tally


# -- recorder


def kill_recorder(folder: Path, count: int, rng: random.Random) -> Tally:
    """Check that all but the last second of a killed recording is recovered without gaps."""
    tally = Tally()
    feed = node('simulator_node', {'scene': 'markers', 'rate': RECORDED_HZ})
    with Process(feed, folder / 'feed.log'):
        for number in range(count):
            bag = folder / f'bag_{number}'
            with Process(command('bag', 'record', '--out', bag), folder / 'log') as process:
                while number % 2 and not bag.exists():  # every other time after its start
                    time.sleep(0.01)
                time.sleep(rng.uniform(0.0, RECORD_S))
                killed_ns = time.time_ns()
                process.kill()
                tally.kills += 1
                tally.hit += 1
                tally.left += len(process.left())
                output = process.output
            tally.states[_state_of_recording(bag, folder / f'out_{number}', killed_ns, tally)] += 1
            if 'Traceback' in output:
                tally.faults.append(output[-500:])
    return tally


def _state_of_recording(bag: Path, out: Path, killed_ns: int, tally: Tally) -> str:
    """Return the remaining content of a killed recording, and record violations."""
    if not bag.exists():
        return 'not begun'
    try:
        recover_bag(bag, out)
    except DataError as error:
        if 'nothing can be recovered' not in str(error):
            tally.faults.append(str(error))
        return 'without messages'
    last_ns = 0
    numbers: dict[str, list[int]] = {}
    for message in iterate_messages(out):
        last_ns = max(last_ns, message.log_time_ns)
        if message.topic.endswith('target_observations'):
            number = decode_target_observations(message.data).frame_number
            numbers.setdefault(message.topic, []).append(number)
    for topic, found in numbers.items():
        if found != list(range(found[0], found[0] + len(found))):
            tally.faults.append(f'{topic}: {len(found)} frames from {found[0]} to {found[-1]}')
    lost_s = (killed_ns - last_ns) * 1e-9
    if lost_s > 2 * FLUSH_S:
        tally.faults.append(f'{lost_s:.2f} s are lost')
    return f'recovered but {"less" if lost_s < FLUSH_S else "more"} than {FLUSH_S:g} s'


# -- the calibration node in a job


def kill_node(folder: Path, count: int, rng: random.Random) -> Tally:
    """Kill the node between the request and some time after the response, then restart it."""
    tally = Tally()
    out = folder / 'calibrations'
    parameters = {'phantom': folder / 'rig' / 'phantom.csv', 'calibration_directory': out}
    simulate(folder / 'rig', SimulationOptions(1, max(SIZES), 0, 0.0))
    with JobClient(folder / 'rig' / 'calibration') as client:
        longest = 0.0
        for number in range(-len(SIZES), count):  # the first ones are not killed
            with Process(node('calibration_node', parameters), folder / 'log') as process:
                client.collect(SIZES[number % 2], process)
                began = time.monotonic()
                answer = client.begin()
                if number < 0:
                    client.wait(answer.done, 'the calibration')
                    longest = time.monotonic() - began
                else:
                    client.spin_for(rng.uniform(0.0, 1.1 * longest))
                    tally.hit += not answer.done()
                    tally.kills += 1
                process.kill()
                tally.left += len(process.left())
                # Python itself prints a traceback if it is killed while starting a process.
                if 'Traceback' in process.output and 'spawn_main' not in process.output:
                    tally.faults.append(process.output[-500:])
            if number < 0:
                continue
            try:
                tally.states[whole_result(out)] += 1
            except (DataError, OSError, ValueError) as error:
                tally.states['broken'] += 1
                tally.faults.append(str(error))
        with Process(node('calibration_node', parameters), folder / 'log') as process:
            client.collect(SIZES[0], process)
            client.wait(client.begin().done, 'the calibration')
    tally.leftovers = len([n for n in os.listdir(folder) if n.startswith('.')])
    return tally
