# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Run a calibration job in another process, so that it does not delay its caller."""

from __future__ import annotations

import multiprocessing
import os
from contextlib import suppress
from multiprocessing.connection import Connection

from ..calibration.request import CalibrationRequest
from .calibration import CalibrationOutcome, Cancellation, Progress, Rig, run_calibration
from .parent_watch import start_child

POLL_S = 0.05  # interval at which the caller may cancel [s]
NICE = 10  # lower priority than the live nodes


def run_in_worker_process(
    request: CalibrationRequest,
    *,
    validate: bool = False,
    rig: Rig | None = None,
    progress: Progress | None = None,
    raise_if_cancelled: Cancellation | None = None,
) -> CalibrationOutcome:
    """Run `run_calibration` in another process.

    Parameters and errors are those of `run_calibration`. The outcome has no networks.
    raise_if_cancelled is called repeatedly and may raise to terminate the process. Raises
    RuntimeError for any other failure of the process.
    """
    context = multiprocessing.get_context('spawn')  # a fork would copy locks of other threads
    receiver, sender = context.Pipe(duplex=False)
    process = start_child(context, _work, sender, request, validate, rig)
    sender.close()
    try:
        return _outcome(receiver, progress, raise_if_cancelled)
    except EOFError:
        process.join()
        raise RuntimeError(f'the worker process ended with status {process.exitcode}') from None
    finally:
        process.terminate()
        process.join()
        receiver.close()


def _outcome(
    receiver: Connection,
    progress: Progress | None,
    raise_if_cancelled: Cancellation | None,
) -> CalibrationOutcome:
    """Receive rounds until the outcome, or the error, arrives."""
    while True:
        if raise_if_cancelled is not None:
            raise_if_cancelled()
        if not receiver.poll(POLL_S):
            continue
        kind, content = receiver.recv()
        if kind == 'error':
            raise content
        if kind == 'outcome':
            return content
        if progress is not None:
            progress(*content)


def _work(
    sender: Connection,
    request: CalibrationRequest,
    validate: bool,
    rig: Rig | None,
) -> None:
    """Run the job in the worker process.

    Sends ('round', arguments of progress) after every round, and ('outcome', CalibrationOutcome)
    or ('error', exception) at the end.
    """
    os.nice(NICE)
    with suppress(BrokenPipeError):  # the parent has died; so does this process
        try:
            outcome = run_calibration(
                request,
                validate=validate,
                rig=rig,
                progress=lambda *content: sender.send(('round', content)),
            )
            sender.send(('outcome', outcome.without_runs()))
        except BrokenPipeError:
            raise
        except ValueError as error:  # DataError among them
            sender.send(('error', error))
        except Exception as error:
            sender.send(('error', RuntimeError(repr(error))))
