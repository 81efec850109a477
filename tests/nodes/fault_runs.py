"""A session with kills, and the same one without; who is killed when is drawn from a generator."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from nodes.coordinator.phases import Phase
from tests.nodes.fault_site import COORDINATOR, LRF, ROUTER, FaultSite, Size, new_site, site_as

# Far above what a session takes on a busy machine, so that only a fault reaches it.
PATIENCE_S = 240.0
TICK_S = 0.05
DOWN_S = (0.05, 0.8)
# A coordinator that comes back needs about as long until it solves: kills come before, in, and after that.
SOLVING_PAUSE_S = (0.0, 4.0)
# Keys are pressed again, should the coordinator have been killed before it read them.
PRESS_EVERY_S = 1.0
GO_ON_KEY = "\n"


@dataclass(frozen=True, slots=True)
class Kills:
    """How much is to be killed.

    Attributes:
        n_waving: kills from the background to the end of the wave, of coordinator, router and nodes.
        n_solving: kills while the session is completed and solved, of the coordinator first, then of all.
        pause_s: mean time from one being back to the next kill.
        n_tilts: kills during the tilts, of the LRF node and all others.
    """

    n_waving: int
    n_solving: int
    pause_s: float
    n_tilts: int = 0


@dataclass(slots=True)
class Killer:
    """Kills, and starts again.

    Attributes:
        done: phase and name of each kill.
    """

    site: FaultSite
    kills: Kills
    rng: np.random.Generator
    done: list[tuple[Phase, str]] = field(default_factory=list)
    _down: dict[str, float] = field(default_factory=dict)
    _waiting: dict[Phase, list[str]] = field(default_factory=dict)
    _next_s: dict[Phase, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        servers, nodes = [COORDINATOR, ROUTER], list(self.site.nodes)
        self._waiting = {
            Phase.WAVING: self._drawn([*servers, *nodes], self.kills.n_waving),
            # The LRF's turn comes as often as that of all cameras together.
            Phase.TILTS: self._drawn(
                [*servers, *self.site.cameras, *[LRF] * len(self.site.cameras)], self.kills.n_tilts
            ),
            Phase.SOLVING: self._solving([*servers, *nodes]),
        }

    @property
    def is_through_waving(self) -> bool:
        return not self._waiting[Phase.WAVING] and not self._down

    def step(self, phase: Phase) -> None:
        """Kill what is due, start what was down for long enough."""
        now_s = time.monotonic()
        for name in [name for name, back_s in self._down.items() if now_s >= back_s]:
            del self._down[name]
            self.site.start(name)
        stage = Phase.WAVING if phase is Phase.BACKGROUND else phase
        waiting = self._waiting.get(stage, [])
        next_s = self._next_s.setdefault(stage, now_s + self._pause_s(stage))
        if waiting and now_s >= next_s and waiting[0] in self.site.running:
            name = waiting.pop(0)
            self.site.kill(name)
            self.done.append((phase, name))
            self._down[name] = now_s + float(self.rng.uniform(*DOWN_S))
            self._next_s[stage] = self._down[name] + self._pause_s(stage)

    def _solving(self, names: list[str]) -> list[str]:
        n = self.kills.n_solving
        return [COORDINATOR, *self._drawn(names, n - 1)] if n else []

    def _pause_s(self, stage: Phase) -> float:
        ends_s = SOLVING_PAUSE_S if stage is Phase.SOLVING else (0.2 * self.kills.pause_s, 1.8 * self.kills.pause_s)
        return float(self.rng.uniform(*ends_s))

    def _drawn(self, names: list[str], n: int) -> list[str]:
        """Everything once in random order, then once more, and so on."""
        rounds = -(-n // len(names))
        return [names[k] for _ in range(rounds) for k in self.rng.permutation(len(names))][:n]


def run_disturbed(folder: Path, size: Size, kills: Kills, *, seed: int) -> tuple[FaultSite, Killer]:
    """A session in a new world, with kills; all programs are ended when this returns.

    Raises:
        AssertionError: it did not come to its end.
    """
    rng = np.random.default_rng(seed)
    with new_site(folder, size, seed=seed) as site:
        killer = Killer(site, kills, rng)
        for name in rng.permutation(site.programs):
            site.start(str(name))
        _play(site, killer)
    return site, killer


def run_undisturbed(folder: Path, other: FaultSite) -> FaultSite:
    """The session of another site once more, with nothing killed.

    Raises:
        AssertionError: it did not come to its end.
    """
    with site_as(folder, other) as site:
        for name in site.programs:
            site.start(name)
        _play(site, Killer(site, Kills(0, 0, 1.0), np.random.default_rng(0)))
    return site


def _play(site: FaultSite, killer: Killer) -> None:
    """Be the person, until the session is done."""
    end_s = time.monotonic() + PATIENCE_S
    pressed_s = 0.0
    while time.monotonic() < end_s:
        phase = site.phase
        killer.step(phase)
        _check(site, phase)
        if phase is Phase.WAVING and site.end_of_wave() is None:
            site.wave()
        is_enough = phase is Phase.WAVING and killer.is_through_waving and site.has_seen_all()
        if is_enough and time.monotonic() > pressed_s + PRESS_EVERY_S:
            site.press(GO_ON_KEY)
            pressed_s = time.monotonic()
        if phase is Phase.DONE and not site.is_running(COORDINATOR):
            return
        time.sleep(TICK_S)
    raise AssertionError(f"the session is {site.phase} after {PATIENCE_S:g} s; killed {killer.done}\n{site.told()}")


def _check(site: FaultSite, phase: Phase) -> None:
    """Whatever ends by itself before the session is done is a fault."""
    ended = [name for name in site.running if not site.is_running(name)]
    assert phase is Phase.DONE or not ended, f"{ended} ended while {phase}\n{site.told()}"
    assert phase is not Phase.FAILED, site.told()
