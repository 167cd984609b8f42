# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""fluoro-calib bag: record, play, inspect and recover bags."""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import sys
from collections.abc import Callable, Mapping
from datetime import datetime, timezone
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from ..errors import printable
from .arguments import add_options, add_shared, names, options_of
from .output import print_result

if TYPE_CHECKING:
    from ..io.bags.salvage import BagReport, Damage, TopicReport

NAME = 'bag'
HELP = 'Record, play, inspect and recover bags.'
EXAMPLE = 'fluoro-calib bag recover cut.mcap --out recovered'


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    from ..io.bags.recording import PlayingOptions, RecordingOptions

    actions = parser.add_subparsers(dest='action', required=True, metavar='ACTION')
    recover = _add_action(
        actions, 'recover', 'Write all intact messages of a damaged or cut-off bag to a new one.'
    )
    recover.add_argument('source', type=Path, metavar='SOURCE', help='bag (file or folder)')
    add_shared(recover, 'out', help='new bag, which must not exist', metavar='FOLDER')
    info = _add_action(actions, 'info', 'Report the content and the faults of a bag.')
    info.add_argument('source', type=Path, metavar='SOURCE', help='bag (file or folder)')

    record = _add_action(
        actions, 'record', 'Record topics into a new bag until interrupted (needs ROS 2).'
    )
    record.add_argument(
        'topics', nargs='*', metavar='TOPIC', help='topics to record (default: all)'
    )
    add_shared(record, 'out', help='new bag, which must not exist', metavar='FOLDER')
    add_options(record, RecordingOptions)
    play = _add_action(
        actions, 'play', 'Publish the messages of a bag as they were recorded (needs ROS 2).'
    )
    play.add_argument('source', type=Path, metavar='SOURCE', help='bag (file or folder)')
    play.add_argument('--topics', type=names, metavar='T,T', help='topics to play (default: all)')
    metavars = {'start_offset': {'metavar': 'S'}, 'clock': {'metavar': 'HZ'}}
    add_options(play, PlayingOptions, **metavars)


def _add_action(actions: Any, name: str, text: str) -> argparse.ArgumentParser:
    action: argparse.ArgumentParser = actions.add_parser(name, help=text, description=text)
    action.add_argument(
        '--json',
        action='store_true',
        default=argparse.SUPPRESS,
        help='print the result as JSON on standard output',
    )
    return action


def run(arguments: argparse.Namespace) -> None:
    """Run the action. Raises DataError."""
    actions: Mapping[str, Callable[[argparse.Namespace], None]] = {
        'recover': _recover,
        'info': _info,
        'record': _record,
        'play': _play,
    }
    actions[arguments.action](arguments)


def _recover(arguments: argparse.Namespace) -> None:
    from ..io.bags.salvage import recover_bag

    recovery = recover_bag(arguments.source, arguments.out)
    total = sum(recovery.counts.values())
    lost = recovery.lost
    document = {
        'out': str(arguments.out),
        'messages': recovery.counts,
        'lost': lost,
        'damages': [vars(damage) for damage in recovery.damages],
        'left_out': recovery.skipped,
    }
    lines = [f'{total} messages recovered, written to {arguments.out}']
    lines += [f'  {topic}: {count}' for topic, count in recovery.counts.items()]
    lines += [_damage_text(damage) for damage in recovery.damages]
    if lost:
        counts = ', '.join(f'{topic} {count}' for topic, count in lost.items())
        lines.append(f'lost in total, from the message counts of the bag: {counts}')
    elif not recovery.damages:
        lines.append('nothing is lost')
    lines += [f'not recovered: {topic}: {reason}' for topic, reason in recovery.skipped.items()]
    print_result(arguments, document, '\n'.join(map(printable, lines)))


def _info(arguments: argparse.Namespace) -> None:
    from ..io.bags.salvage import inspect_bag

    report = inspect_bag(arguments.source)
    faults = report.faults
    document = {
        'files': report.files,
        'topics': {
            topic: _topic_document(topic_report) for topic, topic_report in report.topics.items()
        },
        'without_partner': report.without_partner,
        'lost': report.lost,
        'damages': [vars(damage) for damage in report.damages],
        'faults': faults,
    }
    print_result(arguments, document, _info_text(report, faults))


def _record(arguments: argparse.Namespace) -> None:
    from ..io.bags.recording import RecordingOptions

    _become('recorder_node', RecordingOptions, arguments, folder=arguments.out)


def _play(arguments: argparse.Namespace) -> None:
    from ..io.bags.recording import PlayingOptions

    _become('player_node', PlayingOptions, arguments, bag=arguments.source)


def _become(node: str, options: type, arguments: argparse.Namespace, **paths: Path) -> NoReturn:
    """Replace this process by a node with these options of the command, topics and paths."""
    parameters = dataclasses.asdict(options_of(options, arguments))
    parameters |= {name: str(path.absolute()) for name, path in paths.items()}
    if arguments.topics:
        parameters['topics'] = arguments.topics
    become_node(node, parameters)


def become_node(node: str, parameters: Mapping[str, Any]) -> NoReturn:
    """Replace this process by a node, which gets its signals and determines the exit status."""
    code = f'from fluoro_calib_ros.entry_points import {node}; {node}()'
    words = ['--ros-args']
    for name, value in parameters.items():
        words += ['-p', f'{name}:={json.dumps(value)}']  # JSON is valid YAML
    os.execv(sys.executable, [sys.executable, '-c', code, *words])


def _info_text(report: BagReport, faults: list[str]) -> str:
    first_ns = [min(topic.log_ns) for topic in report.topics.values()]
    last_ns = [max(topic.log_ns) for topic in report.topics.values()]
    total = sum(len(topic.log_ns) for topic in report.topics.values())
    lines = [f'{total} messages in {len(report.files)} files']
    if first_ns:
        seconds = (max(last_ns) - min(first_ns)) * 1e-9
        lines.append(f'from {_time(min(first_ns))} to {_time(max(last_ns))} ({seconds:.3f} s)')
    for topic, topic_report in report.topics.items():
        rate = f', {1e9 / topic_report.interval_ns:.1f} Hz' if topic_report.interval_ns > 0 else ''
        lines.append(f'  {topic} [{topic_report.type}]: {len(topic_report.log_ns)} messages{rate}')
    lines += [f'fault: {fault}' for fault in faults] or ['no faults found']
    return '\n'.join(map(printable, lines))


def _topic_document(topic: TopicReport) -> dict[str, Any]:
    counts = ('backward_jumps', 'missing_frames', 'repeated_frames', 'restarts', 'undecodable')
    return {
        'type': topic.type,
        'messages': len(topic.log_ns),
        'start_ns': min(topic.log_ns),
        'end_ns': max(topic.log_ns),
        'rate_hz': 1e9 / topic.interval_ns if topic.interval_ns > 0 else None,
        'longest_gap_s': topic.longest_gap_s,
        **{name: getattr(topic, name) for name in counts},
    }


def _damage_text(damage: Damage) -> str:
    """Return the lost time range, and the topics if known, as text."""
    if damage.start_ns is None and damage.end_ns is None:
        period = 'the whole file'
    elif damage.end_ns is None:
        period = f'after {_time(damage.start_ns or 0)}'
    elif damage.start_ns is None:
        period = f'before {_time(damage.end_ns)}'
    else:
        period = f'between {_time(damage.start_ns)} and {_time(damage.end_ns)}'
    counts = ', '.join(f'{topic} {count}' for topic, count in damage.lost.items())
    return f'lost: {period} ({damage.path}: {damage.cause})' + (f': {counts}' if counts else '')


def _time(ns: int) -> str:
    """Return a time as UTC to the millisecond."""
    seconds, remainder_ns = divmod(ns, 10**9)
    try:
        text = datetime.fromtimestamp(seconds, timezone.utc).strftime('%Y-%m-%dT%H:%M:%S')
    except (OverflowError, ValueError, OSError):
        return f'{ns} ns'
    return f'{text}.{remainder_ns // 10**6:03d}Z'
