# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Wrong marker ids that are still undeclared 0.2 s later.

    python -m benchmarks.marker_trials --trials 100

Each trial is 2 s at 30 Hz of five bodies of six markers, whose shapes are known, in front of
bones. They cross each other in the images, a fifth of which is missing; half-way, an impact shifts
and turns each body in a different direction. An id is wrong if its position is that of another
marker or of none. It is declared if it is marked doubtful, or if a decision within the next 0.2 s
retracts it.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields, replace

import cv2
import numpy as np
from threadpoolctl import threadpool_limits

from fluoro_calib_ros.errors import DataError
from fluoro_calib_ros.images.marker_decisions import Decision, revise
from fluoro_calib_ros.images.marker_ids import identify_markers
from fluoro_calib_ros.images.marker_views import MarkerViews, ViewsFrame
from fluoro_calib_ros.images.markers import MarkerFrame, MarkerOptions
from fluoro_calib_ros.photogrammetry.rotations import matrix_from_vector
from fluoro_calib_ros.simulation.marker_images import (
    MARKER_SETTINGS,
    MarkerImage,
    MarkerScene,
    MarkerSequence,
    MovingMarkers,
)

from .markers import FALSE_PX, calibrated, known_bodies

SEED = 400
FIRST_RIG = 4400
RIG_EVERY = 10  # trials per rig
FRAMES = 60
LATER = 6  # exposures in 0.2 s
MISSING = 0.2  # fraction of missing images, after the first exposure
APART_MM = 70.0  # bodies cross each other at this distance
IMPACT = FRAMES / 2
IMPACT_MM = 8.0  # shift in the first exposure after the impact: 0.24 m/s
IMPACT_RAD = 0.08
DECAY = 3.0  # decay constant of the impact, in exposures


class HitMarkers(MovingMarkers):
    """Moving clusters that an impact deflects, each in its own direction."""

    def __init__(self, scene: MarkerScene, seed: int) -> None:
        super().__init__(scene, seed)
        rng = np.random.default_rng([seed, 31])
        way = rng.normal(size=(2, scene.clusters, 3))
        way /= np.linalg.norm(way, axis=2, keepdims=True)
        self._shift = IMPACT_MM * way[0]
        self._spin = IMPACT_RAD * way[1]

    def poses(self, frame: float) -> list[tuple[np.ndarray, np.ndarray]]:
        """Return rotations (3, 3) and shifts (3,) [mm] of all clusters at an image number."""
        since = max(frame - IMPACT, 0.0)
        part = DECAY * (1 - np.exp(-since / DECAY)) * np.exp(-since / (4 * DECAY))
        return [
            (matrix_from_vector(part * spin) @ rotation, shift + part * away)
            for (rotation, shift), away, spin in zip(super().poses(frame), self._shift, self._spin)
        ]


@dataclass(frozen=True)
class Counts:
    """Counts over trials."""

    images: int = 0
    seen: int = 0
    measured: int = 0
    wrong: int = 0
    undeclared: int = 0  # immediately
    undeclared_later: int = 0
    trials_undeclared: int = 0
    not_begun: int = 0

    def __add__(self, other: Counts) -> Counts:
        sums = {f.name: getattr(self, f.name) + getattr(other, f.name) for f in fields(self)}
        return Counts(**sums)

    def line(self, trials: int) -> str:
        """Return the counts as text."""
        return (
            f'{trials} trials, {self.images} images: {self.measured / max(self.seen, 1):.2%} of '
            f'{self.seen} visible markers measured; {self.wrong} ids wrong, of them '
            f'{self.undeclared} undeclared at once, {self.undeclared_later} after 0.2 s (in '
            f'{self.trials_undeclared} trials); {self.not_begun} trials did not begin'
        )


def exposures(sequence: MarkerSequence, seed: int) -> Iterator[Mapping[str, MarkerImage | None]]:
    """Yield the images of each moment by fluoroscope; missing images are None."""
    rng = np.random.default_rng([seed, 32])
    for number, images in enumerate(sequence):
        there = (rng.random(len(images)) >= MISSING) | (number == 0)
        yield {
            name: image if is_there else None
            for (name, image), is_there in zip(images.items(), there)
        }


def run_trial(number: int) -> Counts:
    """Follow the markers of a trial."""
    rig, calibrations, orientation = calibrated(FIRST_RIG + number // RIG_EVERY)
    scene = MarkerScene(apart_mm=APART_MM, speed_mm=1.0)
    markers = HitMarkers(scene, SEED + number)
    sequence = MarkerSequence(rig, markers, MARKER_SETTINGS, FRAMES, SEED + number)
    bodies = known_bodies(markers)
    follower: MarkerViews | None = None
    found: list[ViewsFrame] = []
    truth: list[Mapping[str, MarkerImage | None]] = []
    for exposure, images in enumerate(exposures(sequence, SEED + number), 1):
        shown = {name: None if one is None else one.image for name, one in images.items()}
        if follower is None:
            there = {name: one for name, one in shown.items() if one is not None}
            if len(there) < len(shown):
                continue
            try:
                first = identify_markers(there, calibrations, orientation, bodies)
            except DataError:
                continue
            follower = MarkerViews(
                calibrations,
                orientation,
                MarkerOptions(shutter=scene.shutter),
                first={name: first.get(name) for name in shown},
                bodies=bodies,
            )
        found.append(follower.update(shown, exposure))
        truth.append(
            {
                name: one and replace(one, image=np.zeros((0, 0), np.uint8))
                for name, one in images.items()
            }
        )
    return counts_of(found, truth, markers.target_id)


def counts_of(
    found: list[ViewsFrame],
    truth: list[Mapping[str, MarkerImage | None]],
    target_id: np.ndarray,
) -> Counts:
    """Compare the markers of a trial with the truth."""
    out = Counts(not_begun=int(not found))
    for number, (exposure, images) in enumerate(zip(found, truth)):
        soon = [one for later in found[number + 1 : number + 1 + LATER] for one in later.decisions]
        for name, image in images.items():
            if image is None:
                continue
            of_view = exposure.views[name]
            later = _revised(of_view, name, soon)
            wrong = _wrong(of_view, image, target_id)
            row = np.searchsorted(target_id, of_view.target_id)
            out += Counts(
                images=1,
                seen=int(image.seen.sum()),
                measured=int(image.seen[row].sum()),
                wrong=int(wrong.sum()),
                undeclared=int((wrong & ~of_view.doubtful).sum()),
                undeclared_later=int((_wrong(later, image, target_id) & ~later.doubtful).sum()),
            )
    return replace(out, trials_undeclared=int(out.undeclared_later > 0))


def _revised(found: MarkerFrame, name: str, decisions: list[Decision]) -> MarkerFrame:
    """Return the markers of a view after applying later decisions."""
    for decision in decisions:
        if decision.fluoroscope == name and decision.since <= found.frame:
            found = revise(found, decision)
    return found


def _wrong(found: MarkerFrame, image: MarkerImage, target_id: np.ndarray) -> np.ndarray:
    """Return whether (n,) markers are away from their true positions.

    For a shadow smeared by an impact, the mean marker position over the exposure is accepted, too.
    """
    row = np.searchsorted(target_id, found.target_id)
    away = [np.linalg.norm(found.uv - true[row], axis=1) for true in (image.uv, image.mean_uv)]
    return np.minimum(*away) > FALSE_PX


def main() -> None:
    """Run the trials."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument('--trials', type=int, default=100)
    parser.add_argument('--first', type=int, default=0, metavar='N', help='first trial')
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    total = Counts()
    with threadpool_limits(1):
        for number in range(arguments.first, arguments.first + arguments.trials):
            counts = run_trial(number)
            total += counts
            print(f'    trial {number}: {counts.line(1)}', flush=True)
    print(total.line(arguments.trials))


if __name__ == '__main__':
    main()
