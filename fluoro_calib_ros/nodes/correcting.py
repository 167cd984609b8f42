"""What the nodes that correct streams have in common: calibrations, counts, refusals and the
verdict by fluoroscope.
"""

import time
from collections import Counter

from . import support
from .calibrations import Calibrations
from .checks import Refused


class Stream:
    """What a node holds of one fluoroscope."""

    def __init__(self):
        self.received = self.corrected = self.waiting = 0
        # by kind
        self.refused = Counter()
        self.last_fault = ''
        self.latencies = (
            support.Latencies()
        )  # from the arrival of a message to the publication of its correction

    def published(self, info):
        """Count a message that has been corrected and published; info: its times, see
        StreamReader.
        """
        self.corrected += 1
        self.latencies.add(time.time_ns() - info['received_timestamp'])


class CorrectingNode(support.StreamNode):
    """Node that corrects what comes from fluoroscopes, by the calibrations that come; nothing
    before there is one.

    item: what is corrected, frame or image; subject: what is listened for; topics: on which, below
    each fluoroscope; kinds: of what is refused. new_stream(name) makes a Stream;
    prepared(calibration), in a thread, what is kept of a calibration; taken(name, kept) is told;
    more(name, stream, kept) are further values of the diagnostics.
    """

    item = ''
    subject = ''
    topics = ()
    kinds = ()

    def __init__(self, name):
        super().__init__(name)
        self.names = support.fluoroscopes_of(self)
        self.calibrations = None
        self.forget()

    def forget(self):
        """Begin to count."""
        self.streams = {name: self.new_stream(name) for name in self.names}

    def take_calibrations(self):
        """Take calibrations from now on: outputs that they need must be there."""
        self.calibrations = Calibrations(
            self, self.names, self.prepared, self.taken, self._on_refused_calibration
        )
        self.kept(self.calibrations, self.calibrations.close)

    def _on_refused_calibration(self, name, sentence):
        self.streams[name].last_fault = sentence

    def undecodable(self, topic):
        """Count a message that cannot be decoded, on the topic of a fluoroscope, and tell of it."""
        name = topic.partition('/')[0]
        self.streams[name].received += 1
        self.refuse(
            self.streams[name],
            Refused('undecodable', f'fluoroscope {name}: a message on {topic} cannot be decoded'),
        )

    def refuse(self, stream, error):
        """Count a message that is Refused, and tell why."""
        stream.refused[error.kind] += 1
        stream.last_fault = str(error)
        self.sentences.warn(f'{self.item} refused: {error}')

    def report(self):
        """Diagnostics of every fluoroscope."""
        deaf = {}
        parts = []
        for reader in self.readers:
            deaf.update(support.deafness(reader, self.sentences))
        for name, stream in self.streams.items():
            kept = self.calibrations.of(name)
            items = f'{self.item}s'
            values = {
                f'{items} received': stream.received,
                f'{items} corrected': stream.corrected,
                f'{items} without calibration': stream.waiting,
                f'{items} refused': stream.refused.total(),
                **{f'refused: {kind}': stream.refused[kind] for kind in self.kinds},
                'last fault': stream.last_fault,
                **self.more(name, stream, kept),
                **stream.latencies.values(),
            }
            parts.append((name, *self._verdict(name, stream, deaf), values))
        return parts

    def _verdict(self, name, stream, deaf):
        """Level and message of the diagnostics of a fluoroscope."""
        topics = [f'{name}/{topic}' for topic in self.topics]
        unheard = next((deaf[topic] for topic in topics if topic in deaf), None)
        if unheard:
            return support.WARN, unheard
        if self.calibrations.of(name) is None:
            return (
                support.WARN,
                f'no calibration yet: {stream.waiting} {self.item}s were not corrected',
            )
        if not self.readers:
            return support.WARN, 'the node is not active'
        if not any(map(self.count_publishers, topics)):
            return support.WARN, f'nobody publishes {self.subject}'
        if stream.refused:
            return (
                support.WARN,
                f'{stream.refused.total()} {self.item}s refused: {stream.last_fault}',
            )
        return support.OK, 'correcting'
