"""How long to wait before the next attempt to reach a camera that is away."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, slots=True)
class Backoff:
    """Waits that double up to a limit, each shortened by a random part.

    The random part keeps the nodes of a site, which lost their cameras in the same power cut, from asking all at once.

    Attributes:
        first_s: longest first wait.
        most_s: longest wait.
        jitter: a wait is shortened by up to this part of it, 0 to 1.
    """

    first_s: float = 0.5
    most_s: float = 30.0
    jitter: float = 0.5

    def waits_s(self, rng: np.random.Generator) -> Iterator[float]:
        """Endless."""
        longest_s = self.first_s
        while True:
            yield longest_s * (1 - self.jitter * rng.random())
            longest_s = min(2 * longest_s, self.most_s)
