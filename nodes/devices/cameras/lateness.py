"""Which frames came late: more than two periods after their predecessor."""

from __future__ import annotations

# The learned period follows changes of the rate (cameras halve it in the dark) within about this many frames.
_N_MEMORY = 16


class Lateness:
    """Judges the arrivals of one connection.

    Args:
        rate_hz: nominal rate; None to learn the period from the arrivals.
    """

    def __init__(self, rate_hz: float | None) -> None:
        self._is_nominal = rate_hz is not None
        self._period_s = 1.0 / rate_hz if rate_hz is not None else None
        self._last_s: float | None = None

    def is_late(self, arrival_s: float) -> bool:
        """Whether the frame that came now is late; the first never is."""
        last_s, self._last_s = self._last_s, arrival_s
        if last_s is None:
            return False
        interval_s, period_s = arrival_s - last_s, self._period_s
        if period_s is None:
            self._period_s = interval_s
            return False
        is_late = interval_s > 2 * period_s
        if not self._is_nominal:
            # A late frame tells little of the period: it counts as the two periods that it surely took.
            self._period_s = period_s + (min(interval_s, 2 * period_s) - period_s) / _N_MEMORY
        return is_late
