"""`devices`, `emulate` and `lrf monitor` on emulated instruments in real time."""

from io import StringIO

import numpy as np
import pytest
from rich.console import Console

from lrf_stereo.scanner import ScanSteps
from network_calib.errors import InputError
from nodes.devices.instruments import Instrument, identify
from nodes.devices_list import devices_view
from nodes.emulate import run_emulators
from nodes.lrf.monitor import MonitorAddresses, monitor, scan_bars


def quiet():
    return Console(quiet=True)


def text_of(renderable) -> str:
    console = Console(width=200, record=True, file=StringIO())
    console.print(renderable)
    return console.export_text()


def serve(name, folder, inside, *, is_tcp=False, is_newer=False):
    lines = Console(record=True, width=200, quiet=False, file=StringIO())
    addresses = {}

    def wait(server):
        del server
        for line in lines.export_text(clear=False).splitlines():
            each, address = line.split()
            addresses[each] = address
        inside(addresses)

    run_emulators(name, folder, is_tcp=is_tcp, is_newer=is_newer, seed=1, console=lines, wait=wait)


@pytest.mark.parametrize("is_newer", [False, True])
def test_every_emulated_instrument_is_found_by_what_it_says(tmp_path, is_newer):
    def inside(addresses):
        found = {name: identify(address) for name, address in addresses.items()}
        assert {name: each.kind for name, each in found.items()} == {
            "urg": Instrument.SCANNER,
            "ptu": Instrument.TILT_UNIT,
            "mti": Instrument.IMU,
        }
        assert ("UST-10LX" if is_newer else "URG-04LX, serial H0706400") in found["urg"].description
        assert "185.143 arcsec a step, steps -1200 to 604" in found["ptu"].description
        assert "00500001" in found["mti"].description

    serve("platform", tmp_path, inside, is_tcp=is_newer, is_newer=is_newer)


def test_monitor_shows_scan_clock_tilt_and_rates(tmp_path):
    def inside(addresses):
        console = Console(width=120, record=True, file=StringIO(), force_terminal=True)
        where = MonitorAddresses(addresses["urg"], addresses["ptu"], addresses["mti"])
        counts = monitor(where, duration_s=2.5, console=console)
        # Ten turns a second on a quiet machine; on a busy one the scanner is asked for its clock again meanwhile.
        assert counts.scans >= 2
        shown = console.export_text()
        assert all(word in shown for word in ("URG-04LX", "beams with a range", "ppm; stamps ±", "0.00°", "m/s²"))

    serve("platform", tmp_path, inside)


def test_a_list_without_instruments_says_why(tmp_path):
    view = text_of(devices_view([str(tmp_path / "none")], console=quiet()))
    assert "none known" in view
    assert "no such device" in view


def test_an_unknown_instrument_is_refused(tmp_path):
    with pytest.raises(InputError, match="expected one of urg, ptu, mti, platform"):
        run_emulators("sonar", tmp_path, is_tcp=False, is_newer=False, seed=0, console=quiet())


def test_bars_stand_left_to_right_and_tell_the_farthest():
    steps = ScanSteps()
    range_m = np.full(steps.n_measured, 1.0)
    range_m[:100] = 4.0  # the first beams look to the right
    range_m[-100:] = np.nan
    bars, ends, legend = scan_bars(range_m, steps).splitlines()
    assert bars[0] == " "
    assert bars[36] == "▂"
    assert bars[-1] == "█"
    assert ends.split() == ["+120°", "-120°"]
    assert "4.00 m" in legend
