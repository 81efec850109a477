"""Which of several channels the spot stands out in most: a vote over the places at which one does plainly better.

Passers-by, doors and lamps look alike in all channels, and so have no weight. A coloured picture on a screen has, but
one vote for each place only, and the spot comes to many.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from nodes.detection.candidates import Candidate

# So many places at which one channel is plainly better decide, if it leads by so much.
N_VOTES = 12
PLACE = 24
PLAINLY = 1.3
LEAD = 2.0
# After so many frames with something like a spot there is no colour to be found: the best is taken.
N_PATIENCE = 250
# What looks less like a spot has no vote.
MIN_SCORE = 0.4
SAME_PLACE = 3.0


class ChannelChoice:
    """Counts how the channels do."""

    def __init__(self, n_channels: int, *, advantage: float = 1.0) -> None:
        """Begin.

        Args:
            n_channels: the first is preferred.
            advantage: how many times more the spot must stand out of the noise in another than in the first.
        """
        self._handicap = np.array([advantage] + [1.0] * (n_channels - 1))
        self._lead = np.zeros(n_channels)
        self._total = np.zeros(n_channels)
        self._places: set[tuple[int, int]] = set()
        self._n_votes = 0

    def best(self, found: Sequence[Sequence[Candidate]]) -> int:
        """The channel with the most spot-like candidate of one frame; `found`: of each channel, best first."""
        standing = [one[0].standing if one else 0.0 for one in found]
        return standing.index(max(standing))

    def vote(self, found: Sequence[Sequence[Candidate]]) -> int | None:
        """Count a frame; the channel chosen once there were enough, else None."""
        leaders = found[self.best(found)]
        if not leaders or leaders[0].score < MIN_SCORE:
            return None
        snr = self._handicap * [_snr_at(leaders[0], one) for one in found]
        second, first = np.sort(snr)[-2:]
        self._total += snr
        self._n_votes += 1
        place = int(leaders[0].px[0]) // PLACE, int(leaders[0].px[1]) // PLACE
        if first > PLAINLY * second and place not in self._places:
            self._lead[snr.argmax()] += first - second
            self._places.add(place)
        second, first = np.sort(self._lead)[-2:]
        if len(self._places) >= N_VOTES and first > LEAD * second:
            return int(self._lead.argmax())
        return int(self._total.argmax()) if self._n_votes >= N_PATIENCE else None


def _snr_at(leader: Candidate, found: Sequence[Candidate]) -> float:
    """How far the same thing stands out in another channel."""
    near = SAME_PLACE + leader.length
    return max((one.snr for one in found if np.linalg.norm(one.px - leader.px) < near), default=0.0)
