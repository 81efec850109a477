"""The session as a pure state machine: what is known now, and a key, give the next state and what is to be done.

    idle -> background -> waving -> tilts -> solving -> done | failed

No clock, no terminal and no bus: time is an argument. What nodes must be told to be in a state (`orders.py`) follows
from the state alone, so that a node or a coordinator that comes back falls into step by itself; only what happens once
is an `Action`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import StrEnum

# A node that has not learnt its background so long after the time for it holds nobody up any longer.
LATE_BACKGROUND_S = 30.0


class Phase(StrEnum):
    """Where a session is."""

    IDLE = "idle"
    BACKGROUND = "background"
    WAVING = "waving"
    TILTS = "tilts"
    SOLVING = "solving"
    DONE = "done"
    FAILED = "failed"

    @property
    def is_observing(self) -> bool:
        """Nodes are to be started."""
        return self in (Phase.BACKGROUND, Phase.WAVING, Phase.TILTS)

    @property
    def is_over(self) -> bool:
        """Nothing will change any more."""
        return self in (Phase.DONE, Phase.FAILED)


class Press(StrEnum):
    """What a person asks for by a key."""

    ON = "go on"
    SOLVE = "solve now"
    RELEARN = "relearn backgrounds"
    TILT = "next tilt"
    QUIT = "stop"


class Action(StrEnum):
    """What happens once."""

    RELEARN = "relearn"
    NEXT_TILT = "next tilt"
    SOLVE = "solve"
    QUIT = "quit"


@dataclass(frozen=True, slots=True)
class Rules:
    """How a session goes.

    Attributes:
        background_s: the empty room.
        min_waving_s: at least.
        max_waving_s: at most; the tilts get as much again.
        is_auto: begins by itself when all expected nodes are there.
    """

    background_s: float
    min_waving_s: float
    max_waving_s: float
    is_auto: bool = False


@dataclass(frozen=True, slots=True)
class Facts:
    """What is known at a moment.

    Attributes:
        now_s: seconds since the epoch.
        missing: nodes that are expected and not there.
        n_cameras: camera nodes that are there.
        learning: nodes that are there and do not watch yet.
        waving_lacks: what waving has not given yet; empty: enough.
        tilting: LRFs that have not finished their tilts; empty where there is none.
        n_lrfs: LRFs that are there or expected.
        solved: None while the solve runs, else "" for success or the reason of the failure.
    """

    now_s: float
    missing: tuple[str, ...] = ()
    n_cameras: int = 0
    learning: tuple[str, ...] = ()
    waving_lacks: tuple[str, ...] = ()
    tilting: tuple[str, ...] = ()
    n_lrfs: int = 0
    solved: str | None = None


@dataclass(frozen=True, slots=True)
class State:
    """Of a session.

    Attributes:
        phase: where it is.
        since_s: when it came there, seconds since the epoch.
        warning: about how it came there; empty when all went well.
    """

    phase: Phase
    since_s: float
    warning: str = ""


@dataclass(frozen=True, slots=True)
class Step:
    """The next state, and what happens once."""

    state: State
    actions: tuple[Action, ...] = ()


def advance(state: State, facts: Facts, rules: Rules, press: Press | None = None) -> Step:
    """One step; the same state comes back where nothing changes."""
    if press is Press.QUIT:
        return Step(state, (Action.QUIT,))
    if press is Press.SOLVE and state.phase.is_observing:
        return _to(Phase.SOLVING, facts)
    match state.phase:
        case Phase.IDLE:
            return _idle(state, facts, rules, press)
        case Phase.BACKGROUND:
            return _background(state, facts, rules, press)
        case Phase.WAVING:
            return _waving(state, facts, rules, press)
        case Phase.TILTS:
            return _tilts(state, facts, rules, press)
        case Phase.SOLVING:
            return _solving(state, facts)
        case Phase.DONE | Phase.FAILED:
            return Step(state)


def resumed(state: State, rules: Rules, *, now_s: float, was_stopped: bool) -> Step:
    """How a session goes on that another run of the coordinator left.

    Args:
        state: as it was left.
        rules: how the session goes.
        now_s: seconds since the epoch.
        was_stopped: the nodes were told to stop, so that they begin with the background again.
    """
    if state.phase is Phase.FAILED or (was_stopped and state.phase.is_observing):
        return Step(State(Phase.BACKGROUND, now_s))
    if state.phase.is_observing and not 0 <= now_s - state.since_s <= rules.max_waving_s:
        # Nobody waved while it was away for so long, or the clock was set.
        return Step(replace(state, since_s=now_s))
    return Step(state, (Action.SOLVE,) if state.phase is Phase.SOLVING else ())


def _idle(state: State, facts: Facts, rules: Rules, press: Press | None) -> Step:
    is_complete = rules.is_auto and not facts.missing and facts.n_cameras > 0
    if press is Press.ON or is_complete:
        absent = f"begun without {', '.join(facts.missing)}" if facts.missing else ""
        return _to(Phase.BACKGROUND, facts, absent)
    return Step(state)


def _background(state: State, facts: Facts, rules: Rules, press: Press | None) -> Step:
    if press is Press.RELEARN:
        return _to(Phase.BACKGROUND, facts, "", Action.RELEARN)
    if press is Press.ON:
        return _to(Phase.WAVING, facts)
    spent_s = facts.now_s - state.since_s
    if spent_s < rules.background_s:
        return Step(state)
    if not facts.learning and facts.n_cameras > 0:
        return _to(Phase.WAVING, facts)
    if spent_s >= rules.background_s + LATE_BACKGROUND_S:
        late = ", ".join(facts.learning) or "no camera node is there; it"
        return _to(Phase.WAVING, facts, f"{late} had not learnt the background in {spent_s:.0f} s")
    return Step(state)


def _waving(state: State, facts: Facts, rules: Rules, press: Press | None) -> Step:
    if press is Press.RELEARN:
        return _to(Phase.BACKGROUND, facts, "", Action.RELEARN)
    spent_s = facts.now_s - state.since_s
    if press is Press.ON:
        return _after_waving(facts, f"went on without: {'; '.join(facts.waving_lacks)}" if facts.waving_lacks else "")
    if not facts.waving_lacks and spent_s >= rules.min_waving_s:
        return _after_waving(facts, "")
    if spent_s >= rules.max_waving_s:
        return _after_waving(facts, f"waving ended after {spent_s:.0f} s without: {'; '.join(facts.waving_lacks)}")
    return Step(state)


def _after_waving(facts: Facts, warning: str) -> Step:
    return _to(Phase.TILTS if facts.n_lrfs else Phase.SOLVING, facts, warning)


def _tilts(state: State, facts: Facts, rules: Rules, press: Press | None) -> Step:
    if press is Press.TILT:
        return Step(state, (Action.NEXT_TILT,))
    if press is Press.ON or not facts.tilting:
        return _to(Phase.SOLVING, facts, f"went on without {', '.join(facts.tilting)}" if facts.tilting else "")
    spent_s = facts.now_s - state.since_s
    if spent_s >= rules.max_waving_s:
        return _to(Phase.SOLVING, facts, f"after {spent_s:.0f} s not through its tilts: {', '.join(facts.tilting)}")
    return Step(state)


def _solving(state: State, facts: Facts) -> Step:
    if facts.solved is None:
        return Step(state)
    return _to(Phase.DONE, facts) if not facts.solved else _to(Phase.FAILED, facts, facts.solved)


def _to(phase: Phase, facts: Facts, warning: str = "", *actions: Action) -> Step:
    begun = (*actions, Action.SOLVE) if phase is Phase.SOLVING else actions
    return Step(State(phase, facts.now_s, warning), begun)
