"""Package fluoro_calib_ros: for colcon, and for pip without ROS."""

import os
from glob import glob

from setuptools import find_packages, setup

package_name = 'fluoro_calib_ros'


def files_below(folder):
    """Return the data files of a folder, each with the folder in share/ into which it goes."""
    return [
        (os.path.join('share', package_name, path), [os.path.join(path, name) for name in names])
        for path, _, names in os.walk(folder)
        if names
    ]


setup(
    name=package_name,
    version='0.1.0',
    packages=find_packages(include=[package_name, package_name + '.*']),
    package_data={
        package_name + '.io.bags': ['msg/*.msg'],
        package_name + '.nodes.dashboard': ['page/*'],
        package_name + '.report': ['templates/*'],
    },
    data_files=[
        ('share/ament_index/resource_index/packages', ['resource/' + package_name]),
        ('share/' + package_name, ['package.xml']),
        ('share/' + package_name + '/launch', sorted(glob('launch/*.launch.py'))),
        ('share/' + package_name + '/config', sorted(glob('config/*'))),
        *files_below('bags'),
    ],
    python_requires='>=3.10',
    install_requires=[
        'setuptools',
        'numpy>=1.26',
        'scipy>=1.11',
        'scikit-learn>=1.4',
        'matplotlib',
        'mcap',
        'zstandard',
        'lz4',
        'rosbags',
        'threadpoolctl',
        'tifffile',
        'PyYAML',
        'opencv-python-headless>=4.6',
        'tqdm',
        'jinja2',
        'tomli; python_version < "3.11"',
    ],
    extras_require={
        'c3d': ['ezc3d'],
        'cluster': ['distributed'],
        'dicom': ['pydicom>=3'],
        'completion': ['shtab'],
        'hdf5': ['h5py'],
        'foxglove': ['foxglove-sdk'],
        'pandas': ['pandas'],
        'watch': ['textual', 'tornado'],
        'test': ['hypothesis', 'pytest', 'pytest-timeout', 'pytest-xdist'],
    },
    zip_safe=False,
    url='https://arxiv.org/abs/1810.00138',
    author='fluoro_calib_ros maintainers',
    author_email='maintainers@fluoro-calib.example',
    maintainer='fluoro_calib_ros maintainers',
    maintainer_email='maintainers@fluoro-calib.example',
    description='Self-calibration of dual fluoroscopes for ROS 2: robust bundle adjustment and '
    'nonparametric distortion correction.',
    license='Apache-2.0',
    entry_points={
        'console_scripts': [
            'calibration_node = fluoro_calib_ros.entry_points:calibration_node',
            'extraction_node = fluoro_calib_ros.entry_points:extraction_node',
            'correction_node = fluoro_calib_ros.entry_points:correction_node',
            'reconstruction_node = fluoro_calib_ros.entry_points:reconstruction_node',
            'image_node = fluoro_calib_ros.entry_points:image_node',
            'player_node = fluoro_calib_ros.entry_points:player_node',
            'recorder_node = fluoro_calib_ros.entry_points:recorder_node',
            'bridge_node = fluoro_calib_ros.entry_points:bridge_node',
            'simulator_node = fluoro_calib_ros.entry_points:simulator_node',
            'fluoro_calib_demo = fluoro_calib_ros.entry_points:demo',
            'fluoro-calib = fluoro_calib_ros.cli:main',
        ],
    },
)
