# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The dashboard in a browser: a page for use next to the X-ray machine.

The page requests everything by HTTP and loads nothing from elsewhere. Opening the address with the
token sets a cookie, without which no request is answered. Requests that act on the rig are
accepted from this page only (same origin).
"""

from __future__ import annotations

import asyncio
import hmac
import logging
import os
import secrets
import signal
import sys
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from tornado.httpserver import HTTPServer
from tornado.netutil import bind_sockets
from tornado.web import Application, HTTPError, RequestHandler

from ...errors import DataError
from ...io.calibration import RESULT_NAME
from ...io.documents import to_json_values
from ...jobs.image_sources import dose_texts
from ...jobs.result_folder import REPORT
from .scene import Scene
from .state import REQUESTS, Session, light

PAGE = Path(__file__).parent / 'page'
FILES = {
    '/': ('index.html', 'text/html'),
    '/style.css': ('style.css', 'text/css'),
    '/page.js': ('page.js', 'text/javascript'),
}
POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src data: blob:; "
    "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
# The report contains its styles and scripts, and must not act on behalf of this page.
REPORT_POLICY = (
    "sandbox allow-scripts; default-src 'none'; script-src 'unsafe-inline'; "
    "style-src 'unsafe-inline'; img-src data:"
)
REFUSAL = 'open the address that fluoro-calib watch has printed, with its token'


@dataclass(frozen=True)
class WebOptions:
    """Where the page is served, and settings of a rig.toml.

    port 0: any free one. token: empty for a new one. mas: tube load of a frame [mAs], 0 if
    unknown. dicom: folder of DICOM files from which the dose is read, or None.
    """

    host: str = '127.0.0.1'
    port: int = 8080
    token: str = ''
    mas: float = 0.0
    dicom: Path | None = None


@dataclass(frozen=True)
class Desk:
    """Objects shared by the handlers of the page."""

    session: Session
    scene: Scene
    options: WebOptions
    residuals: dict[str, Any]  #: residual vectors, by calibration ids


class Handler(RequestHandler):
    """Answers clients that have the token."""

    def initialize(self, desk: Desk) -> None:
        """Store the shared objects."""
        self._desk = desk

    def set_default_headers(self) -> None:
        """Forbid everything that the page does not need."""
        self.set_header('Content-Security-Policy', POLICY)
        self.set_header('X-Content-Type-Options', 'nosniff')
        self.set_header('Referrer-Policy', 'no-referrer')
        self.set_header('Cache-Control', 'no-store')

    def prepare(self) -> None:
        """Refuse requests without the token, and requests of other pages that act on the rig."""
        token = self.get_query_argument('token', '')
        cookie = f'fluoro_calib_{self._desk.options.port}'
        if self._is_token(token):
            self.set_cookie(cookie, token, httponly=True, samesite='Strict')
            self.redirect(self.request.path)  # drops the token, which a screenshot would show
        elif not self._is_token(self.get_cookie(cookie) or ''):
            raise HTTPError(403, reason='Forbidden', log_message=REFUSAL)
        elif self.request.method != 'GET':
            origin = f'{self.request.protocol}://{self.request.host}'
            if self.request.headers.get('Origin') != origin:
                raise HTTPError(
                    403, reason='Forbidden', log_message='the request comes from another page'
                )

    def write_error(self, status_code: int, **kwargs: Any) -> None:
        """Answer with one sentence."""
        error = kwargs.get('exc_info', (None, None, None))[1]
        self.set_header('Content-Type', 'text/plain; charset=utf-8')
        self.finish(str(getattr(error, 'log_message', None) or 'the request cannot be answered'))

    def _is_token(self, text: str) -> bool:
        return hmac.compare_digest(text.encode(), self._desk.options.token.encode())

    def _finish_json(self, value: dict[str, Any]) -> None:
        self.finish(to_json_values(value))


class FileHandler(Handler):
    """Serves a file of the page."""

    def get(self) -> None:
        """Answer with the file."""
        name, kind = FILES[self.request.path]
        self.set_header('Content-Type', f'{kind}; charset=utf-8')
        self.finish((PAGE / name).read_bytes())


class StateHandler(Handler):
    """Serves the state of the session."""

    async def get(self) -> None:
        """Answer with the state, its summary light, and the known doses."""
        state = self._desk.session.state()
        folder = self._desk.options.dicom
        doses = await asyncio.to_thread(dose_texts, folder) if folder else {}
        self._finish_json(
            {
                **asdict(state),
                'acceptable': state.acceptable,
                'light': asdict(light(state)),
                'mas': self._desk.options.mas,
                'doses': doses,
            }
        )


class RadiographHandler(Handler):
    """Serves the current view of a fluoroscope."""

    def get(self, name: str) -> None:
        """Answer with the newest image and its image points."""
        self._finish_json(self._desk.scene.radiograph(_known(self._desk, name)))


class CoverageHandler(Handler):
    """Serves the coverage by the exposures, and the next pose."""

    def get(self, name: str) -> None:
        """Answer with the picture, or 204 before there is one."""
        picture = self._desk.scene.coverage(_known(self._desk, name))
        if not picture:
            self.set_status(204)
            return
        self.set_header('Content-Type', 'image/png')
        self.finish(picture)


class SpaceHandler(Handler):
    """Serves points in space."""

    def get(self) -> None:
        """Answer with the newest points and the sources."""
        self._finish_json(self._desk.scene.space())


class ResidualHandler(Handler):
    """Serves residual vectors of the calibration in use."""

    async def get(self) -> None:
        """Answer with the vectors, or with the reason why there are none."""
        key = ' '.join(f.calibration_id for f in self._desk.session.state().fluoroscopes)
        cache = self._desk.residuals
        if key not in cache:
            cache.clear()
            folder = _results(self._desk)
            cache[key] = await asyncio.to_thread(_vectors_of, folder)
        self._finish_json(cache[key])


class ReportHandler(Handler):
    """Serves the report of the calibration in use."""

    async def get(self) -> None:
        """Answer with the report; write it first if it is missing or outdated."""
        folder = _results(self._desk)
        report = folder / REPORT
        result = folder / RESULT_NAME
        if not report.exists() or report.stat().st_mtime < result.stat().st_mtime:
            await _write_report(folder)
        self.set_header('Content-Security-Policy', REPORT_POLICY)
        self.finish(report.read_bytes())


class RequestHandlerOfSession(Handler):
    """Passes requests to the rig on."""

    def post(self, action: str) -> None:
        """Pass a request to the session; the answer is added to its log."""
        if action not in REQUESTS:
            raise HTTPError(404, log_message='there is no such request')
        self._desk.session.request(action)
        self.set_status(204)


def _known(desk: Desk, name: str) -> str:
    """Return the name if the session has this fluoroscope. Raises HTTPError."""
    if name not in {f.name for f in desk.session.state().fluoroscopes}:
        raise HTTPError(404, log_message='there is no such fluoroscope')
    return name


def _results(desk: Desk) -> Path:
    """Return the result folder of the calibration node. Raises HTTPError."""
    folder = Path(desk.session.state().results or os.devnull)
    if not (folder / RESULT_NAME).is_file():
        raise HTTPError(
            404, log_message='there is no result of a calibration in a folder of this machine yet'
        )
    return folder


def _vectors_of(folder: Path) -> dict[str, Any]:
    from ...jobs.report import residual_vectors  # imports matplotlib

    try:
        return {'fluoroscopes': residual_vectors(folder)}
    except DataError as error:
        return {'fluoroscopes': {}, 'reason': str(error)}


async def _write_report(folder: Path) -> None:
    """Write the report in a separate process, as this takes seconds. Raises HTTPError."""
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, '-m', 'fluoro_calib_ros.cli', 'report', str(folder)),
        stdout=asyncio.subprocess.DEVNULL,
        stderr=asyncio.subprocess.PIPE,
    )
    _, message = await process.communicate()
    if process.returncode:
        raise HTTPError(500, log_message=message.decode(errors='replace').strip()[-1000:])


def application(desk: Desk) -> Application:
    """Return the application that serves the page."""
    name_pattern = '([A-Za-z0-9_-]+)'
    routes: list[tuple[str, type[Handler]]] = [
        *((path, FileHandler) for path in FILES),
        ('/state', StateHandler),
        (f'/fluoroscopes/{name_pattern}/radiograph', RadiographHandler),
        (f'/fluoroscopes/{name_pattern}/coverage', CoverageHandler),
        ('/space', SpaceHandler),
        ('/residuals', ResidualHandler),
        ('/report', ReportHandler),
        (f'/request/{name_pattern}', RequestHandlerOfSession),
    ]
    return Application([(path, handler, {'desk': desk}) for path, handler in routes])


async def run_server(
    session: Session, scene: Scene, options: WebOptions, started: Callable[[str], None]
) -> None:
    """Serve the page until the task is cancelled; started is called with its address.

    Raises DataError if the address cannot be bound.
    """
    logging.getLogger('tornado.access').setLevel(logging.CRITICAL)  # clients are told of refusals
    try:
        sockets = bind_sockets(options.port, options.host)
    except OSError as error:
        raise DataError(
            f'no page on {options.host}:{options.port} ({error.strerror or error}); --port '
            'chooses another'
        ) from None
    options = replace(
        options,
        port=sockets[0].getsockname()[1],
        token=options.token or secrets.token_urlsafe(16),
    )
    server = HTTPServer(
        application(Desk(session, scene, options, residuals={})),
        max_body_size=1000,  # bytes: a request names an action
    )
    server.add_sockets(sockets)
    started(f'http://{options.host}:{options.port}/?token={options.token}')
    try:
        await asyncio.Event().wait()
    finally:
        server.stop()
        await server.close_all_connections()


def serve(session: Session, scene: Scene, options: WebOptions) -> None:
    """Serve the page until an interrupt. Exits with a message if the address cannot be bound."""

    def started(address: str) -> None:
        print(f'fluoro-calib watch: open {address} in a browser; Ctrl-C ends it', flush=True)

    async def main() -> None:
        task = asyncio.ensure_future(run_server(session, scene, options, started))
        for number in (signal.SIGINT, signal.SIGTERM):
            asyncio.get_running_loop().add_signal_handler(number, task.cancel)
        await asyncio.wait([task])
        if not task.cancelled():
            task.result()

    try:
        asyncio.run(main())
    except DataError as error:
        sys.exit(f'fluoro-calib watch: {error}')
    finally:
        scene.close()
