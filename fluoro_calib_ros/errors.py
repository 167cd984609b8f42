"""The exception that faults in the data raise."""


class DataError(ValueError):
    """A fault in the data: one sentence that names the place and the cause."""
