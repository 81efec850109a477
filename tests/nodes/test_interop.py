"""Programs of other people against the emulated instruments: they know the real ones."""

import importlib.util
import logging
import warnings
from urllib.parse import urlsplit

import numpy as np
import pytest

from nodes.emulate import emulated_devices
from nodes.simulated.emulator_server import EmulatorServer
from nodes.simulated.scip_model import UST_10LX
from nodes.simulated.tilt_unit_device import TiltUnitDevice


def needs(package: str):
    reason = f"{package} is not installed"
    return pytest.mark.skipif(importlib.util.find_spec(package) is None, reason=reason)


def place(address: str) -> tuple[str, int]:
    parts = urlsplit(address)
    assert parts.hostname is not None
    assert parts.port is not None
    return parts.hostname, parts.port


@needs("hokuyolx")
def test_hokuyolx_measures_with_the_emulated_network_scanner():
    from hokuyolx import HokuyoLX  # pyright: ignore[reportMissingImports]

    server = EmulatorServer()
    devices = emulated_devices(seed=0, is_newer=True)
    address = server.add_tcp(devices.by_name["urg"])
    with server:
        laser = HokuyoLX(addr=place(address), logger=logging.getLogger("test"), time_tolerance=100_000)
        try:
            assert laser.model == "UST-10LX"
            assert (laser.amin, laser.amax, laser.aforw, laser.scan_freq) == (0, 1080, 540, 40)
            scans = [scan for scan, _, _ in laser.iter_dist(scans=5)]
            assert [len(scan) for scan in scans] == [1081] * 5
            # Two scans of one still room differ by noise alone, wherever both have a range.
            both = (scans[0] > 20) & (scans[1] > 20)
            assert both.sum() > 500
            assert np.median(np.abs(scans[0][both].astype(int) - scans[1][both].astype(int))) < 20
            laser.activate()  # a counted stream leaves the laser off
            _, with_intensity = laser.get_intens()
            assert with_intensity.shape == (1081, 2)
            assert laser.laser_state() == (3, "Single scan state")
        finally:
            laser.close()
    assert UST_10LX.steps.n_measured == 1081


@needs("flir_ptu")
def test_flir_ptu_moves_the_emulated_tilt_unit():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # telnetlib
        from flir_ptu.ptu import PTU  # pyright: ignore[reportMissingImports]

    server, unit = EmulatorServer(), TiltUnitDevice(is_echoing=False, banner="E-Series emulated *")
    host, port = place(server.add_tcp(unit))
    with server:
        ptu = PTU(host, port)
        ptu.connect()
        try:
            ptu.tilt(-235)  # returns when the unit reads back that it is there
            assert ptu.tilt() == "-235"
            assert np.degrees(float(unit.tilt_rad(server.now_s))) == pytest.approx(12.086, abs=0.026)  # half a step
            assert ptu.pan() == "0"
        finally:
            ptu.stream.close()
