# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Sources of the data, their licences, and the download.

The data are not part of this project. A file is stored below the data folder as
OWNER/REPOSITORY/PATH.
"""

from __future__ import annotations

import sys
import urllib.request
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from textwrap import fill

RAW = 'https://raw.githubusercontent.com'
TIMEOUT = 60.0  # s
WIDTH = 120  # line width of the list

PM = 'data/riva2014/pmexports'
ZHANG = (
    'imagingbook-calibrate-lib/src/main/resources/imagingbook/calibration/zhang/data/'
    'TextDataResource-data'
)
CUBE_TRAIN = tuple(f'{k:04d}' for k in (0, 3, 6, 7, 9, 26, 28, 31, 33, 35, 39, 41, 43, 46, 51))
CUBE_TEST = tuple(f'{k:04d}' for k in (2, 10, 34, 37, 42, 47, 49))
# Hour, minute and second of the exposures.
PLANE_TRAIN = (
    *('13-08-27', '13-09-36', '14-00-30', '14-01-07', '14-01-37', '14-05-28', '14-05-42'),
    *('14-06-12', '14-06-53', '14-07-11', '14-10-53', '14-11-48', '14-11-57', '14-12-15'),
    *('14-13-39', '14-13-55', '14-14-11', '14-14-21'),
)
PLANE_TEST = (
    *('13-08-53', '14-01-22', '14-05-46', '14-06-44', '14-11-34', '14-14-02', '14-14-36'),
)
OPENCV_NUMBERS = (1, 2, 3, 4, 5, 6, 7, 8, 9, 11, 12, 13, 14)


@dataclass(frozen=True)
class Source:
    """A public repository with data.

    Attributes
    ----------
    repository : str
        OWNER/NAME at GitHub.
    commit : str
        Commit or tag.
    licence : str
        Licence that the repository states.
    about : str
        Description of the data, and their authors.
    paths : tuple of str
    """

    repository: str
    commit: str
    licence: str
    about: str
    paths: tuple[str, ...]

    def addresses(self) -> dict[str, str]:
        """Address of every file, by its path below the data folder."""
        return {
            f'{self.repository}/{path}': f'{RAW}/{self.repository}/{self.commit}/{path}'
            for path in self.paths
        }


SOURCES = (
    Source(
        'niclasborlin/dbat',
        'b8d1b156987e20f91fabee6b85565740893c2d55',
        'BSD-like, citation requested (LICENSE.txt): Boerlin and Grussenmeyer 2013 to 2020',
        'Networks of the Damped Bundle Adjustment Toolbox, measured with PhotoModeler: flat '
        'calibration sheets and test fields of five digital cameras',
        (
            f'{PM}/net1-C404Z-2d.txt',
            f'{PM}/net2-canon40d-2d.txt',
            f'{PM}/net3-canon7d-2d.txt',
            f'{PM}/net4-canon7d-3d.txt',
            f'{PM}/net5-canon5d-3d.txt',
            'data/hamburg2017/stpierre/pmexports/camcal_exom-pmexport.txt',
        ),
    ),
    Source(
        'ylochman/babelcalib',
        '5f7f220a2228c886fe2a3927e0559b455a5f6c87',
        'MIT',
        'Corners of a wide-angle camera (OmniVision) on three boards in space and on one board; '
        'Lochman et al., BabelCalib, ICCV 2021',
        (
            'data/ov_cube/ov_cube.dsc',
            'data/ov_cube/ov_cube.tp',
            *(f'data/ov_cube/corners/train/{name}.orpc' for name in CUBE_TRAIN),
            *(f'data/ov_cube/corners/test/{name}.orpc' for name in CUBE_TEST),
            'data/ov_plane/ov_plane.dsc',
            *(
                f'data/ov_plane/corners/train/br0_cam01-2020-05-07-{name}.orpc'
                for name in PLANE_TRAIN
            ),
            *(
                f'data/ov_plane/corners/test/br0_cam01-2020-05-07-{name}.orpc'
                for name in PLANE_TEST
            ),
        ),
    ),
    Source(
        'opencv/opencv',
        '4.10.0',
        'Apache 2.0',
        'Images of a chessboard by a stereo pair of webcams, samples/data; corners by '
        'cv2.findChessboardCorners and cv2.cornerSubPix',
        tuple(
            f'samples/data/{side}{number:02d}.jpg'
            for side in ('left', 'right')
            for number in OPENCV_NUMBERS
        ),
    ),
    Source(
        'imagingbook/imagingbook-calibrate',
        'efc61433bd3d5b20cd7054f94e0cfa0aecf0b6c6',
        'BSD 2-Clause',
        'The five views of 64 squares with which Zhang published his method (2000)',
        (f'{ZHANG}/Model.txt', *(f'{ZHANG}/data{k}.txt' for k in range(1, 6))),
    ),
    Source(
        'applied-geodesy/bundle-adjustment',
        'a267093b7fb915afa64510b8ee55a2dc22c519a7',
        'GPL 3.0',
        'Coded targets around a radio telescope, measured with AICON; Loesler et al. 2022',
        tuple(f'JAICOV/example/example.{kind}' for kind in ('ior', 'obc', 'phc')),
    ),
)


def download(folder: Path, sources: Sequence[Source] = SOURCES) -> None:
    """Fetch missing files into a folder."""
    for source in sources:
        for name, address in source.addresses().items():
            target = folder / name
            if target.exists():
                continue
            print(address, file=sys.stderr)
            with urllib.request.urlopen(address, timeout=TIMEOUT) as answer:  # an https address
                content = answer.read()
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_bytes(content)


def text_of_sources(sources: Sequence[Source] = SOURCES) -> str:
    """Return the sources as Markdown."""
    lines = (
        f'- [{one.repository}](https://github.com/{one.repository}) ({one.licence}; '
        f'`{one.commit[:7]}`): {one.about}.'
        for one in sources
    )
    return '\n'.join(
        fill(line, WIDTH, subsequent_indent='  ', break_long_words=False, break_on_hyphens=False)
        for line in lines
    )
