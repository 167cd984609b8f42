# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Time of a stream in blocks of equal length, also where the stream begins anew."""

from __future__ import annotations

RESTART_S = 1.0  # a stamp that much before the newest one starts a new stream; it is no late frame
# Exposures in a row before the newest one that start a new stream: of a bag shorter than RESTART_S
# that is played in a loop. Late frames are fewer.
MAX_LATE = 100


class BlockClock:
    """Clock of a stream.

    Parameters
    ----------
    block_s : float
        Length of a block [s].

    Attributes
    ----------
    newest_ns : int
        Newest time [ns].
    """

    def __init__(self, block_s: float) -> None:
        self.newest_ns = 0
        self._length_ns = round(block_s * 1e9)
        self._begin_ns: int | None = None  # of the present block
        self._late = 0  # calls with a stamp before the newest one, since that came
        self._offset_ns = 0  # added to stamps, so that time goes on where a stream begins anew

    def continued_ns(self, stamp_ns: int) -> int:
        """Time of a stamp, as if the stream had not begun anew [ns]."""
        return stamp_ns + self._offset_ns

    def advance(self, stamp_ns: int) -> int | None:
        """Begin of the block that this stamp ends [ns], if any.

        A late frame belongs to the present block.
        """
        now = self.continued_ns(int(stamp_ns))
        if self._begin_ns is None:
            self._begin_ns = now
            self.newest_ns = now
        if now < self.newest_ns:
            self._late += 1
        elif now > self.newest_ns:
            self._late = 0
        if now < self.newest_ns - RESTART_S * 1e9 or self._late > MAX_LATE:
            self._late = 0
            self._offset_ns += self.newest_ns - now
            now = self.newest_ns
        self.newest_ns = max(self.newest_ns, now)
        ended = self._begin_ns
        if now < ended + self._length_ns:
            return None
        self._begin_ns += (now - ended) // self._length_ns * self._length_ns
        return ended
