# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Findings of the program as data: kind, place, cause, advice, severity and numbers.

A Finding is passed from its origin to the output (command, report, file, message), which prints
its sentence. Decisions based on a finding use its kind and numbers, never the sentence.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from enum import Enum, IntEnum

MAX_LISTED = 5  # maximum number of names in a sentence


class Severity(IntEnum):
    """Importance of a finding; the values are the levels of diagnostics and of DriftStatus."""

    NOTE = 0
    WARNING = 1
    ERROR = 2


class Kind(str, Enum):
    """Kind of a finding; the values are written to files and stay the same between versions."""

    # Data that cannot be read or used, if no other kind applies.
    DATA = 'data'

    # Checks of a verdict; the values are the names of the checks in validation.json.
    BEADS = 'beads'
    DISTANCES = 'distances'
    DRIFT = 'drift'
    EXPOSURES = 'exposures'
    GIVEN_INTERIOR = 'given_interior'
    HALVES = 'halves'
    HELD_OUT = 'held_out'
    ORIENTATION = 'orientation'
    PRECISION = 'precision'
    SCALE = 'scale'
    SHAPE = 'shape'
    TAKEN_ON_TRUST = 'taken_on_trust'
    VALIDATION = 'validation'
    VARIATION = 'variation'
    WHITENESS = 'whiteness'
    WORST_AREA = 'worst_area'

    # Exposures, image points and targets that are excluded from a calibration.
    COPIED_EXPOSURE = 'copied_exposure'
    FALSE_MATCHES = 'false_matches'
    FEW_RAYS = 'few_rays'
    FEW_TARGETS = 'few_targets'
    NOT_ORIENTED = 'not_oriented'
    POOR_FIT = 'poor_fit'
    REPEATED_POSE = 'repeated_pose'
    SHARED_EXPOSURE = 'shared_exposure'
    STRAY_POINTS = 'stray_points'

    # Observations that do not suffice.
    FEW_EXPOSURES = 'few_exposures'
    ONE_POSE = 'one_pose'
    UNDETERMINED = 'undetermined'
    UNTILTED_TARGETS = 'untilted_targets'
    WEAK_INTERSECTION = 'weak_intersection'

    # Input that cannot be right.
    DUPLICATE_NAME = 'duplicate_name'
    FRAMES_SHIFTED = 'frames_shifted'
    FRAMES_DELAYED = 'frames_delayed'
    FRAME_LOST = 'frame_lost'
    IDS_REVERSED = 'ids_reversed'
    IDS_SHIFTED = 'ids_shifted'
    IMAGE_MIRRORED = 'image_mirrored'
    IMAGE_TRANSPOSED = 'image_transposed'
    IMPLAUSIBLE_NUMBER = 'implausible_number'
    MIXED_UNITS = 'mixed_units'
    OTHER_PHANTOM = 'other_phantom'
    REMOTE_TARGETS = 'remote_targets'
    REPEATED_COORDINATES = 'repeated_coordinates'
    SOURCE_TOO_NEAR = 'source_too_near'
    WRONG_IMAGE_SIZE = 'wrong_image_size'
    WRONG_KNOWN_ORIENTATION = 'wrong_known_orientation'
    WRONG_UNIT = 'wrong_unit'

    # Results that are impossible.
    FEW_INLIERS = 'few_inliers'
    FLUOROSCOPES_INTERCHANGED = 'fluoroscopes_interchanged'
    INTERIOR_UNDETERMINED = 'interior_undetermined'
    LARGE_RESIDUALS = 'large_residuals'
    PRINCIPAL_POINT_OFF = 'principal_point_off'
    WRONG_PRINCIPAL_DISTANCE = 'wrong_principal_distance'

    # A fixed calibration applied to other exposures.
    CORRECTED_ALREADY = 'corrected_already'
    POOR_CALIBRATION_FIT = 'poor_calibration_fit'
    REUSED_EXPOSURES = 'reused_exposures'

    # Pairing of frames by number or by stamp.
    FRAMES_UNNUMBERED = 'frames_unnumbered'
    STAMPS_APART = 'stamps_apart'
    WIDE_TOLERANCE = 'wide_tolerance'

    # Orientation of the rig.
    NO_COMMON_TARGETS = 'no_common_targets'
    TARGETS_EXCHANGED = 'targets_exchanged'
    TARGETS_REJECTED = 'targets_rejected'
    NOISE_OBSERVED = 'noise_observed'
    PAIRS_CONTRADICT = 'pairs_contradict'
    PAIRS_EXCLUDED = 'pairs_excluded'
    RAYS_DO_NOT_MEET = 'rays_do_not_meet'
    RIG_DEPENDS_ON_ANGLE = 'rig_depends_on_angle'
    RIG_MOVED = 'rig_moved'
    RIG_NOTE = 'rig_note'  # one or more of these, read from a file
    RIG_NOT_ORIENTED = 'rig_not_oriented'

    # Images of the phantom.
    BEADS_NOT_MEASURED = 'beads_not_measured'
    FEW_BEADS = 'few_beads'
    GRID_NOT_MARKED = 'grid_not_marked'
    IMAGE_ENCODING = 'image_encoding'
    IMAGE_EMPTY = 'image_empty'
    NO_POSE = 'no_pose'
    POSE_AMBIGUOUS = 'pose_ambiguous'
    POSE_UNSURE = 'pose_unsure'
    SHADOWS_BENT = 'shadows_bent'

    # Predicted beads of the phantom that are not observed.
    BEAD_ALONE = 'bead_alone'
    BEAD_AWAY = 'bead_away'
    BEAD_CONFUSED = 'bead_confused'
    BEAD_CONTRAST = 'bead_contrast'
    BEAD_DISTURBED = 'bead_disturbed'
    BEAD_HIDDEN = 'bead_hidden'
    BEAD_LOST = 'bead_lost'
    BEAD_UNSURE = 'bead_unsure'

    # Ids of markers that may be wrong, and markers that are not seen.
    MARKER_FOUND_AGAIN = 'marker_found_again'
    MARKER_MOVES_ALONE = 'marker_moves_alone'
    FEW_MARKERS = 'few_markers'
    NO_MARKERS = 'no_markers'
    OTHER_VIEW_MISSING = 'other_view_missing'
    OTHER_SHADOW = 'other_shadow'
    SHADOWS_MET = 'shadows_met'

    # Rigid bodies and their markers.
    BODY_DIFFERENT = 'body_different'
    BODY_MIRRORED = 'body_mirrored'
    BODY_NOT_RIGID = 'body_not_rigid'
    BODY_ON_A_LINE = 'body_on_a_line'
    BODY_SCALED = 'body_scaled'
    BODY_UNSEEN = 'body_unseen'
    JOINT_APART = 'joint_apart'
    JOINT_IMPOSSIBLE = 'joint_impossible'
    MARKER_LOOSE = 'marker_loose'
    MARKER_MIGRATED = 'marker_migrated'
    MARKERS_EXCHANGED = 'markers_exchanged'

    # Changes of a rig, and how well they are identified.
    CAUSE_SURE = 'cause_sure'
    CHANGE_IDENTIFIED = 'change_identified'
    COMMON_MOTION = 'common_motion'
    DISTORTION_CHANGED = 'distortion_changed'
    FLUOROSCOPE_MOVED = 'fluoroscope_moved'
    INTERIOR_CHANGED = 'interior_changed'
    UNSEEN_DISTORTION = 'unseen_distortion'
    UNUSED_EXPOSURES = 'unused_exposures'

    # Files that do not belong together.
    EDITED_RESULT = 'edited_result'
    EXCHANGED_CALIBRATION = 'exchanged_calibration'
    FAILED_VERDICT = 'failed_verdict'
    NOT_IN_BOTH = 'not_in_both'
    WRONG_FORMAT = 'wrong_format'

    # Drift of an image, live or in a recording.
    CLUSTER_CHANGE = 'cluster_change'
    IMAGE_DRIFT = 'image_drift'
    LEARNING = 'learning'
    NO_DRIFT = 'no_drift'
    NOT_WATCHED = 'not_watched'
    SHORT_RECORDING = 'short_recording'
    WIDENED_BY_ALARM = 'widened_by_alarm'


@dataclass(frozen=True)
class Place:
    """Place to which a finding refers."""

    fluoroscopes: tuple[str, ...] = ()
    exposures: tuple[int, ...] = ()  #: exposure numbers
    target_id: tuple[int, ...] = ()
    pixel: tuple[float, float] | None = None  #: (u, v)
    #: name of the place in a sentence; None: fluoroscopes and exposures; '': named by the cause
    name: str | None = None

    @classmethod
    def at(cls, fluoroscope: str, uv: Iterable[float]) -> Place:
        """Return the place of a pixel (2,) in the images of a fluoroscope."""
        u, v = uv
        return cls((fluoroscope,), pixel=(float(u), float(v)))

    @property
    def fluoroscope(self) -> str:
        """The only or first fluoroscope, '' if there is none."""
        return self.fluoroscopes[0] if self.fluoroscopes else ''

    def __str__(self) -> str:
        parts = (_named('fluoroscope', self.fluoroscopes), _named('exposure', self.exposures))
        return ', '.join(filter(None, parts)) if self.name is None else self.name


@dataclass(frozen=True)
class Finding:
    """Result of a check or of reading data, as kind, cause and numbers.

    Attributes
    ----------
    kind : Kind
    cause : str
        What was found, in words.
    place : Place
    advice : str
        What to do; '' if there is no advice.
    severity : Severity
    numbers : mapping of str to float
        Measured values by name; the unit is at the end of the name.
    """

    kind: Kind
    cause: str
    place: Place = Place()
    advice: str = ''
    severity: Severity = Severity.ERROR
    numbers: Mapping[str, float] = field(default_factory=dict, hash=False)

    @property
    def sentence(self) -> str:
        """Place, cause and advice as a sentence for people."""
        return sentence_of(self.place, self.cause, self.advice)

    def __str__(self) -> str:
        return self.sentence

    def at(self, where: object) -> Finding:
        """Return the finding with a location, such as a path, in front of its place."""
        if not str(where):
            return self
        return replace(self, place=replace(self.place, name=sentence_of(where, self.place)))

    def explained_by(self, reason: Finding | None) -> Finding:
        """Return the finding with kind and advice of `reason`, if any, both causes and numbers."""
        if reason is None:
            return self
        numbers = {**self.numbers, **reason.numbers}
        cause = f'{self.cause}; {reason.cause}'
        return replace(self, kind=reason.kind, cause=cause, advice=reason.advice, numbers=numbers)


def sentences(findings: Iterable[Finding], severity: Severity | None = None) -> list[str]:
    """Return the sentences of findings, of one severity or of all."""
    return [
        finding.sentence
        for finding in findings
        if severity is None or finding.severity is severity
    ]


def summed_up(findings: Iterable[Finding]) -> list[str]:
    """Return the sentences of findings; of one kind on many exposures only the first.

    It then ends in the numbers of the other exposures. Fluoroscopes are kept apart.
    """
    groups: dict[object, list[Finding]] = {}
    for number, finding in enumerate(findings):
        place = finding.place
        is_exposure = len(place.exposures) == 1
        key = (finding.kind, place.fluoroscopes) if is_exposure else number
        groups.setdefault(key, []).append(finding)
    out = []
    for first, *others in groups.values():
        if len(others) < MAX_LISTED:
            out += sentences([first, *others])
            continue
        numbers = first_few(finding.place.exposures[0] for finding in others)
        out.append(f'{first.sentence}; likewise {len(others)} more exposures: {numbers}')
    return out


def sentence_of(*parts: object) -> str:
    """Return place, cause and advice as a sentence, without empty parts."""
    return ': '.join(filter(None, map(str, parts)))


def first_few(names: Iterable[object], separator: str = ', ') -> str:
    """Return the first few names as text, and how many more there are."""
    texts = list(map(str, names))
    text = separator.join(texts[:MAX_LISTED])
    remaining = len(texts) - MAX_LISTED
    return f'{text} and {remaining} more' if remaining > 0 else text


def too_few(count: int, noun: str) -> str:
    """Return the statement that this number of things is too small; noun in the singular."""
    return f'{count} {noun} is too few' if count == 1 else f'{count} {noun}s are too few'


def _named(noun: str, things: tuple[object, ...]) -> str:
    """Return things with their noun, '' if there are none."""
    *others, last = map(str, things) if things else ('',)
    listed = f'{", ".join(others)} and {last}' if others else last
    return f'{noun}{"s" * bool(others)} {listed}' if things else ''
