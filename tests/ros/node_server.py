# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Run nodes as forks of a process that has already loaded the modules of all nodes.

Loading the modules costs a second of CPU time per node, more than most tests spend on it. A forked
node is a process like any other, with arguments, environment, signals and interpreter shutdown.

Run as a program with the file descriptor of a socket, this module is the process to fork. A
request is a line of JSON with the module, the arguments, the environment and the path of the log;
the answer is {"pid": ...}, and {"pid": ..., "status": ...} follows at the end of the node.
"""

import contextlib
import ctypes
import faulthandler
import gc
import importlib
import json
import os
import select
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

ROOT = Path(__file__).parents[2]
PACKAGE = 'fluoro_calib_ros.nodes'
NODES = sorted(path.stem for path in (ROOT / 'fluoro_calib_ros' / 'nodes').glob('*_node.py'))
ONE_THREAD = dict.fromkeys(('OMP_NUM_THREADS', 'OPENBLAS_NUM_THREADS'), '1')


class NodeServer:
    """Client side of the process from which nodes are forked."""

    def __init__(self):
        self._socket, theirs = socket.socketpair()
        with theirs:
            self._process = subprocess.Popen(
                [sys.executable, __file__, str(theirs.fileno())],
                cwd=ROOT,
                env={**os.environ, **ONE_THREAD},  # further threads would not survive the fork
                pass_fds=[theirs.fileno()],
                start_new_session=True,  # an interrupt of the tests must not reach it
            )
        self._lines = _Lines(self._socket)
        self._statuses = {}
        self._started = []

    def start(self, node, arguments, log, environment):
        """Start a node and return its ForkedNode."""
        Path(log).touch()
        request = {
            'module': f'{PACKAGE}.{node}',
            'arguments': [str(argument) for argument in arguments],
            'environment': environment,
            'log': str(log),
        }
        self._socket.sendall(json.dumps(request).encode() + b'\n')
        while not self._started:
            self._receive(None)
        return ForkedNode(self, self._started.pop())

    def status(self, pid, seconds=0.0):
        """Return the exit status of a node, or None if it has not ended within `seconds`."""
        end = time.monotonic() + seconds
        while pid not in self._statuses:
            left = end - time.monotonic()
            self._receive(max(left, 0.0))
            if left <= 0:
                break
        return self._statuses.get(pid)

    def close(self):
        """End the server process; its nodes must have ended before."""
        self._socket.close()
        self._process.wait()

    def _receive(self, seconds):
        if not select.select([self._socket], [], [], seconds)[0]:
            return
        for line in self._lines.read():
            if 'status' in line:
                self._statuses[line['pid']] = line['status']
            else:
                self._started.append(line['pid'])


class ForkedNode:
    """A node with the interface of subprocess.Popen."""

    def __init__(self, server, pid):
        self._server = server
        self.pid = pid

    def poll(self):
        return self._server.status(self.pid)

    def wait(self, timeout):
        status = self._server.status(self.pid, timeout)
        if status is None:
            raise subprocess.TimeoutExpired(f'node {self.pid}', timeout)
        return status

    def send_signal(self, number):
        if self.poll() is None:
            with contextlib.suppress(ProcessLookupError):  # it has just ended
                os.kill(self.pid, number)

    def kill(self):
        self.send_signal(signal.SIGKILL)


class _Lines:
    """JSON documents from a socket, one per line."""

    def __init__(self, connection):
        self._socket = connection
        self._rest = b''

    def read(self):
        """Return the documents that have arrived. Raise EOFError at the end of the connection."""
        received = self._socket.recv(1 << 16)
        if not received:
            raise EOFError('the node server has ended')
        *lines, self._rest = (self._rest + received).split(b'\n')
        return [json.loads(line) for line in lines]


# ------------------------------------------------------------------------------------------
# the process that is forked


def serve(connection):
    """Fork a process for each request until the client disconnects.

    Return the request in each forked process, and None in this process when it ends.
    """
    woken, wake = os.pipe()
    os.set_blocking(wake, False)
    signal.set_wakeup_fd(wake)
    signal.signal(signal.SIGCHLD, lambda *_: None)
    lines = _Lines(connection)
    while True:
        ready = select.select([connection, woken], [], [])[0]
        if woken in ready:
            os.read(woken, 1000)
            _tell_ended(connection)
        if connection not in ready:
            continue
        try:
            requests = lines.read()
        except (EOFError, ConnectionError):
            return None
        for request in requests:
            pid = os.fork()
            if not pid:
                signal.set_wakeup_fd(-1)
                signal.signal(signal.SIGCHLD, signal.SIG_DFL)
                os.close(woken)
                os.close(wake)
                connection.close()
                return request
            connection.sendall(json.dumps({'pid': pid}).encode() + b'\n')


def _tell_ended(connection):
    """Report the exit statuses of the processes that have ended."""
    with contextlib.suppress(ChildProcessError):
        while True:
            pid, status = os.waitpid(-1, os.WNOHANG)
            if not pid:
                return
            document = {'pid': pid, 'status': os.waitstatus_to_exitcode(status)}
            connection.sendall(json.dumps(document).encode() + b'\n')


def run_node(request):
    """Run a node in this process, which ends with the node."""
    os.setsid()
    log = os.open(request['log'], os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o644)
    for stream in (1, 2):
        os.dup2(log, stream)
    os.close(log)
    os.environ.clear()
    os.environ.update(request['environment'])
    faulthandler.enable()
    # The interpreter shuts down as in any program, but its libraries do not: LTTng,
    # which rclpy loads, would end threads that do not exist in a forked process.
    libc = ctypes.CDLL(None)
    libc.on_exit(libc._exit, None)
    module = importlib.import_module(request['module'])
    sys.argv = [module.__file__, *request['arguments']]
    module.main()


def main():
    sys.path[0] = str(ROOT)
    connection = socket.socket(fileno=int(sys.argv[1]))
    for node in NODES:
        importlib.import_module(f'{PACKAGE}.{node}')
    gc.freeze()  # the forked processes share these memory pages
    request = serve(connection)
    if request is not None:
        run_node(request)


if __name__ == '__main__':
    main()
