"""What a frame must be to be corrected, looked at in microseconds."""

import numpy as np

from ..photogrammetry.observations import DataError

KINDS = ('undecodable', 'lengths', 'image size', 'frame id', 'repeated target', 'sigma')   # of refused messages


class Refused(DataError):
    """Why a message is refused: its kind, one of KINDS, and the sentence."""

    def __init__(self, kind, sentence):
        super().__init__(sentence)
        self.kind = kind


class FrameChecks:
    """The checks of the frames of one fluoroscope.

    A stream brings the same targets frame after frame: they are looked through when they change.
    """

    def __init__(self, fluoroscope):
        self._fluoroscope, self._unique = fluoroscope, None   # target ids that were looked through last

    def arrays_of(self, message, calibration):
        """u, v (n,) and sigma (n,) or None of a TargetObservations message for a calibration; the message keeps the
        memory. Raises Refused where it cannot be corrected as a whole."""
        ids, count = message.target_id, len(message.target_id)
        for name, field in (('u', message.u), ('v', message.v), ('sigma', message.sigma)):
            if len(field) != count and (name != 'sigma' or len(field)):
                raise self._refused('lengths', message, f'{count} target ids, but {len(field)} values of {name}')
        width, height = calibration.image_size
        if message.image_width != width or message.image_height != height:
            raise self._refused('image size', message, f'the image is {message.image_width} x {message.image_height} '
                                f'px, but the calibration is for {width} x {height} px')
        frame_id = message.header.frame_id
        if frame_id != calibration.frame_id and frame_id and calibration.frame_id:
            raise self._refused('frame id', message, f'the frame id is {frame_id}, but the calibration is of '
                                f'{calibration.frame_id}')
        if ids != self._unique:
            values, counts = np.unique(np.asarray(ids), return_counts=True)
            if len(values) < count:
                raise self._refused('repeated target', message,
                                    f'target {values[counts > 1][0]} is there {counts.max()} times')
            self._unique = ids
        if not len(message.sigma):
            return np.frombuffer(message.u), np.frombuffer(message.v), None
        sigma = np.frombuffer(message.sigma)
        if not (sigma.min() > 0 and sigma.max() < np.inf):   # NaN is neither
            wrong = ~(np.isfinite(sigma) & (sigma > 0))
            raise self._refused('sigma', message,
                                f'sigma of target {ids[int(wrong.argmax())]} is not a positive number')
        return np.frombuffer(message.u), np.frombuffer(message.v), sigma

    def _refused(self, kind, message, what):
        return Refused(kind, f'fluoroscope {self._fluoroscope}, frame {message.frame_number}: {what}')


def check_corrected(fluoroscope, message):
    """Raise Refused for a CorrectedObservations message whose arrays do not belong together."""
    count = len(message.target_id)
    where = f'fluoroscope {fluoroscope}, frame {message.frame_number}'
    for name in ('u', 'v', 'sigma', 'correction_sd', 'status'):
        if len(getattr(message, name)) != count:
            raise Refused('lengths', f'{where}: {count} target ids, but {len(getattr(message, name))} values of {name}')
    if len(set(message.target_id)) < count:
        raise Refused('repeated target', f'{where}: a target is there more than once')
