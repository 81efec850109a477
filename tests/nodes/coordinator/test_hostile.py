"""Hostile traffic through the real subscriber, among genuine messages: each counted, nothing that is taken changes."""

from concurrent.futures import ProcessPoolExecutor, wait
from multiprocessing import get_context

import numpy as np
import pytest
import zenoh

from nodes.coordinator.ingest import Ingest
from tests.nodes.coordinator.fake_bus_node import KEYS, PATIENCE_S, SESSION, SITE, bus_at, router_process, wait_until
from tests.nodes.coordinator.hostile_messages import Attack, flood, hostile_messages

N = 20_000
# How an attack is counted, when it is not "doubled" by chance: the beginning of the reason.
REASONS = {
    Attack.MUTATED: "seal: broken",
    Attack.NAN: "x_px, y_px, sigma_px, score: out of bounds",
    Attack.WRONG_KEY: "key: no observation",
    Attack.WRONG_NODE: "header.node: not the key's",
    Attack.REPLAYED: "header.sequence: doubled",
    Attack.FUTURE: "header.stamp_ns: in the future",
    Attack.OTHER_SESSION: "header.session: not the running one",
    Attack.JUMP: "header.sequence: far ahead of the journal",
}


@pytest.fixture(scope="module")
def endpoints():
    with router_process() as endpoints:
        yield endpoints


@pytest.fixture(scope="module")
def flooded(endpoints):
    """The ingest's refusals after N hostile messages, what it took, what it should have, and what was sent."""
    taken = []
    with bus_at(endpoints) as bus, ProcessPoolExecutor(1, mp_context=get_context("spawn")) as attacker:
        node, other = bus.node("n1"), bus.node("n2")
        with Ingest(bus.session(), KEYS, SESSION, taken.append) as ingest:
            node.observe()
            assert wait_until(lambda: len(taken) == 1)
            flooding = attacker.submit(flood, bus.endpoints, SITE, taken[0].payload, "n1", N, 5)
            k = 0
            while not flooding.done():
                for one in (node, other):
                    one.observe(is_lost=k % 5 == 0)
                k += 1
                wait([flooding], timeout=0.01)
            # Huge ones may be lost on their way, all others arrive.
            n_certain = N - flooding.result()[Attack.HUGE]
            assert wait_until(lambda: ingest.refusals.n >= n_certain)
            report = ingest.complete(PATIENCE_S)
    return ingest.refusals, taken, (node, other), flooding.result(), report


def test_exactly_what_the_nodes_observed_is_taken(flooded):
    _, taken, nodes, _, report = flooded
    assert report.is_complete, report
    assert len(nodes[0].payloads) > 20
    assert sorted(received.payload for received in taken) == sorted(
        payload for node in nodes for payload in node.payloads
    )


def test_each_is_counted(flooded):
    refusals, _, _, sent, _ = flooded
    # Genuine rows come twice when replay is faster than the bus: more may be counted than was sent.
    assert sent.total() == N
    assert N - sent[Attack.HUGE] <= refusals.n <= N + 2000


@pytest.mark.parametrize("attack", REASONS)
def test_the_reason_says_what_was_wrong(flooded, attack):
    refusals, _, _, sent, _ = flooded
    n = sum(n for reason, n in refusals.by_reason().items() if reason in REASONS[attack] or _is_of(reason, attack))
    assert sent[attack] > 0
    assert n >= sent[attack]


def _is_of(reason, attack):
    return attack is Attack.NAN and reason.split(":")[0] in ("x_px", "y_px", "sigma_px", "score")


def test_forged_boots_are_refused_whether_or_not_they_waited(flooded):
    refusals, _, _, sent, _ = flooded
    n = sum(n for reason, n in refusals.by_reason().items() if reason.startswith("header.boot:"))
    assert n >= sent[Attack.BOOT] > 0


def test_a_huge_message_is_refused_before_it_is_queued(flooded):
    refusals, taken, *_ = flooded
    assert refusals.by_reason()["message: too large"] <= 2
    assert max(len(received.payload) for received in taken) < 1000


def test_counts_are_bounded_and_name_who(flooded):
    refusals = flooded[0]
    assert len(refusals.top()) <= 2001
    assert {refused.source for refused in refusals.top(8)} == {"n1"}


def test_mutations_without_a_seal_never_crash_the_intake(endpoints):
    with bus_at(endpoints) as bus:
        taken = []
        node = bus.node("n1")
        with Ingest(bus.session(), KEYS, SESSION, taken.append) as ingest:
            node.observe()
            assert wait_until(lambda: len(taken) == 1)
            session = bus.session()
            messages = list(hostile_messages(KEYS, taken[0].payload, "n1", 5000, np.random.default_rng(8)))
            mutated = [message.payload for message in messages if message.attack is Attack.MUTATED]
            for payload in mutated:
                session.put(node.key, payload, congestion_control=zenoh.CongestionControl.BLOCK)
            assert wait_until(lambda: ingest.refusals.n + len(taken) >= len(mutated) + 1)
            assert ingest.complete(PATIENCE_S).is_complete
            assert ingest.failure is None
            # Without a seal, a row that no other check can tell from a genuine one may get in, but few do.
            assert len(taken) - 1 < 0.05 * len(mutated)
