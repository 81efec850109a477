"""From the presentation times of an RTSP stream to the camera's wall clock.

A camera sends now and then a sender report (RFC 3550, 6.4.1): the same instant on its wall clock and on the clock of
its packets. FFmpeg turns each packet's time into wall time by the latest report and hands it over beside the packet
(`prft`). Three things are seen in real streams, and dealt with here:

- No packet before the first report has a wall time. Those frames are withheld: to date them back, the decoder or the
  packets would have to wait and then burst, which drops live frames instead. If no report comes, the packets' arrival
  is all there is, and it stays so for the connection, that one recording has one clock.
- The first wall time belongs to the following packet (the parser is one packet behind): the relation of the two clocks
  counts only when two packets in a row agree on it.
- The camera's wall clock is set: the relation jumps. Small changes are followed at once, larger ones when three packets
  agree, and counted.
"""

from __future__ import annotations

from dataclasses import dataclass

from nodes.frames import StampOrigin

# Between two packets of one sender report the relation is constant but for rounding: a microsecond and a tick of
# 1/90000 s. Neighbouring frames are at least 4 ms apart (240 Hz).
_AGREE_NS = 1_000_000
# A report is sampled by a busy processor, and a wall clock is slewed: that much from one report to the next is no step.
_STEP_NS = 50_000_000
_N_AGREEING_FIRST, _N_AGREEING_STEP = 2, 3
# Further from this machine's clock, the camera's has never been set: it counts from 1970 or from its making.
_MAX_AWAY_NS = 86_400 * 10**9


@dataclass(frozen=True, slots=True)
class Stamp:
    """An instant of capture, ns since the epoch, and the clock that gave it."""

    stamp_ns: int
    origin: StampOrigin


class StreamClock:
    """Stamps of one connection.

    Args:
        wait_s: for so long after the first packet, frames without a wall time are withheld.
    """

    def __init__(self, *, wait_s: float) -> None:
        self._wait_ns = round(wait_s * 1e9)
        self._first_arrival_ns: int | None = None
        self._is_arrival = False
        self._wall_from_stream_ns: int | None = None
        self._candidate_ns = 0
        self._n_agreeing = 0
        self.n_steps = 0

    def stamp(self, stream_ns: int | None, wall_ns: int | None, arrival_ns: int) -> Stamp | None:
        """The stamp of a packet; None where it has none (yet).

        Args:
            stream_ns: presentation time.
            wall_ns: the camera's wall clock, ns since the epoch, if it came with the packet.
            arrival_ns: this machine's wall clock when the packet came.
        """
        if self._first_arrival_ns is None:
            self._first_arrival_ns = arrival_ns
        is_set = wall_ns is not None and abs(wall_ns - arrival_ns) <= _MAX_AWAY_NS
        if not self._is_arrival and stream_ns is not None and wall_ns is not None and is_set:
            self._learn(wall_ns - stream_ns)
        if self._wall_from_stream_ns is None and arrival_ns - self._first_arrival_ns >= self._wait_ns:
            self._is_arrival = True
        if self._is_arrival:
            return Stamp(arrival_ns, StampOrigin.ARRIVAL)
        if self._wall_from_stream_ns is None or stream_ns is None:
            return None
        return Stamp(self._wall_from_stream_ns + stream_ns, StampOrigin.CAMERA)

    def _learn(self, wall_from_stream_ns: int) -> None:
        known_ns = self._wall_from_stream_ns
        if known_ns is not None and abs(wall_from_stream_ns - known_ns) <= _STEP_NS:
            self._wall_from_stream_ns, self._n_agreeing = wall_from_stream_ns, 0
            return
        agrees = self._n_agreeing > 0 and abs(wall_from_stream_ns - self._candidate_ns) <= _AGREE_NS
        self._n_agreeing = self._n_agreeing + 1 if agrees else 1
        self._candidate_ns = wall_from_stream_ns
        if self._n_agreeing == (_N_AGREEING_FIRST if known_ns is None else _N_AGREEING_STEP):
            self.n_steps += known_ns is not None
            self._wall_from_stream_ns, self._n_agreeing = wall_from_stream_ns, 0
