"""What the person in the room is told to do next: one sentence for each state of the session."""

from __future__ import annotations

from collections.abc import Sequence

from nodes.coordinator.phases import Facts, Phase, Rules, State


def message_of(
    state: State,
    facts: Facts,
    rules: Rules,
    *,
    guidance: Sequence[str] = (),
    crossings: Sequence[str] = (),
    summary: str = "",
) -> str:
    """The sentence.

    Args:
        state: of the session.
        facts: as of now.
        rules: how it goes.
        guidance: where to wave next, the most urgent first.
        crossings: how far each LRF is, in words.
        summary: of the calibration.
    """
    match state.phase:
        case Phase.IDLE:
            return _idle(facts, rules)
        case Phase.BACKGROUND:
            learning = f"; still learning: {', '.join(facts.learning)}" if facts.learning else ""
            return f"pointer off, and out of the pictures: the background is learnt{learning}"
        case Phase.WAVING:
            return guidance[0] if guidance else "wave the spot slowly through the whole room"
        case Phase.TILTS:
            told = f": {'; '.join(crossings)}" if crossings else ""
            return f"move the spot up and down through the plane of the laser range finder{told}"
        case Phase.SOLVING:
            return "enough: the pointer may be switched off; calibrating"
        case Phase.DONE:
            return f"calibrated: {summary}" if summary else "calibrated"
        case Phase.FAILED:
            return state.warning


def _idle(facts: Facts, rules: Rules) -> str:
    if facts.missing:
        began = "" if rules.is_auto else "; Enter begins without"
        return f"waiting for {', '.join(facts.missing)}{began}"
    if not facts.n_cameras:
        return "waiting for camera nodes"
    return "all nodes are there" if rules.is_auto else "all nodes are there: press Enter to begin"
