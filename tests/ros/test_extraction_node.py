# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The extraction node: observations as by the command, bad images counted, overlay, states."""

from array import array

import numpy as np
import pytest
from fluoro_calib_msgs.srv import Calibrate
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from rclpy.serialization import serialize_message
from ros_graph import JOB_DEADLINE, NAMES
from sensor_msgs.msg import CompressedImage, Image

from benchmarks.bead_images import bead_image
from fluoro_calib_ros.bodies.body import Body
from fluoro_calib_ros.estimation.options import CalibrationOptions, CalibrationRequest
from fluoro_calib_ros.exposures.phantom import Phantom
from fluoro_calib_ros.images.codec import decode, encode
from fluoro_calib_ros.io.bodies import write_bodies
from fluoro_calib_ros.io.calibration_request import RADIOGRAPHS
from fluoro_calib_ros.io.observations import write_observations_csv
from fluoro_calib_ros.io.phantom import read_phantom, write_phantom
from fluoro_calib_ros.jobs.calibration import run_calibration
from fluoro_calib_ros.jobs.extraction import ExtractionRequest, run_extraction
from fluoro_calib_ros.jobs.report import write_report
from fluoro_calib_ros.nodes.messages.observations import stamp_from_nanoseconds
from fluoro_calib_ros.nodes.runtime.topics import images_qos
from fluoro_calib_ros.photogrammetry.rotations import matrix_from_vector
from fluoro_calib_ros.simulation.rig import simulate_tracking, virtual_rig

SIZE = 400
BEADS = np.random.default_rng(5).uniform(-60, 60, (48, 3))
OTHER_BEADS = np.random.default_rng(6).uniform(-60, 60, (24, 3))
DISTANCE_PX = 1600.0
POSES = 4
START_NS = 10**18
INTERVAL_NS = 500_000_000
MODEL = 'collocation'


def picture(name, number, beads=BEADS, dtype=np.uint8):
    """Return an image of the phantom in one of its poses, as seen by a fluoroscope."""
    pose = matrix_from_vector([0.5 * np.sin(number), 0.4 * np.cos(2 * number), 0.9 * number])
    side = matrix_from_vector([0, 0.7 if name == 'a' else -0.7, 0])
    x = beads @ pose.T @ side.T + (5 * np.sin(3 * number), 5 * np.cos(number), 900)
    uv = DISTANCE_PX * x[:, :2] / x[:, 2:] + (SIZE - 1) / 2
    return bead_image(uv, (SIZE, SIZE), dtype, 2.0, 0.6, 0.01, number)


def stamped(message, number, name='a'):
    message.header.stamp = stamp_from_nanoseconds(START_NS + number * INTERVAL_NS)
    message.header.frame_id = f'{name}_optical'
    return message


def raw(image, number, name='a'):
    return stamped(
        Image(
            height=image.shape[0],
            width=image.shape[1],
            encoding='mono8' if image.dtype == np.uint8 else 'mono16',
            step=image.shape[1] * image.itemsize,
            data=array('B', image.tobytes()),
        ),
        number,
        name,
    )


def compressed(data, number):
    return stamped(CompressedImage(format='mono8; png', data=array('B', data)), number)


@pytest.fixture(scope='module')
def rig(module_graph, tmp_path_factory):
    """Extraction and calibration nodes of a small rig, with the images that they receive."""
    folder = tmp_path_factory.mktemp('rig')
    phantom = folder / 'phantom.csv'
    write_phantom(phantom, Phantom(np.arange(48) + 1, BEADS, np.full(48, 0.05)))
    module_graph.fork = False
    client = module_graph.client
    client.expect(ChangeState, 'extraction_node/change_state')
    publishers = {}
    for name in NAMES:
        client.listen(f'{name}/target_observations')
        publishers[name] = client.create_publisher(Image, f'{name}/image_raw', images_qos())
    publishers['compressed'] = client.create_publisher(
        CompressedImage, 'a/image_raw/compressed', images_qos()
    )
    nodes = [
        module_graph.start(
            'extraction_node', {'phantom': phantom, 'principal_distance': DISTANCE_PX}, wait=False
        ),
        module_graph.calibration_node(
            folder / 'calibrations', wait=False, phantom=phantom, model=MODEL
        ),
    ]
    client.connect('calibration_node', nodes[1])
    client.connect('extraction_node', nodes[0])
    client.wait_until(
        lambda: all(p.get_subscription_count() for p in publishers.values()), what='the readers'
    )
    for name in NAMES:  # one reader is the client, the other the calibration node
        wait_for(client, lambda values, _: int(values.get('readers', 0)) == 2, name, 'readers')
    client.node = nodes[0]
    client.folder = folder
    client.images = publishers
    client.phantom = read_phantom(phantom)
    return client


def wait_for(client, condition, name='a', what='a diagnostic'):
    """Return the values of the extraction node's status once they fulfil condition."""

    def values(status):
        return {v.key: v.value for v in status.values}

    status = client.wait_for_diagnostics(
        'extraction_node', lambda s: condition(values(s), s), name, what
    )
    return values(status)


@pytest.fixture(scope='module')
def observed(rig):
    """Observations of the node, by fluoroscope and number."""
    for number in range(1, POSES + 1):
        for name in NAMES:
            rig.images[name].publish(raw(picture(name, number), number, name))
    found = {name: rig.messages[f'{name}/target_observations'] for name in NAMES}
    rig.wait_until(
        lambda: all(len(f) == POSES for f in found.values()), JOB_DEADLINE, 'observations'
    )
    return {name: {m.frame_number: m for m in messages} for name, messages in found.items()}


@pytest.fixture(scope='module')
def frames_by_command(rig):
    """Frames of the command extract, by fluoroscope."""
    out = {}
    for name in NAMES:
        folder = rig.folder / name
        folder.mkdir()
        for number in range(1, POSES + 1):
            data = encode(picture(name, number), '.png')
            (folder / f'{number}.png').write_bytes(data)
        request = ExtractionRequest([folder], rig.phantom, name, DISTANCE_PX, workers=1)
        out[name] = run_extraction(request).frames
    return out


def test_observations_are_those_of_the_command(observed, frames_by_command):
    for name in NAMES:
        assert len(frames_by_command[name]) == POSES
        for frame in frames_by_command[name]:
            message = observed[name][frame.number]
            assert list(message.target_id) == frame.target_id.tolist()
            assert np.abs(np.column_stack([message.u, message.v]) - frame.uv).max() < 1e-3
            assert np.allclose(message.sigma, frame.sigma, rtol=1e-3)
            assert (message.image_width, message.image_height) == (SIZE, SIZE)
            assert message.header == raw(picture(name, 1), frame.number, name).header


def test_calibration_is_that_of_the_command(rig, observed, frames_by_command):
    """The calibration node has collected the exposures unchanged."""
    rig.wait_for_status(lambda s: s.exposures == POSES, what='the exposures')
    answer = rig.call(Calibrate, 'calibrate')
    assert answer.success, answer.message
    options = CalibrationOptions(model=MODEL)
    for f, name in enumerate(NAMES):
        request = CalibrationRequest({name: frames_by_command[name]}, rig.phantom, options)
        calibration = run_calibration(request).calibrations[name]
        live = [answer.xp[f], answer.yp[f], answer.c[f]]
        assert np.abs(calibration.interior - live).max() < 1e-2
        assert answer.observations[f] == sum(len(f.target_id) for f in frames_by_command[name])
    folder = rig.folder / 'calibrations'
    for name in NAMES:
        # The node may discover the reader of radiographs only after the first image.
        for number in range(2, POSES + 1):
            radiograph = decode((folder / RADIOGRAPHS / f'{name}_{number}.jpg').read_bytes())
            shown = picture(name, number).astype(float)
            assert np.corrcoef(radiograph.ravel(), shown.ravel())[0, 1] > 0.98
    write_report(folder)
    report = (folder / 'report.html').read_text(encoding='utf-8')
    assert report.count('"/9j/') >= len(NAMES) * (POSES - 1)


BAD = {  # number of the image, publisher, message, diagnostics key, reported text
    'garbage': (
        'compressed',
        lambda n: compressed(b'no image' * 50, n),
        'refused: damaged',
        'ima',
    ),
    'cut off': (
        'compressed',
        lambda n: compressed(encode(picture('a', 1), '.png')[:-3000], n),
        'refused: damaged',
        'the PNG image is cut off',
    ),
    'another size': (
        'a',
        lambda n: raw(picture('a', 1)[:300], n),
        'refused: image size',
        'the image is 400 x 300 px, but the first one is 400 x 400 px',
    ),
    'another frame id': (
        'a',
        lambda n: raw(picture('a', 1), n, 'b'),
        'refused: frame id',
        "the frame id is 'b_optical', but that of the first image is 'a_optical'",
    ),
    'black': (
        'a',
        lambda n: raw(np.zeros((SIZE, SIZE), np.uint8), n),
        'images without observations',
        'no observations: ',
    ),
    'another phantom': (
        'a',
        lambda n: raw(picture('a', 1, OTHER_BEADS), n),
        'images without observations',
        'no observations: ',
    ),
}


def test_bad_images_are_said_and_counted_and_the_node_lives(rig, observed):
    before = wait_for(rig, lambda v, s: v['images extracted'] == str(POSES))
    for number, (publisher, message, *_) in enumerate(BAD.values(), 100):
        rig.images[publisher].publish(message(number))
    done = ('images refused', 'images without observations')
    values = wait_for(
        rig, lambda v, s: sum(int(v[key]) for key in done) == len(BAD), what='the bad images'
    )
    keys = [key for _, _, key, _ in BAD.values()]
    for key in keys:
        assert int(values[key]) - int(before[key]) == keys.count(key), key
    for name, (*_, text) in BAD.items():
        assert text in rig.node.log, name
    assert 'Traceback' not in rig.node.log and rig.node.running
    found = rig.messages['a/target_observations']
    count = len(found)
    rig.images['a'].publish(raw(picture('a', 2), 200))
    rig.wait_until(lambda: len(found) > count, JOB_DEADLINE, 'the next good image')
    assert len(found) == count + 1 and len(found[-1].target_id) > 40


def test_undecodable_message(rig, observed):
    data = serialize_message(raw(picture('a', 1), 300))
    rig.images['a'].publish(bytes(data[: len(data) // 2]))
    wait_for(rig, lambda v, s: v['refused: undecodable'] == '1')


def test_overlay_is_drawn_for_subscribers_only(rig, observed):
    pictures = []
    found = rig.messages['a/target_observations']
    subscription = rig.create_subscription(Image, 'a/image_overlay', pictures.append, images_qos())
    numbers = iter(range(400, 1000))

    def came():
        count = len(found)
        rig.images['a'].publish(raw(picture('a', 3), next(numbers)))
        rig.wait_until(lambda: len(found) > count, JOB_DEADLINE, 'observations')
        return pictures

    rig.wait_until(came, what='the overlay: the node has found its reader')
    rig.destroy_subscription(subscription)
    overlay = pictures[0]
    assert overlay.encoding == 'bgr8' and overlay.width >= SIZE and overlay.height >= SIZE
    pixels = np.frombuffer(overlay.data, np.uint8).reshape(overlay.height, overlay.width, 3)
    assert (pixels[..., 0] != pixels[..., 2]).any()  # coloured circles

    def followed(values, status):
        came()  # the first image of a pose needs a search, and the overlay may show that image
        return int(values['images followed']) > 0

    values = wait_for(rig, followed)
    assert float(values['latency p50 [ms]']) > 0


def test_inactive_node_receives_no_images_and_starts_anew(rig, observed):
    def change(transition):
        return rig.call(
            ChangeState, 'extraction_node/change_state', transition=Transition(id=transition)
        ).success

    assert change(Transition.TRANSITION_DEACTIVATE)
    wait_for(rig, lambda v, s: s.message == 'the node is not active')
    rig.wait_until(lambda: not rig.images['a'].get_subscription_count(), what='no reader')
    assert change(Transition.TRANSITION_CLEANUP)
    assert change(Transition.TRANSITION_CONFIGURE) and change(Transition.TRANSITION_ACTIVATE)
    rig.wait_until(rig.images['a'].get_subscription_count, what='the reader')
    rig.wait_until_known_to('extraction_node')
    found = rig.messages['a/target_observations']
    found.clear()
    rig.images['a'].publish(raw(picture('a', 4, dtype=np.uint16), 2000))
    rig.wait_until(lambda: found, JOB_DEADLINE, 'observations')
    assert found[0].frame_number == 1
    assert rig.node.end() == 0 and 'Traceback' not in rig.node.log


def test_markers_of_the_simulator_are_followed(graph):
    """Radiographs of the simulator; ids and initial positions from a table."""
    rate = 0.5
    tracking = simulate_tracking(virtual_rig(1, names=('a',)), 4.0, rate, 1, 0.0)
    markers = graph.directory / 'markers.csv'
    write_observations_csv(markers, {'a': tracking.frames['a'][:1]})
    found = graph.client.listen('a/target_observations')
    only_a = {'fluoroscopes': '[a]'}
    node = graph.start('extraction_node', {**only_a, 'mode': 'markers', 'markers': markers})
    scene = {'scene': 'markers', 'images': 'clean', 'rate': rate, 'frames': 1, 'noise': 0.0}
    simulator = graph.start(
        'simulator_node', {**only_a, **scene, 'wait_for_readers': 1}, wait=False
    )
    graph.client.wait_until(lambda: found, JOB_DEADLINE, 'the markers')
    assert simulator.wait() == 0, simulator.log
    true = dict(zip(tracking.marker_id.tolist(), tracking.frames['a'][0].uv))
    assert set(found[0].target_id) <= set(true) and len(found[0].target_id) > 20
    error = [np.hypot(u - true[i][0], v - true[i][1]) for i, u, v in zip(*columns(found[0]))]
    assert np.median(error) < 0.1 and max(error) < 1.0
    assert node.running and 'Traceback' not in node.log


def test_markers_are_followed_in_both_views_together(graph, calibrated):
    """Uses the calibrations of both fluoroscopes."""
    rate = 0.2
    tracking = simulate_tracking(virtual_rig(1), 6.0, rate, 1, 0.0)
    markers = graph.directory / 'markers.csv'
    write_observations_csv(markers, {name: tracking.frames[name][:1] for name in NAMES})
    found = {name: graph.client.listen(f'{name}/target_observations') for name in NAMES}
    together = {'mode': 'markers', 'markers': markers, 'calibration_directory': calibrated}
    node = graph.start('extraction_node', together)
    scene = {'scene': 'markers', 'images': 'clean', 'rate': rate, 'frames': 1, 'noise': 0.0}
    simulator = graph.start('simulator_node', {**scene, 'wait_for_readers': 1}, wait=False)
    graph.client.wait_until(lambda: all(found.values()), JOB_DEADLINE, 'the markers of both views')
    assert simulator.wait() == 0, simulator.log
    for name in NAMES:
        true = dict(zip(tracking.marker_id.tolist(), tracking.frames[name][0].uv))
        seen = found[name][0]
        assert set(seen.target_id) <= set(true) and len(seen.target_id) > 20
        error = [np.hypot(u - true[i][0], v - true[i][1]) for i, u, v in zip(*columns(seen))]
        assert np.median(error) < 0.1 and max(error) < 1.0
    assert node.running and 'Traceback' not in node.log


def test_bodies_give_the_ids_of_the_first_markers(graph, calibrated):
    """No initial positions: the shapes of the bodies suffice, in any pose."""
    rate = 0.2
    tracking = simulate_tracking(virtual_rig(1), 6.0, rate, 1, 0.0)
    bodies = graph.directory / 'bodies.csv'
    shapes = zip(tracking.marker_id.reshape(-1, 6), tracking.points_mm[0].reshape(-1, 6, 3))
    write_bodies(
        bodies,
        [Body(f'bone {ids[0]}', ids, xyz - xyz[0], np.full(6, 0.05)) for ids, xyz in shapes],
    )
    found = {name: graph.client.listen(f'{name}/target_observations') for name in NAMES}
    together = {'mode': 'markers', 'bodies': bodies, 'calibration_directory': calibrated}
    node = graph.start('extraction_node', together)
    scene = {'scene': 'markers', 'images': 'clean', 'rate': rate, 'frames': 1, 'noise': 0.0}
    simulator = graph.start('simulator_node', {**scene, 'wait_for_readers': 1}, wait=False)
    graph.client.wait_until(lambda: all(found.values()), JOB_DEADLINE, 'the markers of both views')
    assert simulator.wait() == 0, simulator.log
    for name in NAMES:
        true = dict(zip(tracking.marker_id.tolist(), tracking.frames[name][0].uv))
        seen = found[name][0]
        error = [np.hypot(u - true[i][0], v - true[i][1]) for i, u, v in zip(*columns(seen))]
        assert len(error) > 5 and max(error) < 1.0
    assert node.running and 'Traceback' not in node.log


def test_views_that_cannot_be_followed_together_are_refused(graph, calibrated):
    tracking = simulate_tracking(virtual_rig(1), 2.0, 1.0, 1, 0.0)
    markers = graph.directory / 'markers.csv'
    write_observations_csv(markers, {name: tracking.frames[name][:1] for name in NAMES})
    together = {'mode': 'markers', 'markers': markers, 'calibration_directory': calibrated}
    for more, sentence in (
        ({'fluoroscopes': '[a]'}, 'two fluoroscopes or more are followed together, not 1'),
        ({'calibration_directory': graph.directory / 'nothing'}, 'nothing'),
        ({'clusters': '[tibia]'}, 'does not declare a body'),
        ({'bodies': graph.directory / 'nowhere.csv'}, 'nowhere.csv'),
    ):
        node = graph.start('extraction_node', {**together, **more}, wait=False)
        assert node.wait() == 1
        assert sentence in node.log and 'Traceback' not in node.log


def columns(message):
    return message.target_id, message.u, message.v


def test_node_without_a_phantom_says_so(graph):
    node = graph.start('extraction_node', wait=False)
    assert node.wait() == 1
    assert 'parameter phantom is not set' in node.log and 'Traceback' not in node.log


def test_each_image_shows_one_of_the_parts_of_a_phantom(module_graph, tmp_path):
    solid = Phantom(np.arange(48) + 1, BEADS, np.full(48, 0.05))
    other = Phantom(np.arange(24) + 1, OTHER_BEADS, np.full(24, 0.05))
    write_phantom(tmp_path / 'both.csv', solid.with_part(other))
    client = module_graph.client
    client.listen('c/target_observations')
    images = client.create_publisher(Image, 'c/image_raw', images_qos())
    module_graph.start(
        'extraction_node',
        {
            'phantom': tmp_path / 'both.csv',
            'principal_distance': DISTANCE_PX,
            'fluoroscopes': ['c'],
        },
    )
    client.wait_until(images.get_subscription_count, what='the reader of images')
    found = client.messages['c/target_observations']
    for number, beads in enumerate((BEADS, OTHER_BEADS, BEADS), 1):
        images.publish(raw(picture('a', number, beads), number, 'c'))
        client.wait_until(lambda n=number: len(found) == n, JOB_DEADLINE, 'observations')
    for message, of_other in zip(found, (False, True, False)):
        ids = np.asarray(message.target_id)
        assert len(ids) > 15
        assert ((ids > 100) if of_other else (ids <= 48)).all()
