"""Advice on a whole recording, out of a detector's advice on its last seconds."""

from __future__ import annotations

from collections import Counter

from nodes.detection.spots import Advice, AdviceKind


class LastingAdvice:
    """Keeps the advice that was given half of the times or more, in its latest words.

    A spot that is out of view for a while is no fault of a recording.
    """

    def __init__(self) -> None:
        self._n_asked = 0
        self._n_given: Counter[AdviceKind] = Counter()
        self._message: dict[AdviceKind, str] = {}

    def note(self, given: tuple[Advice, ...]) -> None:
        """What the detector advised once it was asked."""
        self._n_asked += 1
        self._n_given.update(one.kind for one in given)
        self._message |= {one.kind: one.message for one in given}

    def messages(self) -> tuple[str, ...]:
        """In the order in which they were first given."""
        return tuple(self._message[kind] for kind, n in self._n_given.items() if 2 * n >= self._n_asked)
