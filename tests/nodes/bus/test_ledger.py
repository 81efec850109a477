"""The ledger against a plain set; refusals stay bounded and lose no count."""

from hypothesis import given
from hypothesis import strategies as st

from nodes.bus.ledger import Gap, Ledger, Runs
from nodes.coordinator.refusals import OTHERS, Refusals, Refused

A, B = bytes(16), bytes([1] * 16)
numbers = st.lists(st.integers(0, 40), max_size=80)


@given(numbers)
def test_an_insert_tells_whether_the_row_is_new(sequence):
    runs, here = Runs(), set()
    for number in sequence:
        assert runs.add(number) is (number not in here)
        here.add(number)
    assert (runs.n, runs.last) == (len(here), max(here, default=-1))
    assert runs.n_runs == sum(number - 1 not in here for number in here)


@given(numbers, st.integers(0, 45), st.integers(0, 45))
def test_missing_ranges_are_what_a_set_lacks(sequence, first, last):
    runs = Runs()
    for number in sequence:
        runs.add(number)
    ranges = list(runs.missing(first, last))
    assert [n for low, high in ranges for n in range(low, high + 1)] == sorted(
        set(range(first, last + 1)) - set(sequence)
    )
    assert all(low <= high for low, high in ranges)


@given(numbers, st.integers(0, 45))
def test_a_number_touches_when_it_opens_no_new_run(sequence, number):
    runs = Runs()
    for one in sequence:
        runs.add(one)
    n_runs, touches = runs.n_runs, runs.touches(number)
    runs.add(number)
    assert touches is (runs.n_runs <= n_runs)


def test_boots_and_nodes_are_kept_apart():
    ledger = Ledger()
    assert [ledger.insert("n1", A, 0), ledger.insert("n1", B, 0), ledger.insert("n2", A, 0)] == [True] * 3
    assert not ledger.insert("n1", B, 0)
    assert (ledger.n_rows(), ledger.n_rows("n1"), ledger.boots("n1")) == (3, 2, (A, B))


def test_gaps_lie_between_rows_only():
    ledger = Ledger()
    for sequence in (5, 6, 9, 12):
        ledger.insert("n1", A, sequence)
    ledger.insert("n1", B, 7)
    assert ledger.gaps("n1") == (Gap(A, 7, 8), Gap(A, 10, 11))
    assert ledger.gaps("nobody") == ()


def test_memory_goes_with_runs_not_with_rows():
    runs = Runs()
    for number in range(100_000):
        runs.add(number)
    runs.add(2**50)
    assert runs.n_runs == 2
    assert list(runs.missing(0, 2**50)) == [(100_000, 2**50 - 1)]


def test_refusals_keep_the_frequent_and_lose_no_count():
    refusals = Refusals(max_pairs=100)
    for k in range(5000):
        refusals.count(f"stranger-{k}", "key: no observation")
        refusals.count("n1", "seal: broken")
    top = refusals.top()
    assert refusals.n == 10_000
    assert len(top) <= 101
    assert Refused("n1", "seal: broken", 5000) in top
    assert refusals.by_reason() == {"key: no observation": 5000, "seal: broken": 5000}
    assert any(refused.source == OTHERS for refused in top)


def test_a_long_source_is_cut():
    refusals = Refusals()
    refusals.count("x" * 10**6, "key: no observation")
    assert len(refusals.top()[0].source) < 200
