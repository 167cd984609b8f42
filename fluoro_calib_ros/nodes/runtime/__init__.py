"""What all nodes share: parameters, lifecycle, streams, diagnostics, logging and the main loop."""
