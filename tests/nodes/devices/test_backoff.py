from itertools import islice

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from nodes.devices.backoff import Backoff


@given(st.integers(0, 2**32 - 1))
def test_waits_double_up_to_the_limit_each_shortened_by_at_most_the_jitter(seed):
    backoff = Backoff(first_s=0.5, most_s=30.0, jitter=0.5)
    waits = np.array(list(islice(backoff.waits_s(np.random.default_rng(seed)), 10)))
    longest = np.array([0.5, 1, 2, 4, 8, 16, 30, 30, 30, 30])
    assert np.all(waits <= longest)
    assert np.all(waits >= 0.5 * longest)


def test_waits_of_two_nodes_differ():
    first, second = (list(islice(Backoff().waits_s(np.random.default_rng(seed)), 5)) for seed in (1, 2))
    assert all(a != b for a, b in zip(first, second, strict=True))
