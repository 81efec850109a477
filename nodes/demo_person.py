"""Plays the person in the simulated room: reads what the coordinator asks for, and waves the spot when it is time."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from google.protobuf.message import DecodeError

from nodes.bus import spotcal_pb2 as pb
from nodes.simulated.smart_room import read_world
from nodes.simulated.smart_room_events import LEAD_S, EventFile, Stop, Wave

if TYPE_CHECKING:
    import zenoh

    from nodes.bus.keys import Keys

# From hearing of it to beginning; more than LEAD_S.
REACTION_S = 1.2
# One wave; where it was not enough, another follows.
WAVE_S = 60.0


class DemoPerson:
    """One person.

    Args:
        world: folder of the simulated room.
        clock_s: the wall clock.
    """

    def __init__(self, world: Path, *, clock_s: Callable[[], float] = time.time) -> None:
        self._events, self._world, self._clock_s = EventFile(world), read_world(world), clock_s
        self._heard: deque[bytes] = deque(maxlen=100)
        self._waving_until_s = -math.inf
        self.phase = pb.SESSION_PHASE_IDLE

    def listen(self, bus: zenoh.Session, keys: Keys) -> zenoh.Subscriber[None]:
        """Hear what the coordinator says; the subscriber is the caller's."""
        return bus.declare_subscriber(keys.session_state, lambda sample: self.hear(sample.payload.to_bytes()))

    def hear(self, payload: bytes) -> None:
        """A message of the coordinator; from any thread."""
        self._heard.append(payload)

    def step(self) -> None:
        """Heed what was heard."""
        while self._heard:
            try:
                self.phase = pb.SessionState.FromString(self._heard.popleft()).phase
            except DecodeError:
                continue
        now_s = self._clock_s()
        if self.phase == pb.SESSION_PHASE_WAVING:
            if now_s >= self._waving_until_s:
                self._wave(now_s)
        elif now_s < self._waving_until_s:
            self._events.append(Stop(now_s + LEAD_S))
            self._waving_until_s = -math.inf

    def _wave(self, now_s: float) -> None:
        # On the cameras' grid: so the same frames of the wave show the same pictures in every run.
        frame = math.ceil((now_s + REACTION_S - self._world.start_s) * self._world.rate_hz)
        begin_s = self._world.start_s + frame / self._world.rate_hz
        self._events.append(Wave(begin_s, WAVE_S))
        self._waving_until_s = begin_s + WAVE_S
