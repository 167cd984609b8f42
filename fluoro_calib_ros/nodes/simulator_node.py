"""Node that publishes what the virtual dual fluoroscope sees: the phantom, set up in pose after
pose, a grid, or markers.
"""

import threading
import time
import traceback

import numpy as np
import rclpy
from fluoro_calib_msgs.msg import TargetObservations
from rclpy.node import Node
from scipy.spatial.transform import Rotation

from ..exposures.frame import Frame
from ..photogrammetry.rotations import matrix_from_vector
from ..simulation.rig import (
    CLUSTER,
    phantom_poses,
    seen_beads,
    simulate_grid,
    simulate_tracking,
    virtual_rig,
)
from . import support
from .conversion import message_from_frame
from .qos import OBSERVATIONS, overridable
from .support import StartError, declare

SCENES = ('phantom', 'standing', 'markers', 'grid')
LOOP_S = 10.0  # length of a scene that is made before, and comes over and over


class SimulatorNode(Node):
    """Publishes target observations of every fluoroscope at a rate, with stamps of now."""

    def __init__(self):
        super().__init__('simulator_node')
        names = support.fluoroscopes_of(self)
        self._scene = declare(
            self,
            'scene',
            'phantom',
            'what is seen: phantom (set up in pose after pose), standing '
            '(the phantom in the rig frame), markers (a joint in motion) or grid (2,028 points)',
        )
        if self._scene not in SCENES:
            raise StartError(f'parameter scene is one of {", ".join(SCENES)}, not {self._scene!r}')
        self._rate = declare(self, 'rate', 60.0, 'frames a second', 0.1, 2000.0)
        seed = declare(
            self, 'seed', 1, 'number of the rig, the same as of fluoro-calib simulate', 0, 2**31
        )
        strength = declare(self, 'strength', 1.0, 'strength of the distortion', 0.0, 10.0)
        self._noise = declare(self, 'noise', 0.25, 'noise of an image coordinate [px]', 0.0, 100.0)
        self._false = declare(
            self, 'false_matches', 0.01, 'part of the targets with a wrong number', 0.0, 0.5
        )
        self._stand = declare(
            self, 'stand_time', 1.0, 'time for which the phantom stands in a pose [s]', 0.0, 3600.0
        )
        self._move = declare(
            self, 'move_time', 1.0, 'time in which it is moved to the next one [s]', 0.0, 3600.0
        )
        poses = declare(self, 'poses', 15, 'number of poses, then from the first again', 1, 10000)
        clusters = declare(self, 'clusters', 4, f'rigid clusters of {CLUSTER} markers each', 1, 8)
        self._frames = declare(
            self, 'frames', 0, 'frames after which the node ends; 0: never', 0, 2**31
        )
        wait = declare(
            self, 'wait_for_readers', 0, 'subscriptions of every topic to wait for', 0, 100
        )
        self._rig = virtual_rig(seed, strength, tuple(names))
        self._rng = np.random.default_rng([seed, 4])
        self._poses = phantom_poses(self._rng, poses)
        self._outputs = {
            n: self.create_publisher(
                TargetObservations,
                f'{n}/target_observations',
                OBSERVATIONS,
                qos_overriding_options=overridable(),
            )
            for n in names
        }
        self._ready = self._made_before(seed, clusters)
        self._ending = threading.Event()
        self.failed = False
        self._worker = threading.Thread(target=self._run, args=(wait,), daemon=True)
        self._worker.start()

    def _made_before(self, seed, clusters):
        """Messages {fluoroscope: [message, ...]} of a scene that comes over and over, {} for one
        that is drawn live.
        """
        if self._scene == 'markers':
            frames = simulate_tracking(
                self._rig, LOOP_S, self._rate, seed, self._noise, clusters=clusters
            ).frames
        elif self._scene == 'grid':
            frames = simulate_grid(
                self._rig, max(1, round(LOOP_S * self._rate)), seed, self._noise
            )
        else:
            return {}
        return {
            name: [message_from_frame(frame) for frame in of_one]
            for name, of_one in frames.items()
        }

    def _run(self, wait):
        """Publish frame after frame at its time, from a thread: a timer of an executor costs more
        than a frame.
        """
        try:
            support.wait_for_readers(self, self._outputs.values(), wait, self._ending)
            began = time.monotonic()
            number = 0
            while not (self._frames and number >= self._frames):
                if self._ending.wait(max(0.0, began + number / self._rate - time.monotonic())):
                    return
                number += 1
                self._publish(number)
            support.wait_until_taken(self._outputs.values(), self._ending)
            rclpy.try_shutdown()
        except Exception:
            if not self._ending.is_set():  # else the node has been ended between two messages
                self.get_logger().fatal(traceback.format_exc())
                self.failed = True
                rclpy.try_shutdown()

    def _publish(self, number):
        if self._ready:
            messages = [
                (name, of_one[(number - 1) % len(of_one)]) for name, of_one in self._ready.items()
            ]
        else:
            messages = [(name, message_from_frame(frame)) for name, frame in self._phantom(number)]
        seconds, nanoseconds = divmod(self.get_clock().now().nanoseconds, 1_000_000_000)
        for name, message in messages:
            message.frame_number = number
            message.header.stamp.sec = seconds
            message.header.stamp.nanosec = nanoseconds
            self._outputs[name].publish(message)

    def _phantom(self, number):
        """Frames of the phantom at its pose of now."""
        rotation, shift = (
            self._pose(number) if self._scene == 'phantom' else (np.eye(3), np.zeros(3))
        )
        points = self._rig.true_mm @ rotation.T + shift
        for fluoroscope in self._rig.fluoroscopes:
            ids, uv = seen_beads(
                self._rng,
                fluoroscope,
                points,
                self._rig.phantom.target_id,
                self._noise,
                self._false,
                (130, 160),
            )
            yield (
                fluoroscope.name,
                Frame(
                    fluoroscope.name,
                    number,
                    ids,
                    uv,
                    fluoroscope.image_size,
                    frame_id=f'{fluoroscope.name}_optical',
                ),
            )

    def _pose(self, number):
        """Pose of now: standing, or on the way to the next one."""
        cycle = self._stand + self._move
        turn, time_s = divmod(number / self._rate, cycle) if cycle else (0, 0.0)
        start = self._poses[int(turn) % len(self._poses)]
        if time_s <= self._stand:
            return start
        end = self._poses[(int(turn) + 1) % len(self._poses)]
        part = (time_s - self._stand) / self._move
        turn = matrix_from_vector(part * Rotation.from_matrix(end[0] @ start[0].T).as_rotvec())
        return turn @ start[0], start[1] + part * (end[1] - start[1])

    def stop(self):
        """End publishing: the node is to go."""
        self._ending.set()
        self._worker.join(2.0)


def main(args=None):
    """Entry point."""
    support.run(SimulatorNode, args)


if __name__ == '__main__':
    main()
