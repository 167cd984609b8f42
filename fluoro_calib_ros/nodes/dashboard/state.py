# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What a dashboard shows of a session, whichever way; it knows neither ROS nor a screen."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Protocol

LEVELS = ('ok', 'warn', 'error', 'silent')  # of a node or a function; silent: nothing is heard
# Keys by which a user asks for something, and what the dashboard then calls.
CAPTURE = 'capture'
CALIBRATE = 'calibrate'
CALIBRATE_FAST = 'calibrate_fast'
CANCEL = 'cancel'
ORIENT = 'orient'
RESET = 'reset'
HEAL = 'heal'
ACCEPT = 'accept_healing'
ROLL_BACK = 'roll_back_healing'
REQUESTS = (
    *(CAPTURE, CALIBRATE, CALIBRATE_FAST, CANCEL, ORIENT, RESET),
    *(HEAL, ACCEPT, ROLL_BACK),
)

RATE_WINDOW_S = 5.0  # over which rates are counted


@dataclass(frozen=True)
class FluoroscopeState:
    """One fluoroscope. NaN and '' stand for what is not known yet."""

    name: str
    state: str = ''  #: 'collecting', 'calibrating', 'calibrated'
    #: frames that arrive, and frames that are corrected, a second
    frames_hz: float = math.nan
    corrected_hz: float = math.nan
    #: from the arrival of a frame to its correction
    latency_p50_ms: float = math.nan
    latency_p99_ms: float = math.nan
    rejected: int = 0  #: frames refused because their content was wrong
    frames: int = 0  #: frames that arrived since the calibration node was started
    exposures: int = 0
    coverage: float = 0.0  #: covered part of the image, 0 to 1
    next_pose: str = ''  #: what the next exposure should show
    ready: bool = False  #: whether the exposures suffice
    iteration: int = 0  #: round of the running or last calibration
    rmse_px: tuple[float, float] = (math.nan, math.nan)  #: of that round, in u and v
    calibration_id: str = ''
    age_s: float = math.nan  #: of the calibration
    verdict: str = ''  #: on the calibration
    findings: tuple[str, ...] = ()  #: why it is no pass


@dataclass(frozen=True)
class NodeState:
    """One node: its worst level and the message that belongs to it."""

    name: str
    level: str
    message: str


@dataclass(frozen=True)
class Diagnosis:
    """What the action heal has found, until it is accepted or rolled back."""

    verdict: str = ''  #: on the healed rig, '' without a diagnosis
    findings: tuple[str, ...] = ()  #: what has changed, and what speaks against the healed rig
    orientation_id: str = ''  #: of the healed rig, '' where nothing of the rig has changed


@dataclass(frozen=True)
class SessionState:
    """The whole session."""

    namespace: str = '/'
    fluoroscopes: tuple[FluoroscopeState, ...] = ()
    nodes: tuple[NodeState, ...] = ()
    points_hz: float = math.nan  #: exposures reconstructed a second
    points_latency_ms: tuple[float, float] = (math.nan, math.nan)  #: median and 99th percentile
    orientation: str = ''  #: source of the orientation of the rig, '' without one
    orientation_id: str = ''  #: of the one in use
    diagnosis: Diagnosis = field(default_factory=Diagnosis)
    #: of the drift watch
    drift_level: str = ''
    drift: str = ''
    verdict: str = ''  #: the worst one on the calibrations in use
    findings: tuple[str, ...] = ()
    results: str = ''  #: folder into which the calibration node writes its results
    job: str = ''  #: what runs at the moment, '' if nothing does
    log: tuple[str, ...] = ()  #: what was asked for, and the answers; the newest last

    @property
    def acceptable(self) -> bool:
        """Whether a healed rig waits to be accepted."""
        healed = self.diagnosis
        return healed.verdict == 'pass' and healed.orientation_id not in ('', self.orientation_id)


VERDICTS = ('fail', 'cannot tell', 'pass', '')  # the worst one first


def worst_verdict(fluoroscopes: Iterable[FluoroscopeState]) -> tuple[str, tuple[str, ...]]:
    """Return the worst verdict on the calibrations in use, and all findings."""
    of_all = tuple(fluoroscopes)
    known = [one.verdict for one in of_all if one.verdict in VERDICTS]
    verdict = min(known, key=VERDICTS.index, default='')
    return verdict, tuple(dict.fromkeys(found for one in of_all for found in one.findings))


class Session(Protocol):
    """What the view needs: the present state, and somebody who carries out requests."""

    def state(self) -> SessionState:
        """Return the present state."""
        ...

    def request(self, action: str) -> None:
        """Start one of REQUESTS; the answer comes into the log."""
        ...


@dataclass
class RateMeter:
    """Events a second, from a counter that is read now and then."""

    _readings: deque[tuple[float, int]] = field(default_factory=lambda: deque(maxlen=100))

    def add(self, seconds: float, count: int) -> None:
        """Add a reading; a counter that was reset begins anew."""
        if self._readings and count < self._readings[-1][1]:
            self._readings.clear()
        self._readings.append((seconds, count))
        while seconds - self._readings[0][0] > RATE_WINDOW_S:
            self._readings.popleft()

    @property
    def hz(self) -> float:
        """The mean rate of the last seconds, NaN before two readings."""
        if len(self._readings) < 2:
            return math.nan
        (first_s, first), (last_s, last) = self._readings[0], self._readings[-1]
        return (last - first) / (last_s - first_s) if last_s > first_s else math.nan


@dataclass(frozen=True)
class Light:
    """The session in one colour, one word and one sentence, for whoever stands at the phantom."""

    level: str  #: 'ok', 'warn', 'error' or 'busy'
    word: str
    sentence: str


def light(state: SessionState) -> Light:
    """Return the light of a session: what is worst, else what is to be done next."""
    bad = [node for node in state.nodes if node.level in ('error', 'silent')]
    if not state.nodes:
        return Light('error', 'No signal', 'no node of the rig has reported yet')
    if state.acceptable and not state.job:
        return Light('warn', 'Healed', 'accept the healed rig, which is then in use')
    if bad:
        return Light('error', 'Problem', f'{bad[0].name}: {bad[0].message}')
    if state.job:
        return Light('busy', 'Healing' if state.job.startswith(HEAL) else 'Calibrating', state.job)
    if state.verdict == 'fail':
        return Light('error', 'Do not use', 'the last calibration has failed its verdict')
    open_ = [f for f in state.fluoroscopes if not f.calibration_id]
    missing = [f for f in open_ if not f.ready]
    if missing:
        return Light('warn', 'Collecting', f'{missing[0].name}: {missing[0].next_pose}')
    if open_:
        return Light('warn', 'Ready', 'enough poses are collected: calibrate')
    doubtful = [node for node in state.nodes if node.level == 'warn']
    if doubtful:
        return Light('warn', 'Attention', f'{doubtful[0].name}: {doubtful[0].message}')
    if state.verdict == 'cannot tell':
        return Light('warn', 'Attention', 'it cannot be told whether the calibration is good')
    drift = f'; drift: {state.drift}' if state.drift else ''
    return Light('ok', 'OK', f'calibrated{drift}')
