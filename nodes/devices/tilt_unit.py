"""Driver of a Directed Perception / FLIR pan-tilt unit's tilt axis, over RS-232 or TCP.

Replies may be verbose or terse, with or without echo of the command: whatever stands before the first `*` or `!` is
echo, and a number is a number. `!T` and `!P`, without a space, are not replies but limits that an axis ran into.
"""

from __future__ import annotations

import math
import re
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from lrf_stereo.tilt import ARCSEC_RAD
from network_calib.errors import InputError
from nodes.devices.errors import DeviceError
from nodes.devices.transport import Transport

BAUD, TCP_PORT = 9600, 4000
REPLY_TIMEOUT_S = 2.0
RESET_TIMEOUT_S = 40.0
# A move is given this many times the time that it needs by the unit's own speed, and some seconds.
PATIENCE, PATIENCE_S = 2.0, 3.0
MAX_REPLY_BYTES = 4096
POLL_S = 0.05
LIMIT_HIT = re.compile(r"!([TP])(?![A-Za-z ])")
REPLY = re.compile(r"[*!][^*!\r\n]*[\r\n]")
NUMBER = re.compile(r"[-+]?\d+(?:\.\d+)?")


@dataclass(frozen=True, slots=True)
class TiltUnitOptions:
    """How the unit is mounted and used.

    Attributes:
        tilt_sign: -1 where positions grow upwards, as on these units; +1 where the unit hangs upside down.
        zero_steps: position that is called tilt zero.
        obeys_limits: whether the unit's position limits stay in force.
        approach_rad: every target is reached from positions this much lower in tilt, so that the gear's play always
            lies on one side; 0 goes straight there.
        speed_rad_s: of moves; None leaves the unit's own.
    """

    tilt_sign: int = -1
    zero_steps: int = 0
    obeys_limits: bool = True
    approach_rad: float = math.radians(1.0)
    speed_rad_s: float | None = None


@dataclass(frozen=True, slots=True)
class TiltUnitInfo:
    """What the unit says of itself.

    Attributes:
        arcsec_per_step: resolution.
        low_steps: lower limit.
        high_steps: upper limit.
        speed_steps_s: speed of moves.
        acceleration_steps_s2: of moves.
        version: firmware.
    """

    arcsec_per_step: float
    low_steps: int
    high_steps: int
    speed_steps_s: float
    acceleration_steps_s2: float
    version: str


class TiltDrive(Protocol):
    """What tilts the scanner."""

    def go_to(self, tilt_rad: float, *, meanwhile: Callable[[], None] | None = None) -> int | None:
        """Move there and wait; the position in steps as read back, or None where nothing counts steps.

        `meanwhile` is called again and again until the move is over: other devices want to be read.
        """
        ...

    def steps(self) -> int | None:
        """The position now."""
        ...


class NullTiltUnit:
    """No tilt unit: somebody tilts the LRF by hand, and the IMU alone tells when it stands, and where."""

    def go_to(self, tilt_rad: float, *, meanwhile: Callable[[], None] | None = None) -> int | None:
        """Nothing moves by itself."""
        del tilt_rad, meanwhile

    def steps(self) -> int | None:
        """Nothing counts."""
        return None


class TiltUnit:
    """The tilt axis of a unit on an open line.

    Args:
        transport: the line.
        options: how the unit is mounted and used.
        clock: this machine's clock, s.

    Raises:
        InputError: a tilt sign that is none.
    """

    def __init__(
        self,
        transport: Transport,
        *,
        options: TiltUnitOptions | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._line, self._clock, self.options = transport, clock, options or TiltUnitOptions()
        if self.options.tilt_sign not in (-1, 1):
            raise InputError(f"tilt sign {self.options.tilt_sign}, expected -1 (positions grow upwards) or 1")
        self._text = ""
        self._info: TiltUnitInfo | None = None
        self.n_limit_hits = 0

    def start(self) -> TiltUnitInfo:
        """Set the modes this driver wants, and read what the unit is.

        Raises:
            DeviceError: no answer, or answers that are not a tilt unit's.
            LineLostError: it is gone.
        """
        self._drain()
        # The first command ends whatever half command a predecessor left; its answer may be an error.
        self._line.write(b" ")
        self._drain()
        for command in ("ED", "FT", "CI", "I", "LE" if self.options.obeys_limits else "LD"):
            self._command(command)
        resolution = self._number("TR")
        if not resolution > 0:
            raise DeviceError(f"{self._line.name}: the tilt unit says its resolution is {resolution} arcsec")
        if self.options.speed_rad_s is not None:
            self._command(f"TS{round(self.options.speed_rad_s / (resolution * ARCSEC_RAD))}")
        self._info = TiltUnitInfo(
            arcsec_per_step=resolution,
            low_steps=int(self._number("TN")),
            high_steps=int(self._number("TX")),
            speed_steps_s=self._number("TS"),
            acceleration_steps_s2=self._number("TA"),
            version=self._command("V"),
        )
        return self._info

    @property
    def info(self) -> TiltUnitInfo:
        """As read by `start`."""
        if self._info is None:
            raise DeviceError(f"{self._line.name}: the tilt unit was not started")
        return self._info

    def steps_of(self, tilt_rad: float) -> int:
        """The position nearest to a tilt angle."""
        step_rad = self.info.arcsec_per_step * ARCSEC_RAD
        return self.options.zero_steps + round(self.options.tilt_sign * tilt_rad / step_rad)

    def tilt_rad_of(self, steps: float) -> float:
        """The tilt angle of a position."""
        step_rad = self.info.arcsec_per_step * ARCSEC_RAD
        return self.options.tilt_sign * step_rad * (steps - self.options.zero_steps)

    def go_to(self, tilt_rad: float, *, meanwhile: Callable[[], None] | None = None) -> int:
        """Move to a tilt angle from below it, wait until the unit rests; the position as read back.

        Args:
            tilt_rad: where to.
            meanwhile: called about every POLL_S until the move is over.

        Raises:
            InputError: the angle is beyond the unit's limits, and they are obeyed.
            DeviceError: the unit ran into a limit or did not arrive.
        """
        target, info = self.steps_of(tilt_rad), self.info
        if self.options.obeys_limits and not info.low_steps <= target <= info.high_steps:
            ends = sorted(math.degrees(self.tilt_rad_of(end)) for end in (info.low_steps, info.high_steps))
            raise InputError(
                f"tilt of {math.degrees(tilt_rad):.2f} deg, but the tilt unit reaches {ends[0]:.2f} to {ends[1]:.2f}",
                advice="Choose other tilt angles, or mount the unit differently.",
            )
        before = self.steps_of(tilt_rad - self.options.approach_rad)
        if self.options.obeys_limits:
            before = min(max(before, info.low_steps), info.high_steps)
        if before != target:
            self._move(before, meanwhile)
        return self._move(target, meanwhile)

    def steps(self) -> int:
        """The position now."""
        return int(self._number("TP"))

    def reset(self) -> None:
        """Let the unit find its zero again, after it lost steps."""
        self._command("RT", timeout_s=RESET_TIMEOUT_S)

    def halt(self) -> None:
        """Stop at once."""
        self._command("H")

    def _move(self, target: int, meanwhile: Callable[[], None] | None) -> int:
        hits, info = self.n_limit_hits, self.info
        way, speed = abs(target - self.steps()), max(info.speed_steps_s, 1.0)
        needed_s = way / speed + speed / max(info.acceleration_steps_s2, 1.0)
        self._command(f"TP{target}")
        self._command("A", timeout_s=PATIENCE * needed_s + PATIENCE_S, meanwhile=meanwhile)
        arrived = self.steps()
        if self.n_limit_hits > hits:
            raise DeviceError(
                f"{self._line.name}: the tilt unit ran into a limit on its way to {target}: it may have lost steps",
                advice="Free its way and reset it; tilt angles from its steps are not to be trusted until then.",
            )
        if arrived != target:
            raise DeviceError(f"{self._line.name}: the tilt unit rests at {arrived}, expected {target}")
        return arrived

    def _number(self, query: str) -> float:
        reply = self._command(query)
        found = NUMBER.search(reply)
        number = float(found[0]) if found else math.inf
        # A line that repeats a digit a few hundred times makes a number that is none.
        if not math.isfinite(number):
            raise DeviceError(f"{self._line.name}: the tilt unit answers {query} by {reply[:80]!r}, expected a number")
        return number

    def _command(
        self, command: str, *, timeout_s: float = REPLY_TIMEOUT_S, meanwhile: Callable[[], None] | None = None
    ) -> str:
        """What stands behind the `*` of the reply."""
        self._line.write(f"{command} ".encode("ascii"))
        end_s = self._clock() + timeout_s
        while True:
            reply = self._next_reply()
            if reply is not None:
                break
            # Also when the time is over: `meanwhile` may have taken it all, and the answer be there.
            left_s = max(end_s - self._clock(), 0.0)
            heard = self._line.read(left_s if meanwhile is None else min(left_s, POLL_S))
            if not heard and left_s == 0:
                raise DeviceError(
                    f"{self._line.name}: no answer from the tilt unit to {command} within {timeout_s:.0f} s",
                    advice=f"Is this the tilt unit's port, and its speed {BAUD} baud?",
                )
            self._text = (self._text + heard.decode("ascii", errors="replace"))[-MAX_REPLY_BYTES:]
            if meanwhile is not None:
                meanwhile()
        if reply.startswith("!"):
            raise DeviceError(f"{self._line.name}: the tilt unit refuses {command}: {reply[1:].strip()}")
        return reply[1:].strip()

    def _next_reply(self) -> str | None:
        """Take limit hits, then the first whole reply, out of what was heard."""
        self.n_limit_hits += len(LIMIT_HIT.findall(self._text))
        self._text = LIMIT_HIT.sub("", self._text)
        found = REPLY.search(self._text)
        if found is None:
            return None
        self._text = self._text[found.end() :]
        return found[0]

    def _drain(self) -> None:
        while self._line.read(0.1):
            pass
        self._text = ""
