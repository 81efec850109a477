"""Beams that the ball's edge cuts in two are told from the ball."""

import numpy as np

from lrf_stereo.scan_spot import SpotCandidates
from nodes.lrf.acquisition import _is_edge


def candidates(*rows):
    """Of (first beam, beams, range)."""
    first, n_hits, range_m = (np.array(column) for column in zip(*rows, strict=True))
    ones = np.ones(len(rows))
    return SpotCandidates(np.zeros(len(rows), np.int64), first, n_hits, range_m, 0 * ones, ones, ones, ones)


def test_what_is_farther_and_right_beside_the_ball_is_its_edge():
    beside = candidates((399, 1, 3.8), (400, 2, 2.04), (402, 1, 5.4))
    assert _is_edge(beside).tolist() == [True, False, True]
    with_a_gap = candidates((398, 1, 3.8), (400, 2, 2.04))
    assert _is_edge(with_a_gap).tolist() == [True, False]


def test_what_is_apart_or_as_near_stays():
    assert not _is_edge(candidates((395, 1, 3.8), (400, 2, 2.04))).any()
    assert not _is_edge(candidates((399, 1, 2.08), (400, 2, 2.04))).any()
    assert not _is_edge(candidates((400, 2, 2.04))).any()
