#!/usr/bin/env python3

# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Make or refresh the project's .venv: packages, ROS 2, messages, this package. Called by
tools/setup.sh.

Standard library only. Each step leaves a stamp in .venv/.setup with a digest of what it was made
from; a step whose stamp is valid is not repeated, and a step that fails or is interrupted leaves
none. Deleting .venv, moving the folder, another PYTHON, a changed lock file or a changed message
are therefore all noticed.
"""

from __future__ import annotations

import contextlib
import fcntl
import glob
import hashlib
import os
import pathlib
import platform
import re
import shlex
import shutil
import signal
import subprocess
import sys
import sysconfig
import time
from collections.abc import Callable, Iterator

ROOT = pathlib.Path(__file__).resolve().parent.parent
VENV = ROOT / '.venv'
STAMPS = VENV / '.setup'
BUILD = ROOT / '.build'
LOG = BUILD / 'setup.log'
LOCK = ROOT / 'requirements.lock'
HOOK = ROOT / 'tools' / 'venv_hook.py'
PACKAGE = 'fluoro_calib_ros'
# tf2_msgs has no wheel: the single message that the nodes publish is built unless ROS provides it.
MESSAGES = {'fluoro_calib_msgs': ROOT / 'msg_defs', 'tf2_msgs': ROOT / 'tools' / 'tf2_msgs'}

BASE_PYTHON = getattr(sys, '_base_executable', None) or sys.executable
VENV_PYTHON = str(VENV / 'bin' / 'python')
SITE_PACKAGES = (
    VENV / 'lib' / f'python{sys.version_info.major}.{sys.version_info.minor}' / 'site-packages'
)

# Variables that must not leak in from the shell: a sourced ROS, another venv, settings of pip, of
# an outer make.
FOREIGN = (
    'AMENT_',
    'COLCON_',
    'ROS_',
    'RMW_',
    '_ROS_WHEELS_',
    'CMAKE_PREFIX_PATH',
    'LD_LIBRARY_PATH',
    'PYTHONPATH',
    'PYTHONHOME',
    'PYTHONSTARTUP',
    'VIRTUAL_ENV',
    'CONDA_PREFIX',
    'PKG_CONFIG_PATH',
    'PIP_TARGET',
    'PIP_PREFIX',
    'PIP_ROOT',
    'PIP_USER',
    'PIP_REQUIRE_VIRTUALENV',
    'PIP_CONSTRAINT',
    'PIP_REQUIREMENT',
    'PIP_EDITABLE',
    'PIP_NO_BINARY',
    'MAKEFLAGS',
    'MAKELEVEL',
    'MFLAGS',
    'MAKEFILES',
    'DESTDIR',
)


class SetupError(Exception):
    """A problem that the user can fix; the text describes it."""


def environment() -> dict[str, str]:
    """Return the environment for every program this script starts."""
    env = {name: value for name, value in os.environ.items() if not name.startswith(FOREIGN)}
    env['PATH'] = os.pathsep.join([str(VENV / 'bin'), env.get('PATH', os.defpath)])
    env['AMENT_PREFIX_PATH'] = env['CMAKE_PREFIX_PATH'] = str(VENV)
    env['COLCON_HOME'] = str(BUILD / 'colcon')
    env['PIP_DISABLE_PIP_VERSION_CHECK'] = '1'
    env['PIP_NO_INPUT'] = '1'
    return env


def run(*command: str) -> None:
    """Run a program with its output in the log; raise SetupError if it fails."""
    with open(LOG, 'a') as log:
        log.write('\n$ ' + ' '.join(shlex.quote(word) for word in command) + '\n')
        log.flush()
        process = subprocess.Popen(
            command,
            cwd=ROOT,
            env=environment(),
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=subprocess.STDOUT,
        )
        try:
            code = process.wait()
        except KeyboardInterrupt:  # the program has received Ctrl-C too: let it stop by itself
            for stop in (lambda: None, process.terminate, process.kill):
                stop()
                with contextlib.suppress(subprocess.TimeoutExpired):
                    process.wait(5)
                    break
            raise
    if code:
        raise SetupError(f'{pathlib.Path(command[0]).name} failed with exit status {code}')


def digest(*parts: str | pathlib.Path) -> str:
    """Return one digest of texts, and of files and folders (names and contents) below ROOT."""
    total = hashlib.sha256()
    for part in parts:
        if isinstance(part, str):
            total.update(part.encode() + b'\0')
            continue
        files = (
            sorted(path for path in part.rglob('*') if path.is_file()) if part.is_dir() else [part]
        )
        for path in files:
            if '__pycache__' not in path.parts and path.is_file():
                total.update(
                    str(path.relative_to(ROOT)).encode() + b'\0' + path.read_bytes() + b'\0'
                )
    return total.hexdigest()


class Step:
    """A setup step: its inputs, and whether it has been done."""

    def __init__(
        self, name: str, title: str, action: Callable[[], None], *inputs: str | pathlib.Path
    ) -> None:
        """Take a name for the stamp, a title for the user, and the inputs as for digest()."""
        self.stamp = STAMPS / name
        self.title = title
        self.action = action
        self.wanted = digest(name, *inputs)

    def is_done(self) -> bool:
        """Return whether the stamp shows that the step was done from exactly these inputs."""
        try:
            return self.stamp.read_text() == self.wanted
        except OSError:
            return False

    def do(self) -> None:
        """Perform the step, with one line of output for the user."""
        start = time.monotonic()
        print(f'setup: {self.title} ... ', end='', flush=True)
        self.stamp.unlink(missing_ok=True)
        try:
            self.action()
        except BaseException:
            print('failed', flush=True)
            raise
        STAMPS.mkdir(parents=True, exist_ok=True)
        self.stamp.write_text(self.wanted)
        print(f'{time.monotonic() - start:.1f} s', flush=True)


# -------------------------------------------------------------------------------------------------
# the steps


def check_machine() -> None:
    """Raise SetupError with one sentence for each missing prerequisite."""
    missing = []
    version = f'{sys.version_info.major}.{sys.version_info.minor}'
    if sys.implementation.name != 'cpython':
        missing.append(
            f'{BASE_PYTHON} is {sys.implementation.name}, but the ROS packages are for CPython: '
            'name a CPython with PYTHON=python3 make setup.'
        )
    if sys.platform != 'linux' or platform.machine() != 'x86_64':
        missing.append(
            'The ROS 2 packages exist for Linux on x86_64 only, and this is '
            f'{platform.system()} on {platform.machine()}: use such a machine, or a ROS 2 Jazzy '
            'installation and colcon.'
        )
    else:
        libc, libc_version = platform.libc_ver()
        if libc != 'glibc' or tuple(int(part) for part in libc_version.split('.')[:2]) < (2, 28):
            missing.append(
                'The ROS 2 packages need glibc 2.28 or newer, and this is '
                f'{libc or "another libc"} {libc_version}: use a distribution of 2019 or later '
                'that is built on glibc.'
            )
    if subprocess.run(
        [BASE_PYTHON, '-c', 'import venv, ensurepip'], env=environment(), stderr=subprocess.DEVNULL
    ).returncode:
        missing.append(
            f'Python {version} has no venv module: get it with '
            f"'sudo apt install python{version}-venv' (Debian, Ubuntu)."
        )
    if not (pathlib.Path(sysconfig.get_path('include')) / 'Python.h').is_file():
        missing.append(
            f'Python {version} has no Python.h: get it with '
            f"'sudo apt install python{version}-dev' (Debian, Ubuntu) or "
            f"'sudo dnf install python{version}-devel' (Fedora)."
        )
    if not compiles():
        missing.append(
            "There is no working C and C++ compiler: get one with 'sudo apt install g++' "
            "(Debian, Ubuntu) or 'sudo dnf install gcc-c++' (Fedora), or name yours in CC and CXX."
        )
    if not shutil.which('make'):
        missing.append(
            "There is no make: get it with 'sudo apt install make' (Debian, Ubuntu) or "
            "'sudo dnf install make' (Fedora)."
        )
    if missing:
        raise SetupError('\n'.join(missing))


def compiles() -> bool:
    """Return whether a C and a C++ compiler turn a trivial source into a shared library."""
    sources = (
        ('CC', ('cc', 'gcc', 'clang'), 'c', '#include <stdio.h>\n'),
        ('CXX', ('c++', 'g++', 'clang++'), 'c++', '#include <string>\n'),
    )
    for variable, names, language, source in sources:
        candidates = [os.environ[variable]] if os.environ.get(variable) else names
        command = next(
            (shlex.split(name) for name in candidates if shutil.which(shlex.split(name)[0])), None
        )
        if command is None:
            return False
        output = BUILD / 'compiler_check.so'
        answer = subprocess.run(
            command + ['-x', language, '-shared', '-fPIC', '-o', str(output), '-'],
            input=source,
            text=True,
            env=environment(),
            capture_output=True,
        )
        output.unlink(missing_ok=True)
        if answer.returncode:
            with open(LOG, 'a') as log:
                log.write(answer.stderr)
            return False
    return True


def make_venv() -> None:
    """Recreate .venv with every package of the lock file."""
    if VENV.is_symlink():
        VENV.unlink()
    elif VENV.exists():
        shutil.rmtree(VENV)
    run(BASE_PYTHON, '-m', 'venv', str(VENV))
    # colcon searches the folder in which it is started for packages; exclude .venv.
    (VENV / 'COLCON_IGNORE').touch()
    pip = (VENV_PYTHON, '-m', 'pip', 'install', '--no-deps', '--require-hashes')
    installers = BUILD / 'installers.lock'
    installers.write_text(locked_installers(LOCK.read_text()))
    run(*pip, '-r', str(installers))
    run(*pip, '--no-build-isolation', '-r', str(LOCK))
    rewrite_cmake_files()
    run(VENV_PYTHON, '-m', 'pip', 'check')
    STAMPS.mkdir()
    (STAMPS / 'python').write_text(BASE_PYTHON + '\n')


def locked_installers(lock: str) -> str:
    """Return the part of a lock file that pins build and install tools, with hashes."""
    requirements = re.findall(r'^\S+==.*(?:\n    .*)*', lock, re.MULTILINE)
    return '\n'.join(
        requirement
        for requirement in requirements
        if requirement.split('==')[0] in ('pip', 'poetry-core', 'setuptools', 'wheel')
    )


def rewrite_cmake_files() -> None:
    """Point the wheels' exported CMake files, which name their builder's Python, to this Python
    and its numpy.
    """
    numpy_include = str(SITE_PACKAGES / 'numpy' / '_core' / 'include')
    python_include = sysconfig.get_path('include')
    for path in list((VENV / 'share').rglob('*.cmake')) + list(
        (VENV / 'lib' / 'cmake').rglob('*.cmake')
    ):
        text = path.read_text()
        if '/opt/python/' in text:
            new = re.sub(
                r'/opt/python/[^;"\s]*/numpy/_core/include', lambda _: numpy_include, text
            )
            new = re.sub(
                r'/opt/python/[^;"\s]*/include/python3\.\d+', lambda _: python_include, new
            )
            if '/opt/python/' in new:
                raise SetupError(
                    f'{path} names a folder of the machine the wheel was built on, in an '
                    'unknown way'
                )
            path.write_text(new)


def install_hook() -> None:
    """Let every Python of .venv start with the environment that ROS needs."""
    shutil.copyfile(HOOK, SITE_PACKAGES / 'fluoro_calib_venv.py')
    # .pth files are read in alphabetical order: this name precedes ros_wheels_bootstrapper.pth.
    (SITE_PACKAGES / '00_fluoro_calib_venv.pth').write_text('import fluoro_calib_venv\n')
    run(VENV_PYTHON, '-c', 'import rclpy')


def build_messages() -> None:
    """Build the messages with colcon and install them into .venv."""
    for package in MESSAGES:
        for pattern in (
            f'share/{package}',
            f'include/{package}',
            f'lib/lib{package}__*',
            f'lib/{package}',
            f'lib/python3*/site-packages/{package}*',
            f'share/ament_index/resource_index/*/{package}',
            f'share/colcon-core/packages/{package}',
        ):
            for name in glob.glob(
                str(VENV / pattern)
            ):  # a message that was removed must not stay installed
                if os.path.isdir(name):
                    shutil.rmtree(name)
                else:
                    os.remove(name)
    shutil.rmtree(BUILD / 'messages', ignore_errors=True)
    run(
        str(VENV / 'bin' / 'colcon'),
        '--log-base',
        str(BUILD / 'colcon_log'),
        'build',
        '--base-paths',
        *(str(folder) for folder in MESSAGES.values()),
        '--build-base',
        str(BUILD / 'messages'),
        '--install-base',
        str(VENV),
        '--merge-install',
        '--event-handlers',
        'console_direct+',
        '--cmake-args',
        f'-DPython3_EXECUTABLE={VENV_PYTHON}',
        '-DPython3_FIND_VIRTUALENV=ONLY',
        '-DBUILD_TESTING=OFF',
        '-DCMAKE_BUILD_TYPE=Release',
    )
    run(
        VENV_PYTHON,
        '-c',
        'import rclpy, fluoro_calib_msgs.msg as m, tf2_msgs.msg as t; '
        'm.TargetObservations.__class__.__import_type_support__(); '
        't.TFMessage.__class__.__import_type_support__()',
    )


def install_package() -> None:
    """Install this package into .venv such that its sources are used in place."""
    run(
        VENV_PYTHON,
        '-m',
        'pip',
        'install',
        '--no-deps',
        '--no-build-isolation',
        '--editable',
        str(ROOT),
    )
    # An editable install omits data_files, so link the files that ROS looks up in share/ and lib/,
    # each file separately, because `ros2 launch` does not follow links to folders.
    share = VENV / 'share' / PACKAGE
    index = VENV / 'share' / 'ament_index' / 'resource_index' / 'packages'
    files = [ROOT / 'package.xml', *(ROOT / 'launch').iterdir(), *(ROOT / 'config').iterdir()]
    links = {share / path.relative_to(ROOT): path for path in files}
    links[index / PACKAGE] = ROOT / 'resource' / PACKAGE
    for script in (VENV / 'bin').iterdir():
        if script.name.endswith('_node') or script.name.startswith('fluoro'):
            links[VENV / 'lib' / PACKAGE / script.name] = script
    for folder in (share, VENV / 'lib' / PACKAGE):
        shutil.rmtree(folder, ignore_errors=True)
    for link, target in links.items():
        link.parent.mkdir(parents=True, exist_ok=True)
        link.unlink(missing_ok=True)
        link.symlink_to(target)


def steps() -> list[Step]:
    """Return the steps in order, each with the inputs on which it depends."""
    venv = Step(
        'packages',
        f'packages from {LOCK.name} into .venv',
        make_venv,
        LOCK,
        str(ROOT),
        os.path.realpath(BASE_PYTHON),
        sys.version,
    )
    return [
        venv,
        Step('hook', 'start-up hook', install_hook, venv.wanted, HOOK),
        Step('messages', 'ROS messages', build_messages, venv.wanted, *MESSAGES.values()),
        Step(
            'package',
            'fluoro_calib_ros, editable',
            install_package,
            venv.wanted,
            *(
                ROOT / name
                for name in (
                    'setup.py',
                    'setup.cfg',
                    'package.xml',
                    'resource',
                    'launch',
                    'config',
                )
            ),
        ),
    ]


# -------------------------------------------------------------------------------------------------
# the program


@contextlib.contextmanager
def only_one() -> Iterator[None]:
    """Hold a lock file, so that two set-ups in one folder run one after the other."""
    with open(BUILD / 'setup.lock', 'w') as stream:
        try:
            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            print('setup: waiting for another set-up in this folder', flush=True)
            fcntl.flock(stream, fcntl.LOCK_EX)
        yield


def set_up() -> None:
    """Run the steps that have not been done yet."""
    plan = steps()
    if all(step.is_done() for step in plan):
        return
    LOG.write_text('')
    check_machine()
    for step in plan:
        if not step.is_done():
            step.do()


def main() -> int:
    """Run the set-up, and turn every failure into an actionable message."""
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    BUILD.mkdir(exist_ok=True)
    (BUILD / 'COLCON_IGNORE').touch()
    try:
        with only_one():
            set_up()
    except KeyboardInterrupt:
        print(
            'setup: interrupted; make setup goes on from the last finished step', file=sys.stderr
        )
        return 130
    except (SetupError, OSError) as error:
        tail = LOG.read_text(errors='replace').splitlines()[-25:] if LOG.exists() else []
        for line in tail:
            print(f'  | {line}', file=sys.stderr)
        for line in str(error).splitlines():
            print(f'setup: {line}', file=sys.stderr)
        if tail:
            print(
                f'setup: the lines above are the last of {LOG.relative_to(ROOT)}', file=sys.stderr
            )
        return 1
    return 0


if __name__ == '__main__':
    sys.exit(main())
