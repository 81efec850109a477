"""Bytes to and from an instrument: a serial port or a TCP connection behind one seam.

Addresses are a device file (`/dev/ttyACM0`) or `tcp://host:port`. The third member of the family, a simulated line in
virtual time, is `nodes.simulated.loopback`.
"""

from __future__ import annotations

import errno
import select
import socket
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Protocol, Self
from urllib.parse import urlsplit

from network_calib.errors import InputError
from nodes.closing import Closing
from nodes.devices.errors import DeviceError, LineLostError

if TYPE_CHECKING:
    import serial

MAX_READ_BYTES = 65536
CONNECT_TIMEOUT_S = 3.0
WRITE_TIMEOUT_S = 2.0


class Transport(Protocol):
    """A line to one instrument, open from its making until `close`."""

    @property
    def name(self) -> str:
        """The address, for messages."""
        ...

    def read(self, timeout_s: float) -> bytes:
        """What has come, at most MAX_READ_BYTES; nothing when nothing comes within `timeout_s`.

        Raises:
            LineLostError: the instrument was unplugged or the connection ended.
        """
        ...

    def write(self, data: bytes) -> None:
        """Send everything.

        Raises:
            LineLostError: as `read`, or the instrument takes nothing for WRITE_TIMEOUT_S.
        """
        ...

    def set_baud(self, baud: int) -> None:
        """Change the speed of a serial line; nothing on others."""
        ...

    def close(self) -> None:
        """Give the line back; further calls do nothing."""
        ...

    def __enter__(self) -> Self: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...


def open_transport(address: str, *, baud: int, default_port: int | None = None) -> Transport:
    """Open a serial port or a TCP connection.

    Args:
        address: `/dev/...`, or `tcp://host:port`; the port may be left out where `default_port` is given.
        baud: speed of a serial port.
        default_port: TCP port that this kind of instrument listens on.

    Raises:
        InputError: the address is neither.
        DeviceError: it cannot be opened: absent, no permission (which group), busy, refused.
    """
    if not address.startswith("tcp://"):
        return SerialTransport(address, baud=baud)
    try:
        parts = urlsplit(address)
        host, port = parts.hostname, parts.port or default_port
    except ValueError:
        host, port = None, None
    if not host or not port:
        raise InputError(f"address {address!r}: expected /dev/... or tcp://host:port")
    return TcpTransport(host, port)


class SerialTransport(Closing):
    """A serial port, locked against a second client."""

    def __init__(self, path: str, *, baud: int) -> None:
        import serial

        self.name = path
        if not Path(path).exists():
            raise DeviceError(f"{path}: no such device", advice="Is it plugged in? `spotcal devices` lists what is.")
        try:
            self._port: serial.Serial = serial.Serial(path, baud, exclusive=True, write_timeout=WRITE_TIMEOUT_S)
        except (serial.SerialException, OSError) as error:
            raise _not_opened(path, error) from error

    def read(self, timeout_s: float) -> bytes:
        """See `Transport`."""
        try:
            if self._port.timeout != timeout_s:
                self._port.timeout = timeout_s
            first = self._port.read(1)
            return first + self._port.read(min(self._port.in_waiting, MAX_READ_BYTES - 1)) if first else b""
        except (
            OSError,
            TypeError,
        ) as error:  # pyserial's errors are OSErrors; a port closed by a thread is a TypeError
            raise LineLostError(f"{self.name}: the device is gone ({error})") from error

    def write(self, data: bytes) -> None:
        """See `Transport`."""
        try:
            self._port.write(data)
        except (OSError, TypeError) as error:
            raise LineLostError(f"{self.name}: the device takes no data ({error})") from error

    def set_baud(self, baud: int) -> None:
        """See `Transport`."""
        self._port.baudrate = baud

    def close(self) -> None:
        """See `Transport`."""
        self._port.close()


class TcpTransport(Closing):
    """A TCP connection."""

    def __init__(self, host: str, port: int) -> None:
        self.name = f"tcp://{host}:{port}"
        try:
            self._socket = socket.create_connection((host, port), timeout=CONNECT_TIMEOUT_S)
        except OSError as error:
            raise DeviceError(
                f"{self.name}: no connection ({error.strerror or error})",
                advice="Is the device on, and are its address and this machine's network right?",
            ) from error
        self._socket.settimeout(WRITE_TIMEOUT_S)
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def read(self, timeout_s: float) -> bytes:
        """See `Transport`."""
        try:
            if not select.select([self._socket], [], [], timeout_s)[0]:
                return b""
            data = self._socket.recv(MAX_READ_BYTES)
        except (OSError, ValueError) as error:  # a socket closed by another thread is a ValueError of select
            raise LineLostError(f"{self.name}: the connection broke ({error})") from error
        if not data:
            raise LineLostError(f"{self.name}: the device closed the connection")
        return data

    def write(self, data: bytes) -> None:
        """See `Transport`."""
        try:
            self._socket.sendall(data)
        except OSError as error:
            raise LineLostError(f"{self.name}: the connection broke ({error})") from error

    def set_baud(self, baud: int) -> None:
        """A network has no baud rate."""

    def close(self) -> None:
        """See `Transport`."""
        self._socket.close()


def _not_opened(path: str, error: OSError) -> DeviceError:
    code = error.errno
    if code == errno.EACCES:
        return DeviceError(
            f"{path}: permission denied", advice="Add yourself to the group dialout: sudo usermod -aG dialout $USER"
        )
    if code in (errno.EBUSY, errno.EAGAIN):
        return DeviceError(f"{path}: in use by another program", advice="Close that program, or choose another device.")
    return DeviceError(f"{path}: cannot be opened as a serial port ({error})")
