"""The tilt unit's driver against the emulated unit, in virtual time."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from network_calib.errors import InputError, SpotcalError
from nodes.devices.errors import DeviceError
from nodes.devices.tilt_unit import NullTiltUnit, TiltUnit, TiltUnitOptions
from nodes.simulated.loopback import LoopbackTransport, VirtualClock
from nodes.simulated.tilt_unit_device import AxisModel, TiltUnitDevice
from tests.nodes.simulated.babbler import Babbler

STEP_RAD = math.radians(185.1428 / 3600)
PAPER_DEG = (12.1, 23.2, 50.0)
# The paper's tilts point down: positions below zero on a unit that counts upwards.
LONG = AxisModel(-1200, 604)


def started(device=None, **options):
    device, clock = device or TiltUnitDevice(tilt=LONG), VirtualClock()
    unit = TiltUnit(LoopbackTransport(device, clock), options=TiltUnitOptions(**options), clock=clock)
    unit.start()
    return unit, device, clock


def say(device, text, now_s=0.0, wait_s=60.0):
    device.receive(text.encode(), now_s)
    return device.send(now_s + wait_s).decode()


@pytest.mark.parametrize("is_verbose", [True, False])
@pytest.mark.parametrize("is_echoing", [True, False])
@pytest.mark.parametrize("banner", ["", "FLIR Motion Control Systems *"])
def test_every_way_of_talking_is_understood(is_verbose, is_echoing, banner):
    device = TiltUnitDevice(tilt=LONG, is_verbose=is_verbose, is_echoing=is_echoing, banner=banner)
    unit, _, _ = started(device)
    assert unit.info.arcsec_per_step == 185.1428
    assert (unit.info.low_steps, unit.info.high_steps, unit.info.speed_steps_s) == (-1200, 604, 1000)
    assert unit.go_to(math.radians(12.1)) == unit.steps() == -235


def test_the_papers_tilts_are_these_positions():
    unit, device, clock = started()
    assert [unit.go_to(math.radians(tilt)) for tilt in PAPER_DEG] == [-235, -451, -972]
    # Half a step is what rounding leaves.
    assert float(device.tilt_rad(clock())) == pytest.approx(math.radians(50.0), abs=STEP_RAD / 2)


def test_a_move_takes_its_time_and_the_driver_waits_for_it():
    unit, _, clock = started(approach_rad=0.0)
    begin_s = clock()
    unit.go_to(math.radians(50.0))
    # 972 steps at 1000 steps/s and 2000 steps/s2: 0.972 + 0.5 s; some replies of 5 ms each beside it.
    assert 1.472 <= clock() - begin_s <= 1.472 + 0.1


def test_play_lies_on_one_side_however_the_unit_came():
    device = TiltUnitDevice(tilt=AxisModel(-1200, 604, play=6.0))
    unit, _, clock = started(device)
    tilts = []
    for start in (0.0, 60.0, 30.0):
        unit.go_to(math.radians(start))
        unit.go_to(math.radians(40.0))
        tilts.append(float(device.tilt_rad(clock())))
    assert np.ptp(tilts) == 0.0
    straight, _, _ = started(device, approach_rad=0.0)
    straight.go_to(math.radians(60.0))
    straight.go_to(math.radians(40.0))
    # The negative control: from the other side the play of six steps shows.
    assert abs(float(device.tilt_rad(1e9)) - tilts[0]) == pytest.approx(6 * STEP_RAD)


def test_limits_are_obeyed_or_disabled():
    unit, _, _ = started(TiltUnitDevice())
    with pytest.raises(InputError, match=r"tilt of 50.00 deg, but the tilt unit reaches -31.06 to 46.65"):
        unit.go_to(math.radians(50.0))
    free, _, _ = started(TiltUnitDevice(), obeys_limits=False)
    with pytest.raises(DeviceError, match="ran into a limit on its way"):
        free.go_to(math.radians(50.0))
    assert free.n_limit_hits == 1


def test_lost_steps_show_in_the_truth_only_until_a_reset():
    device = TiltUnitDevice(lost_steps=20)
    unit, _, clock = started(device, obeys_limits=False)
    with pytest.raises(DeviceError):
        unit.go_to(math.radians(50.0))
    unit.go_to(math.radians(20.0))
    reported = unit.tilt_rad_of(unit.steps())
    assert float(device.tilt_rad(clock())) - reported == pytest.approx(-20 * STEP_RAD)
    unit.reset()
    assert unit.steps() == 0
    assert float(device.tilt_rad(clock())) == 0.0


@pytest.mark.parametrize(("sign", "steps"), [(-1, -451 + 100), (1, 451 + 100)])
def test_sign_and_zero_come_from_the_options(sign, steps):
    unit, _, _ = started(tilt_sign=sign, zero_steps=100)
    assert unit.go_to(math.radians(23.2)) == steps
    assert unit.tilt_rad_of(steps) == pytest.approx(math.radians(23.2), abs=STEP_RAD / 2)
    with pytest.raises(InputError, match="tilt sign"):
        started(tilt_sign=0)


def test_a_silent_line_is_said():
    class Silent(TiltUnitDevice):
        def receive(self, data: bytes, now_s: float) -> None:
            del data, now_s

    with pytest.raises(DeviceError, match="no answer from the tilt unit to ED") as error:
        started(Silent())
    assert "9600" in error.value.advice


def test_a_unit_that_does_not_arrive_is_said():
    class Stuck(TiltUnitDevice):
        def _obey(self, command: str, now_s: float) -> None:
            super()._obey("CI" if command.startswith("TP-") else command, now_s)

    unit, _, _ = started(Stuck(tilt=LONG))
    with pytest.raises(DeviceError, match="rests at 0, expected"):
        unit.go_to(math.radians(10.0))


def test_no_tilt_unit_neither_moves_nor_counts():
    assert NullTiltUnit().go_to(0.3) is None
    assert NullTiltUnit().steps() is None


def test_documented_replies():
    device = TiltUnitDevice(is_echoing=False)
    documented = {
        "PP ": "* Current Pan position is 0",
        "PN ": "* Minimum Pan position is -3090",
        "TN ": "* Minimum Tilt position is -907",
        "TX ": "* Maximum Tilt position is 604",
        "PP3200 ": "! Maximum allowable Pan position is 3090",
        "PU ": "* Maximum Pan speed is 2902 positions/sec",
        "PS3300 ": "! Pan speed cannot exceed 2902 positions/sec",
        "PL20 ": "! Motor speed cannot be less than 31 pos/sec",
        "pr\r": "* 185.1428 seconds arc per Pan position",
        "HELLO ": "! Illegal Command Entered",
        "R ": "!T!T!P!P*",
    }
    assert {command: say(device, command).strip() for command in documented} == documented
    assert say(device, "FT ").strip() == "*"
    assert say(device, "PP ").strip() == "* 0"
    assert say(device, "F ").strip() == "* ASCII terse mode"


def test_slaved_moves_wait_for_each_other():
    device = TiltUnitDevice(is_echoing=False, is_verbose=False)
    say(device, "S PP100 TP-100 ")
    assert float(device.tilt_rad(60.0)) == 0.0
    assert say(device, "A ", now_s=60.0).strip() == "*"
    assert say(device, "TP PP ", now_s=120.0).split() == ["*", "-100", "*", "100"]


@given(pieces=st.lists(st.one_of(st.binary(max_size=30), st.sampled_from([b"*", b"!", b"!T", b"\r\n", b"* 12\r\n"]))))
def test_any_replies_end_in_the_projects_own_errors(pieces):
    clock = VirtualClock()
    unit = TiltUnit(LoopbackTransport(Babbler(pieces), clock), clock=clock)
    with pytest.raises(SpotcalError):
        unit.start()


@given(data=st.binary(max_size=200))
def test_any_commands_leave_the_emulator_alive(data):
    device = TiltUnitDevice()
    device.receive(data, 0.0)
    device.send(1e6)
    device.receive(b" FT ", 2e6)
    assert device.send(3e6).endswith(b"*\r\n")


def test_an_answer_that_came_while_other_devices_took_all_the_time_counts():
    unit, _, clock = started()
    naps = iter([60.0])
    assert unit.go_to(math.radians(12.1), meanwhile=lambda: clock.sleep(next(naps, 0.0))) == -235
