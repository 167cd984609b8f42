# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Workers: results do not change if a worker of a Dask cluster dies; none outlives its caller."""

from __future__ import annotations

import asyncio
import os
import shutil
import signal
import subprocess
import sys
from multiprocessing.connection import wait
from pathlib import Path

import cv2
import numpy as np
import pytest
import rigs

from benchmarks.bead_images import bead_image
from fluoro_calib_ros.errors import DataError
from fluoro_calib_ros.exposures.phantom import Phantom
from fluoro_calib_ros.jobs import scheduling
from fluoro_calib_ros.jobs.extraction import ExtractionRequest, run_extraction
from fluoro_calib_ros.jobs.image_correction import ImageCorrectionRequest, run_image_correction
from fluoro_calib_ros.jobs.scheduling import Cluster, LocalWorkers, open_workers
from fluoro_calib_ros.photogrammetry.rotations import matrix_from_vector

SIZE = 400
COUNT = 60
IMAGES = 10


def phantom() -> Phantom:
    xyz = np.random.default_rng(5).uniform(-60, 60, (COUNT, 3))
    return Phantom(np.arange(COUNT) + 1, xyz, np.full(COUNT, 0.1))


def picture(number: int) -> np.ndarray:
    x = phantom().xyz_mm @ matrix_from_vector([0.3 * number, 0.2, -0.1 * number]).T
    uv = 1600 * x[:, :2] / (x[:, 2:] + 900) + (SIZE - 1) / 2
    return bead_image(uv, (SIZE, SIZE), np.uint8, 2.0, 0.6, 0.01, number)


@pytest.fixture(scope='module')
def images(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp('images')
    for number in range(1, IMAGES + 1):
        cv2.imwrite(str(folder / f'image_{number:02d}.png'), picture(number))
    (folder / 'image_03.png').write_bytes(b'\x89PNG\r\n\x1a\nnothing')
    return folder


def request(images: Path, **settings) -> ExtractionRequest:
    return ExtractionRequest([images], phantom(), 'a', **settings)


@pytest.fixture(scope='module')
def cluster():
    from distributed import LocalCluster

    with LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as started:
        yield started


class Killer:
    """Progress callback that kills a worker of a cluster after the second file."""

    def __init__(self, cluster) -> None:
        self.cluster = cluster
        self.killed: list[int] = []

    def __call__(self, done: int, total: int) -> None:
        from distributed import Client

        if done == 2:
            with Client(self.cluster, set_as_default=False) as client:
                self.killed.append(next(iter(client.run(os.getpid).values())))
            os.kill(self.killed[0], signal.SIGKILL)


@pytest.mark.long
def test_a_killed_worker_of_a_cluster_loses_no_image(images, cluster):
    expected = run_extraction(request(images, workers=1))
    killer = Killer(cluster)
    found = run_extraction(request(images, scheduler=cluster.scheduler_address), killer)
    assert killer.killed
    assert [r.exposure for r in found.results] == list(range(1, IMAGES + 1))
    assert [r.reason for r in found.refused] == [r.reason for r in expected.refused]
    for one, other in zip(found.frames, expected.frames):
        assert np.array_equal(one.target_id, other.target_id)
        assert np.array_equal(one.uv, other.uv)


@pytest.mark.long
def test_a_killed_worker_of_a_cluster_loses_no_corrected_image(images, cluster, tmp_path):
    """The files are the same bytes; the damaged one is named with the place that read it."""
    calibration = rigs.pincushion('a', (SIZE, SIZE))
    outs = [tmp_path / 'here', tmp_path / 'cluster']
    settings = {'keep_going': True, 'workers': 1}
    run_image_correction(ImageCorrectionRequest(images, outs[0], calibration, **settings))
    settings['scheduler'] = cluster.scheduler_address
    killer = Killer(cluster)
    done = run_image_correction(
        ImageCorrectionRequest(images, outs[1], calibration, **settings), killer
    )
    assert killer.killed and done.files == IMAGES - 1
    assert 'image_03.png' in done.failed[0] and 'worker of the cluster' in done.failed[0]
    names = sorted(os.listdir(outs[0]))
    assert sorted(os.listdir(outs[1])) == names and len(names) == IMAGES - 1
    assert all((outs[0] / n).read_bytes() == (outs[1] / n).read_bytes() for n in names)


def test_a_scheduler_that_is_not_there_is_told(monkeypatch):
    monkeypatch.setattr(scheduling, 'CONNECT_S', 0.5)
    with pytest.raises(DataError, match=r'no Dask scheduler at tcp://127\.0\.0\.1:9'):
        open_workers(scheduler='tcp://127.0.0.1:9')
    with pytest.raises(DataError, match='no Dask scheduler at nonsense'):
        open_workers(scheduler=Cluster('nonsense', trusted_network=True))


def test_a_client_that_could_not_connect_is_closed_at_once(monkeypatch):
    """If only the garbage collector closes it, it may hang with the start of another client."""
    from distributed import Client

    monkeypatch.setattr(scheduling, 'CONNECT_S', 0.5)
    closed = []
    monkeypatch.setattr(Client, '__del__', lambda client: closed.append(client.status))
    with pytest.raises(DataError, match='no Dask scheduler'):
        open_workers(scheduler='tcp://127.0.0.1:9')
    assert len(closed) == 1


def certificate(folder: Path, name: str, authority: str) -> Path:
    """Make a certificate NAME.pem with its key NAME.key, signed by AUTHORITY.pem."""
    pem = folder / f'{name}.pem'
    command = ['openssl', 'req', '-x509', '-newkey', 'ec', '-pkeyopt', 'ec_paramgen_curve:P-256']
    command += ['-nodes', '-subj', f'/CN={name}', '-days', '2', '-out', pem]
    command += ['-keyout', folder / f'{name}.key']
    if name != authority:
        command += ['-CA', folder / f'{authority}.pem', '-CAkey', folder / f'{authority}.key']
    subprocess.run(command, check=True, capture_output=True)
    return pem


def cluster_with(folder: Path, address: str, authority: str, name: str) -> Cluster:
    files = [str(folder / f) for f in (f'{authority}.pem', f'{name}.pem', f'{name}.key')]
    return Cluster(address, *files)


@pytest.mark.long
def test_who_has_no_certificate_of_the_cluster_gets_and_gives_nothing(tmp_path, monkeypatch):
    from distributed import LocalCluster, Worker
    from distributed.security import Security

    if shutil.which('openssl') is None:
        pytest.skip('openssl is not installed')
    for name, authority in (('ca', 'ca'), ('lab', 'ca'), ('other', 'other'), ('evil', 'other')):
        certificate(tmp_path, name, authority)

    def security(authority: str, name: str) -> Security:
        pem, key = str(tmp_path / f'{name}.pem'), str(tmp_path / f'{name}.key')
        files = {
            f'tls_{of}_{what}': path
            for of in ('client', 'worker', 'scheduler')
            for what, path in (('cert', pem), ('key', key))
        }
        return Security(
            tls_ca_file=str(tmp_path / f'{authority}.pem'), **files, require_encryption=True
        )

    settings = {'n_workers': 1, 'threads_per_worker': 1, 'dashboard_address': None}
    settings |= {'protocol': 'tls://', 'processes': False, 'security': security('ca', 'lab')}
    with LocalCluster(**settings) as cluster:
        address = cluster.scheduler_address
        assert address.startswith('tls://')
        known = cluster_with(tmp_path, address, 'ca', 'lab')
        with open_workers(scheduler=known) as workers:
            assert list(workers.map(abs, [-1, -2])) == [1, 2]
        monkeypatch.setattr(scheduling, 'CONNECT_S', 3)  # [s], short for connections that fail
        with pytest.raises(DataError, match='no Dask scheduler'):
            open_workers(scheduler=cluster_with(tmp_path, address, 'other', 'evil'))
        with pytest.raises(DataError, match='no Dask scheduler'):  # needs the same authority
            open_workers(scheduler=cluster_with(tmp_path, address, 'ca', 'evil'))

        async def join() -> None:
            async with Worker(address, security=security('ca', 'evil'), death_timeout=2):
                pass

        with pytest.raises((OSError, TimeoutError, RuntimeError)):
            asyncio.run(join())
        assert len(cluster.scheduler.workers) == 1


@pytest.mark.parametrize(
    'address', ['tcp://10.0.0.7:8786', '10.0.0.7:8786', 'tcp://lab:8786', 'tcp://127.lab:1']
)
def test_plain_tcp_to_another_machine_needs_a_trusted_network(address):
    with pytest.raises(DataError, match='anyone who reaches this scheduler can run code here'):
        open_workers(scheduler=address)
    assert Cluster(address, trusted_network=True).security() is None


@pytest.mark.parametrize('address', ['tcp://127.0.0.1:9', 'tcp://localhost:9', 'tcp://[::1]:9'])
def test_plain_tcp_on_this_machine_is_allowed(address):
    assert Cluster(address).security() is None


def test_incomplete_certificates_are_told(tmp_path):
    with pytest.raises(DataError, match='needs the certificate of the authority'):
        Cluster('tls://lab:8786').security()
    with pytest.raises(DataError, match='there is no such file'):
        cluster_with(tmp_path, 'tls://lab:8786', 'ca', 'lab').security()
    with pytest.raises(DataError, match='certificates are for a scheduler tls'):
        cluster_with(tmp_path, 'tcp://lab:8786', 'ca', 'lab').security()


def test_results_keep_the_order_of_their_tasks_and_few_tasks_are_in_memory():
    taken = []

    def tasks():
        for number in range(40):
            taken.append(number)
            yield number

    with LocalWorkers(2) as workers:
        results = workers.map(abs, tasks())
        first = next(results)
        assert len(taken) < 10
        assert [first, *results] == list(range(40))


def test_a_worker_that_dies_is_told():
    with (
        LocalWorkers(2) as workers,
        pytest.raises(DataError, match='worker process was terminated'),
    ):
        list(workers.map(os._exit, [1, 1]))


CALLER = """
import os, sys, threading
sys.path.insert(0, {root!r})
from fluoro_calib_ros.jobs.scheduling import LocalWorkers

def work(_):
    os.write(1, b'%d\\n' % os.getpid())  # in one piece, unlike print()
    threading.Event().wait()

if __name__ == '__main__':
    with LocalWorkers(2) as workers:
        list(workers.map(work, range(4)))
"""


@pytest.mark.long
@pytest.mark.parametrize('number', [signal.SIGKILL, signal.SIGTERM])
def test_workers_end_with_their_caller(tmp_path, number):
    """The caller cannot end them after either of these signals."""
    script = tmp_path / 'caller.py'
    script.write_text(CALLER.format(root=str(Path(__file__).parents[2])))
    with subprocess.Popen(
        [sys.executable, script], stdout=subprocess.PIPE, text=True, start_new_session=True
    ) as caller:
        workers = [os.pidfd_open(int(caller.stdout.readline())) for _ in range(2)]
        caller.send_signal(number)
        for worker in workers:  # the descriptor becomes readable when the worker has ended
            assert wait([worker], 30)
            os.close(worker)
