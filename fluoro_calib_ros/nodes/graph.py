"""Starting and ending the nodes of a graph as processes, where there is no launch."""

import os
import signal
import socket
import subprocess
import sys


class Graph:
    """Node processes that end together; a context manager.

    log_directory: what each node prints goes to NAME.log there.
    """

    def __init__(self, log_directory):
        self._directory = log_directory
        self._processes = []

    def start(self, name, parameters=None):
        """Start fluoro_calib_ros.nodes.NAME with {parameter: value}; returns the process."""
        command = [sys.executable, '-m', f'fluoro_calib_ros.nodes.{name}', '--ros-args']
        for key, value in (parameters or {}).items():
            command += ['-p', f'{key}:={value}']
        log = open(self._directory / f'{name}.log', 'ab')
        with log:
            # A session of its own: an interrupt from the keyboard reaches the nodes from here, in
            # order.
            process = subprocess.Popen(command, stdout=log, stderr=log, start_new_session=True)
        self._processes.append(process)
        return process

    def ended(self):
        """Processes that have ended by themselves with a fault."""
        return [p for p in self._processes if p.poll() not in (None, 0)]

    def __enter__(self):
        return self

    def __exit__(self, *_):
        running = [p for p in self._processes if p.poll() is None]
        for process in running:
            process.send_signal(signal.SIGINT)
        for process in running:
            try:
                process.wait(timeout=5)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


def isolate():
    """Keep this process and its children on this machine and off the graph of others, unless told
    otherwise.
    """
    os.environ.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    if 'ROS_DOMAIN_ID' not in os.environ:
        domains = [1 + (os.getpid() + i) % 100 for i in range(100)]
        os.environ['ROS_DOMAIN_ID'] = str(next((d for d in domains if _is_free(d)), domains[0]))


def _is_free(domain):
    """Whether nobody on this machine is in a ROS domain: the first participant has this port
    (DDSI-RTPS 9.6.1.1).
    """
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as port:
        try:
            port.bind(('', 7400 + 250 * domain + 10))
        except OSError:
            return False
    return True
