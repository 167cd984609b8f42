# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Run the main job on recorded bags over real ROS 2: collect, self-calibrate, correct and
reconstruct live, calibrate from radiographs, and report.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import DataError
from ..estimation.calibrate import calibrate
from ..estimation.result import CalibrationResult
from ..exposures.collector import collect_recorded
from ..io.access import make_folder, write_text
from ..io.bags.reader import read_frames
from ..io.phantom import read_phantom
from ..nodes.demo_client import DemoClient, DemoError, demo_clients
from ..report.report_figures import write_figures
from ..report.tables import markdown_table, summary_table
from .assessment import (
    NodeProcesses,
    RecordedRig,
    image_errors,
    isolate_ros_graph,
    latencies_ms,
    space_figures,
)
from .image_twin import (
    NAMESPACE,
    PLAYED,
    ImageTwin,
    LiveKnee,
    calibrate_from_images,
    comparison_table,
)

QUIET_S = 3.0  # time without messages after which a stream has ended


def run_graph(bags: Path, out: Path, client: DemoClient, knee: LiveKnee) -> int:
    """Run the graph from the first exposure to the last corrected frame.

    Returns the number of lost corrected frames. Raises DemoError.
    """
    _clear(out)
    recorded = _frame_counts(bags / 'calibration')
    tracked = _frame_counts(bags / 'tracking')
    with NodeProcesses(out) as nodes:
        _start_nodes(nodes, bags, out, names=client.names, knee=knee)
        print(
            f'1  player -> calibration node: {min(recorded.values())} exposures of '
            f'{" and ".join(client.names)}'
        )
        nodes.start(
            'player_node', {'bag': bags / 'calibration', 'rate': 5.0, 'wait_for_readers': 3}
        )
        nodes.wait(
            client,
            lambda: min(client.exposures.values(), default=0) >= min(recorded.values()),
            60,
            'the exposures',
        )
        print('2  client -> calibration node: self-calibrate')
        message = client.self_calibrate(lambda line: print(f'    {line}', flush=True))
        print(f'    {message}')
        client.wait(lambda: client.is_correcting, 20, 'the correction node to use the calibration')
        client.wait(lambda: client.is_reconstructing, 20, 'the reconstruction node')
        print('3  player -> correction node -> reconstruction node: a knee that lands, live')
        player = nodes.start(
            'player_node', {'bag': knee.bag, 'rate': PLAYED, 'wait_for_readers': 3}
        )
        wait_for_stream(client, player, nodes, knee.frames)
        print('4  the same: markers in motion')
        for frames in (client.sent, client.corrected, client.points):
            frames.clear()
        player = nodes.start('player_node', {'bag': bags / 'tracking', 'wait_for_readers': 3})
        wait_for_stream(client, player, nodes, tracked)
    if not client.corrected or not client.points:
        raise DemoError(f'no corrected frames or no points have arrived, see the logs in {out}')
    return sum(tracked.values()) - len(client.corrected)


def wait_for_stream(
    client: DemoClient,
    player: subprocess.Popen[Any],
    nodes: NodeProcesses,
    tracked: Mapping[str, int],
) -> None:
    """Wait until all frames have arrived, or the player has ended and no more messages arrive.

    tracked: number of frames by fluoroscope. Raises DemoError.
    """
    received_count = 0
    quiet_since = time.monotonic()

    def is_over() -> bool:
        nonlocal received_count, quiet_since
        count = len(client.sent) + len(client.corrected) + len(client.points)
        if count != received_count or player.poll() is None:
            received_count = count
            quiet_since = time.monotonic()
        complete = (
            len(client.corrected) >= sum(tracked.values())
            and len(client.points) >= min(tracked.values())
            and client.corrected.keys() <= client.sent.keys()
        )
        return complete or time.monotonic() > quiet_since + QUIET_S

    nodes.wait(client, is_over, 120, 'the end of the stream')
    for key in client.corrected.keys() - client.sent.keys():  # no latency without the source frame
        del client.corrected[key]


def report(
    bags: Path,
    out: Path,
    client: DemoClient,
    recorded: RecordedRig,
    *,
    lost: int,
    start: float,
    texts: Sequence[str],
) -> bool:
    """Write and print the table; return whether live and offline calibration are identical.

    The figures need the residuals, so the bag is calibrated again without ROS.

    Parameters
    ----------
    bags, out : Path
    client : DemoClient
        With the messages that it has recorded.
    recorded : RecordedRig
    lost : int
        Number of corrected frames that did not arrive.
    start : float
        Monotonic time of the start of the demonstration [s].
    texts : sequence of str
        Line on the knee, and table of the calibrations from coordinates and from images.
    """
    print('6  the same bag without ROS, figures and table')
    frames, _ = collect_recorded(read_frames(bags / 'calibration').frames)
    job = calibrate(frames, read_phantom(bags / 'phantom.csv'))
    figures = write_figures(job, out / 'figures')
    is_equal = {
        name: job.calibrations[name].calibration_id == calibration.calibration_id
        for name, calibration in client.calibrations.items()
    }
    knee_text, comparison = texts
    lines = [
        *_image_lines(recorded, client, job),
        '',
        _space_line(recorded, client),
        knee_text,
        '',
    ]
    lines += ['Calibrated from coordinates and from radiographs:', comparison, '']
    lines.append(
        'Calibration through the nodes and without ROS is identical to the last bit: '
        + ', '.join(f'{name} {"yes" if ok else "NO"}' for name, ok in is_equal.items())
    )
    lines.append(
        f'Figures: {out / "figures"} ({len(figures)} pictures), calibration: {out / "calibration"}'
    )
    if lost:
        lines.append(f'{lost} corrected frames were lost: the machine is too busy for the rate')
    lines.append(f'{time.monotonic() - start:.0f} s in all')
    text = '\n'.join(lines)
    write_text(out / 'table.txt', text + '\n')
    print('\n' + text)
    return all(is_equal.values())


def _image_lines(recorded: RecordedRig, client: DemoClient, job: CalibrationResult) -> list[str]:
    """Return the tables of the calibration and of the corrected markers."""
    latency = latencies_ms(client.sent, client.corrected)
    errors = image_errors(recorded, client.sent, client.corrected)
    summary = summary_table(
        job,
        {
            'p50': np.percentile(latency, 50),
            'p99': np.percentile(latency, 99),
            'max': latency.max(),
            'frames': len(latency),
        },
    )
    head = ['fluoroscope', 'observed RMSE [px]', 'corrected RMSE [px]', 'frames in', 'frames out']
    rows = [
        [
            name,
            f'{errors[name][0]:.3f}',
            f'{errors[name][1]:.3f}',
            str(sum(key[0] == name for key in client.sent)),
            str(sum(key[0] == name for key in client.corrected)),
        ]
        for name in client.names
    ]
    return [
        summary,
        '',
        'Markers in motion against the truth (after the best projective map):',
        markdown_table(head, rows),
    ]


def _space_line(recorded: RecordedRig, client: DemoClient) -> str:
    """Return the accuracy of reconstructed points in one line."""
    space = space_figures(recorded, client.good_points(), client.sent, client.names[0])
    return (
        f'In space: {space.exposures} exposures, {100 * space.good_fraction:.1f} % of the points; '
        f'RMSE against the truth {space.rmse_mm:.3f} mm (3-D), squared error over its variance '
        f'{space.normalised:.2f}; latency {space.latency_ms:.1f} ms (median)'
    )


def _clear(out: Path) -> None:
    """Create the folder of the results; delete logs and calibrations of an earlier run."""
    out.mkdir(parents=True, exist_ok=True)
    for leftover in (*out.glob('*.log'), *(out / 'calibration').glob('*.calibration.npz')):
        leftover.unlink()


def _frame_counts(bag: Path) -> dict[str, int]:
    return {name: len(frames) for name, frames in read_frames(bag).frames.items()}


def _start_nodes(
    nodes: NodeProcesses, bags: Path, out: Path, names: Sequence[str], knee: LiveKnee
) -> None:
    fluoroscopes = f'[{",".join(names)}]'
    nodes.start(
        'calibration_node',
        {
            'fluoroscopes': fluoroscopes,
            'phantom': bags / 'phantom.csv',
            'calibration_directory': out / 'calibration',
        },
    )
    nodes.start('correction_node', {'fluoroscopes': fluoroscopes})
    nodes.start('reconstruction_node', {'fluoroscopes': fluoroscopes, **knee.parameters})


def default_bags() -> Path:
    """Return the folder bags in the working directory, or the one installed in a workspace."""
    local_folder = Path('bags')
    prefixes = filter(None, os.environ.get('AMENT_PREFIX_PATH', '').split(os.pathsep))
    installed = [Path(prefix) / 'share' / 'fluoro_calib_ros' / 'bags' for prefix in prefixes]
    return next((folder for folder in (local_folder, *installed) if folder.is_dir()), local_folder)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the demonstration; exit with status 0 if all of it worked."""
    parser = argparse.ArgumentParser(prog='fluoro_calib_demo', description=__doc__)
    parser.add_argument(
        '--bags',
        type=Path,
        default=default_bags(),
        help='folder of the bags (default: bags, or where there is none the installed one)',
    )
    parser.add_argument(
        '--out',
        type=Path,
        default=Path('demo_result'),
        help='folder to write (default: demo_result)',
    )
    options = parser.parse_args(arguments)
    start = time.monotonic()
    isolate_ros_graph()
    try:
        names = sorted(read_frames(options.bags / 'calibration').frames)
        options.out.mkdir(parents=True, exist_ok=True)
        recorded = RecordedRig.of(options.bags, names)
        twin = ImageTwin(recorded, options.out / 'calibration_images')
        with demo_clients(names, '', NAMESPACE) as (client, image_client), twin:
            knee = LiveKnee(recorded, options.out / 'knee')
            lost = run_graph(options.bags, options.out, client, knee)
            print('5  the same from radiographs: player -> extraction node -> calibration node')
            image_calibrations = calibrate_from_images(
                twin, options.bags, options.out, image_client
            )
            comparison = comparison_table(
                recorded, {'coordinates': client.calibrations, 'images': image_calibrations}
            )
            make_folder(options.out / 'figures')
            knee_text = knee.assess(client.joint_angles, options.out / 'figures' / 'knee_live.png')
            passed = report(
                options.bags,
                options.out,
                client,
                recorded,
                lost=lost,
                start=start,
                texts=(knee_text, comparison),
            )
    except (DemoError, DataError, OSError) as error:
        print(f'fluoro_calib_demo: {error}', file=sys.stderr)
        sys.exit(1)
    except KeyboardInterrupt:
        sys.exit(130)
    sys.exit(0 if passed else 1)


if __name__ == '__main__':
    main()
