# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Node that publishes what the virtual dual fluoroscope sees: the phantom, a grid, or markers."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from fluoro_calib_msgs.msg import TargetObservations
from numpy.typing import NDArray
from sensor_msgs.msg import Image
from std_msgs.msg import Header

from ..exposures.frame import Frame
from ..jobs.simulation import MARKER_MM, SETTINGS, RenderedScene, Renderers
from ..options import option
from ..photogrammetry.rotations import matrix_from_vector, vector_from_matrix
from ..simulation.marker_images import MarkerScene
from ..simulation.rig import (
    CLUSTER_MARKERS,
    Detection,
    StreamStart,
    detect_beads,
    phantom_poses,
    simulate_grid,
    simulate_tracking,
    virtual_rig,
)
from .messages.image import message_from_image
from .messages.observations import message_from_frame, set_number_and_stamp, stamp_from_nanoseconds
from .runtime.diagnostics import StartError
from .runtime.main import run
from .runtime.parameters import ParameterGroup, RigParameters
from .runtime.topics import (
    images_qos,
    observations_qos,
    qos_overrides,
    wait_for_readers,
    wait_until_acknowledged,
)
from .runtime.worker import WorkerNode

SCENES = ('phantom', 'standing', 'markers', 'grid')
GRID_FRAMES = 300  # of the grid, which are repeated: 45 MB
LOOP_S = 10.0  # duration of a precomputed scene, which is repeated


@dataclass(frozen=True)
class SimulatorParameters(RigParameters):
    """Parameters of the simulator."""

    scene: str = option(
        'phantom',
        'what is seen: the phantom set up in pose after pose, or standing in the rig frame, '
        'markers on a moving joint, or a grid of 2,028 points',
        choices=SCENES,
    )
    rate: float = option(60.0, 'frame rate', minimum=0.1, maximum=2000.0, unit='Hz')
    frames: int = option(0, 'frames after which the node ends; 0: never', minimum=0, maximum=2**31)
    wait_for_readers: int = option(
        0, 'subscriptions of every topic to wait for', minimum=0, maximum=100
    )
    seed: int = option(
        1,
        'number of the rig, as of fluoro-calib simulate; 1 is the rig of bags/',
        minimum=0,
        maximum=2**31,
    )
    strength: float = option(1.0, 'strength of the distortion', minimum=0.0, maximum=10.0)
    noise: float = option(
        0.25, 'noise of an image coordinate', minimum=0.0, maximum=100.0, unit='px'
    )
    false_matches: float = option(
        0.01, "fraction of the phantom's targets with a wrong number", minimum=0.0, maximum=0.5
    )
    images: str = option(
        'none',
        'radiographs instead of observations, at most as many as can be rendered, clean or with '
        'clutter and little dose; not of the scene grid',
        choices=('none', *SETTINGS),
    )
    stand_time: float = option(
        1.0,
        'time for which the phantom stands in a pose',
        minimum=0.0,
        maximum=3600.0,
        unit='s',
    )
    move_time: float = option(
        1.0,
        'time in which the phantom is moved to the next pose',
        minimum=0.0,
        maximum=3600.0,
        unit='s',
    )
    poses: int = option(
        15, 'number of poses, after which the first one follows', minimum=1, maximum=10000
    )
    clusters: int = option(
        4,
        f'rigid clusters of {CLUSTER_MARKERS} markers each in the scene markers',
        minimum=1,
        maximum=8,
    )


_NODE = ParameterGroup(SimulatorParameters)
PARAMETERS = (_NODE,)


class SimulatorNode(WorkerNode):
    """Publishes target observations or radiographs of every fluoroscope, with current stamps."""

    def __init__(self) -> None:
        super().__init__('simulator_node')
        self._settings = parameters = _NODE.declare(self)
        self._rig = virtual_rig(parameters.seed, parameters.strength, parameters.fluoroscopes)
        self._rng = np.random.default_rng([parameters.seed, 4])
        self._detection = Detection(parameters.noise, parameters.false_matches)
        self._poses = phantom_poses(self._rng, parameters.poses)
        self._with_images = parameters.images != 'none'
        if self._with_images and parameters.scene == 'grid':
            raise StartError('parameter images: there are no radiographs of the scene grid')
        kind, topic, qos = TargetObservations, 'target_observations', observations_qos
        if self._with_images:
            kind, topic, qos = Image, 'image_raw', images_qos
        self._outputs = {
            name: self.create_publisher(
                kind, f'{name}/{topic}', qos(), qos_overriding_options=qos_overrides()
            )
            for name in parameters.fluoroscopes
        }
        self._moving_mm = np.zeros((0, 0, 3))  # positions of the markers for radiographs
        self._precomputed = self._precompute()
        self._renderers: Renderers | None = None
        self.start()

    def _precompute(self) -> dict[str, list[TargetObservations]]:
        """Return the messages of a repeated scene; empty for a scene that is generated live."""
        parameters = self._settings
        if parameters.scene == 'markers':
            tracking = simulate_tracking(
                self._rig,
                LOOP_S,
                parameters.rate,
                parameters.seed,
                parameters.noise,
                clusters=parameters.clusters,
            )
            self._moving_mm = tracking.points_mm
            frames = tracking.frames
        elif parameters.scene == 'grid':
            frames = simulate_grid(self._rig, GRID_FRAMES, parameters.seed, parameters.noise)
        else:
            return {}
        return {
            name: [message_from_frame(frame) for frame in of_fluoroscope]
            for name, of_fluoroscope in frames.items()
        }

    def work(self) -> None:
        """Publish frame after frame from a thread: a timer of rclpy costs more than a frame."""
        parameters = self._settings
        outputs = self._outputs.values()
        if self._with_images:
            self._start_rendering()
        wait_for_readers(self, outputs, parameters.wait_for_readers, self.stopping)
        start = time.monotonic()
        number = 0
        while not (parameters.frames and number >= parameters.frames):
            due = start + number / parameters.rate
            if self.stopping.wait(max(0.0, due - time.monotonic())):
                return
            number += 1
            if not self._with_images:
                self._publish(number)
                continue
            # Skip missed frames, like a camera that is too slow.
            due_number = math.floor((time.monotonic() - start) * parameters.rate)
            number = max(number, min(due_number, parameters.frames or due_number))
            self._publish_images(number)
        wait_until_acknowledged(outputs, self.stopping)

    def _start_rendering(self) -> None:
        """Start the rendering processes, and wait until they are ready."""
        settings = SETTINGS[self._settings.images]
        if self._settings.scene == 'markers':
            settings = replace(settings, bead_attenuation=MarkerScene.attenuation)
        self._renderers = Renderers(self._rig.fluoroscopes, settings)
        self._renderers.start()
        self._renderers.images(self._rendered_scene(1))  # so that the first one is in time

    def _publish_images(self, number: int) -> None:
        """Render and publish the radiographs of an exposure, stamped with its start."""
        assert self._renderers is not None
        stamp = stamp_from_nanoseconds(self.get_clock().now().nanoseconds)
        scene = self._rendered_scene(number)
        for name, image in self._renderers.images(scene).items():
            header = Header(stamp=stamp, frame_id=f'{name}_optical')
            self._outputs[name].publish(message_from_image(header, image))

    def _rendered_scene(self, number: int) -> RenderedScene:
        """Return the scene that the fluoroscopes see in an exposure."""
        pose = self._pose(number)
        if self._settings.scene == 'markers':
            points = self._moving_mm[(number - 1) % len(self._moving_mm)]
            diameter = np.full(len(points), MARKER_MM)
            return RenderedScene(points, pose, number, diameter, plates=False)
        return RenderedScene(self._rig.true_mm, pose, number)

    def _publish(self, number: int) -> None:
        """Publish the frames of an exposure."""
        if self._precomputed:
            messages = [
                (name, of_fluoroscope[(number - 1) % len(of_fluoroscope)])
                for name, of_fluoroscope in self._precomputed.items()
            ]
        else:
            messages = [
                (frame.fluoroscope, message_from_frame(frame))
                for frame in self._phantom_frames(number)
            ]
        stamp_ns = self.get_clock().now().nanoseconds
        for name, message in messages:
            set_number_and_stamp(message, number, stamp_ns)
            self._outputs[name].publish(message)

    def _phantom_frames(self, number: int) -> Iterator[Frame]:
        """Yield the frames of the phantom in its current pose."""
        rotation, shift = self._pose(number)
        points = self._rig.true_mm @ rotation.T + shift
        for fluoroscope in self._rig.fluoroscopes:
            ids, uv = detect_beads(
                self._rng,
                fluoroscope,
                points,
                self._rig.phantom.target_id,
                self._detection,
            )
            yield StreamStart(0, number).frame(fluoroscope, 0, 0.0, ids, uv)

    def _pose(self, number: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the current pose of the phantom: standing, or moving to the next pose."""
        if self._settings.scene != 'phantom':
            return np.eye(3), np.zeros(3)
        stand_s = self._settings.stand_time
        move_s = self._settings.move_time
        cycle_s = stand_s + move_s
        cycle, time_s = divmod(number / self._settings.rate, cycle_s) if cycle_s else (0, 0.0)
        start = self._poses[int(cycle) % len(self._poses)]
        if time_s <= stand_s:
            return start
        end = self._poses[(int(cycle) + 1) % len(self._poses)]
        fraction = (time_s - stand_s) / move_s
        turn = matrix_from_vector(fraction * vector_from_matrix(end[0] @ start[0].T))
        return turn @ start[0], start[1] + fraction * (end[1] - start[1])

    def stop(self) -> None:
        """Stop publishing before the node is destroyed."""
        self.stopping.set()
        if self._renderers is not None:
            self._renderers.close()
        super().stop()


main = partial(run, SimulatorNode)

if __name__ == '__main__':
    main()
