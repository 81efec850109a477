"""Emulated instruments on ptys and TCP ports, in real time: any program may talk to them as to the real ones.

One thread serves them all, so that instruments that share their physics need no locks. A pty is reached by a symbolic
link that stays the same when the device is pulled and plugged in again, as udev's links do.
"""

from __future__ import annotations

import math
import os
import selectors
import socket
import threading
import time
import tty
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Protocol, Self

from network_calib.errors import InputError
from nodes.simulated.emulator import Emulator
from nodes.simulated.line_faults import LineFaults

MAX_WAIT_S = 0.05
MAX_READ_BYTES = 4096
# What a client that does not read may leave waiting before it is lost, as in a driver's buffer.
MAX_WAITING_BYTES = 1 << 16


class _Endpoint(Protocol):
    emulator: Emulator

    def poll(self, selector: selectors.BaseSelector, now_s: float) -> None: ...

    def on_ready(self, fd: int, selector: selectors.BaseSelector, now_s: float) -> None: ...

    def close(self, selector: selectors.BaseSelector, now_s: float) -> None: ...


class EmulatorServer:
    """Serves emulators until `close`; use it with `with`, after adding them.

    Args:
        clock: seconds; the emulators' time is this clock's since the server was made.
    """

    def __init__(self, *, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock, self._begin_s = clock, clock()
        self._selector = selectors.DefaultSelector()
        self._endpoints: list[_Endpoint] = []
        self._wake_read, self._wake_write = os.pipe()
        self._selector.register(self._wake_read, selectors.EVENT_READ, None)
        self._thread = threading.Thread(target=self._run, name="emulators", daemon=True)
        self._is_closing = False
        self.error: BaseException | None = None

    @property
    def now_s(self) -> float:
        """The emulators' time."""
        return self._clock() - self._begin_s

    def add_pty(self, emulator: Emulator, link: Path, *, faults: LineFaults | None = None) -> str:
        """Serve over a pty, reached by the symbolic link `link`; returns the link as a device address.

        Raises:
            InputError: something else than a link is at that path.
        """
        self._endpoints.append(_Pty(emulator, link, faults))
        return str(link)

    def add_tcp(self, emulator: Emulator, *, host: str = "127.0.0.1", port: int = 0) -> str:
        """Serve one client after the other over TCP; returns the address `tcp://host:port`."""
        endpoint = _Tcp(emulator, host, port)
        self._endpoints.append(endpoint)
        return endpoint.address

    def close(self) -> None:
        """Stop serving and take the devices away."""
        if self._is_closing:
            return
        self._is_closing = True
        os.write(self._wake_write, b"x")
        if self._thread.ident is not None:
            self._thread.join()
        for endpoint in self._endpoints:
            endpoint.close(self._selector, self.now_s)
        self._selector.close()
        os.close(self._wake_read)
        os.close(self._wake_write)

    def _run(self) -> None:
        try:
            while not self._is_closing:
                self._serve_once()
        except BaseException as error:  # told by whoever owns the server; a silent thread would look like a dead device
            self.error = error
            raise

    def _serve_once(self) -> None:
        for endpoint in self._endpoints:
            endpoint.poll(self._selector, self.now_s)
        due_s = min((endpoint.emulator.next_due_s() for endpoint in self._endpoints), default=math.inf)
        for key, _ in self._selector.select(min(max(due_s - self.now_s, 0.0), MAX_WAIT_S)):
            if key.data is not None:
                key.data.on_ready(key.fd, self._selector, self.now_s)

    def __enter__(self) -> Self:
        now_s = self.now_s
        for endpoint in self._endpoints:  # so that every device is there when this returns
            endpoint.poll(self._selector, now_s)
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


class _Pty:
    def __init__(self, emulator: Emulator, link: Path, faults: LineFaults | None) -> None:
        if link.exists() and not link.is_symlink():
            raise InputError(f"{link}: is there already and is no link", advice="Give the path of a link to be made.")
        self.emulator, self._link, self._faults = emulator, link, faults
        self._fds: tuple[int, int] | None = None
        self._waiting = b""

    def poll(self, selector: selectors.BaseSelector, now_s: float) -> None:
        is_unplugged = self._faults is not None and self._faults.is_unplugged(now_s)
        if is_unplugged:
            self.close(selector, now_s)
            return
        if self._fds is None:
            self._plug_in(selector, now_s)
        assert self._fds is not None
        data = self.emulator.send(now_s)
        self._waiting += data if self._faults is None else self._faults.carry(data, now_s)
        if self._waiting:
            self._waiting = _write(self._fds[0], self._waiting)[-MAX_WAITING_BYTES:]

    def on_ready(self, fd: int, selector: selectors.BaseSelector, now_s: float) -> None:
        del selector
        self.emulator.receive(os.read(fd, MAX_READ_BYTES), now_s)

    def close(self, selector: selectors.BaseSelector, now_s: float) -> None:
        if self._fds is None:
            return
        master, slave = self._fds
        selector.unregister(master)
        # The slave's end is held here too: without it the master would read errors whenever no client is there.
        os.close(slave)
        os.close(master)
        self._link.unlink(missing_ok=True)
        self._fds, self._waiting = None, b""
        self.emulator.disconnect(now_s)

    def _plug_in(self, selector: selectors.BaseSelector, now_s: float) -> None:
        master, slave = os.openpty()
        tty.setraw(slave)
        os.set_blocking(master, False)
        self._fds = master, slave
        self._link.unlink(missing_ok=True)
        self._link.symlink_to(os.ttyname(slave))
        selector.register(master, selectors.EVENT_READ, self)
        self.emulator.connect(now_s)


class _Tcp:
    def __init__(self, emulator: Emulator, host: str, port: int) -> None:
        self.emulator = emulator
        self._listener = socket.create_server((host, port))
        self._listener.setblocking(False)
        self.address = f"tcp://{host}:{self._listener.getsockname()[1]}"
        self._client: socket.socket | None = None
        self._is_registered = False
        self._waiting = b""

    def poll(self, selector: selectors.BaseSelector, now_s: float) -> None:
        if not self._is_registered:
            selector.register(self._listener, selectors.EVENT_READ, self)
            self._is_registered = True
        data = self.emulator.send(now_s)
        if self._client is None:
            return
        self._waiting += data
        if self._waiting:
            try:
                self._waiting = _write(self._client.fileno(), self._waiting)[-MAX_WAITING_BYTES:]
            except OSError:
                self._drop(selector, now_s)

    def on_ready(self, fd: int, selector: selectors.BaseSelector, now_s: float) -> None:
        if fd == self._listener.fileno():
            self._accept(selector, now_s)
            return
        assert self._client is not None
        try:
            data = self._client.recv(MAX_READ_BYTES)
        except OSError:
            data = b""
        if data:
            self.emulator.receive(data, now_s)
        else:
            self._drop(selector, now_s)

    def close(self, selector: selectors.BaseSelector, now_s: float) -> None:
        self._drop(selector, now_s)
        if self._is_registered:
            selector.unregister(self._listener)
        self._listener.close()

    def _accept(self, selector: selectors.BaseSelector, now_s: float) -> None:
        client, _ = self._listener.accept()
        if self._client is not None:  # these devices serve one client; a second is turned away
            client.close()
            return
        client.setblocking(False)
        client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._client, self._waiting = client, b""
        selector.register(client, selectors.EVENT_READ, self)
        self.emulator.connect(now_s)

    def _drop(self, selector: selectors.BaseSelector, now_s: float) -> None:
        if self._client is None:
            return
        selector.unregister(self._client)
        self._client.close()
        self._client = None
        self.emulator.disconnect(now_s)


def _write(fd: int, data: bytes) -> bytes:
    """What could not be written yet."""
    try:
        return data[os.write(fd, data) :]
    except BlockingIOError:
        return data
