"""A calibration in a process of its own: it takes neither the interpreter nor the time of its
caller's threads.
"""

import multiprocessing
import os
import signal
from dataclasses import replace

from ..calibration.calibrate import calibrate
from ..calibration.rig_orientation import orientation_of_exposures
from ..errors import DataError
from ..validation.verdict import validate_or_tell

POLL_S = 0.05  # how often the caller may stop it
NICE = 10  # what runs live goes first


def calibrate_beside(
    frames,
    phantom,
    options,
    joint,
    principal_distance,
    progress,
    raise_if_cancelled,
    validated=False,
    others=(),
    order=None,
):
    """calibrate() of job.py in a process of its own; returns its JobResult without the runs, the
    Validation of it, or None unless validated, and the RigOrientation or the sentence that says
    why there is none.

    progress(fluoroscope, Round) after every round; raise_if_cancelled() is called all the time and
    may raise to end it at once; others: (frames, calibration) of each fluoroscope that is not
    calibrated now, but belongs to the rig; order: names of the fluoroscopes of the rig, None: as
    they come. Raises DataError as calibrate() does, and RuntimeError where it failed otherwise.
    """
    context = multiprocessing.get_context(
        'spawn'
    )  # a fork would take locks of other threads along
    here, there = context.Pipe(duplex=False)
    process = context.Process(
        target=_work,
        daemon=True,
        args=(
            there,
            validated,
            others,
            order,
            frames,
            phantom,
            options,
            joint,
            principal_distance,
        ),
    )
    masked = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])  # is inherited
    # without the interrupt from the keyboard, which comes to all: the caller ends it
    process.start()
    signal.pthread_sigmask(signal.SIG_SETMASK, masked)
    there.close()
    try:
        while True:
            raise_if_cancelled()
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


def _work(there, validated, others, order, frames, phantom, *how):
    """Calibrate, and send ('round', (fluoroscope, Round)), then ('done', (JobResult, Validation or
    None, RigOrientation or sentence)) or ('fault', exception).
    """
    os.nice(NICE)
    try:
        job = calibrate(
            frames, phantom, *how, progress=lambda *content: there.send(('round', content))
        )
        orientation = _orientation(frames, phantom, job.calibrations, others, order)
        verdict = validate_or_tell(frames, phantom, job.calibrations, *how) if validated else None
        there.send(('done', (replace(job, runs={}), verdict, orientation)))
    except ValueError as error:  # DataError among them
        there.send(('fault', error))
    except Exception as error:
        there.send(('fault', RuntimeError(repr(error))))


def _orientation(frames, phantom, calibrations, others, order):
    """RigOrientation of the calibrated fluoroscopes and the others, or why there is none."""
    frames = {**frames, **{c.fluoroscope: of_one for of_one, c in others}}
    calibrations = {**calibrations, **{c.fluoroscope: c for _, c in others}}
    if len(calibrations) < 2:
        return 'a single fluoroscope is calibrated'
    names = [name for name in order or calibrations if name in calibrations]
    try:
        return orientation_of_exposures(
            {n: frames[n] for n in names}, phantom, {n: calibrations[n] for n in names}
        )
    except DataError as error:
        return str(error)
