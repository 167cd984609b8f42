# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The dashboard in a terminal; it depends on the session state only, not on ROS."""

from __future__ import annotations

import math
import time
from collections.abc import Callable

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text
from textual.app import App, ComposeResult
from textual.binding import Binding
from textual.containers import VerticalScroll
from textual.widgets import Footer, Static

from .state import FluoroscopeState, Session, SessionState

COLOURS = {
    'ok': 'green',
    'warn': 'yellow',
    'error': 'bold red',
    'silent': 'bold red',
    'pass': 'bold green',
    'fail': 'bold red',
    'cannot tell': 'yellow',
    'calibrated': 'green',
    'calibrating': 'cyan',
}
CONFIRM_S = 5.0  # time in which a second key press confirms
CONFIRMATIONS = {
    'reset': 'press r again to discard the exposures; the calibration stays',
    'roll_back_healing': 'press b again to return to the rig before it was healed',
}
BAR = 20  # width of the coverage bar in characters


def session_text(state: SessionState) -> Group:
    """Return the whole session as a rich renderable."""
    parts = [_fluoroscopes(state), Text(), _nodes(state), Text(), _results(state)]
    return Group(*_title(state), *parts)


def plain(text: str) -> str:
    """Return a text without control characters: messages of peers must not control a terminal."""
    return ''.join(c if c.isprintable() else ' ' for c in text)


def _cell(text: str | Text) -> Text:
    """Return a table cell in which brackets are not interpreted as markup."""
    return text if isinstance(text, Text) else Text(plain(text))


def _title(state: SessionState) -> list[Text]:
    title = Text(plain(f'fluoro_calib  {state.namespace}'), style='bold')
    if state.job:
        title.append(plain(f'   {state.job}'), style='cyan')
    return [title, Text()]


def _fluoroscopes(state: SessionState) -> Table | Text:
    """Return a table with a column for each fluoroscope."""
    if not state.fluoroscopes:
        return Text('waiting for a calibration node or a correction node ...', style='yellow')
    table = _table()
    table.add_column('fluoroscope', style='dim')
    for fluoroscope in state.fluoroscopes:
        table.add_column(Text(plain(fluoroscope.name)), style='default')
    rows: list[tuple[str, Callable[[FluoroscopeState], str | Text]]] = [
        ('state', lambda f: _coloured(f.state)),
        ('frames', _frames),
        ('exposures', lambda f: str(f.exposures) if f.state else '-'),
        ('coverage', _coverage),
        ('next pose', lambda f: Text(plain(f.next_pose), style='green' if f.ready else 'default')),
        ('calibration', _calibration),
        ('corrected', _corrected),
    ]
    for label, cell in rows:
        table.add_row(label, *(_cell(cell(fluoroscope)) for fluoroscope in state.fluoroscopes))
    return table


def _frames(state: FluoroscopeState) -> str:
    rejected = f', {state.rejected} refused' if state.rejected else ''
    return _rate(state.frames_hz) + rejected


def _coverage(state: FluoroscopeState) -> Text:
    filled = round(BAR * state.coverage)
    bar = Text('#' * filled, style='green')
    bar.append('.' * (BAR - filled), style='dim')
    bar.append(f' {100 * state.coverage:3.0f} %')
    return bar


def _calibration(state: FluoroscopeState) -> str:
    rmse = state.rmse_px
    residuals = '' if math.isnan(rmse[0]) else f'RMSE {rmse[0]:.3f} {rmse[1]:.3f} px'
    if state.state == 'calibrating':
        return f'round {state.iteration}  {residuals}'
    if not state.calibration_id:
        return 'none'
    age = '' if math.isnan(state.age_s) else f'{_duration(state.age_s)} ago  '
    return f'{age}{residuals}' or state.calibration_id


def _corrected(state: FluoroscopeState) -> str:
    if math.isnan(state.corrected_hz):
        return '-'
    return f'{_rate(state.corrected_hz)}  {_latency(state.latency_p50_ms, state.latency_p99_ms)}'


def _nodes(state: SessionState) -> Table:
    table = _table()
    table.add_column('node', no_wrap=True)
    table.add_column('state', no_wrap=True)
    table.add_column('')
    for node in state.nodes:
        table.add_row(_cell(node.name), _coloured(node.level), _cell(node.message))
    if not state.nodes:
        table.add_row('none', '', '')
    return table


def _results(state: SessionState) -> Table:
    table = _table(header=False)
    table.add_column(style='dim', no_wrap=True)
    table.add_column()
    points = _rate(state.points_hz)
    if not math.isnan(state.points_latency_ms[0]):
        points += f'  {_latency(*state.points_latency_ms)}'
    table.add_row('points in space', points)
    table.add_row('orientation', _cell(state.orientation or 'none yet'))
    table.add_row('drift', _coloured(state.drift_level, state.drift or '-'))
    if state.diagnosis.verdict:
        hint = ', a accepts it' if state.acceptable else ''
        table.add_row(
            'healing', _coloured(state.diagnosis.verdict, state.diagnosis.verdict + hint)
        )
        for finding in state.diagnosis.findings:
            table.add_row('', _cell(finding))
    verdict = _coloured(state.verdict, state.verdict or 'none on the calibration in use')
    table.add_row('verdict', verdict)
    for finding in state.findings:
        table.add_row('', _cell(finding))
    return table


def _table(header: bool = True) -> Table:
    return Table(box=None, pad_edge=False, show_header=header, padding=(0, 2, 0, 0), expand=False)


def _coloured(key: str, text: str | None = None) -> Text:
    return Text(plain(key or '-' if text is None else text), style=COLOURS.get(key, 'default'))


def _rate(hz: float) -> str:
    return '-' if math.isnan(hz) else f'{hz:.1f} a second'


def _latency(p50_ms: float, p99_ms: float) -> str:
    return '' if math.isnan(p50_ms) else f'{p50_ms:.2f} ms (99 %: {p99_ms:.2f})'


def _duration(seconds: float) -> str:
    for unit, length in (('d', 86400), ('h', 3600), ('min', 60)):
        if seconds >= 2 * length:
            return f'{seconds / length:.0f} {unit}'
    return f'{seconds:.0f} s'


class Dashboard(App[None]):
    """Shows a session, and passes the requests made by key to it."""

    CSS = """
    #session { height: auto; padding: 0 1; }
    #log { height: 8; dock: bottom; padding: 0 1; border-top: solid gray; margin-bottom: 1; }
    """
    ENABLE_COMMAND_PALETTE = False
    BINDINGS = [
        Binding('p', "ask('capture')", 'Pose: capture'),
        Binding('c', "ask('calibrate')", 'Calibrate'),
        Binding('f', "ask('calibrate_fast')", 'Fast, no verdict'),
        Binding('o', "ask('orient')", 'Orient'),
        Binding('h', "ask('heal')", 'Heal'),
        Binding('a', "ask('accept_healing')", 'Accept'),
        Binding('b', "confirm('roll_back_healing')", 'Roll back'),
        Binding('r', "confirm('reset')", 'Reset'),
        Binding('x', "ask('cancel')", 'Cancel'),
        Binding('q', 'quit', 'Quit'),
    ]

    def __init__(self, session: Session) -> None:
        super().__init__()
        self._session = session
        self._confirm_until = 0.0
        self._confirmed = ''  # request that a second key press confirms
        self._note = ''

    def compose(self) -> ComposeResult:
        """Create the widgets."""
        with VerticalScroll():
            yield Static(id='session')
        yield Static(id='log')
        yield Footer()

    def on_mount(self) -> None:
        """Show the state now and twice a second."""
        self.show()
        self.set_interval(0.5, self.show)

    def show(self) -> None:
        """Show the current state."""
        state = self._session.state()
        self._update('#session', session_text(state))
        if self._note and time.monotonic() > self._confirm_until:
            self._note = ''
        lines = [*state.log, *([self._note] if self._note else [])]
        self._update('#log', Text('\n'.join(map(plain, lines[-6:]))))

    def _update(self, selector: str, content: RenderableType) -> None:
        """Update a widget, if it exists: as the application ends, it may go before the timer."""
        for widget in self.query(selector).results(Static):
            widget.update(content)

    def action_ask(self, request: str) -> None:
        """Make a request to the session."""
        self._confirm_until = 0.0
        self._note = ''
        self._session.request(request)
        self.show()

    def action_confirm(self, request: str) -> None:
        """Make a request that loses data, once the key is pressed a second time."""
        if request == self._confirmed and time.monotonic() < self._confirm_until:
            self.action_ask(request)
            return
        self._confirmed = request
        self._confirm_until = time.monotonic() + CONFIRM_S
        self._note = CONFIRMATIONS[request]
        self.show()
