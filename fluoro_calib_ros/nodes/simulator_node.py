"""Node that publishes what the virtual dual fluoroscope sees: the phantom, set up in pose after pose, or markers."""

import numpy as np
from fluoro_calib_msgs.msg import TargetObservations
from rclpy.node import Node
from scipy.spatial.transform import Rotation

from ..photogrammetry.observations import Frame
from ..photogrammetry.rotations import matrix_from_vector
from ..simulation.rig import phantom_poses, seen_beads, simulate_tracking, virtual_rig
from . import support
from .conversion import message_from_frame
from .qos import OBSERVATIONS, overridable
from .support import StartError, declare

SCENES = ('phantom', 'markers')


class SimulatorNode(Node):
    """Publishes target observations of every fluoroscope at a rate, with stamps of now."""

    def __init__(self):
        super().__init__('simulator_node')
        names = list(declare(self, 'fluoroscopes', ['a', 'b'], 'names of the fluoroscopes'))
        self._scene = declare(self, 'scene', 'phantom', 'what is seen: phantom or markers')
        if self._scene not in SCENES:
            raise StartError(f'parameter scene is {" or ".join(SCENES)}, not {self._scene!r}')
        self._rate = declare(self, 'rate', 60.0, 'frames a second', 0.1, 2000.0)
        seed = declare(self, 'seed', 1, 'number of the rig, the same as of fluoro-calib simulate', 0, 2 ** 31)
        strength = declare(self, 'strength', 1.0, 'strength of the distortion', 0.0, 10.0)
        self._noise = declare(self, 'noise', 0.25, 'noise of an image coordinate [px]', 0.0, 100.0)
        self._false = declare(self, 'false_matches', 0.01, 'part of the targets with a wrong number', 0.0, 0.5)
        self._stand = declare(self, 'stand_time', 1.0, 'time for which the phantom stands in a pose [s]', 0.0, 3600.0)
        self._move = declare(self, 'move_time', 1.0, 'time in which it is moved to the next one [s]', 0.0, 3600.0)
        poses = declare(self, 'poses', 15, 'number of poses, then from the first again', 1, 10000)
        self._rig = virtual_rig(seed, strength, tuple(names))
        self._rng = np.random.default_rng([seed, 4])
        self._poses = phantom_poses(self._rng, poses)
        self._tracking = None
        if self._scene == 'markers':
            self._tracking = simulate_tracking(self._rig, 10.0, self._rate, seed, self._noise)
        self._outputs = {n: self.create_publisher(TargetObservations, f'{n}/target_observations', OBSERVATIONS,
                                                  qos_overriding_options=overridable()) for n in names}
        self._number = 0
        self.create_timer(1 / self._rate, self._on_timer)

    def _on_timer(self):
        self._number += 1
        stamp = self.get_clock().now().nanoseconds
        for name, frame in (self._phantom() if self._tracking is None else self._markers()):
            message = message_from_frame(frame)
            message.frame_number = self._number
            message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp, 1_000_000_000)
            self._outputs[name].publish(message)

    def _phantom(self):
        """Frames of the phantom at its pose of now."""
        rotation, shift = self._pose()
        points = self._rig.true_mm @ rotation.T + shift
        for fluoroscope in self._rig.fluoroscopes:
            ids, uv = seen_beads(self._rng, fluoroscope, points, self._rig.phantom.target_id, self._noise,
                                 self._false, (130, 160))
            yield fluoroscope.name, Frame(fluoroscope.name, self._number, ids, uv, fluoroscope.image_size,
                                          frame_id=f'{fluoroscope.name}_optical')

    def _pose(self):
        """Pose of now: standing, or on the way to the next one."""
        cycle = self._stand + self._move
        turn, time = divmod(self._number / self._rate, cycle) if cycle else (0, 0.0)
        start = self._poses[int(turn) % len(self._poses)]
        if time <= self._stand:
            return start
        end, part = self._poses[(int(turn) + 1) % len(self._poses)], (time - self._stand) / self._move
        turn = matrix_from_vector(part * Rotation.from_matrix(end[0] @ start[0].T).as_rotvec())
        return turn @ start[0], start[1] + part * (end[1] - start[1])

    def _markers(self):
        frames = self._tracking.frames
        return ((name, of_one[(self._number - 1) % len(of_one)]) for name, of_one in frames.items())


def main(args=None):
    """Entry point."""
    support.run(SimulatorNode, args)


if __name__ == '__main__':
    main()
