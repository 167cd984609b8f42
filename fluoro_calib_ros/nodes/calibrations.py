"""Taking calibrations over in a node that works with them: each is prepared beside the stream."""

import threading

from fluoro_calib_msgs.msg import FluoroscopeCalibration

from ..errors import DataError
from .conversion import calibration_from_message
from .qos import LATCHED
from .support import sentence_of


class Calibrations:
    """The calibrations of fluoroscopes (names) that arrive at a node.

    prepare(calibration): makes what the first frame needs, in a thread, and returns what is to be
    kept; taken(name, prepared): called in that thread once it is kept; refused(name, error): why a
    calibration is none. What was kept before stays until then: a frame sees one or the other,
    never half of each. Of calibrations that come while one is being prepared the newest is next.
    """

    def __init__(self, node, names, prepare, taken, refused):
        self._node = node
        self._prepare = prepare
        self._taken = taken
        self._refused = refused
        self._kept = dict.fromkeys(names)
        self._next = {}
        self._threads = {}
        self._lock = threading.Lock()  # of _next and _threads
        self._inputs = [
            node.create_subscription(
                FluoroscopeCalibration,
                f'{name}/calibration',
                lambda message, name=name: self._on_calibration(name, message),
                LATCHED,
            )
            for name in names
        ]

    def of(self, name):
        """What is kept of a fluoroscope, None before its first calibration."""
        return self._kept[name]

    def _on_calibration(self, name, message):
        with self._lock:
            self._next[name] = message
            at_work = self._threads.get(name)
            if (
                at_work is None or not at_work.is_alive()
            ):  # one a fluoroscope, however many calibrations come
                self._threads[name] = threading.Thread(
                    target=self._work, args=(name,), daemon=True
                )
                self._threads[name].start()

    def _work(self, name):
        while True:
            with self._lock:
                message = self._next.pop(name, None)
                if message is None:
                    self._threads.pop(name, None)
                    return
            self._take(name, message)

    def _take(self, name, message):
        try:
            calibration = calibration_from_message(message)
            if calibration.fluoroscope != name:
                raise DataError(
                    f'the calibration on topic {name}/calibration is of fluoroscope '
                    f'{calibration.fluoroscope}'
                )
            prepared = self._prepare(calibration)
        except (
            Exception
        ) as error:  # a message may hold anything, and the stream goes on with the running one
            self._node.get_logger().error(
                f'calibration refused, the running one stays: {sentence_of(error)}'
            )
            self._refused(name, sentence_of(error))
            return
        self._kept[name] = prepared
        self._taken(name, prepared)

    def close(self):
        """Take no more, and wait for what is being prepared: it needs the node."""
        for subscription in self._inputs:
            self._node.destroy_subscription(subscription)
        self._inputs = []
        with self._lock:
            self._next.clear()
            running = list(self._threads.values())
        for thread in running:
            thread.join()
