import threading

import pytest
import zenoh

from network_calib.errors import InputError
from nodes.bus import session as bus_session
from nodes.bus.session import BusOptions, TlsFiles, client_config, open_bus, open_router, router_config
from nodes.devices.errors import DeviceError
from tests.nodes.bus.buses import free_endpoint, options_of, routed, wait_until


@pytest.mark.parametrize("endpoint", ["", "nonsense", "foo/1:2", "127.0.0.1:7447", "tcp:127.0.0.1:7447", "http/1:2"])
def test_what_is_no_address_is_refused_before_anything_is_opened(endpoint):
    for make in (lambda: client_config(BusOptions("s1", (endpoint,))), lambda: router_config((endpoint,))):
        with pytest.raises(InputError, match="no addresses of a bus"):
            make()


def test_no_address_at_all_is_refused():
    with pytest.raises(InputError, match="none: no addresses"):
        client_config(BusOptions("s1", ()))


def test_a_taken_address_is_told_in_few_words_without_places_in_sources():
    endpoint = free_endpoint()
    with open_router((endpoint,)), pytest.raises(DeviceError) as refused, open_router((endpoint,)):
        pass
    assert refused.value.message == f"the router cannot listen at {endpoint}: Address already in use"
    assert "another router" in refused.value.advice


def test_a_name_that_nobody_knows_is_told_in_few_words():
    with pytest.raises(DeviceError) as refused, open_router(("tcp/no-such-host.invalid:7447",)):
        pass
    assert ".rs" not in str(refused.value)
    assert len(refused.value.message) < 200


def test_a_client_waits_for_its_router_and_takes_the_one_that_answers():
    missing, endpoint = free_endpoint(), free_endpoint()
    opened = threading.Event()

    def run():
        with open_bus(BusOptions("s1", (missing, endpoint))):
            opened.set()

    thread = threading.Thread(target=run)
    thread.start()
    assert not opened.wait(0.3)
    with open_router((endpoint,)):
        assert opened.wait(20)
        thread.join(20)
    assert not thread.is_alive()


def test_a_client_that_is_told_to_stop_waits_no_longer():
    stop = threading.Event()
    stop.set()
    endpoint = free_endpoint()
    with (
        pytest.raises(DeviceError, match=f"no router answered at {endpoint}"),
        open_bus(options_of(endpoint), stop=stop),
    ):
        pass


def test_only_clients_of_a_router_hear_each_other_and_no_multicast_is_sent():
    with routed() as endpoint, open_bus(options_of(endpoint)) as one, open_bus(options_of(endpoint)) as other:
        heard = []
        one.declare_subscriber("a/b", lambda sample: heard.append(sample.payload.to_bytes()))

        def is_heard():
            other.put("a/b", b"x", congestion_control=zenoh.CongestionControl.DROP)
            return bool(heard)

        wait_until(is_heard, "a sample")
    for config in (client_config(options_of(endpoint)), router_config((endpoint,))):
        assert config.get_json("scouting/multicast/enabled") == "false"
        assert config.get_json("transport/shared_memory/enabled") == "false"


def test_certificates_are_asked_of_both_sides(tmp_path):
    tls = TlsFiles(tmp_path / "ca.pem", tmp_path / "n1.pem", tmp_path / "n1.key")
    client = client_config(BusOptions("s1", ("tls/127.0.0.1:7447",), tls))
    router = router_config(("tls/127.0.0.1:7447",), tls=tls)
    for config in (client, router):
        assert config.get_json("transport/link/tls/enable_mtls") == "true"
        assert str(tls.ca) in config.get_json("transport/link/tls/root_ca_certificate")
    assert str(tls.certificate) in client.get_json("transport/link/tls/connect_certificate")
    assert str(tls.key) in router.get_json("transport/link/tls/listen_private_key")


def test_a_router_takes_a_thousand_nodes():
    assert bus_session.MAX_SESSIONS >= 1000
    assert bus_session.MAX_PENDING >= 1000
