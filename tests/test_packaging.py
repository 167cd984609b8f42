# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The two packages, their metadata and their set-up files agree with each other."""

import configparser
import fnmatch
import importlib.metadata
import importlib.util
import os
import pathlib
import re
import signal
import subprocess
import sys
import xml.etree.ElementTree as ElementTree

import pytest

ROOT = pathlib.Path(__file__).resolve().parent.parent
MSG_DEFS = ROOT / 'msg_defs'
INTERFACES = sorted(
    path for kind in ('msg', 'srv', 'action') for path in MSG_DEFS.glob(f'{kind}/*.{kind}')
)


def package_xml(folder):
    """Return the fields of a package.xml that both packages share, and its dependencies."""
    root = ElementTree.parse(folder / 'package.xml').getroot()
    fields = {tag: root.findtext(tag) for tag in ('name', 'version', 'license', 'maintainer')}
    fields['email'] = root.find('maintainer').get('email')
    return fields, {element.text for element in root.iter() if element.tag.endswith('depend')}


def test_metadata_agrees():
    """Name, version, licence and maintainer are the same wherever they are written."""
    ours, depends = package_xml(ROOT)
    messages, _ = package_xml(MSG_DEFS)
    assert ours['name'] == 'fluoro_calib_ros' and messages['name'] == 'fluoro_calib_msgs'
    assert messages['name'] in depends
    assert {**messages, 'name': ours['name']} == ours

    setup = (ROOT / 'setup.py').read_text()
    written = dict(re.findall(r"^    (\w+)='([^']*)'", setup, re.MULTILINE))
    assert written['version'] == ours['version']
    assert written['license'] == ours['license']
    assert (written['maintainer'], written['maintainer_email']) == (
        ours['maintainer'],
        ours['email'],
    )
    assert (ROOT / 'resource' / ours['name']).is_file()
    assert (ROOT / 'LICENSE').read_bytes() == (MSG_DEFS / 'LICENSE').read_bytes()
    assert f'project({messages["name"]})' in (MSG_DEFS / 'CMakeLists.txt').read_text()


def test_scripts_are_installed_where_ros2_run_looks():
    """A colcon install puts the scripts into lib/<package>."""
    config = configparser.ConfigParser()
    config.read(ROOT / 'setup.cfg')
    assert (
        config['develop']['script_dir']
        == config['install']['install_scripts']
        == '$base/lib/fluoro_calib_ros'
    )


@pytest.mark.parametrize(
    'entry',
    importlib.metadata.distribution('fluoro_calib_ros').entry_points,
    ids=lambda entry: entry.name,
)
def test_console_scripts_exist(entry):
    """Every console script names a module that exists and defines what it calls."""
    spec = importlib.util.find_spec(entry.module)
    assert spec is not None, f'{entry.name}: there is no module {entry.module}'
    defined = rf'^(def {entry.attr}\(|{entry.attr} = )'
    assert re.search(defined, pathlib.Path(spec.origin).read_text(), re.MULTILINE)


def test_every_interface_is_built():
    """CMakeLists.txt lists exactly the interface files that exist."""
    listed = re.findall(
        r'"((?:msg|srv|action)/\w+\.\w+)"', (MSG_DEFS / 'CMakeLists.txt').read_text()
    )
    assert sorted(listed) == sorted(str(path.relative_to(MSG_DEFS)) for path in INTERFACES)


@pytest.mark.parametrize('path', INTERFACES, ids=lambda path: path.name)
def test_every_message_field_is_documented(path):
    """Every field and constant has a comment, and every numeric one states a unit."""
    for number, line in enumerate(path.read_text().splitlines(), 1):
        field, _, comment = line.partition('#')
        if field.strip() in ('', '---'):
            continue
        where = f'{path.name}:{number}: {line}'
        assert comment.strip(), where
        kind = field.split()[0].rstrip('[]0123456789')
        if (
            re.fullmatch(r'float\d+|u?int\d+', kind)
            and '=' not in field
            and 'target_id' not in field
        ):
            assert re.search(r'\[[^\]]+\]', comment) or 'the same' in comment, where


def test_messages_without_ros():
    """The bag writer reads the message definitions from the package, so it needs no ROS."""
    folder = ROOT / 'fluoro_calib_ros' / 'io' / 'bags' / 'msg'
    assert sorted(path.name for path in folder.glob('*.msg')) == sorted(
        path.name for path in INTERFACES if path.suffix == '.msg'
    )


def test_lock_is_exact():
    """The lock file pins every package to one version and its files to hashes, and contains all of
    requirements.in.
    """
    text = (ROOT / 'requirements.lock').read_text()
    pins = re.findall(r'^[^\s#].*(?:\n    .*)*', text, re.MULTILINE)
    pin = r'[\w.-]+==[\w.]+( ; [^\\]*)?( \\\n    --hash=sha256:[0-9a-f]{64})+'
    assert [line for line in pins if not re.fullmatch(pin, line)] == []
    wanted = [
        re.split(r'[\[<=>;]', line)[0].strip()
        for line in (ROOT / 'requirements.in').read_text().splitlines()
        if line.strip() and not line.startswith('#')
    ]
    locked = {pin.split('==')[0] for pin in pins}
    assert not {name.lower().replace('_', '-') for name in wanted} - locked


def project_files():
    """Return the paths of the project's files: those that git lists or, in an unpacked archive,
    all files that .gitignore does not name.
    """
    listing = subprocess.run(
        ['git', 'ls-files', '--cached', '--others', '--exclude-standard', '-z'],
        cwd=ROOT,
        capture_output=True,
        check=False,
    )
    if not listing.returncode:
        return [ROOT / name.decode() for name in filter(None, listing.stdout.split(b'\0'))]
    made = {line.strip().strip('/') for line in (ROOT / '.gitignore').read_text().splitlines()}
    return [
        path
        for path in ROOT.rglob('*')
        if not any(
            fnmatch.fnmatch(part, pattern)
            for part in path.relative_to(ROOT).parts
            for pattern in made
        )
    ]


def test_no_machine_paths():
    """No file of the project names a folder of the machine on which it was written."""
    files = project_files()
    assert ROOT / 'README.md' in files
    foreign = re.compile(rb'(?<![\w.])/(?:home|root|Users|work)/[\w.]')
    for path in files:
        if path.is_file() and not path.is_symlink():
            content = path.read_bytes()
            if b'\0' in content[:8192]:
                continue
            found = foreign.search(content)
            assert not found, f'{path}: {content[found.start() : found.start() + 60]!r}'


@pytest.mark.parametrize(
    'node, blocked, said',
    [
        ('image_node', 'rclpy', 'source /opt/ros/<distribution>/setup.bash'),
        (
            'calibration_node',
            'fluoro_calib_msgs',
            'ln -s fluoro_calib_ros/msg_defs src/fluoro_calib_msgs',
        ),
        ('player_node', 'mcap', 'pip install mcap'),
    ],
)
def test_node_without_a_module_says_what_to_install(node, blocked, said):
    """A missing module gives one sentence and exit status 1, but no traceback."""
    code = (
        f'import sys; sys.modules[{blocked!r}] = None; '
        f'from fluoro_calib_ros.entry_points import {node}; {node}()'
    )
    done = subprocess.run(
        [sys.executable, '-c', code], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.returncode == 1
    (line,) = done.stderr.strip().splitlines()
    assert line.startswith(f'{node}: the Python module {blocked} is missing: ')
    assert said in line


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM])
def test_node_that_is_interrupted_during_its_import_ends_with_status_0(tmp_path, number):
    """The import of rclpy comes first; here a substitute module waits during it."""
    (tmp_path / 'rclpy.py').write_text('import time\nprint(flush=True)\ntime.sleep(60)\n')
    code = 'from fluoro_calib_ros.entry_points import correction_node; correction_node()'
    with subprocess.Popen(
        [sys.executable, '-c', code],
        cwd=ROOT,
        env={**os.environ, 'PYTHONPATH': str(tmp_path)},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    ) as process:
        assert process.stdout.read(1)
        process.send_signal(number)
        assert process.wait(10) == 0
        assert not process.stderr.read()
