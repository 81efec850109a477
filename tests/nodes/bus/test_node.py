import threading
import time
from contextlib import ExitStack

import pytest
import zenoh

from network_calib.errors import InputError
from nodes.bus import spotcal_pb2 as pb
from nodes.bus.client import fetch_rows, fetch_summary, send_command
from nodes.bus.keys import Kind, Role, Verb
from nodes.bus.node import BusNode
from nodes.bus.presence_token import SILENCE_S, PresenceToken
from nodes.bus.replay import RowsWanted
from nodes.bus.session import open_router
from nodes.devices.errors import DeviceError
from nodes.journal import Journal
from tests.nodes.bus.buses import (
    KEYS,
    PATIENCE_S,
    STAMP_NS,
    event,
    free_endpoint,
    listening,
    options_of,
    routed,
    wait_until,
)


@pytest.fixture
def journal(tmp_path):
    with Journal(tmp_path / "n1.journal") as opened:
        yield opened


@pytest.fixture
def endpoint():
    with routed() as address:
        yield address


def node_of(endpoint, journal, name="n1"):
    return BusNode(
        name,
        Role.CAMERA,
        options_of(endpoint),
        journal,
        clock=pb.ClockQuality(source=pb.CLOCK_SOURCE_NTP, sigma_s=1e-3),
    )


def command(session=""):
    header = pb.Header(schema=1, node="coordinator", boot=bytes(16), stamp_ns=STAMP_NS, session=session)
    return pb.Command(header=header)


def heard_by(node, heard):
    """Observe until the subscriber has one: then the way is open."""

    def is_through():
        node.observe(Kind.EVENT, event("is it open?"), stamp_ns=STAMP_NS)
        return bool(heard.samples)

    wait_until(is_through, "an observation to get through")


def rows_of(session, journal, of_session="", last=10**6):
    wanted = RowsWanted(of_session, journal.boot, 0, last)
    return list(fetch_rows(session, KEYS, "n1", wanted, timeout_s=PATIENCE_S))


def test_an_observation_is_journalled_and_published_as_the_same_bytes_with_a_full_header(endpoint, journal):
    journal.session = "S1"
    with listening(endpoint) as (_, heard), node_of(endpoint, journal) as node:
        heard_by(node, heard)
    key, payload, _ = heard.samples[0]
    header = pb.NodeEvent.FromString(payload).header
    stored = {sequence: row for sequence, *row in journal.rows("S1", journal.boot, 0, 10**6, max_bytes=10**9)}
    assert stored[header.sequence] == [key, payload]
    assert (header.schema, header.node, header.boot, header.stamp_ns) == (1, "n1", journal.boot, STAMP_NS)
    assert (header.session, header.clock.source, header.clock.sigma_s) == ("S1", 2, 1e-3)


def test_a_node_observes_before_its_router_is_there_and_gives_the_rows_back_later(journal):
    endpoint = free_endpoint()
    with node_of(endpoint, journal) as node:
        for i in range(10):
            node.observe(Kind.EVENT, event(str(i)), stamp_ns=STAMP_NS + i)
        with open_router((endpoint,)), listening(endpoint) as (session, heard):
            heard_by(node, heard)
            rows = rows_of(session, journal, last=9)
    assert [pb.NodeEvent.FromString(row.payload).text for row in rows] == [str(i) for i in range(10)]


def test_a_node_outlives_its_router_and_replay_gives_what_was_lost_meanwhile(journal):
    endpoint = free_endpoint()
    with node_of(endpoint, journal) as node:
        with open_router((endpoint,)), listening(endpoint) as (_, before):
            heard_by(node, before)
        for i in range(50):
            node.observe(Kind.EVENT, event(f"alone {i}"), stamp_ns=STAMP_NS)
        node.beat()
        with open_router((endpoint,)), listening(endpoint) as (session, heard):
            heard_by(node, heard)
            n_observed = node.journal.n_rows
            rows = rows_of(session, journal, last=n_observed - 1)
            assert [pb.NodeEvent.FromString(row.payload).header.sequence for row in rows] == list(range(n_observed))
            # Everything else comes back as well: commands, status, presence.
            reply = send_command(session, KEYS, "n1", Verb.NEXT, command(), timeout_s=PATIENCE_S)
            assert reply.code == "UNSUPPORTED"
            node.beat()
            wait_until(lambda: is_alive(session), "presence")


def is_alive(session):
    return any(reply.ok for reply in session.liveliness().get(KEYS.all_live, timeout=2))


def test_replay_gives_rows_of_older_boots_and_sessions(endpoint, tmp_path):
    path = tmp_path / "n1.journal"
    boots = []
    for of_session in ("S1", "S2"):
        with Journal(path) as journal, node_of(endpoint, journal) as node:
            journal.session = of_session
            boots.append(journal.boot)
            for i in range(5):
                node.observe(Kind.EVENT, event(f"{of_session} {i}"), stamp_ns=STAMP_NS)
    with Journal(path) as journal, node_of(endpoint, journal), listening(endpoint) as (session, _):
        summary = fetch_summary(session, KEYS, "n1", "S1", timeout_s=PATIENCE_S)
        assert summary is not None
        assert [(span.boot, span.first, span.last, span.n_dropped) for span in summary.spans] == [(boots[0], 0, 4, 0)]
        wanted = RowsWanted("S1", boots[0], 1, 3)
        rows = list(fetch_rows(session, KEYS, "n1", wanted, timeout_s=PATIENCE_S))
        assert [pb.NodeEvent.FromString(row.payload).text for row in rows] == ["S1 1", "S1 2", "S1 3"]
        assert {row.key for row in rows} == {KEYS.observation("n1", Kind.EVENT)}


def test_replay_of_many_megabytes_comes_whole_in_bounded_replies(endpoint, journal):
    # 12 MB: several requests of 1 MiB, each of many replies of 256 kB.
    payload = "x" * 60_000
    for _ in range(200):
        message = event(payload)
        message.header.boot = journal.boot

        def build(sequence, message=message):
            message.header.sequence = sequence
            return message.SerializeToString()

        journal.append(Kind.EVENT, "k", build)
    with node_of(endpoint, journal), listening(endpoint) as (session, _):
        rows = rows_of(session, journal)
        assert sorted(pb.NodeEvent.FromString(row.payload).header.sequence for row in rows) == list(range(200))
        parameters = RowsWanted("", journal.boot, 0, 199).parameters
        replies = session.get(
            f"{KEYS.replay_rows('n1')}?{parameters}", consolidation=zenoh.ConsolidationMode.NONE, timeout=PATIENCE_S
        )
        assert max(len(reply.ok.payload.to_bytes()) for reply in replies if reply.ok) <= 256 * 1024


@pytest.mark.parametrize(
    "parameters",
    ["", "boot=00;from=0;to=1", f"boot={'0' * 32};from=-1;to=1", f"session=a/b;boot={'0' * 32};from=0;to=1"],
)
def test_a_request_that_is_none_is_answered_with_the_reason_and_harms_nobody(endpoint, journal, parameters):
    with node_of(endpoint, journal) as node, listening(endpoint) as (session, heard):
        heard_by(node, heard)
        replies = list(session.get(f"{KEYS.replay_rows('n1')}?{parameters}", timeout=PATIENCE_S))
        assert [reply.err is not None for reply in replies] == [True]
        assert rows_of(session, journal, last=0)


def test_status_comes_each_second_with_counts_and_survives_a_status_that_raises(endpoint, journal):
    answers = [pb.NodeStatus(state="watching", rate_hz=30.0)]
    node = node_of(endpoint, journal)
    node.status = answers.pop
    node.observe(Kind.EVENT, event(), stamp_ns=STAMP_NS)
    with listening(endpoint, KEYS.all_status) as (_, heard), node:
        wait_until(lambda: len(heard.samples) >= 3, "three statuses")
    told = heard.messages(pb.NodeStatus)
    assert [status.header.sequence for status in told] == sorted({status.header.sequence for status in told})
    assert {status.journal_rows for status in told} == {1}
    assert {status.role for status in told} == {"camera"}
    assert {status.state for status in told} <= {"watching", "fault"}
    assert "IndexError" in told[-1].message


def test_a_full_disk_is_told_in_the_status_and_the_node_goes_on_publishing(endpoint, journal, monkeypatch):
    def full(_kind, _key, build):
        build(7)
        raise DeviceError("journal cannot be written: database or disk is full")

    monkeypatch.setattr(journal, "append", full)
    node = node_of(endpoint, journal)
    with listening(endpoint, "spotcal/@v1/s1/node/**") as (_, heard), node:

        def is_told():
            node.observe(Kind.EVENT, event("still here"), stamp_ns=STAMP_NS)
            statuses = [pb.NodeStatus.FromString(p).message for key, p, _ in list(heard.samples) if "status" in key]
            events = [key for key, _, _ in list(heard.samples) if key.endswith("event")]
            return any("disk is full" in message for message in statuses) and len(events) > 2

        wait_until(is_told, "the fault in a status, and observations")


def test_presence_follows_the_beats(endpoint, journal):
    with listening(endpoint) as (session, _), node_of(endpoint, journal) as node:
        changes = []
        watch = session.liveliness().declare_subscriber(KEYS.all_live, lambda s: changes.append(s.kind), history=True)
        time.sleep(0.2)
        assert changes == []
        node.beat()
        wait_until(lambda: changes == [zenoh.SampleKind.PUT], "presence")
        node.set_alive(False)
        wait_until(lambda: changes == [zenoh.SampleKind.PUT, zenoh.SampleKind.DELETE], "absence")
        node.set_alive(True)
        wait_until(lambda: len(changes) == 3, "presence again")
        watch.undeclare()


def test_without_a_beat_for_five_seconds_no_presence_is_due():
    now_s = 100.0
    token = PresenceToken("k", clock_s=lambda: now_s)
    assert not token.is_due
    token.beat()
    now_s += SILENCE_S - 0.01
    assert token.is_due
    now_s += 0.02
    assert not token.is_due


def test_commands_run_in_a_thread_that_is_not_zenohs_and_a_slow_one_holds_nothing_up(endpoint, journal):
    release, threads = threading.Event(), []

    def handler(verb, _):
        threads.append(threading.current_thread().name)
        release.wait(PATIENCE_S)
        return pb.Reply(code="OK", message=verb)

    node = node_of(endpoint, journal)
    node.on_command = handler
    with listening(endpoint) as (session, heard), node:
        replies = []
        asking = threading.Thread(
            target=lambda: replies.append(
                send_command(session, KEYS, "n1", Verb.RELEARN, command(), timeout_s=PATIENCE_S)
            )
        )
        asking.start()
        wait_until(lambda: bool(threads), "the handler")
        heard_by(node, heard)
        assert rows_of(session, journal, last=0)
        release.set()
        asking.join(PATIENCE_S)
    assert [(reply.code, reply.message, reply.header.node) for reply in replies] == [("OK", "relearn", "n1")]
    assert threads == ["commands n1"]


def test_a_lost_answer_asked_for_again_does_not_run_the_command_twice(endpoint, journal):
    node = node_of(endpoint, journal)
    ran = []
    node.on_command = lambda verb, _: ran.append(verb) or pb.Reply(code="OK")
    request = command().SerializeToString()
    with listening(endpoint) as (session, heard), node:
        heard_by(node, heard)
        for _ in range(3):
            replies = session.get(
                KEYS.command("n1", Verb.NEXT), payload=request, attachment=b"same", timeout=PATIENCE_S
            )
            assert [pb.Reply.FromString(reply.ok.payload.to_bytes()).code for reply in replies if reply.ok] == ["OK"]
    assert ran == [Verb.NEXT]


def test_nobody_there_is_an_error_after_the_time(endpoint):
    with listening(endpoint) as (session, _):
        with pytest.raises(DeviceError, match="node n7 gave no answer to stop"):
            send_command(session, KEYS, "n7", Verb.STOP, command(), timeout_s=0.5)
        assert fetch_summary(session, KEYS, "n7", "", timeout_s=0.5) is None
        assert list(fetch_rows(session, KEYS, "n7", RowsWanted("", bytes(16), 0, 3), timeout_s=0.5)) == []


def test_many_nodes_live_in_one_process(endpoint, tmp_path):
    n = 20
    with ExitStack() as stack:
        _, heard = stack.enter_context(listening(endpoint, KEYS.all_observations))
        journals = [stack.enter_context(Journal(tmp_path / f"n{i}.journal")) for i in range(n)]
        nodes = [stack.enter_context(node_of(endpoint, journal, f"n{i}")) for i, journal in enumerate(journals)]

        def is_complete():
            for node in nodes:
                node.observe(Kind.EVENT, event(), stamp_ns=STAMP_NS)
            return len({key for key, _, _ in list(heard.samples)}) == n

        wait_until(is_complete, "all nodes")


def test_leaving_is_quick_while_no_router_is_there(journal):
    node = node_of(free_endpoint(), journal)
    before = threading.active_count()
    with node:
        node.observe(Kind.EVENT, event(), stamp_ns=STAMP_NS)
    assert threading.active_count() == before


def test_an_endpoint_that_is_none_is_refused_at_once(journal):
    with pytest.raises(InputError, match="no addresses of a bus"):
        node_of("nonsense", journal)
