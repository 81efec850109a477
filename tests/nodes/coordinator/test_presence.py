"""Who is there, over a real router; the clock is the test's."""

import pytest
import zenoh

from nodes.bus import spotcal_pb2 as pb
from nodes.bus.keys import Role
from nodes.coordinator.presence import GRACE_S, Presence
from tests.nodes.coordinator.fake_bus_node import KEYS, batch, bus_at, router_process, wait_until


class Clock:
    def __init__(self):
        self.now_s = 100.0

    def __call__(self):
        return self.now_s


@pytest.fixture(scope="module")
def endpoints():
    with router_process() as endpoints:
        yield endpoints


@pytest.fixture
def bus(endpoints):
    with bus_at(endpoints) as bus:
        yield bus


@pytest.fixture
def clock():
    return Clock()


@pytest.fixture
def heard():
    return []


@pytest.fixture
def presence(bus, clock, heard):
    with Presence(bus.session(), KEYS, on_node=heard.append, clock_s=clock) as presence:
        yield presence


def alive(presence):
    return {seen.node: seen.is_alive for seen in presence.nodes()}


def send_status(session, node, *, stamp_ns, role="camera", rate_hz=30.0, as_node=None):
    header = batch(as_node or node, bytes(16), 0, stamp_ns=stamp_ns).header
    status = pb.NodeStatus(header=header, role=role, state="watching", rate_hz=rate_hz)
    session.put(KEYS.status(node), status.SerializeToString(), congestion_control=zenoh.CongestionControl.BLOCK)


STAMP_NS = 1_800_000_000 * 10**9 // 2 + 5 * 10**17  # some time in 2014


def test_a_token_shows_a_node_and_a_late_coordinator_sees_it(bus, clock):
    session = bus.session()
    token = session.liveliness().declare_token(KEYS.live("cam1", Role.CAMERA))
    with Presence(bus.session(), KEYS, clock_s=clock) as presence:
        assert wait_until(lambda: alive(presence) == {"cam1": True})
        clock.now_s += 7
        (seen,) = presence.nodes()
        assert (seen.role, seen.status, seen.since_s) == (Role.CAMERA, None, 7)
        token.undeclare()


def test_a_node_is_gone_only_when_its_token_stays_away(bus, clock, presence):
    session = bus.session()
    token = session.liveliness().declare_token(KEYS.live("lrf1", Role.LRF))
    assert wait_until(lambda: alive(presence) == {"lrf1": True})
    token.undeclare()
    marker = session.liveliness().declare_token(KEYS.live("marker", Role.LRF))
    assert wait_until(lambda: "marker" in alive(presence))
    clock.now_s += GRACE_S / 2
    assert alive(presence)["lrf1"]
    clock.now_s += GRACE_S
    assert not alive(presence)["lrf1"]
    clock.now_s += 5
    assert next(seen.since_s for seen in presence.nodes() if seen.node == "lrf1") == 5
    marker.undeclare()


def test_the_newest_status_counts_and_each_node_is_told_once(bus, presence, heard):
    session = bus.session()
    send_status(session, "cam1", stamp_ns=STAMP_NS)
    send_status(session, "cam1", stamp_ns=STAMP_NS + 2, rate_hz=25.0)
    send_status(session, "cam1", stamp_ns=STAMP_NS + 1)
    assert wait_until(lambda: bool(presence.nodes()) and presence.refusals.n == 1)
    (seen,) = presence.nodes()
    assert seen.status is not None
    assert (seen.role, seen.is_alive, seen.status.rate_hz) == (Role.CAMERA, False, 25.0)
    assert heard == ["cam1"]


def test_bad_statuses_are_counted_and_change_nothing(bus, presence):
    session = bus.session()
    send_status(session, "cam1", stamp_ns=STAMP_NS, as_node="cam2")
    send_status(session, "cam1", stamp_ns=2**62)
    send_status(session, "cam1", stamp_ns=STAMP_NS, rate_hz=float("nan"))
    session.put(KEYS.status("cam1"), b"\xff" * 100_000, congestion_control=zenoh.CongestionControl.BLOCK)
    session.put(KEYS.status("cam1"), b"\xff" * 100, congestion_control=zenoh.CongestionControl.BLOCK)
    assert wait_until(lambda: presence.nodes() == () and presence.refusals.n == 5)
