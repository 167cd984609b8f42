"""Self-calibration: the alternation of adjustment and regression, and its result."""
