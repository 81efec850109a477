"""Emulators on real ptys and TCP ports, through the transports that drivers use."""

import threading
import time
from pathlib import Path

import numpy as np
import pytest

from network_calib.errors import InputError
from nodes.devices.errors import DeviceError, LineLostError
from nodes.devices.transport import open_transport
from nodes.simulated.emulator_server import EmulatorServer
from nodes.simulated.line_faults import LineFaults
from tests.nodes.simulated.echo import Echo

# A reply is due within milliseconds; only a hung test waits so long.
PATIENCE_S = 20.0


def read_all(line, n_bytes: int) -> bytes:
    out, end_s = b"", time.monotonic() + PATIENCE_S
    while len(out) < n_bytes and time.monotonic() < end_s:
        out += line.read(0.2)
    return out


@pytest.fixture(params=["pty", "tcp"])
def served(request, tmp_path):
    server, echo = EmulatorServer(), Echo(0.01)
    address = server.add_pty(echo, tmp_path / "device") if request.param == "pty" else server.add_tcp(echo)
    with server:
        yield address, echo


def test_every_byte_value_passes_both_ways(served):
    address, _ = served
    message = bytes(range(256)) * 8
    with open_transport(address, baud=115200) as line:
        line.write(message)
        assert read_all(line, len(message)) == message
        assert line.read(0.0) == b""


def test_a_client_may_go_and_another_come(served):
    address, _ = served
    for message in (b"first", b"second"):
        with open_transport(address, baud=115200) as line:
            line.write(message)
            assert read_all(line, len(message)) == message


def test_a_closed_server_is_a_lost_line_and_leaves_nothing(tmp_path):
    before = threading.active_count()
    server = EmulatorServer()
    address = server.add_pty(Echo(0.01), tmp_path / "device")
    with server:
        line = open_transport(address, baud=115200)
    with pytest.raises(LineLostError), line:
        read_all(line, 1)
    assert not (tmp_path / "device").is_symlink()
    assert threading.active_count() == before


def test_a_replugged_pty_is_found_by_the_same_link(tmp_path):
    faults = LineFaults(np.random.default_rng(0), unplugs=[(0.3, 0.3)])
    server, echo = EmulatorServer(), Echo(0.0)
    address = server.add_pty(echo, tmp_path / "device", faults=faults)
    with server:
        with open_transport(address, baud=115200) as line, pytest.raises(LineLostError):
            read_all(line, 1)
        while not Path(address).exists():
            time.sleep(0.01)
        with open_transport(address, baud=115200) as line:
            line.write(b"again")
            assert read_all(line, 5) == b"again"
    assert echo.n_connects == 2


def test_tcp_turns_a_second_client_away_and_keeps_the_first():
    server = EmulatorServer()
    address = server.add_tcp(Echo(0.01))
    with server, open_transport(address, baud=0) as first:
        first.write(b"one")
        assert read_all(first, 3) == b"one"
        with open_transport(address, baud=0) as second, pytest.raises(LineLostError):
            read_all(second, 1)
        first.write(b"two")
        assert read_all(first, 3) == b"two"


def test_a_file_in_the_place_of_the_link_is_left_alone(tmp_path):
    (tmp_path / "device").write_text("precious")
    with pytest.raises(InputError, match="is there already"):
        EmulatorServer().add_pty(Echo(0.0), tmp_path / "device")
    assert (tmp_path / "device").read_text() == "precious"


def test_what_is_no_device_is_said(tmp_path):
    with pytest.raises(DeviceError, match="no such device"):
        open_transport(str(tmp_path / "none"), baud=9600)
    (tmp_path / "text").write_text("hello")
    with pytest.raises(DeviceError, match="cannot be opened as a serial port"):
        open_transport(str(tmp_path / "text"), baud=9600)
    with pytest.raises(InputError, match="expected /dev/"):
        open_transport("tcp://host:port", baud=9600)
    with pytest.raises(DeviceError, match="no connection"):
        open_transport("tcp://127.0.0.1:1", baud=9600)
