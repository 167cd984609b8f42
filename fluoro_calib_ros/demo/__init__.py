"""The demonstration: the whole graph on recorded bags."""
