"""Counting what a source delivers and loses."""

from __future__ import annotations

from dataclasses import dataclass, field

from nodes.frames import SourceCounts


@dataclass(slots=True)
class FrameTally:
    """Running counts of one pass through a source.

    Attributes:
        rate_hz: nominal rate, from which lateness is judged; None: nothing is late.
    """

    rate_hz: float | None
    _delivered: int = field(default=0, init=False)
    _dropped: int = field(default=0, init=False)
    _late: int = field(default=0, init=False)
    _last_stamp_ns: int | None = field(default=None, init=False)

    def deliver(self, stamp_ns: int) -> None:
        """One more frame is handed out."""
        if self.rate_hz and self._last_stamp_ns is not None:
            self._late += (stamp_ns - self._last_stamp_ns) * self.rate_hz > 2e9
        self._last_stamp_ns = stamp_ns
        self._delivered += 1

    def drop(self, n_frames: int = 1) -> None:
        """So many frames are known to be lost."""
        self._dropped += n_frames

    @property
    def counts(self) -> SourceCounts:
        return SourceCounts(delivered=self._delivered, dropped=self._dropped, late=self._late)
