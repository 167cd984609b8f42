"""A calibration in a process of its own: it takes neither the interpreter nor the time of its caller's threads."""

import multiprocessing
import os
import signal
from dataclasses import replace

from .job import calibrate
from .validation import validate_or_tell

POLL_S = 0.05   # how often the caller may stop it
NICE = 10   # what runs live goes first


def calibrate_beside(frames, phantom, options, joint, principal_distance, progress, check, validated=False):
    """calibrate() of job.py in a process of its own; returns its JobResult without the runs, and the Validation of
    it, or None unless validated.

    progress(fluoroscope, Round) after every round; check() is called all the time and may raise to end it at
    once. Raises DataError as calibrate() does, and RuntimeError where it failed otherwise.
    """
    context = multiprocessing.get_context('spawn')   # a fork would take locks of other threads along
    here, there = context.Pipe(duplex=False)
    process = context.Process(target=_work, daemon=True, args=(
        there, validated, frames, phantom, options, joint, principal_distance))
    masked = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])   # is inherited
    process.start()   # without the interrupt from the keyboard, which comes to all: the caller ends it
    signal.pthread_sigmask(signal.SIG_SETMASK, masked)
    there.close()
    try:
        while True:
            check()
            if not here.poll(POLL_S):
                continue
            kind, content = here.recv()
            if kind == 'round':
                progress(*content)
            elif kind == 'fault':
                raise content
            else:
                return content
    except EOFError:
        process.join()
        raise RuntimeError(f'its process ended with status {process.exitcode}') from None
    finally:
        process.terminate()
        process.join()
        here.close()


def _work(there, validated, frames, phantom, *how):
    """Calibrate, and send ('round', (fluoroscope, Round)), then ('done', (JobResult, Validation or None)) or
    ('fault', exception)."""
    os.nice(NICE)
    try:
        job = calibrate(frames, phantom, *how, progress=lambda *content: there.send(('round', content)))
        verdict = validate_or_tell(frames, phantom, job.calibrations, *how) if validated else None
        there.send(('done', (replace(job, runs={}), verdict)))
    except ValueError as error:   # DataError among them
        there.send(('fault', error))
    except Exception as error:
        there.send(('fault', RuntimeError(repr(error))))
