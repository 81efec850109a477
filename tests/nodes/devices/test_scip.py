"""The scanner's driver against the emulated scanner, in virtual time."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from network_calib.errors import SpotcalError
from nodes.devices.errors import DeviceError, LineLostError
from nodes.devices.scip import Scip
from nodes.devices.scip_frames import ReplyParser, decode_scan
from nodes.simulated.line_faults import LineFaults
from nodes.simulated.loopback import LoopbackTransport, VirtualClock
from nodes.simulated.scip_device import ScipDevice
from nodes.simulated.scip_model import URG_04LX, UST_10LX
from tests.nodes.simulated.babbler import Babbler


def room(model=URG_04LX):
    """Readings that tell the turn they are of: a wall that recedes by 1 mm a turn."""

    def scan_at(begin_s):
        turn = round(begin_s / model.steps.turn_s)
        return np.full(model.steps.n_measured, 1000 + turn % 3000) + np.arange(model.steps.n_measured)

    return scan_at


def connected(model=URG_04LX, *, faults=None, clock=None, **options):
    clock = clock or VirtualClock()
    device = ScipDevice(room(model), model=model)
    scanner = Scip(LoopbackTransport(device, clock, faults=faults), clock=clock, **options)
    scanner.start()
    return scanner, device, clock


def collect(scanner, clock, duration_s):
    scans, end_s = [], clock() + duration_s
    while clock() < end_s:
        scans += scanner.read(min(0.2, end_s - clock()))
    return scans


@pytest.mark.parametrize("model", [URG_04LX, UST_10LX])
def test_scanner_tells_what_it_is(model):
    scanner, _, _ = connected(model)
    assert scanner.info.steps == model.steps
    assert scanner.info.serial in ("H0706400", "H1450000")
    assert scanner.info.status == "Sensor works well."


@pytest.mark.parametrize("model", [URG_04LX, UST_10LX])
def test_every_scan_comes_once_with_the_time_of_its_step_0(model):
    scanner, device, clock = connected(model)
    scans = collect(scanner, clock, 20.0)
    assert [scan.sequence for scan in scans] == list(range(len(scans)))
    assert len(scans) == pytest.approx(20.0 / model.steps.turn_s, abs=1)
    readings = np.array([scan.readings_mm for scan in scans])
    turns = readings[:, 0] - 1000
    assert np.diff(turns).tolist() == [1] * (len(turns) - 1)
    assert (readings - readings[:, :1] == np.arange(model.steps.n_measured)).all()
    true = np.array([device.turn_begin_s(turn) for turn in turns])
    error = np.array([scan.stamp_s for scan in scans]) - true
    # On a line without jitter: the stamp is cut to 1 ms, the scan is sent after its turn in 2.1 ms (16 kB/s at 1 MB/s).
    assert np.abs(error[100:]).max() < 1e-3 + 2.2e-3
    # Two stamps cut to 1 ms, 20 s apart.
    assert scanner.clock_gain == pytest.approx(model.clock_gain, abs=2 * 1e-3 / 20)
    assert scanner.counts.missed == scanner.counts.refused == 0


def test_stamps_hold_under_host_jitter_and_drift():
    rng, errors, clock = np.random.default_rng(3), [], VirtualClock()

    class Jittery:
        """The machine's clock as seen by a program that is woken late."""

        def __call__(self):
            return clock() + rng.exponential(0.02)

    for _ in range(12):
        clock.now_s = 0.0
        device = ScipDevice(room())
        scanner = Scip(LoopbackTransport(device, clock), clock=clock)
        scanner.start()
        scanner._clock = Jittery()
        scans = collect(scanner, clock, 12.0)
        errors += [scan.stamp_s - device.turn_begin_s(scan.readings_mm[0] - 1000) for scan in scans[100:]]
    # 2.2 ms is the time of a scan on the line, which nobody can know but by its constancy.
    assert np.sqrt(np.mean((np.array(errors) - 2.2e-3) ** 2)) < 1e-3
    # Stamping by arrival would be wrong by 20 ms in the mean.
    assert abs(np.mean(errors)) < 5e-3


def test_stamp_wraps_without_a_gap():
    clock = VirtualClock()
    device = ScipDevice(room())
    scanner = Scip(LoopbackTransport(device, clock), clock=clock)
    device._begin_s = -(16777216 / 1.3e3 / 1e3) * 1.3 + 3.0  # the clock wraps some seconds from now
    device._begin_s = round(device._begin_s, 1)
    scanner.start()
    scans = collect(scanner, clock, 40.0)
    assert np.diff([scan.sequence for scan in scans]).tolist() == [1] * (len(scans) - 1)
    assert (np.diff([scan.device_s for scan in scans]) > 0.09).all()
    assert device.sensor_ms(clock()) < 60_000  # it did wrap


def test_damaged_scans_are_refused_whole_and_every_loss_is_counted():
    scanner, _, clock = connected(faults=LineFaults(np.random.default_rng(8), flips_per_byte=2e-5))
    scans = collect(scanner, clock, 200.0)
    for scan in scans:
        assert (np.diff(scan.readings_mm) == 1).all()
    turns = np.array([scan.readings_mm[0] for scan in scans]) - 1000
    sequences = np.array([scan.sequence for scan in scans])
    assert (np.diff(sequences) == np.diff(turns)).all()
    assert scanner.counts.missed == sequences[-1] + 1 - len(scans) > 0


def test_dropped_bytes_do_no_more_harm_than_flipped_ones():
    scanner, _, clock = connected(faults=LineFaults(np.random.default_rng(9), drops_per_byte=2e-5))
    scans = collect(scanner, clock, 100.0)
    assert all((np.diff(scan.readings_mm) == 1).all() for scan in scans)
    # 1000 scans of 2.1 kB: four in a hundred are hit, and a lost LF takes the next with it.
    assert len(scans) > 900


def test_unplugged_scanner_goes_on_and_its_losses_are_counted():
    faults, clock = LineFaults(np.random.default_rng(0), unplugs=[(10.0, 3.0)]), VirtualClock()
    device = ScipDevice(room())
    scanner = Scip(LoopbackTransport(device, clock, faults=faults), clock=clock)
    scanner.start()
    with pytest.raises(LineLostError):
        collect(scanner, clock, 60.0)
    before = scanner.counts
    clock.now_s = 13.05
    scanner.resume(LoopbackTransport(device, clock, faults=faults))
    scans = collect(scanner, clock, 10.0)
    assert scans[0].sequence > before.scans
    # Three seconds without the scanner and those of starting it again, at ten scans a second.
    assert scanner.counts.missed - before.missed == pytest.approx(10 * (scans[0].stamp_s - 10.0), abs=2)


def test_stream_that_stopped_is_asked_for_again():
    scanner, device, clock = connected()
    collect(scanner, clock, 2.0)
    device.receive(b"QT\n", clock())  # a second program on the same line
    scans = collect(scanner, clock, 20.0)
    assert scanner.counts.restarts == 1
    assert len(scans) > 150


def test_laser_fault_is_said_and_not_mistaken_for_silence():
    clock = VirtualClock()
    scanner = Scip(LoopbackTransport(ScipDevice(room(), laser_faults_at_s=(8.0,)), clock), clock=clock)
    scanner.start()
    with pytest.raises(DeviceError, match="hardware fault, status 50"):
        collect(scanner, clock, 30.0)
    assert scanner.counts.laser_faults == 1


def test_dead_stream_is_given_up_with_an_error():
    class Dying(ScipDevice):
        def send(self, now_s: float) -> bytes:
            return b"" if now_s > 5.0 else super().send(now_s)

    clock = VirtualClock()
    scanner = Scip(LoopbackTransport(Dying(room()), clock), clock=clock)
    scanner.start()
    with pytest.raises(DeviceError, match="no answer from the scanner to BM"):
        collect(scanner, clock, 60.0)


def test_what_is_no_scanner_is_said():
    class Deaf(ScipDevice):
        def receive(self, data: bytes, now_s: float) -> None:
            del data, now_s

    class Odd(ScipDevice):
        def _obey(self, command: str, now_s: float) -> None:
            super()._obey("VV" if command == "PP" else command, now_s)

    clock = VirtualClock()
    with pytest.raises(DeviceError, match="no answer from the scanner to VV"):
        Scip(LoopbackTransport(Deaf(room()), clock), clock=clock).start()
    with pytest.raises(DeviceError, match="no answer from the scanner to PP"):
        Scip(LoopbackTransport(Odd(room()), clock), clock=clock).start()


def test_intensity_of_the_newer_model():
    scanner, _, clock = connected(UST_10LX, with_intensity=True)
    scan = collect(scanner, clock, 1.0)[0]
    assert scan.intensity is not None
    assert scan.intensity.shape == scan.readings_mm.shape == (1081,)
    assert (scan.intensity == 4000 - scan.readings_mm // 10).all()


def test_sensor_clock_is_asked_for():
    scanner, device, clock = connected()
    scanner.stop()
    told = scanner.sensor_clock_ms()
    # Asked, answered on a tick within 0.1 s, and switched back on another.
    assert 0 <= device.sensor_ms(clock()) - told <= 250


def ask(device, text, now_s):
    device.receive(text.encode(), now_s)
    return device.send(now_s + 0.35).decode("latin-1")


def test_emulated_urg_wakes_up_in_scip1_and_answers_on_its_tick():
    device = ScipDevice(room())
    device.connect(0.0)
    assert ask(device, "VV\n", 0.0).startswith("VV\nE")
    assert ask(device, "V\n", 1.0).startswith("V\n0\nVEND:")
    assert ask(device, "SCIP2.0\n", 2.0) == "SCIP2.0\n0\n\n"
    device.receive(b"BM\n", 3.03)
    assert device.send(3.09) == b""
    assert device.send(3.11) == b"BM\n00P\n\n"
    assert ask(device, "BM\n", 4.0) == "BM\n02R\n\n"
    assert ask(device, "HELLO\n", 5.0) == "HELLO\n0Ee\n\n"
    assert ask(device, "GD0384038501;12345678901234567\n", 6.0).split("\n")[1] == "0Gg"


def test_emulated_status_of_bad_requests():
    device = ScipDevice(room())
    device.connect(0.0)
    ask(device, "SCIP2.0\n", 0.0)
    wrong = {"GD0384038300": "05U", "GD0384076900": "0Cc", "GD0384102400": "04T", "MDxxxx038500000": "0Cc"}
    assert ask(device, "GD0384038500\n", 1.0).split("\n")[1] == "10Q"
    for k, (request, status) in enumerate(wrong.items()):
        expected = status if request != "GD0384076900" else "10Q"
        assert ask(device, f"{request}\n", 2.0 + k).split("\n")[1] == expected


def test_cluster_takes_the_least_distance_and_a_counted_stream_ends():
    device = ScipDevice(room())
    device.connect(0.0)
    ask(device, "SCIP2.0\n", 0.0)
    device.receive(b"MD0044004703002\n", 1.0)
    replies = ReplyParser().feed(device.send(3.0))
    assert [reply.echo for reply in replies] == ["MD0044004703002", "MD0044004703001", "MD0044004703000"]
    scan = decode_scan(replies[1], n_characters=3, n_beams=2, with_intensity=False)
    assert scan.readings_mm[1] - scan.readings_mm[0] == 3
    assert device.send(10.0) == b""


@settings(max_examples=60)
@given(
    data=st.lists(
        st.one_of(st.binary(max_size=60), st.sampled_from([b"\n\n", b"VV\n00P\n\n", b"PP\n00P\nARES:0;\n\n"]))
    )
)
def test_any_bytes_harm_neither_the_emulator_nor_the_driver(data):
    device, now_s = ScipDevice(room()), 0.0
    device.connect(0.0)
    for piece in data:
        now_s += 0.05
        device.receive(piece, now_s)
        device.send(now_s)
    clock = VirtualClock()
    with pytest.raises(SpotcalError):
        Scip(LoopbackTransport(Babbler(data), clock), clock=clock).start()
