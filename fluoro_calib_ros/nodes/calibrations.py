"""Taking calibrations over in a node that works with them: each is prepared beside the stream."""

import threading

from fluoro_calib_msgs.msg import FluoroscopeCalibration

from ..photogrammetry.observations import DataError
from .conversion import calibration_from_message
from .qos import LATCHED


class Calibrations:
    """The calibrations of fluoroscopes (names) that arrive at a node.

    prepare(calibration): makes what the first frame needs, in a thread, and returns what is to be kept; taken(name,
    prepared): called in that thread once it is kept; refused(name, error): why a calibration is none. What was kept
    before stays until then: a frame sees one or the other, never half of each.
    """

    def __init__(self, node, names, prepare, taken, refused):
        self._node, self._prepare, self._taken, self._refused = node, prepare, taken, refused
        self._kept, self._newest, self._threads = dict.fromkeys(names), dict.fromkeys(names, 0), {}
        self._inputs = [node.create_subscription(
            FluoroscopeCalibration, f'{name}/calibration',
            lambda message, name=name: self._on_calibration(name, message), LATCHED) for name in names]

    def of(self, name):
        """What is kept of a fluoroscope, None before its first calibration."""
        return self._kept[name]

    def _on_calibration(self, name, message):
        self._newest[name] += 1
        self._threads[name] = threading.Thread(target=self._take, args=(name, message, self._newest[name]), daemon=True)
        self._threads[name].start()

    def _take(self, name, message, number):
        try:
            calibration = calibration_from_message(message)
            if calibration.fluoroscope != name:
                raise DataError(f'the calibration on topic {name}/calibration is of fluoroscope '
                                f'{calibration.fluoroscope}')
            prepared = self._prepare(calibration)
        except ValueError as error:   # DataError among them
            self._node.get_logger().error(f'calibration refused, the running one stays: {error}')
            self._refused(name, error)
            return
        if number == self._newest[name]:   # else a newer one has come meanwhile
            self._kept[name] = prepared
            self._taken(name, prepared)

    def close(self):
        """Take no more, and wait for what is being prepared: it needs the node."""
        for subscription in self._inputs:
            self._node.destroy_subscription(subscription)
        self._inputs = []
        for thread in self._threads.values():
            thread.join()
