"""The main job on recorded bags, over real ROS 2: collect, self-calibrate, correct and reconstruct
live, and report.
"""

import argparse
import json
import sys
import time
from pathlib import Path

import numpy as np
import rclpy
from action_msgs.msg import GoalStatus
from diagnostic_msgs.msg import DiagnosticArray
from fluoro_calib_msgs.action import SelfCalibrate
from fluoro_calib_msgs.msg import (
    CalibrationStatus,
    CorrectedObservations,
    FluoroscopeCalibration,
    ReconstructedPoints,
    RigOrientation,
    TargetObservations,
)
from rclpy.action import ActionClient
from rclpy.node import Node
from sensor_msgs.msg import CameraInfo

from ..bags.reader import read_frames
from ..calibration.calibrate import calibrate
from ..errors import DataError
from ..exposures.collector import collect_recorded
from ..files.atomic import write_text
from ..files.phantom import read_phantom
from ..photogrammetry.collinearity import project
from ..photogrammetry.rotations import matrix_from_quaternion
from ..report.figures import write_figures
from ..report.tables import markdown_table, summary_table
from .conversion import calibration_from_message
from .graph import Graph, isolate
from .qos import LATCHED, OBSERVATIONS
from .streams import StreamReader
from .wire import corrected_of, observations_of

QUIET_S = 3.0  # after which nothing comes any more


class DemoError(RuntimeError):
    """Why the demonstration did not work, in one sentence."""


class Client(Node):
    """The user of the graph: calls the action, and listens to what comes out."""

    def __init__(self, names):
        super().__init__('demo_client')
        self.names = names
        self.exposures = {}
        self.calibrations = {}
        self.ready = {}
        self.sent = {}
        self.corrected = {}
        self.points = []
        self.orientations = []
        self.streams = StreamReader(self, self._on_undecodable, self._on_undecodable)
        self.streams.subscribe(
            ReconstructedPoints,
            'reconstruction/points_with_covariance',
            lambda m, info: self.points.append((m, info['source_timestamp'])),
            OBSERVATIONS,
        )
        self.create_subscription(
            RigOrientation, 'rig_orientation', self.orientations.append, LATCHED
        )
        # of the corrected observations, by fluoroscope, as the correction node knows them
        self.readers = {}
        self.create_subscription(DiagnosticArray, '/diagnostics', self._on_diagnostics, 10)
        for n in names:
            self.create_subscription(
                CalibrationStatus,
                f'{n}/calibration_status',
                lambda m, n=n: self.exposures.update({n: m.exposures}),
                10,
            )
            self.create_subscription(
                FluoroscopeCalibration,
                f'{n}/calibration',
                lambda m, n=n: self.calibrations.update({n: m}),
                LATCHED,
            )
            # Its first CameraInfo tells that the correction node works with the new calibration.
            self.create_subscription(
                CameraInfo, f'{n}/camera_info', lambda m, n=n: self.ready.update({n: m}), LATCHED
            )
            self.streams.subscribe(
                TargetObservations,
                f'{n}/target_observations',
                lambda m, info, n=n: self._on_sent(n, m, info),
                OBSERVATIONS,
                observations_of,
            )
            self.streams.subscribe(
                CorrectedObservations,
                f'{n}/corrected_observations',
                lambda m, info, n=n: self._on_corrected(n, m, info),
                OBSERVATIONS,
                corrected_of,
            )
        self.action = ActionClient(self, SelfCalibrate, 'self_calibrate')
        self.streams.start()

    def _on_undecodable(self, what):
        self.get_logger().error(f'cannot be read: {what}')

    def _on_diagnostics(self, array):
        for status in array.status:
            if status.name.startswith('/correction_node: '):
                self.readers.update(
                    {status.hardware_id: int(v.value) for v in status.values if v.key == 'readers'}
                )

    def _on_sent(self, name, message, info):
        self.sent[name, message.frame_number] = (message, info['source_timestamp'])

    def _on_corrected(self, name, message, info):
        self.corrected[name, message.frame_number] = (message, info['source_timestamp'])

    def wait(self, condition, seconds, what):
        """Spin until condition() is true. Raises DemoError when the time is up."""
        end = time.monotonic() + seconds
        while not condition():
            if time.monotonic() > end:
                raise DemoError(f'waited {seconds:g} s for {what}')
            rclpy.spin_once(self, timeout_sec=0.1)

    def future(self, future, seconds, what):
        """Result of a future. Raises DemoError when the time is up."""
        self.wait(future.done, seconds, what)
        return future.result()


def self_calibrate(client):
    """Ask for a self-calibration, show its progress, and return its result."""

    def show(message):
        f = message.feedback
        print(
            f'    fluoroscope {f.fluoroscope}  round {f.iteration:2d}  F {f.cost_adjustment:10.1f}  '
            f'G {f.cost_regression:10.1f}  k {f.k:3d}  RMSE {f.rmse_u:.3f} {f.rmse_v:.3f} px',
            flush=True,
        )

    client.wait(client.action.server_is_ready, 20, 'the action self_calibrate')
    goal = client.future(
        client.action.send_goal_async(SelfCalibrate.Goal(), feedback_callback=show),
        10,
        'the answer to the goal',
    )
    answer = client.future(goal.get_result_async(), 120, 'the self-calibration')
    if answer.status != GoalStatus.STATUS_SUCCEEDED:
        raise DemoError(answer.result.message)
    print(f'    {answer.result.message}')
    return answer.result


def run_graph(bags, out, names):
    """The graph from the first exposure to the last corrected frame; returns the client with what
    it heard.
    """
    out.mkdir(parents=True, exist_ok=True)
    for old in (*out.glob('*.log'), *(out / 'calibration').glob('*.calibration.npz')):
        old.unlink()
    listed = '[' + ','.join(names) + ']'
    recorded = {n: len(f) for n, f in read_frames(bags / 'calibration').frames.items()}
    tracked = {n: len(f) for n, f in read_frames(bags / 'tracking').frames.items()}
    client = Client(names)
    try:
        with Graph(out) as graph:
            graph.start(
                'calibration_node',
                {
                    'fluoroscopes': listed,
                    'phantom': bags / 'phantom.csv',
                    'calibration_directory': out / 'calibration',
                },
            )
            graph.start('correction_node', {'fluoroscopes': listed})
            graph.start('reconstruction_node', {'fluoroscopes': listed})
            print(
                f'1  player -> calibration node: {min(recorded.values())} exposures of {" and ".join(names)}'
            )
            graph.start(
                'player_node', {'bag': bags / 'calibration', 'rate': 5.0, 'wait_for_readers': 3}
            )
            client.wait(
                lambda: (
                    (client.exposures and min(client.exposures.values()) >= min(recorded.values()))
                    or graph.ended()
                ),
                60,
                'the exposures',
            )
            _stop_for_faults(graph, out)
            print('2  client -> calibration node: self-calibrate')
            self_calibrate(client)
            client.wait(
                lambda: len(client.ready) == len(names),
                20,
                'the correction node to take up the calibration',
            )
            client.wait(
                lambda: client.orientations and all(client.readers.get(n, 0) > 1 for n in names),
                20,
                'the reconstruction node',
            )
            print('3  player -> correction node -> reconstruction node: markers in motion, live')
            client.sent.clear()
            player = graph.start('player_node', {'bag': bags / 'tracking', 'wait_for_readers': 3})
            wait_for_stream(client, player, graph, tracked)
            _stop_for_faults(graph, out)
    finally:
        client.streams.stop()
        client.destroy_node()
    if not client.corrected or not client.points:
        raise DemoError(f'no corrected frames or no points have come, see the logs in {out}')
    client.lost = sum(tracked.values()) - len(client.corrected)
    return client


def wait_for_stream(client, player, graph, tracked):
    """Wait until all frames {fluoroscope: number} have come out, or the player has ended and
    nothing comes any more.
    """
    seen = 0
    quiet_since = time.monotonic()

    def over():
        nonlocal seen, quiet_since
        came = len(client.sent) + len(client.corrected) + len(client.points)
        if came != seen or player.poll() is None:
            seen = came
            quiet_since = time.monotonic()
        complete = (
            len(client.corrected) >= sum(tracked.values())
            and len(client.points) >= min(tracked.values())
            and client.corrected.keys() <= client.sent.keys()
        )
        return complete or graph.ended() or time.monotonic() > quiet_since + QUIET_S

    client.wait(over, 120, 'the end of the stream')
    for key in client.corrected.keys() - client.sent.keys():  # it was heard once only
        del client.corrected[key]


def _stop_for_faults(graph, out):
    if graph.ended():
        raise DemoError(f'a node ended with a fault, see the logs in {out}')


def latencies_ms(client):
    """Latency [ms] of every corrected frame, from its publication by the player to that of the
    correction.
    """
    return np.array(
        [(client.corrected[key][1] - client.sent[key][1]) * 1e-6 for key in client.corrected]
    )


def against_truth(bags, client):
    """RMSE [px] of the markers, (observed, corrected) by fluoroscope, against the true rig.

    A calibration is known up to a turn of the sensor and what goes with it in the interior
    orientation, so a projective map of the image is fitted first, to the observed ones as to the
    corrected ones.
    """
    rig = json.loads((bags / 'truth' / 'rig.json').read_text())['fluoroscopes']
    markers = np.loadtxt(bags / 'truth' / 'markers.csv', delimiter=',', skiprows=1)
    order = {(int(row[0]), int(row[1])): row[2:] for row in markers}
    out = {}
    for name in client.names:
        observed = []
        corrected = []
        points = []
        for (fluoroscope, number), (message, _) in client.corrected.items():
            if fluoroscope == name:
                source = client.sent[name, number][0]
                observed += zip(source.u, source.v)
                corrected += zip(message.u, message.v)
                points += [order[number, i] for i in message.target_id]
        true = rig[name]
        n = len(points)
        ideal = project(
            np.broadcast_to(matrix_from_quaternion(true['quaternion_wxyz']), (n, 3, 3)),
            np.broadcast_to(true['position_mm'], (n, 3)),
            np.array(points),
            np.array([true['interior'][key] for key in ('xp', 'yp', 'c')]),
        )
        out[name] = tuple(projective_misfit(np.array(uv), ideal) for uv in (observed, corrected))
    return out


def points_against_truth(bags, client):
    """Figures of the points in space: RMSE [mm] against the true markers after the turn and shift
    that bring them nearest, their mean normalised squared error by coordinate, the part that is
    good, and the median latency [ms].
    """
    markers = np.loadtxt(bags / 'truth' / 'markers.csv', delimiter=',', skiprows=1)
    order = {(int(row[0]), int(row[1])): row[2:] for row in markers}
    points = []
    true = []
    covariance = []
    count = 0
    for message, _ in client.points:
        c = {
            n: np.array(getattr(message, f'cov_{n}')) for n in ('xx', 'xy', 'xz', 'yy', 'yz', 'zz')
        }
        whole = np.stack(
            [c[n] for n in ('xx', 'xy', 'xz', 'xy', 'yy', 'yz', 'xz', 'yz', 'zz')], axis=1
        )
        good = np.array(message.status) <= message.OUTSIDE
        count += len(good)
        points.append(1e3 * np.stack([message.x, message.y, message.z], axis=1)[good])
        covariance.append(1e6 * whole.reshape(-1, 3, 3)[good])
        true += [order[message.frame_number, i] for i in np.array(message.target_id)[good]]
    points = np.concatenate(points)
    covariance = np.concatenate(covariance)
    true = np.array(true)
    a = points - points.mean(axis=0)
    b = true - true.mean(axis=0)
    u, _, vt = np.linalg.svd(a.T @ b)
    error = a - b @ (u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt).T
    normalised = np.einsum('ni,nij,nj->n', error, np.linalg.inv(covariance), error).mean() / 3
    first = client.names[0]
    latency = [
        (stamp - client.sent[first, m.frame_number][1]) * 1e-6
        for m, stamp in client.points
        if (first, m.frame_number) in client.sent
    ]
    return {
        'rmse_mm': float(np.sqrt((error**2).sum(axis=1).mean())),
        'normalised': float(normalised),
        'good': len(points) / count,
        'exposures': len(client.points),
        'latency_ms': float(np.median(latency)),
    }


def projective_misfit(uv, ideal):
    """RMSE [px] of a coordinate between ideal (n, 2) and the projective map of uv (n, 2) that fits
    it best.
    """
    x, y = (uv - 511.5).T / 512
    one = np.ones_like(x)
    zero = np.zeros_like(x)
    u, v = (ideal - 511.5).T / 512
    rows = np.concatenate(
        [
            np.stack([x, y, one, zero, zero, zero, -u * x, -u * y], axis=1),
            np.stack([zero, zero, zero, x, y, one, -v * x, -v * y], axis=1),
        ]
    )
    h, *_ = np.linalg.lstsq(rows, np.concatenate([u, v]), rcond=None)
    h = np.append(h, 1.0).reshape(3, 3)
    mapped = np.stack([x, y, one], axis=1) @ h.T
    residual = 512 * (mapped[:, :2] / mapped[:, 2:] - np.stack([u, v], axis=1))
    return float(np.sqrt(np.mean(residual**2)))


def report(bags, out, client, began):
    """Table and figures; the figures need the residuals, so the bag is calibrated once more
    without ROS.
    """
    print('4  the same bag without ROS, figures and table')
    live = {name: calibration_from_message(m) for name, m in client.calibrations.items()}
    frames, _ = collect_recorded(read_frames(bags / 'calibration').frames)
    job = calibrate(frames, read_phantom(bags / 'phantom.csv'))
    figures = write_figures(job, out / 'figures')
    latency = latencies_ms(client)
    same = {
        name: job.calibrations[name].calibration_id == c.calibration_id for name, c in live.items()
    }
    truth = against_truth(bags, client)
    space = points_against_truth(bags, client)
    lines = [
        summary_table(
            job,
            {
                'p50': np.percentile(latency, 50),
                'p99': np.percentile(latency, 99),
                'max': latency.max(),
                'frames': len(latency),
            },
        ),
        '',
        'Markers in motion against the truth (after the best projective map):',
        markdown_table(
            [
                'fluoroscope',
                'observed RMSE [px]',
                'corrected RMSE [px]',
                'frames in',
                'frames out',
            ],
            [
                [
                    n,
                    f'{truth[n][0]:.3f}',
                    f'{truth[n][1]:.3f}',
                    str(sum(k[0] == n for k in client.sent)),
                    str(sum(k[0] == n for k in client.corrected)),
                ]
                for n in client.names
            ],
        ),
        '',
        f'In space: {space["exposures"]} exposures, {100 * space["good"]:.1f} % of the points; RMSE against the '
        f'truth {space["rmse_mm"]:.3f} mm (3-D), squared error over its variance {space["normalised"]:.2f}; '
        f'latency {space["latency_ms"]:.1f} ms (median)',
        '',
        'Calibration through the nodes and without ROS the same to the last bit: '
        + ', '.join(f'{n} {"yes" if ok else "NO"}' for n, ok in same.items()),
        f'Figures: {out / "figures"} ({len(figures)} pictures), calibration: {out / "calibration"}',
        f'{time.monotonic() - began:.0f} s in all',
    ]
    if client.lost:
        lines.insert(
            -1,
            f'{client.lost} corrected frames did not come here: the machine is too busy for the rate',
        )
    text = '\n'.join(lines)
    write_text(out / 'table.txt', text + '\n')
    print('\n' + text)
    return all(same.values())


def main(arguments=None):
    """Entry point: exit status 0 when all of it worked."""
    parser = argparse.ArgumentParser(prog='fluoro_calib_demo', description=__doc__)
    parser.add_argument(
        '--bags', type=Path, default=Path('bags'), help='folder of the bags (default: bags)'
    )
    parser.add_argument(
        '--out',
        type=Path,
        default=Path('demo_result'),
        help='folder to write (default: demo_result)',
    )
    options = parser.parse_args(arguments)
    began = time.monotonic()
    isolate()
    rclpy.init(args=[])
    try:
        names = sorted(read_frames(options.bags / 'calibration').frames)
        good = report(
            options.bags, options.out, run_graph(options.bags, options.out, names), began
        )
    except (DemoError, DataError, OSError) as error:
        print(f'fluoro_calib_demo: {error}', file=sys.stderr)
        sys.exit(1)
    except KeyboardInterrupt:
        sys.exit(130)
    finally:
        rclpy.try_shutdown()
    sys.exit(0 if good else 1)


if __name__ == '__main__':
    main()
