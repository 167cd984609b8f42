"""The exception for faults in the data."""


class DataError(ValueError):
    """A fault in the data; the message is one sentence that names place and cause."""
