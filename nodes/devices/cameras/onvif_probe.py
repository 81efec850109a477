"""Which cameras of the local network answer to ONVIF's discovery (WS-Discovery, one UDP multicast).

Any machine of the network may answer, with anything: answers are bounded in size and number, read by patterns that
neither expand entities nor fetch, and only addresses and printable names are taken from them.
"""

from __future__ import annotations

import re
import socket
import time
import uuid
from dataclasses import dataclass
from urllib.parse import unquote, urlsplit

from nodes.devices.errors import DeviceError

MULTICAST = ("239.255.255.250", 3702)
_MAX_ANSWERS = 512
_MAX_ANSWER_BYTES = 16_384
_MAX_NAME = 80
_PROBE = """<?xml version="1.0" encoding="UTF-8"?>
<e:Envelope xmlns:e="http://www.w3.org/2003/05/soap-envelope" \
xmlns:w="http://schemas.xmlsoap.org/ws/2004/08/addressing" \
xmlns:d="http://schemas.xmlsoap.org/ws/2005/04/discovery" \
xmlns:n="http://www.onvif.org/ver10/network/wsdl"><e:Header><w:MessageID>{message_id}</w:MessageID>\
<w:To>urn:schemas-xmlsoap-org:ws:2005:04:discovery</w:To>\
<w:Action>http://schemas.xmlsoap.org/ws/2005/04/discovery/Probe</w:Action></e:Header>\
<e:Body><d:Probe><d:Types>n:NetworkVideoTransmitter</d:Types></d:Probe></e:Body></e:Envelope>"""
_ADDRESSES = re.compile(rb"<(?:[\w.-]{1,40}:)?XAddrs(?:\s[^<>]{0,500})?>([^<>]{1,4000})</")
_SCOPES = re.compile(rb"<(?:[\w.-]{1,40}:)?Scopes(?:\s[^<>]{0,500})?>([^<>]{1,8000})</")


@dataclass(frozen=True, slots=True)
class OnvifCamera:
    """A camera that answered.

    Attributes:
        host: name or address for `rtsp://host/...`.
        service: address of its ONVIF service, which tells the stream's path to those who log in.
        name: as set in the camera; may be empty.
    """

    host: str
    service: str
    name: str


def probe_onvif(*, wait_s: float = 2.0, target: tuple[str, int] = MULTICAST) -> list[OnvifCamera]:
    """Ask once, and collect the answers of so many seconds; each service once, in the order of addresses.

    Raises:
        DeviceError: the network does not take the question.
    """
    message_id = f"uuid:{uuid.uuid4()}"
    found: dict[str, OnvifCamera] = {}
    try:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as asking:
            asking.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, 1)
            asking.sendto(_PROBE.format(message_id=message_id).encode(), target)
            for answer in _answers(asking, until_s=time.monotonic() + wait_s):
                if (camera := read_answer(answer, message_id)) is not None:
                    found.setdefault(camera.service, camera)
    except OSError as error:
        raise DeviceError(
            f"asking the network for ONVIF cameras failed: {error.strerror or error}",
            advice="Check that this machine has a network interface that is up.",
        ) from None
    return [found[service] for service in sorted(found)]


def read_answer(answer: bytes, message_id: str) -> OnvifCamera | None:
    """The camera of one answer; None for anything that is no answer to this question."""
    addresses = _ADDRESSES.search(answer)
    if len(answer) > _MAX_ANSWER_BYTES or message_id.encode() not in answer or addresses is None:
        return None
    scopes = _SCOPES.search(answer)
    name = _name(scopes[1].decode("utf-8", "replace") if scopes else "")
    for service in addresses[1].decode("utf-8", "replace").split():
        try:
            parts = urlsplit(service)
            host, _ = parts.hostname, parts.port
        except ValueError:
            continue
        if parts.scheme in ("http", "https") and host and service.isprintable() and "@" not in parts.netloc:
            return OnvifCamera(host, service, name)
    return None


def _answers(asking: socket.socket, *, until_s: float) -> list[bytes]:
    answers: list[bytes] = []
    while len(answers) < _MAX_ANSWERS and (left_s := until_s - time.monotonic()) > 0:
        asking.settimeout(left_s)
        try:
            answers.append(asking.recv(_MAX_ANSWER_BYTES + 1))
        except TimeoutError:
            break
    return answers


def _name(scopes: str) -> str:
    marked = next((scope for scope in scopes.split() if "//www.onvif.org/name/" in scope), "")
    name = unquote(marked.rpartition("/")[2])
    return "".join(character for character in name if character.isprintable())[:_MAX_NAME]
