"""How good this machine's clock is, as the kernel tells: whoever disciplines it (chrony, ntpd, timesyncd) tells it."""

from __future__ import annotations

import ctypes
import sys
from collections.abc import Callable
from dataclasses import dataclass

from nodes.bus import spotcal_pb2 as pb

_TIME_ERROR = 5
_STA_UNSYNC = 0x0040


class Timex(ctypes.Structure):
    """`struct timex` of adjtimex(2) on 64-bit Linux; microseconds."""

    _fields_ = (
        ("modes", ctypes.c_uint),
        ("offset", ctypes.c_long),
        ("freq", ctypes.c_long),
        ("maxerror", ctypes.c_long),
        ("esterror", ctypes.c_long),
        ("status", ctypes.c_int),
        ("constant", ctypes.c_long),
        ("precision", ctypes.c_long),
        ("tolerance", ctypes.c_long),
        ("time_sec", ctypes.c_long),
        ("time_usec", ctypes.c_long),
        ("tick", ctypes.c_long),
        # Pulse-per-second figures and room for more; more than any kernel writes.
        ("rest", ctypes.c_byte * 256),
    )


@dataclass(frozen=True, slots=True)
class KernelClock:
    """What adjtimex says.

    Attributes:
        state: its return value; negative where the call failed.
        status: bits.
        estimated_us: error of the clock as estimated; some daemons leave it 0.
        largest_us: bound of the error.
    """

    state: int
    status: int
    estimated_us: int
    largest_us: int


def clock_quality(read: Callable[[], KernelClock | None] | None = None) -> pb.ClockQuality:
    """Of this machine's clock.

    A kernel does not tell NTP from PTP: a disciplined clock is called NTP. Where no error is estimated its bound
    stands for it.
    """
    kernel = (read or read_kernel_clock)()
    if kernel is None or kernel.state < 0:
        return pb.ClockQuality()
    if kernel.state == _TIME_ERROR or kernel.status & _STA_UNSYNC:
        return pb.ClockQuality(source=pb.CLOCK_SOURCE_FREE)
    error_us = kernel.estimated_us or kernel.largest_us
    return pb.ClockQuality(source=pb.CLOCK_SOURCE_NTP, sigma_s=1e-6 * max(error_us, 0))


def read_kernel_clock() -> KernelClock | None:
    """Ask the kernel; None where it is no 64-bit Linux."""
    if not sys.platform.startswith("linux") or ctypes.sizeof(ctypes.c_long) != 8:
        return None
    timex = Timex()
    try:
        state = ctypes.CDLL(None, use_errno=True).adjtimex(ctypes.byref(timex))
    except (OSError, AttributeError):
        return None
    return KernelClock(state, timex.status, timex.esterror, timex.maxerror)
