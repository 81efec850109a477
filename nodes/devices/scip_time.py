"""The scanner's clock by its TM commands, and its stamps without wraps.

A TM1 is answered by the sensor's clock, which it read between asking and hearing. The URG-04LX answers on the tick of
its scans, a tenth of a second apart, so that the two are far from each other. But whether a command came before a tick
is told by the stamp of its answer: each one is therefore sent so that it halves what is still unknown, and a few bring
it to the millisecond of the stamps, however late the answers are heard.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

from nodes.devices.clock_fit import Bounds
from nodes.devices.errors import DeviceError, LineLostError
from nodes.devices.scip_frames import STAMP_MODULUS_MS, decode_stamp
from nodes.devices.scip_line import ScipLine
from nodes.devices.scip_status import STATUS_OK, status_words

MAX_EXCHANGES, N_PLAIN = 12, 2
STAMP_S = 1e-3
# Answers to TM1 come at every one of these on newer models.
SHORT_TICK_S = 5e-3
# Stamps of ticks are whole ticks apart, but for their cut to 1 ms and for a clock that is off by as much as any is.
TICK_GAIN = 3e-3
# A command reaches the sensor within one frame of USB after the line has taken it.
TRANSIT_S = 1e-3
LEAD_S = 3e-3


@dataclass(frozen=True, slots=True)
class TimeExchange:
    """One TM1.

    Attributes:
        device_s: the sensor's clock, wraps undone, cut to 1 ms.
        before_s: this machine's clock before it was asked for.
        after_s: when the line had taken the command.
        heard_s: when the answer had come.
    """

    device_s: float
    before_s: float
    after_s: float
    heard_s: float


class SensorTime:
    """The sensor's clock without wraps, from stamps in ms modulo 2**24."""

    def __init__(self) -> None:
        self._last_ms: int | None = None
        self._device_ms = 0

    def seconds(self, stamp_ms: int) -> float:
        """Device time of a stamp less than two hours from the last."""
        if self._last_ms is None:
            self._device_ms = stamp_ms
        else:
            step_ms = (stamp_ms - self._last_ms) % STAMP_MODULUS_MS
            self._device_ms += step_ms - (STAMP_MODULUS_MS if step_ms > STAMP_MODULUS_MS // 2 else 0)
        self._last_ms = stamp_ms
        return self._device_ms / 1e3


def exchange_times(
    line: ScipLine, sensor_time: SensorTime, *, clock: Callable[[], float], turn_s: float
) -> list[TimeExchange]:
    """Some TM1 exchanges; the laser is off and nothing streams afterwards. None where the scanner refuses.

    Raises:
        LineLostError: the scanner is gone.
    """
    exchanges: list[TimeExchange] = []
    try:
        if line.command("TM0").status not in (STATUS_OK, "02"):
            return []
        while len(exchanges) < MAX_EXCHANGES:
            tick_s = tick_of(exchanges, turn_s)
            if tick_s is not None:
                low_s, high_s = _offset_range(exchanges, tick_s, transit_s=0.0)
                if high_s - low_s < STAMP_S:
                    break
                line.wait_until(_next_send_s(exchanges[-1], (low_s + high_s) / 2, tick_s, clock()))
            exchanges.append(_exchange(line, sensor_time))
        return exchanges
    except LineLostError:
        raise
    except DeviceError:  # what was learnt until then is still true
        return exchanges
    finally:
        _leave(line)


def time_bounds(exchanges: Sequence[TimeExchange], turn_s: float) -> list[Bounds]:
    """What each exchange tells."""
    tick_s = tick_of(exchanges, turn_s)
    low_s, high_s = _offset_range(exchanges, tick_s, transit_s=TRANSIT_S)
    if high_s < low_s - STAMP_S:  # it does not answer on the first tick after all
        tick_s = None
    return [Bounds(one.device_s, one.before_s, _latest_s(one, tick_s, TRANSIT_S), one.heard_s) for one in exchanges]


def tick_of(exchanges: Sequence[TimeExchange], turn_s: float) -> float | None:
    """The time between the ticks on which all answers were given; None where there seem to be none."""
    if len(exchanges) < N_PLAIN:
        return None
    steps_s = [after.device_s - before.device_s for before, after in pairwise(exchanges)]
    for tick_s in (turn_s, SHORT_TICK_S):
        if all(abs(step_s - tick_s * round(step_s / tick_s)) <= STAMP_S + TICK_GAIN * step_s for step_s in steps_s):
            return tick_s
    return None


def _latest_s(one: TimeExchange, tick_s: float | None, transit_s: float) -> float:
    # The tick before this one was gone when the command arrived, or that one had been answered on.
    return math.inf if tick_s is None else one.after_s + transit_s + tick_s


def _offset_range(exchanges: Sequence[TimeExchange], tick_s: float | None, *, transit_s: float) -> tuple[float, float]:
    """Between which values host - device is, for stamps as they are told, drift apart."""
    low = max(one.before_s - one.device_s for one in exchanges)
    return low, min(min(one.heard_s, _latest_s(one, tick_s, transit_s)) - one.device_s for one in exchanges)


def _next_send_s(last: TimeExchange, offset_s: float, tick_s: float, now_s: float) -> float:
    """When to send so that the command just makes a tick if host - device is at least `offset_s`."""
    on_tick_s = last.device_s + offset_s
    return on_tick_s + tick_s * math.ceil((now_s + LEAD_S - on_tick_s) / tick_s)


def _exchange(line: ScipLine, sensor_time: SensorTime) -> TimeExchange:
    answer = line.ask("TM1")
    if answer.reply.status != STATUS_OK or not answer.reply.lines:
        raise DeviceError(
            f"{line.name}: the scanner does not tell its time, {status_words('TM1', answer.reply.status)}"
        )
    device_s = sensor_time.seconds(decode_stamp(answer.reply.lines[0]))
    return TimeExchange(device_s, answer.before_s, answer.after_s, answer.heard_s)


def _leave(line: ScipLine) -> None:
    try:
        line.command("TM2")
    except LineLostError:
        raise
    except DeviceError:
        pass  # the next command finds out whether it still listens
