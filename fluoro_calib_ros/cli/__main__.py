"""`python -m fluoro_calib_ros.cli`."""

from . import main

main()
