"""What a frame must be to be corrected, looked at in microseconds."""

import numpy as np

from ..errors import DataError

KINDS = (
    'undecodable',
    'lengths',
    'image size',
    'frame id',
    'repeated target',
    'sigma',
)  # of refused messages
# characters of a sentence: names in a message may have any length, and go into log and diagnostics
LONGEST = 500


class Refused(DataError):
    """Why a message is refused: its kind, one of KINDS, and the sentence."""

    def __init__(self, kind, sentence):
        super().__init__(sentence if len(sentence) <= LONGEST else f'{sentence[:LONGEST]}...')
        self.kind = kind


class FrameChecks:
    """The checks of the frames of one fluoroscope.

    A stream brings the same targets frame after frame: they are looked through when they change.
    """

    def __init__(self, fluoroscope):
        # target ids that were looked through last, as bytes
        self._fluoroscope = fluoroscope
        self._unique = None

    def arrays_of(self, frame, calibration):
        """u, v (n,) and sigma (n,) or None of the Observations of a frame for a calibration.
        Raises Refused where they cannot be corrected as a whole.
        """
        sigma = frame.sigma
        count = len(frame.target_id) // 4
        if len(frame.u) != count or len(frame.v) != count or len(sigma) not in (0, count):
            name, values = next(
                (name, values)
                for name, values in (('u', frame.u), ('v', frame.v), ('sigma', sigma))
                if len(values) != count
            )
            raise self._refused(
                'lengths', frame, f'{count} target ids, but {len(values)} values of {name}'
            )
        if frame.image_size != calibration.image_size:
            (width, height) = frame.image_size
            (w, h) = calibration.image_size
            raise self._refused(
                'image size',
                frame,
                f'the image is {width} x {height} px, but the calibration is for {w} x {h} px',
            )
        frame_id = frame.frame_id
        if frame_id != calibration.frame_id and frame_id and calibration.frame_id:
            raise self._refused(
                'frame id',
                frame,
                f'the frame id is {frame_id}, but the calibration is of {calibration.frame_id}',
            )
        if frame.target_id != self._unique:
            self._check_unique(frame)
        if not len(sigma):
            return frame.u, frame.v, None
        if not (sigma.min() > 0 and sigma.max() < np.inf):  # NaN is neither
            wrong = ~(np.isfinite(sigma) & (sigma > 0))
            number = np.frombuffer(frame.target_id, np.uint32)[wrong.argmax()]
            raise self._refused(
                'sigma', frame, f'sigma of target {number} is not a positive number'
            )
        return frame.u, frame.v, sigma

    def _check_unique(self, frame):
        values, counts = np.unique(np.frombuffer(frame.target_id, np.uint32), return_counts=True)
        if len(counts) and counts.max() > 1:
            raise self._refused(
                'repeated target',
                frame,
                f'target {values[counts > 1][0]} is there {counts[counts > 1][0]} times',
            )
        self._unique = frame.target_id

    def _refused(self, kind, frame, what):
        return Refused(
            kind, f'fluoroscope {self._fluoroscope}, frame {frame.frame_number}: {what}'
        )


def check_corrected(fluoroscope, frame):
    """Raise Refused for a Corrected frame of which arrays do not belong together, or a standard
    deviation is none; it may be NaN, as at points that are INVALID.
    """
    count = len(frame.target_id)
    where = f'fluoroscope {fluoroscope}, frame {frame.frame_number}'
    for name in ('u', 'v', 'sigma', 'correction_sd', 'status'):
        if len(getattr(frame, name)) != count:
            raise Refused(
                'lengths',
                f'{where}: {count} target ids, but {len(getattr(frame, name))} values of {name}',
            )
    if len(set(frame.target_id.tolist())) < count:
        raise Refused('repeated target', f'{where}: a target is there more than once')
    for name, wrong in (
        ('sigma', frame.sigma <= 0),
        ('correction_sd', frame.correction_sd < 0),
    ):  # NaN is neither
        if wrong.any():
            raise Refused(
                'sigma',
                f'{where}: {name} of target {frame.target_id[wrong.argmax()]} is no standard '
                'deviation',
            )
