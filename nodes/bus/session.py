"""Sessions: every program is a client of a router. Peers that do not listen exchange nothing through one.

A client's `open` fails at once while no router is there, so opening is tried again until it succeeds; once open, the
session reconnects by itself. Sessions are left by `with`: one that is forgotten keeps the process from ending.
"""

from __future__ import annotations

import json
import re
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

import zenoh

from network_calib.errors import InputError
from nodes.devices.errors import DeviceError

DEFAULT_PORT = 7447
DEFAULT_ENDPOINT = f"tcp/127.0.0.1:{DEFAULT_PORT}"
RETRY_S = 0.5
CLOSE_S = 1.0
# A node that freezes or loses its link is missed after this.
LEASE_MS = 2000
MAX_SESSIONS, MAX_PENDING = 4000, 2000
MAX_MESSAGE_BYTES = 16 * 2**20
# Zenoh takes any protocol here and fails when it connects, which looks as if nobody answered.
PROTOCOLS = ("tcp", "tls", "quic", "udp", "ws", "unixsock-stream")


@dataclass(frozen=True, slots=True)
class TlsFiles:
    """Certificates of one program; all PEM.

    Attributes:
        ca: of the site.
        certificate: of this program; its common name is the node's id.
        key: of the certificate.
    """

    ca: Path
    certificate: Path
    key: Path


@dataclass(frozen=True, slots=True)
class BusOptions:
    """How to reach the bus.

    Attributes:
        site: name of the site, first part of all keys.
        endpoints: of the routers, such as "tcp/127.0.0.1:7447"; the first that answers is taken.
        tls: None where the bus stays on one machine.
    """

    site: str
    endpoints: tuple[str, ...] = (DEFAULT_ENDPOINT,)
    tls: TlsFiles | None = None


def client_config(options: BusOptions) -> zenoh.Config:
    """Of a node, coordinator or service.

    Raises:
        InputError: an endpoint that is none.
    """
    settings: dict[str, object] = {
        "mode": "client",
        "connect/endpoints": list(options.endpoints),
        "connect/retry": {"period_init_ms": 200, "period_max_ms": 1000, "period_increase_factor": 2},
        **_common(),
    }
    if options.tls is not None:
        settings["transport/link/tls"] = {
            "root_ca_certificate": str(options.tls.ca),
            "connect_certificate": str(options.tls.certificate),
            "connect_private_key": str(options.tls.key),
            "enable_mtls": True,
            "verify_name_on_connect": True,
        }
    return _config(settings, options.endpoints)


def router_config(listen: tuple[str, ...], *, tls: TlsFiles | None = None) -> zenoh.Config:
    """Of a router.

    Raises:
        InputError: an endpoint that is none.
    """
    settings: dict[str, object] = {
        "mode": "router",
        "listen/endpoints": list(listen),
        "transport/unicast/max_sessions": MAX_SESSIONS,
        "transport/unicast/accept_pending": MAX_PENDING,
        "timestamping/drop_future_timestamp": True,
        "adminspace/enabled": True,
        **_common(),
    }
    if tls is not None:
        settings["transport/link/tls"] = {
            "root_ca_certificate": str(tls.ca),
            "listen_certificate": str(tls.certificate),
            "listen_private_key": str(tls.key),
            "enable_mtls": True,
        }
    return _config(settings, listen)


@contextmanager
def open_bus(options: BusOptions, *, stop: threading.Event | None = None) -> Iterator[zenoh.Session]:
    """A client's session; waits until a router answers.

    Args:
        options: where the bus is.
        stop: ends the waiting.

    Raises:
        DeviceError: told to stop before a router answered.
        InputError: an endpoint that is none.
    """
    zenoh.init_log_from_env_or("off")
    halt = stop or threading.Event()
    while True:
        try:
            session = zenoh.open(client_config(options))
            break
        except zenoh.ZError:
            if halt.wait(RETRY_S):
                raise DeviceError(f"no router answered at {', '.join(options.endpoints)}") from None
    try:
        yield session
    finally:
        _close(session)


@contextmanager
def open_router(listen: tuple[str, ...], *, tls: TlsFiles | None = None) -> Iterator[zenoh.Session]:
    """A router in this process.

    Raises:
        DeviceError: the address is taken.
        InputError: an endpoint that is none.
    """
    zenoh.init_log_from_env_or("off")
    try:
        session = zenoh.open(router_config(listen, tls=tls))
    except zenoh.ZError as error:
        raise DeviceError(
            f"the router cannot listen at {', '.join(listen)}: {_first_cause(error)}",
            advice="Does another router run there? Stop it, or choose another port.",
        ) from None
    try:
        yield session
    finally:
        _close(session)


def _first_cause(error: zenoh.ZError) -> str:
    """What Zenoh's innermost error says, without the places in its sources that it appends."""
    innermost = re.split(r" at \S+\.rs:\d+", str(error))[0].rpartition("[")[2]
    return re.sub(r" \(os error \d+\)$", "", innermost).rpartition(": ")[2]


def _close(session: zenoh.Session) -> None:
    """Close, in bounded time: with a router that is frozen it takes ten seconds, and then fails."""
    closing = threading.Thread(target=_close_quietly, args=(session,), name="close bus", daemon=True)
    closing.start()
    closing.join(CLOSE_S)


def _close_quietly(session: zenoh.Session) -> None:
    with suppress(zenoh.ZError):
        session.close()


def _common() -> dict[str, object]:
    return {
        "scouting/multicast/enabled": False,
        "transport/link/tx/lease": LEASE_MS,
        "transport/link/rx/max_message_size": MAX_MESSAGE_BYTES,
        # Shared memory would leave the encrypted channel, and no message here is large.
        "transport/shared_memory/enabled": False,
    }


def _config(settings: dict[str, object], endpoints: tuple[str, ...]) -> zenoh.Config:
    fault = InputError(
        f"{', '.join(endpoints) or 'none'}: no addresses of a bus", advice="Expected such as tcp/192.168.1.10:7447."
    )
    if not endpoints or any(endpoint.partition("/")[0] not in PROTOCOLS for endpoint in endpoints):
        raise fault
    config = zenoh.Config()
    for path, value in settings.items():
        try:
            config.insert_json5(path, json.dumps(value))
        except zenoh.ZError:
            raise fault from None
    return config
