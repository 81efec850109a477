import re
import socket
import threading

import pytest
from hypothesis import given
from hypothesis import strategies as st

from nodes.devices.cameras.onvif_probe import OnvifCamera, probe_onvif, read_answer
from nodes.devices.errors import DeviceError

ID = "uuid:1234"


def answer(*, service="http://10.0.0.7/onvif/device_service", name="Front%20Door", relates_to=ID, extra=""):
    return (
        f'<?xml version="1.0"?>{extra}<s:Envelope><s:Header><a:RelatesTo>{relates_to}</a:RelatesTo></s:Header><s:Body>'
        f"<d:ProbeMatches><d:ProbeMatch><d:Types>dn:NetworkVideoTransmitter</d:Types>"
        f"<d:Scopes>onvif://www.onvif.org/type/video_encoder onvif://www.onvif.org/name/{name}</d:Scopes>"
        f'<d:XAddrs xml:space="default">{service}</d:XAddrs></d:ProbeMatch></d:ProbeMatches></s:Body></s:Envelope>'
    ).encode()


class Network:
    """A UDP socket that answers each question with the given datagrams, `ID` replaced by the question's."""

    def __init__(self, *answers):
        self._answers = answers
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", 0))
        self._socket.settimeout(10)
        self.address = self._socket.getsockname()
        self.question = b""
        self._thread = threading.Thread(target=self._reply, daemon=True)
        self._thread.start()

    def _reply(self):
        self.question, asking = self._socket.recvfrom(65536)
        (message_id,) = re.findall(rb"MessageID>([^<]+)<", self.question)
        for datagram in self._answers:
            self._socket.sendto(datagram.replace(ID.encode(), message_id), asking)

    def close(self):
        self._thread.join(10)
        self._socket.close()


def test_answers_are_collected_once_each():
    network = Network(answer(), answer(), b"\xff\x00junk", answer(service="https://10.0.0.9:8443/onvif", name=""))
    found = probe_onvif(wait_s=0.5, target=network.address)
    network.close()
    assert found == [
        OnvifCamera("10.0.0.7", "http://10.0.0.7/onvif/device_service", "Front Door"),
        OnvifCamera("10.0.0.9", "https://10.0.0.9:8443/onvif", ""),
    ]
    assert b"NetworkVideoTransmitter</d:Types></d:Probe>" in network.question


def test_silence_is_an_empty_list():
    network = Network()
    assert probe_onvif(wait_s=0.05, target=network.address) == []
    network.close()


def test_a_network_that_takes_no_question_is_an_error():
    with pytest.raises(DeviceError, match="ONVIF cameras failed"):
        probe_onvif(wait_s=0.05, target=("255.255.255.255", 3702))  # broadcast, which this socket may not send


def test_an_answer_to_another_question_is_none():
    assert read_answer(answer(relates_to="uuid:9"), ID) is None


@pytest.mark.parametrize(
    "service",
    ["file:///etc/passwd", "http://", "http://[::1/onvif", "http://a:b@10.0.0.7/", "ftp://10.0.0.7/", "x" * 5000],
)
def test_an_answer_without_a_usable_address_is_none(service):
    assert read_answer(answer(service=service), ID) is None


def test_the_first_usable_of_several_addresses_counts():
    camera = read_answer(answer(service="bad http://10.0.0.7/a http://192.168.1.7/a"), ID)
    assert camera is not None
    assert camera.service == "http://10.0.0.7/a"


def test_too_long_answers_and_names_are_cut_off():
    assert read_answer(answer(extra="<!--" + "x" * 20_000 + "-->"), ID) is None
    camera = read_answer(answer(name="%1b[31m" + "n" * 500), ID)
    assert camera is not None
    assert camera.name == ("[31m" + "n" * 500)[:80]


def test_entities_are_not_expanded():
    bomb = '<!DOCTYPE x [<!ENTITY a "aaaa"><!ENTITY b "&a;&a;">]>'
    camera = read_answer(answer(extra=bomb, name="&b;"), ID)
    assert camera is not None
    assert camera.name == "&b;"


@given(st.binary(max_size=300), st.integers(0, 600), st.integers(0, 600))
def test_any_mutation_is_an_answer_or_none(junk, start, end):
    whole = answer()
    camera = read_answer(whole[:start] + junk + whole[end:], ID)
    assert camera is None or (camera.host and camera.service.startswith("http") and camera.name.isprintable())
