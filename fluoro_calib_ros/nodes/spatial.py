"""Orientations and reconstructed points as messages: metres, and the frames of TF."""

from array import array

import numpy as np
from fluoro_calib_msgs.msg import DriftStatus, ReconstructedPoints, RigOrientation
from geometry_msgs.msg import Point, TransformStamped
from sensor_msgs.msg import PointCloud2, PointField
from std_msgs.msg import ColorRGBA
from tf2_msgs.msg import TFMessage
from visualization_msgs.msg import Marker, MarkerArray

from ..errors import DataError
from ..photogrammetry import rig_orientation as rig
from ..photogrammetry.rotations import matrix_from_quaternion, quaternion_from_matrix
from .conversion import doubles, to_nanoseconds, to_stamp, unsigned

try:  # the messages of the motion capture stack are used where they are installed
    from mocap4r2_msgs.msg import Marker as MocapMarker
    from mocap4r2_msgs.msg import Markers as MocapMarkers
except ImportError:
    MocapMarker = MocapMarkers = None

CLOUD = np.dtype([('x', '<f4'), ('y', '<f4'), ('z', '<f4'), ('id', '<u4'), ('sigma', '<f4')])
_KINDS = {'f': PointField.FLOAT32, 'u': PointField.UINT32}
GREEN = ColorRGBA(r=0.2, g=0.9, b=0.3, a=0.8)
YELLOW = ColorRGBA(r=1.0, g=0.8, b=0.1, a=0.8)
MARKER_LIFETIME_NS = 500_000_000  # after which RViz takes a marker away that is not seen any more


def message_from_orientation(orientation):
    """RigOrientation message of a RigOrientation."""
    message = RigOrientation()
    message.header.stamp = to_stamp(orientation.stamp_ns)
    message.header.frame_id = orientation.frame_id
    message.orientation_id = orientation.orientation_id
    message.source = orientation.source
    message.fluoroscope = list(orientation.fluoroscopes)
    message.calibration_id = list(orientation.calibration_ids)
    message.optical_frame_id = list(orientation.optical_frame_ids)
    message.exposures = orientation.exposures
    for name, column in zip(('xp', 'yp', 'c'), orientation.interior.T):
        setattr(message, name, doubles(column))
    for name, column in zip('xyz', orientation.position_mm.T):
        setattr(message, name, doubles(column / 1000))
    attitude = quaternion_from_matrix(orientation.rotation.transpose(0, 2, 1))
    for name, column in zip(('qw', 'qx', 'qy', 'qz'), attitude.T):
        setattr(message, name, doubles(column))
    scale = _metres(len(orientation.fluoroscopes))
    message.covariance = doubles(orientation.covariance * scale * scale[:, None])
    return message


def orientation_from_message(message):
    """RigOrientation of a RigOrientation message, but for rounding. Raises DataError where it
    holds none.
    """
    count = len(message.fluoroscope)
    columns = {
        name: np.array(getattr(message, name))
        for name in ('xp', 'yp', 'c', 'x', 'y', 'z', 'qw', 'qx', 'qy', 'qz')
    }
    wrong = [name for name, column in columns.items() if len(column) != count]
    if wrong or len(message.covariance) != (rig.ORIENTATION_SIZE * count) ** 2:
        raise DataError(
            f'rig orientation: {count} fluoroscopes, but the array {(wrong or ["covariance"])[0]} has '
            'another length'
        )
    scale = _metres(count)
    covariance = np.array(message.covariance).reshape(len(scale), -1) / (scale * scale[:, None])
    attitude = np.stack([columns[name] for name in ('qw', 'qx', 'qy', 'qz')], axis=1)
    if not np.isfinite(attitude).all() or not (np.linalg.norm(attitude, axis=1) > 0.5).all():
        raise DataError('rig orientation: an attitude is no unit quaternion')
    return rig.RigOrientation(
        tuple(message.fluoroscope),
        np.stack([columns[name] for name in ('xp', 'yp', 'c')], axis=1),
        matrix_from_quaternion(attitude).transpose(0, 2, 1),
        1000 * np.stack([columns[name] for name in 'xyz'], axis=1),
        covariance,
        message.header.frame_id,
        message.source,
        tuple(message.calibration_id),
        to_nanoseconds(message.header.stamp),
        message.exposures,
        tuple(message.optical_frame_id),
    )


def _metres(count):
    """Factors (9 count,) that turn T [mm] of the unknowns of an orientation into metres."""
    return np.tile(np.repeat([1e-3, 1.0], [3, 6]), count)


def transforms_of(message):
    """TFMessage of a RigOrientation message: the optical frames in the rig frame, but for one that
    is the rig frame.
    """
    out = TFMessage()
    for i, child in enumerate(message.optical_frame_id):
        if child == message.header.frame_id:
            continue
        one = TransformStamped(header=message.header, child_frame_id=child)
        for name in 'xyz':
            setattr(one.transform.translation, name, getattr(message, name)[i])
        for name in 'xyzw':
            setattr(one.transform.rotation, name, getattr(message, f'q{name}')[i])
        out.transforms.append(one)
    return out


def points_message(stamp_ns, frame_number, rig, target_id, points):
    """ReconstructedPoints message of IntersectedPoints with their target ids (n,).

    rig: orientation_id and orientation with which they were intersected.
    """
    message = ReconstructedPoints()
    message.header.stamp = to_stamp(stamp_ns)
    message.header.frame_id = rig.orientation.frame_id
    message.frame_number = frame_number
    message.target_id = unsigned(target_id)
    message.x, message.y, message.z = (doubles(column) for column in points.xyz_mm.T / 1000)
    terms = points.covariance.reshape(-1, 9).T * 1e-6
    for name, row in zip(
        ('cov_xx', 'cov_xy', 'cov_xz', 'cov_yy', 'cov_yz', 'cov_zz'), (0, 1, 2, 4, 5, 8)
    ):
        setattr(message, name, doubles(terms[row]))
    message.residual = doubles(points.residual)
    message.rays = array('B', points.rays.astype(np.uint8).tobytes())
    message.status = array('B', points.status.tobytes())
    message.orientation_id = rig.orientation_id
    message.calibration_id = list(rig.orientation.calibration_ids)
    return message


def cloud_message(message, good):
    """PointCloud2 of the good points (indices) of a ReconstructedPoints message: x, y, z, id,
    sigma [m].
    """
    points = np.empty(len(good), dtype=CLOUD)
    for name in 'xyz':
        points[name] = np.asarray(getattr(message, name))[good]
    points['id'] = np.asarray(message.target_id)[good]
    variance = sum(
        np.asarray(getattr(message, name))[good] for name in ('cov_xx', 'cov_yy', 'cov_zz')
    )
    points['sigma'] = np.sqrt(variance / 3)
    cloud = PointCloud2(
        header=message.header,
        height=1,
        width=len(good),
        is_dense=True,
        point_step=CLOUD.itemsize,
        row_step=CLOUD.itemsize * len(good),
    )
    cloud.fields = [
        PointField(
            name=name, offset=CLOUD.fields[name][1], datatype=_KINDS[CLOUD[name].kind], count=1
        )
        for name in CLOUD.names
    ]
    cloud.data = array('B', points.tobytes())
    return cloud


def ellipsoids_message(message, good, sigmas):
    """MarkerArray of the good points of a ReconstructedPoints message: ellipsoids of so many
    standard deviations.
    """
    covariance = np.empty((len(good), 3, 3))
    for name, (i, j) in {
        'xx': (0, 0),
        'xy': (0, 1),
        'xz': (0, 2),
        'yy': (1, 1),
        'yz': (1, 2),
        'zz': (2, 2),
    }.items():
        covariance[:, i, j] = covariance[:, j, i] = np.asarray(getattr(message, f'cov_{name}'))[
            good
        ]
    values, axes = np.linalg.eigh(covariance)
    axes[:, :, 0] *= np.linalg.det(axes)[:, None]  # a rotation, not a reflection
    out = MarkerArray()
    for k, q, axis in zip(
        good,
        quaternion_from_matrix(axes).tolist(),
        (2 * sigmas * np.sqrt(np.maximum(values, 0))).tolist(),
    ):
        marker = Marker(
            header=message.header, ns='targets', id=int(message.target_id[k]), type=Marker.SPHERE
        )
        pose = marker.pose
        pose.position.x = message.x[k]
        pose.position.y = message.y[k]
        pose.position.z = message.z[k]
        pose.orientation.w, pose.orientation.x, pose.orientation.y, pose.orientation.z = q
        marker.scale.x, marker.scale.y, marker.scale.z = axis
        marker.color = GREEN if message.status[k] == message.OK else YELLOW
        marker.lifetime.nanosec = MARKER_LIFETIME_NS
        out.markers.append(marker)
    return out


def mocap_message(message, good):
    """mocap4r2 Markers of the good points of a ReconstructedPoints message; the index of each is
    its target id.
    """
    out = MocapMarkers(header=message.header, frame_number=message.frame_number)
    for k in good:
        out.markers.append(
            MocapMarker(
                id_type=MocapMarker.USE_INDEX,
                marker_index=int(message.target_id[k]),
                translation=Point(x=message.x[k], y=message.y[k], z=message.z[k]),
            )
        )
    return out


def drift_message(state, stamp, orientation):
    """DriftStatus message of a DriftState at the stamp of an exposure of a rig with a
    RigOrientation.
    """
    message = DriftStatus(
        level=int(state.level),
        fluoroscope=state.fluoroscope,
        source=state.source,
        message=state.message,
        observations=int(state.observations),
    )
    message.header.stamp = stamp
    if state.fluoroscope in orientation.fluoroscopes:
        message.header.frame_id = orientation.optical_frame_ids[
            orientation.index(state.fluoroscope)
        ]
    for name in ('size', 'sd', 'evidence', 'threshold_warn', 'threshold_error'):
        setattr(message, name, float(getattr(state, name)))
    message.u0, message.v0, message.u1, message.v1 = (float(x) for x in state.area)
    message.since = float(state.since_s)
    return message
