"""Real processes: a router and a node that are told to end, and a node that is killed."""

import signal
import subprocess
import sys
from contextlib import ExitStack, contextmanager

import pytest

from network_calib.errors import InputError
from nodes.bus import spotcal_pb2 as pb
from nodes.bus.client import fetch_rows, fetch_summary
from nodes.bus.replay import RowsWanted
from nodes.bus.router import tls_of
from nodes.bus.session import open_bus
from tests.nodes.bus.buses import KEYS, PATIENCE_S, free_endpoint, listening, options_of, routed, wait_until

SPOTCAL = [sys.executable, "-c", "from nodes.cli import main; main()"]
# A node as programs are: it observes until SIGTERM, or for ever.
NODE = """
import sys, time
from pathlib import Path
from nodes.bus import spotcal_pb2 as pb
from nodes.bus.keys import Kind, Role
from nodes.bus.node import BusNode
from nodes.bus.session import BusOptions
from nodes.journal import Journal
from nodes.site.until_signal import until_signal
with until_signal() as stop, Journal(Path(sys.argv[2])) as journal:
    with BusNode("n1", Role.CAMERA, BusOptions("s1", (sys.argv[1],)), journal) as node:
        if not node.session:
            journal.session = "S1"
        print("runs", flush=True)
        while not stop.wait(0.002):
            node.observe(Kind.EVENT, pb.NodeEvent(text="x"), stamp_ns=time.time_ns())
            node.beat()
"""


@contextmanager
def running(arguments):
    with subprocess.Popen(arguments, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as process:
        try:
            yield process
        finally:
            process.kill()


def line_of(process):
    assert process.stdout is not None
    return process.stdout.readline()


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_router_says_when_it_listens_and_ends_well_when_told(number):
    endpoint = free_endpoint()
    with running([*SPOTCAL, "router", "--listen", endpoint]) as router:
        assert line_of(router) == f"router listens at {endpoint}\n"
        with open_bus(options_of(endpoint)):
            router.send_signal(number)
            out, _ = router.communicate(timeout=PATIENCE_S)
    assert (router.returncode, out) == (0, "")


def test_a_router_whose_address_is_taken_ends_with_the_reason():
    with routed() as endpoint, running([*SPOTCAL, "router", "--listen", endpoint]) as router:
        out, _ = router.communicate(timeout=PATIENCE_S)
    assert router.returncode == 2
    assert "Address already in use" in out


def test_certificates_are_named_together(tmp_path):
    assert tls_of(None, None, None) is None
    assert tls_of(tmp_path, tmp_path, tmp_path) is not None
    with pytest.raises(InputError, match="all three"):
        tls_of(tmp_path, None, tmp_path)


@pytest.mark.parametrize("has_router", [True, False])
def test_a_node_ends_well_when_told(tmp_path, has_router):
    endpoint = free_endpoint()
    with (
        running([*SPOTCAL, "router", "--listen", endpoint]) as router,
        running([sys.executable, "-c", NODE, endpoint if has_router else free_endpoint(), str(tmp_path / "j")]) as node,
    ):
        line_of(router)
        assert line_of(node) == "runs\n"
        if has_router:
            with listening(endpoint) as (_, heard):
                wait_until(lambda: bool(heard.samples), "an observation")
        node.terminate()
        out, _ = node.communicate(timeout=PATIENCE_S)
    assert (node.returncode, out) == (0, "")


def test_node_and_router_end_well_though_the_router_was_frozen(tmp_path):
    endpoint = free_endpoint()
    with (
        running([*SPOTCAL, "router", "--listen", endpoint]) as router,
        running([sys.executable, "-c", NODE, endpoint, str(tmp_path / "j")]) as node,
    ):
        line_of(router)
        with listening(endpoint) as (_, heard):
            wait_until(lambda: bool(heard.samples), "an observation")
        router.send_signal(signal.SIGSTOP)
        node.terminate()
        assert node.wait(PATIENCE_S) == 0
        # Its threads wake all at once: the next signal may reach any of them.
        router.send_signal(signal.SIGCONT)
        router.terminate()
        assert router.wait(PATIENCE_S) == 0


def test_killed_nodes_and_routers_lose_nothing_that_was_journalled(tmp_path):
    endpoint = free_endpoint()
    arguments = [sys.executable, "-c", NODE, endpoint, str(tmp_path / "j")]
    with heard_through_kills(endpoint, arguments) as (session, heard):
        summary = fetch_summary(session, KEYS, "n1", "S1", timeout_s=PATIENCE_S)
        assert summary is not None
        spans = {span.boot: (span.first, span.last, span.n_dropped) for span in summary.spans}
        messages = heard.messages(pb.NodeEvent)
        boots = {message.header.boot for message in messages}
        # Every boot that was heard stands in the journal of the node that runs now.
        assert len(boots) == 3
        assert boots <= set(spans)
        for boot in boots:
            first, last, n_dropped = spans[boot]
            assert (first, n_dropped) == (0, 0)
            rows = fetch_rows(session, KEYS, "n1", RowsWanted("S1", boot, first, last), timeout_s=PATIENCE_S)
            stored = {pb.NodeEvent.FromString(row.payload).header.sequence: row.payload for row in rows}
            assert sorted(stored) == list(range(last + 1))
            heard_of_boot = [message for message in messages if message.header.boot == boot]
            known = [message for message in heard_of_boot if message.header.sequence <= last]
            assert all(stored[message.header.sequence] == message.SerializeToString() for message in known)


@contextmanager
def heard_through_kills(endpoint, arguments):
    """A subscriber that has heard three boots of a node, after kills of node, router and node; the last one runs."""
    router_arguments = [*SPOTCAL, "router", "--listen", endpoint]
    with ExitStack() as stack:
        router = stack.enter_context(running(router_arguments))
        line_of(router)
        session, heard = stack.enter_context(listening(endpoint))

        def hear_more():
            n_before = len(heard.samples)
            wait_until(lambda: len(heard.samples) > n_before + 20, "observations")

        with running(arguments):
            hear_more()
        with running(arguments):
            hear_more()
            router.kill()
            router.wait()
            line_of(stack.enter_context(running(router_arguments)))
            hear_more()
        stack.enter_context(running(arguments))
        hear_more()
        yield session, heard
