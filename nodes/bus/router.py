"""The router: the one process that all programs of a site are clients of."""

from __future__ import annotations

import threading
from collections.abc import Callable
from pathlib import Path

from network_calib.errors import InputError
from nodes.bus.session import TlsFiles, open_router

LOOK_S = 0.2


def run_router(
    listen: tuple[str, ...], *, stop: threading.Event, say: Callable[[str], None], tls: TlsFiles | None = None
) -> None:
    """Route until told to stop.

    Args:
        listen: addresses, such as "tcp/0.0.0.0:7447".
        stop: ends it.
        say: gets one line when the router listens.
        tls: certificates; None where the bus stays on one machine.

    Raises:
        DeviceError: an address is taken.
        InputError: an address that is none.
    """
    with open_router(listen, tls=tls):
        say(f"router listens at {', '.join(listen)}")
        # A signal may reach one of Zenoh's threads; Python then handles it when this one next runs.
        while not stop.wait(LOOK_S):
            pass


def tls_of(ca: Path | None, certificate: Path | None, key: Path | None) -> TlsFiles | None:
    """The certificates of a router; None when none are named.

    Raises:
        InputError: some are named, and not all.
    """
    if ca is None and certificate is None and key is None:
        return None
    if ca is None or certificate is None or key is None:
        raise InputError("TLS needs all three: the site's certificate, the router's, and its key")
    return TlsFiles(ca, certificate, key)
