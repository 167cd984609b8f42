"""Self-calibration: collecting exposures, the loop of adjustment and regression, and its result."""
