# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Session state that every dashboard view shows; independent of ROS and of the display."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Protocol

LEVELS = ('ok', 'warn', 'error', 'silent')  # of a node or a function; silent: no reports
# Names of the requests that a user can make.
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

RATE_WINDOW_S = 5.0  # time window in which rates are counted


@dataclass(frozen=True)
class FluoroscopeState:
    """State of one fluoroscope; NaN and '' mean not known yet."""

    name: str
    state: str = ''  #: 'collecting', 'calibrating', 'calibrated'
    #: frames received and frames corrected per second
    frames_hz: float = math.nan
    corrected_hz: float = math.nan
    #: delay from the arrival of a frame to its correction
    latency_p50_ms: float = math.nan
    latency_p99_ms: float = math.nan
    rejected: int = 0  #: frames refused because of their content
    frames: int = 0  #: frames received since the calibration node was started
    exposures: int = 0
    coverage: float = 0.0  #: covered part of the image, 0 to 1
    next_pose: str = ''  #: what the next exposure should show
    ready: bool = False  #: whether the exposures suffice to calibrate
    iteration: int = 0  #: round of the running or last calibration
    rmse_px: tuple[float, float] = (math.nan, math.nan)  #: residuals of that round, in u and v
    calibration_id: str = ''
    age_s: float = math.nan  #: of the calibration
    verdict: str = ''  #: on the calibration
    findings: tuple[str, ...] = ()  #: why the verdict is not pass


@dataclass(frozen=True)
class NodeState:
    """State of one node: its worst level and the corresponding message."""

    name: str
    level: str
    message: str


@dataclass(frozen=True)
class Diagnosis:
    """Result of the action heal, until it is accepted or rolled back."""

    verdict: str = ''  #: on the healed rig, '' if there is no diagnosis
    findings: tuple[str, ...] = ()  #: what has changed, and objections to the healed rig
    orientation_id: str = ''  #: of the healed rig, '' if the rig has not changed


@dataclass(frozen=True)
class SessionState:
    """State of the whole session."""

    namespace: str = '/'
    fluoroscopes: tuple[FluoroscopeState, ...] = ()
    nodes: tuple[NodeState, ...] = ()
    points_hz: float = math.nan  #: exposures reconstructed per second
    points_latency_ms: tuple[float, float] = (math.nan, math.nan)  #: median and 99th percentile
    orientation: str = ''  #: source of the orientation of the rig, '' without one
    orientation_id: str = ''  #: id of the orientation in use
    diagnosis: Diagnosis = field(default_factory=Diagnosis)
    #: level and message of the drift watch
    drift_level: str = ''
    drift: str = ''
    verdict: str = ''  #: worst verdict on the calibrations in use
    findings: tuple[str, ...] = ()
    results: str = ''  #: result folder of the calibration node
    job: str = ''  #: running job, '' if there is none
    log: tuple[str, ...] = ()  #: requests and their answers, the newest last

    @property
    def acceptable(self) -> bool:
        """Whether a healed rig can be accepted."""
        result = self.diagnosis
        return result.verdict == 'pass' and result.orientation_id not in ('', self.orientation_id)


VERDICTS = ('fail', 'cannot tell', 'pass', '')  # the worst first


def worst_verdict(fluoroscopes: Iterable[FluoroscopeState]) -> tuple[str, tuple[str, ...]]:
    """Return the worst verdict on the calibrations in use, and the findings on all of them."""
    states = tuple(fluoroscopes)
    verdicts = [fluoroscope.verdict for fluoroscope in states if fluoroscope.verdict in VERDICTS]
    verdict = min(verdicts, key=VERDICTS.index, default='')
    return verdict, tuple(
        dict.fromkeys(finding for fluoroscope in states for finding in fluoroscope.findings)
    )


class Session(Protocol):
    """Interface that a view needs: the current state, and a way to make requests."""

    def state(self) -> SessionState:
        """Return the current state."""
        ...

    def request(self, action: str) -> None:
        """Start one of REQUESTS; the answer is added to the log."""
        ...


@dataclass
class RateMeter:
    """Event rate, from occasional readings of a counter."""

    _readings: deque[tuple[float, float]] = field(default_factory=lambda: deque(maxlen=100))

    def add(self, seconds: float, count: float) -> None:
        """Add a reading; if the counter or the clock was set back, start again."""
        if self._readings and (seconds < self._readings[-1][0] or count < self._readings[-1][1]):
            self._readings.clear()
        self._readings.append((seconds, count))
        while seconds - self._readings[0][0] > RATE_WINDOW_S:
            self._readings.popleft()

    @property
    def hz(self) -> float:
        """Mean rate over the last RATE_WINDOW_S [Hz], NaN before two readings."""
        if len(self._readings) < 2:
            return math.nan
        (first_s, first), (last_s, last) = self._readings[0], self._readings[-1]
        return (last - first) / (last_s - first_s) if last_s > first_s else math.nan


@dataclass(frozen=True)
class Light:
    """Summary of a session for the operator at the phantom: a colour, a word and a sentence."""

    level: str  #: 'ok', 'warn', 'error' or 'busy'
    word: str
    sentence: str


def light(state: SessionState) -> Light:
    """Return the summary of a session: its worst problem, else what to do next."""
    faulty = [node for node in state.nodes if node.level in ('error', 'silent')]
    if not state.nodes:
        return Light('error', 'No signal', 'no node of the rig has reported yet')
    if state.acceptable and not state.job:
        return Light('warn', 'Healed', 'accept the healed rig, which is then in use')
    if faulty:
        return Light('error', 'Problem', f'{faulty[0].name}: {faulty[0].message}')
    if state.job:
        return Light('busy', 'Healing' if state.job.startswith(HEAL) else 'Calibrating', state.job)
    if state.verdict == 'fail':
        return Light('error', 'Do not use', 'the last calibration has failed its verdict')
    uncalibrated = [f for f in state.fluoroscopes if not f.calibration_id]
    collecting = [f for f in uncalibrated if not f.ready]
    if collecting:
        return Light('warn', 'Collecting', f'{collecting[0].name}: {collecting[0].next_pose}')
    if uncalibrated:
        return Light('warn', 'Ready', 'enough poses are collected: calibrate')
    doubtful = [node for node in state.nodes if node.level == 'warn']
    if doubtful:
        return Light('warn', 'Attention', f'{doubtful[0].name}: {doubtful[0].message}')
    if state.verdict == 'cannot tell':
        return Light(
            'warn', 'Attention', 'the checks cannot decide whether the calibration is good'
        )
    # A calibration that was loaded has its verdict in its report.
    verdict = f'verdict: {state.verdict}' if state.verdict else 'no verdict in this session'
    drift = f'; drift: {state.drift}' if state.drift else ''
    return Light('ok', 'OK', f'calibrated, {verdict}{drift}')
