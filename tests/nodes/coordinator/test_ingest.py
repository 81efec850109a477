"""Nothing lost, nothing doubled: through a real router, with nodes that lose, freeze, die and come back."""

import os
import time

import pytest

from nodes.bus import spotcal_pb2 as pb
from nodes.bus.keys import Kind, Role
from nodes.bus.ledger import Ledger
from nodes.bus.node import BusNode
from nodes.bus.session import BusOptions
from nodes.coordinator import asker
from nodes.coordinator.ingest import Ingest
from nodes.journal import Journal
from tests.nodes.coordinator.fake_bus_node import (
    KEYS,
    PATIENCE_S,
    SESSION,
    SITE,
    batch,
    bus_at,
    router_process,
    wait_until,
)


@pytest.fixture(scope="module")
def endpoints():
    with router_process() as endpoints:
        yield endpoints


@pytest.fixture
def bus(endpoints):
    with bus_at(endpoints) as bus:
        yield bus


@pytest.fixture
def taken():
    return []


@pytest.fixture
def ingest(bus, taken):
    with Ingest(bus.session(), KEYS, SESSION, taken.append) as ingest:
        yield ingest


def payloads_of(taken):
    return sorted(received.payload for received in taken)


def test_what_is_published_is_taken_once_and_as_it_was(bus, ingest, taken):
    node = bus.node("n1")
    for _ in range(100):
        node.observe()
    report = ingest.complete(PATIENCE_S)
    assert report.is_complete, report
    assert report.nodes == ("n1",)
    assert payloads_of(taken) == node.payloads
    received = taken[0]
    assert (received.node, received.boot, received.key) == ("n1", node.boot, node.key)
    assert received.message == pb.SpotBatch.FromString(received.payload)
    assert abs(received.arrival_ns - time.time_ns()) < 600e9


def test_a_gap_is_filled_without_being_told(bus, ingest, taken):
    node = bus.node("n1")
    for k in range(1500):
        node.observe(is_lost=200 <= k < 1300 or k % 7 == 0)
    assert wait_until(lambda: len(taken) >= 1499)
    assert ingest.complete(PATIENCE_S).is_complete
    assert payloads_of(taken) == node.payloads


@pytest.mark.usefixtures("ingest")
def test_a_lost_tail_is_found_by_asking(bus, taken):
    node = bus.node("n1")
    for k in range(50):
        node.observe(is_lost=k >= 20)
    assert wait_until(lambda: len(taken) == 50)
    assert payloads_of(taken) == node.payloads


def test_rows_from_before_the_coordinator_and_old_boots_are_fetched(bus, taken):
    node = bus.node("n1")
    for _ in range(3):
        for _ in range(700):
            node.observe()
        node.restart()
    with Ingest(bus.session(), KEYS, SESSION, taken.append) as ingest:
        assert ingest.complete(PATIENCE_S).is_complete
    assert payloads_of(taken) == node.payloads
    assert len({received.boot for received in taken}) == 3


def test_messages_sent_again_are_taken_once_and_counted(bus, ingest, taken):
    node = bus.node("n1")
    for _ in range(10):
        node.observe()
    assert ingest.complete(PATIENCE_S).is_complete
    for payload in node.payloads * 3:
        node.publish(payload)
    assert wait_until(lambda: ingest.refusals.by_reason()["header.sequence: doubled"] >= 30)
    assert payloads_of(taken) == node.payloads


def test_a_restarted_coordinator_fetches_only_what_is_missing(bus, taken):
    node = bus.node("n1")
    for _ in range(900):
        node.observe(is_lost=True)
    ledger = Ledger()
    for sequence in (*range(400), *range(500, 880)):
        ledger.insert("n1", node.boot, sequence)
    with Ingest(bus.session(), KEYS, SESSION, taken.append, ledger=ledger) as ingest:
        assert ingest.complete(PATIENCE_S).is_complete
    assert sorted(received.sequence for received in taken) == [*range(400, 500), *range(880, 900)]
    # One question from the first missing row on, at most 500 rows long; perhaps twice, when a reply was lost.
    assert node.n_rows_asked <= 1000


def test_a_frozen_node_holds_up_nobody(bus, taken):
    frozen, good = bus.node("frozen"), bus.node("good")
    frozen.freeze()
    with Ingest(bus.session(), KEYS, SESSION, taken.append) as ingest:
        for k in range(300):
            frozen.observe()
            good.observe(is_lost=k % 3 == 0)
        assert wait_until(lambda: sum(received.node == "good" for received in taken) == 300)
        report = ingest.complete(1.0)
    assert [(item.node, item.boot) for item in report.items] == [("frozen", None)]
    assert "does not answer" in str(report)
    assert payloads_of(received for received in taken if received.node == "good") == good.payloads


def test_a_node_without_a_journal_is_believed_and_reported(bus, ingest, taken):
    node = bus.node("n1", is_serving=False)
    for _ in range(20):
        node.observe()
    assert wait_until(lambda: len(taken) == 20)
    assert [item.node for item in ingest.complete(1.0).items] == ["n1"]


def test_a_node_that_comes_back_is_asked_again(bus, ingest, taken, monkeypatch):
    monkeypatch.setattr(asker, "TIMEOUT_S", 1.0)
    node = bus.node("n1")
    for k in range(100):
        node.observe(is_lost=k >= 10)
    node.freeze()
    assert wait_until(lambda: len(taken) >= 10)
    node.thaw()
    assert ingest.complete(PATIENCE_S).is_complete
    assert payloads_of(taken) == node.payloads


def test_rows_that_the_journal_gave_up_are_told(bus, ingest):
    node = bus.node("n1")
    node.n_dropped = 30
    for _ in range(100):
        node.observe(is_lost=True)
    report = ingest.complete(PATIENCE_S)
    assert [(item.node, item.boot, item.n_rows) for item in report.items] == [("n1", node.boot, 30)]


def test_a_row_that_cannot_be_had_holds_up_no_other(bus, ingest, taken):
    node = bus.node("n1")
    for k in range(1200):
        node.observe(is_lost=True)
        if k % 400 == 0:
            node.rows_refused.add(k)
    report = ingest.complete(PATIENCE_S)
    assert [(item.boot, item.n_rows) for item in report.items] == [(node.boot, 3)]
    assert len(taken) == 1197


def test_a_forged_jump_asks_for_no_row_that_is_not_there(bus, ingest, taken):
    node = bus.node("n1")
    for k in range(100):
        node.observe(is_lost=10 <= k < 20)
        if k == 50:
            node.publish(batch("n1", node.boot, 2**50).SerializeToString())
    assert ingest.complete(PATIENCE_S).is_complete
    assert payloads_of(taken) == node.payloads
    assert node.n_rows_asked <= 1000
    assert ingest.refusals.by_reason()["header.sequence: far ahead of the journal"] == 1


def test_boots_that_no_journal_vouches_for_are_refused(bus, ingest, taken):
    node = bus.node("n1")
    node.observe()
    assert wait_until(lambda: len(taken) == 1)
    for _ in range(3000):
        node.publish(batch("n1", os.urandom(16), 0).SerializeToString())
    node.restart()
    node.observe()
    assert ingest.complete(PATIENCE_S).is_complete
    assert wait_until(lambda: ingest.refusals.n >= 3000)
    assert payloads_of(taken) == node.payloads


def test_other_sessions_and_strangers_are_counted(bus, taken):
    node, stranger = bus.node("n1"), bus.node("n2")
    with Ingest(bus.session(), KEYS, SESSION, taken.append, nodes=("n1",)) as ingest:
        node.publish(batch("n1", node.boot, 0, session="s0").SerializeToString())
        stranger.observe()
        assert wait_until(lambda: len(ingest.refusals.top()) >= 2)
        assert ingest.complete(PATIENCE_S).nodes == ("n1",)
    counts = {(refused.source, refused.reason) for refused in ingest.refusals.top()}
    assert ("n1", "header.session: not the running one") in counts
    assert ("n2", "node: not of this site, or too many") in counts
    assert taken == []


def test_a_failing_sink_ends_the_ingest_and_is_told(bus):
    def full(_):
        raise OSError("no space left")

    node = bus.node("n1")
    node.observe()
    with Ingest(bus.session(), KEYS, SESSION, full) as ingest, pytest.raises(OSError, match="no space"):
        ingest.complete(PATIENCE_S)
    assert isinstance(ingest.failure, OSError)


def test_real_nodes_observe_before_and_after_they_and_the_coordinator_are_there(bus, endpoints, taken, tmp_path):
    payloads = []
    for _ in range(2):  # started again with the same journal
        with Journal(tmp_path / "n1.journal") as journal:
            journal.session = SESSION
            with (
                BusNode("n1", Role.CAMERA, BusOptions(SITE, endpoints), journal) as node,
                Ingest(bus.session(), KEYS, SESSION, taken.append) as ingest,
            ):
                for k in range(700):
                    node.observe(Kind.SPOTS, batch("", b"", k), stamp_ns=time.time_ns())
                assert wait_until(lambda ingest=ingest: ingest.n_rows >= 700)
                assert ingest.complete(PATIENCE_S).is_complete
            payloads = [
                payload
                for span in journal.spans(SESSION)
                for _, _, payload in journal.rows(SESSION, span.boot, span.first, span.last, max_bytes=2**30)
            ]
    # The second coordinator knew nothing of the first one's rows, and fetched those as well.
    assert len(payloads) == 1400
    assert len(taken) == 700 + 1400
    assert sorted({received.payload for received in taken}) == sorted(payloads)


def test_a_node_that_goes_on_observing_is_told_of_until_it_stops(endpoints, ingest, tmp_path):
    with Journal(tmp_path / "n1.journal") as journal:
        journal.session = SESSION
        with BusNode("n1", Role.CAMERA, BusOptions(SITE, endpoints), journal) as node:
            node.observe(Kind.SPOTS, batch("", b"", 0), stamp_ns=time.time_ns())
            assert wait_until(lambda: ingest.n_rows == 1)
            report = ingest.complete(PATIENCE_S)
            # Nothing is missing so far, and yet the recording must not be closed.
            assert (report.is_complete, report.observing) == (True, ("n1",))
            journal.session = ""
            assert ingest.complete(PATIENCE_S).observing == ()
