"""An emulated Directed Perception tilt unit: its commands, its texts, its motion, its limits.

Both axes are there. A command that arrives during a move takes over from where the axis is, at rest. Texts that no
document quotes are made after those that are.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from lrf_stereo.tilt import ARCSEC_RAD
from network_calib.observations import FloatArray
from nodes.simulated.tilt_motion import Move, TiltMotion

REPLY_S = 5e-3
MAX_COMMAND_BYTES = 64
COMMAND = re.compile(r"(@|[A-Z]+)([-+]?\d+(?:\.\d+)?)?(\(.*\))?")
NAMES = {"P": "Pan", "T": "Tilt"}


@dataclass(frozen=True, slots=True)
class AxisModel:
    """One axis, in steps.

    Attributes:
        low: lower limit.
        high: upper limit.
        arcsec_per_step: resolution.
        speed: that it moves with.
        acceleration: steps/s2.
        max_speed: highest speed that may be set.
        min_speed: lowest.
        play: of the gear.
    """

    low: int
    high: int
    arcsec_per_step: float = 185.1428
    speed: int = 1000
    acceleration: int = 2000
    max_speed: int = 2902
    min_speed: int = 31
    play: float = 0.0


PAN_D46, TILT_D46 = AxisModel(-3090, 3090), AxisModel(-907, 604)


class TiltUnitDevice:
    """The emulator; see `Emulator`.

    Args:
        pan: axis.
        tilt: axis. Positions grow upwards.
        is_verbose: how it is switched on.
        is_echoing: how it is switched on.
        banner: sent to every client that connects, as the network models do.
        lost_steps: by so many steps the tilt axis slips at its first limit, and does not know it.
    """

    def __init__(
        self,
        *,
        pan: AxisModel = PAN_D46,
        tilt: AxisModel = TILT_D46,
        is_verbose: bool = True,
        is_echoing: bool = True,
        banner: str = "",
        lost_steps: int = 0,
    ) -> None:
        self._axes = {"P": _Axis("Pan", pan), "T": _Axis("Tilt", tilt)}
        self._is_verbose, self._is_echoing, self._banner = is_verbose, is_echoing, banner
        self._is_limited, self._is_slaved = True, False
        self._lost_steps, self._slipped = lost_steps, 0
        self._heard = ""
        self._out: list[tuple[float, bytes]] = []

    def tilt_rad(self, time_s: npt.ArrayLike) -> FloatArray:
        """True tilt of the load at times of any shape, positive downwards, as the LRF's tilt angle."""
        axis = self._axes["T"]
        return -axis.model.arcsec_per_step * ARCSEC_RAD * (axis.motion.load(time_s) + self._slipped)

    def rests_since_s(self, time_s: float) -> float:
        """When the tilt axis came to rest; infinite while it moves, and before its first move."""
        return self._axes["T"].motion.rests_since_s(time_s)

    def connect(self, now_s: float) -> None:
        """A client is there."""
        self._heard = ""
        if self._banner:
            self._post(f"{self._banner}\r\n", now_s)

    def disconnect(self, now_s: float) -> None:
        """The client went; the unit stays on."""
        del now_s
        self._out.clear()

    def receive(self, data: bytes, now_s: float) -> None:
        """Commands, ended by a space, CR or (as the network models take it) LF."""
        for character in data.decode("ascii", errors="replace"):
            if self._is_echoing:
                self._post(character, now_s)
            if character in " \r\n":
                self._obey(self._heard.upper(), now_s)
                self._heard = ""
            else:
                self._heard = (self._heard + character)[-MAX_COMMAND_BYTES:]

    def send(self, now_s: float) -> bytes:
        """Replies that are due."""
        due = [data for due_s, data in self._out if due_s <= now_s]
        self._out = [(due_s, data) for due_s, data in self._out if due_s > now_s]
        return b"".join(due)

    def next_due_s(self) -> float:
        """When the next reply is due."""
        return min((due_s for due_s, _ in self._out), default=math.inf)

    def _obey(self, command: str, now_s: float) -> None:
        if not command:
            return
        match = COMMAND.fullmatch(command)
        if match is None:
            self._reply("! Illegal Command Entered", now_s)
        elif match[1][0] in self._axes and match[1][1:] in _Axis.COMMANDS:
            self._obey_axis(self._axes[match[1][0]], match[1][1:], match[2], now_s)
        elif match[1] in ("R", "RP", "RT"):
            self._reset(match[1][1:] or "TP", now_s)
        elif match[1] == "A":
            begin_s = max((axis.start_pending(now_s) for axis in self._axes.values()), default=now_s)
            self._reply("*", max(now_s, begin_s))
        else:
            self._reply(self._switch(match[1], now_s), now_s)

    def _switch(self, name: str, now_s: float) -> str:
        """The reply to a command of the whole unit."""
        match name:
            case "FT" | "FV":
                self._is_verbose = name == "FV"
                return "*"
            case "F":
                return f"* ASCII {'verbose' if self._is_verbose else 'terse'} mode"
            case "EE" | "ED":
                self._is_echoing = name == "EE"
                return "*"
            case "LE" | "LD":
                self._is_limited = name == "LE"
                return "*"
            case "I" | "S":
                self._is_slaved = name == "S"
                return "*"
            case "CI" | "RE" | "RD" | "DS" | "DF" | "DR" | "@":
                return "*"
            case "H" | "HP" | "HT":
                for letter in name[1:] or "PT":
                    self._axes[letter].halt(now_s)
                return "*"
            case "V":
                return "* Pan-Tilt Controller v2.14.0(D46-17), emulated"
            case "O":
                return "* 11.9,103,98,99" if not self._is_verbose else "* 11.9V,103F,98F,99F"
        return "! Illegal Command Entered"

    def _obey_axis(self, axis: _Axis, name: str, value: str | None, now_s: float) -> None:
        if value is None:
            text, number = axis.query(name, now_s)
            self._reply(f"* {text if self._is_verbose else number}", now_s)
            return
        error = axis.set(name, float(value), is_limited=self._is_limited, is_slaved=self._is_slaved, now_s=now_s)
        self._reply(f"! {error}" if error else "*", now_s)
        if not self._is_limited and name in ("P", "O"):
            self._hit_limit(axis, now_s)

    def _hit_limit(self, axis: _Axis, now_s: float) -> None:
        """With limits disabled an axis may run into its end: told whenever it happens, and steps are lost there."""
        hit_s = axis.stop_at_end(now_s)
        if hit_s is not None:
            self._post(f"!{axis.name[0]}", hit_s)
            if axis.name == "Tilt" and not self._slipped:
                self._slipped = self._lost_steps

    def _reset(self, letters: str, now_s: float) -> None:
        end_s = max(self._axes[letter].reset(now_s) for letter in letters)
        hits = "".join(f"!{letter}!{letter}" for letter in letters)
        self._slipped = 0
        self._post(f"{hits}*\r\n", end_s)

    def _reply(self, text: str, now_s: float) -> None:
        # With echo the reply follows the command on its line.
        self._post(f"{' ' if self._is_echoing else ''}{text}\r\n", now_s + REPLY_S)

    def _post(self, text: str, due_s: float) -> None:
        self._out.append((due_s, text.encode("ascii", errors="replace")))
        self._out.sort(key=lambda entry: entry[0])


class _Axis:
    """One axis: what may be asked of it and set."""

    COMMANDS = ("P", "O", "S", "D", "A", "B", "U", "L", "R", "N", "X")

    def __init__(self, name: str, model: AxisModel) -> None:
        self.name, self.model = name, model
        self.motion = TiltMotion(play=model.play)
        self._upper, self._lower, self._base = model.max_speed, model.min_speed, 57
        self._target, self._pending = 0.0, False

    def query(self, name: str, now_s: float) -> tuple[str, str]:
        """The verbose text and the terse number."""
        model, axis = self.model, self.name
        position = round(self.motion.motor(now_s))
        texts = {
            "P": (f"Current {axis} position is {position}", position),
            "O": (f"Target {axis} position is {round(self._target)}", round(self._target)),
            "S": (f"Target {axis} speed is {model.speed} positions/sec", model.speed),
            "D": (f"Current {axis} speed is {self._speed(now_s)} positions/sec", self._speed(now_s)),
            "A": (f"{axis} acceleration is {model.acceleration} positions/sec^2", model.acceleration),
            "B": (f"Current {axis} base speed is {self._base} positions/sec", self._base),
            "U": (f"Maximum {axis} speed is {self._upper} positions/sec", self._upper),
            "L": (f"Minimum {axis} speed is {self._lower} positions/sec", self._lower),
            "R": (f"{model.arcsec_per_step} seconds arc per {axis} position", model.arcsec_per_step),
            "N": (f"Minimum {axis} position is {model.low}", model.low),
            "X": (f"Maximum {axis} position is {model.high}", model.high),
        }
        text, number = texts[name]
        return text, str(number)

    def set(self, name: str, value: float, *, is_limited: bool, is_slaved: bool, now_s: float) -> str | None:
        """Do it, or say why not."""
        model = self.model
        match name:
            case "P" | "O":
                target = value if name == "P" else self._target + value
                if is_limited and not model.low <= target <= model.high:
                    side, end = ("Maximum", model.high) if target > model.high else ("Minimum", model.low)
                    return f"{side} allowable {self.name} position is {end}"
                self._target, self._pending = target, is_slaved
                if not is_slaved:
                    self._go(now_s)
            case "S" if value > self._upper:
                return f"{self.name} speed cannot exceed {self._upper} positions/sec"
            case "S" | "L" | "U" if value < model.min_speed:
                return f"Motor speed cannot be less than {model.min_speed} pos/sec"
            case "S":
                self.model = replace(model, speed=int(value))
            case "A" if value <= 0:
                return "Illegal argument"
            case "A":
                self.model = replace(model, acceleration=int(value))
            case "U":
                self._upper = int(value)
            case "L":
                self._lower = int(value)
            case "B":
                self._base = int(value)
            case _:
                return "Illegal argument"
        return None

    def start_pending(self, now_s: float) -> float:
        """Begin what a slaved axis waits to do; when the axis rests."""
        if self._pending:
            self._go(now_s)
        return self.motion.end_s

    def halt(self, now_s: float) -> None:
        """Stay here."""
        self._target = round(self.motion.motor(now_s))
        self._go(now_s)

    def stop_at_end(self, now_s: float) -> float | None:
        """Where the target is beyond the axis's end, go to the end instead; when it hits it."""
        end = float(np.clip(self._target, self.model.low, self.model.high))
        if end == self._target:
            return None
        self._target = end
        self._go(now_s)
        return self.motion.end_s

    def reset(self, now_s: float) -> float:
        """Seek both ends and come back to zero; when that is done."""
        at_s = now_s
        for target in (self.model.high, self.model.low, 0):
            self._target = target
            self._go(at_s)
            at_s = self.motion.end_s
        return at_s

    def _go(self, now_s: float) -> None:
        self._pending = False
        begin = self.motion.motor(now_s)
        self.motion.go(Move(now_s, begin, self._target, self.model.speed, self.model.acceleration))

    def _speed(self, now_s: float) -> int:
        return round((self.motion.motor(now_s + 5e-4) - self.motion.motor(now_s - 5e-4)) / 1e-3)
