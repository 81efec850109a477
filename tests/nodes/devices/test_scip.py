"""The scanner's driver against the emulated scanner, in virtual time."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from network_calib.errors import InputError, SpotcalError
from nodes.devices.errors import DeviceError, LineLostError
from nodes.devices.scip import Scip
from nodes.devices.scip_frames import ReplyParser, decode_scan, encode_number
from nodes.devices.scip_modes import ScanMode
from nodes.simulated.late_line import LateEmulator
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


def even(rng):
    return rng.uniform(0, 0.1)


def falling(rng):
    return min(rng.exponential(0.02), 0.1)


def stamp_errors(delay, *, duration_s, n_runs, model=URG_04LX, **options):
    """(n_runs, 2) error and stated sigma of the last scan's stamp so long after the start, s."""
    out = []
    for seed in range(n_runs):
        rng, clock = np.random.default_rng(seed), VirtualClock()
        device = ScipDevice(room(model), model=model)
        late = LateEmulator(device, lambda: delay(rng))  # noqa: B023
        scanner = Scip(LoopbackTransport(late, clock), clock=clock, **options)
        scanner.start()
        scan = collect(scanner, clock, duration_s)[-1]
        out.append((scan.stamp_s - device.turn_begin_s(scan.readings_mm[0] - 1000), scan.sigma_s))
    return np.array(out).T


@pytest.mark.parametrize("delay", [even, falling])
def test_stamps_hold_after_ten_seconds_of_late_arrivals_and_drift(delay):
    error, sigma = stamp_errors(delay, duration_s=12.0, n_runs=14)
    # 1 ms is wanted; an RMS of 14 runs is known to 19 % and more where it is not Gaussian: two of 25 %.
    assert np.sqrt(np.mean(error**2)) < 1.5e-3
    assert 0.5 < np.sqrt(np.mean(error**2) / np.mean(sigma**2)) < 1.5


def test_stamps_hold_from_the_first_second_on():
    error, sigma = stamp_errors(even, duration_s=1.0, n_runs=14)
    # The sensor's clock is known to about a millisecond when it is asked, a second and a half before; a drift of 1300
    # ppm makes 2 ms of that. Arrivals alone are wrong by 10 ms here.
    assert np.sqrt(np.mean(error**2)) < 1.5 * np.hypot(1e-3, 2.5 * 1.3e-3)
    assert 0.5 < np.sqrt(np.mean(error**2) / np.mean(sigma**2)) < 1.5


def test_without_lateness_no_scan_is_given_up_for_the_clock():
    scanner, _, clock = connected()
    collect(scanner, clock, 30.0)
    assert scanner.counts.resyncs == scanner.counts.missed == 0


def test_a_scanner_that_does_not_tell_its_time_is_stamped_by_arrivals():
    class Timeless(ScipDevice):
        def _time(self, command: str, name: str, now_s: float) -> None:
            del name
            self._answer(command, "0E", now_s)

    clock = VirtualClock()
    device = Timeless(room())
    scanner = Scip(LoopbackTransport(device, clock), clock=clock)
    scanner.start()
    scan = collect(scanner, clock, 10.0)[-1]
    error = scan.stamp_s - device.turn_begin_s(scan.readings_mm[0] - 1000)
    assert scan.sigma_s > 10e-3  # the latency is not known
    assert abs(error) < scan.sigma_s


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


def test_two_restarts_without_any_answer_on_the_clock_keep_what_was_known_of_its_drift(monkeypatch):
    scanner, _, clock = connected()
    collect(scanner, clock, 20.0)
    gain = scanner.clock_gain
    with monkeypatch.context() as patch:
        patch.setattr("nodes.devices.scip.exchange_times", lambda *_, **__: [])
        scanner._restart()
        scanner._restart()
        assert scanner.clock_gain is None
    scans = collect(scanner, clock, 2.0)
    assert scans
    # Two seconds tell a drift to 1 ms / 2 s at best; what is known from before holds it much better.
    assert scanner.clock_gain == pytest.approx(gain, abs=1e-4)


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


NEWER = [ScanMode.DISTANCES, ScanMode.INTENSITY, ScanMode.ECHOES, ScanMode.ECHOES_INTENSITY]


def edges(begin_s):
    """A near post before a far wall."""
    del begin_s
    readings = np.full(UST_10LX.steps.n_measured, 9000)
    readings[300:320] = 2000
    return readings


@pytest.mark.parametrize("mode", NEWER)
@pytest.mark.parametrize("is_stream", [True, False])
def test_all_modes_of_the_newer_model_give_the_first_echo(mode, is_stream):
    clock = VirtualClock()
    scanner = Scip(LoopbackTransport(ScipDevice(edges, model=UST_10LX), clock), clock=clock, mode=mode)
    scanner.start()
    scan = collect(scanner, clock, 0.5)[-1] if is_stream else scanner.scan_once()
    assert (scan.readings_mm == edges(0.0)).all()
    assert scanner.counts.refused == 0
    if mode.has_intensity:
        assert scan.intensity is not None
        assert (scan.intensity == 4000 - scan.readings_mm // 10).all()
    else:
        assert scan.intensity is None


def test_the_emulated_post_has_two_echoes_at_its_far_edge_only():
    device = ScipDevice(edges, model=UST_10LX)
    device.connect(0.0)
    ask(device, "BM\n", 1.0)
    reply = ReplyParser().feed(ask(device, "HD0318032100\n", 2.0).encode())[0]
    near, far = encode_number(2000, 3), encode_number(9000, 3)
    # Beams 318 and 319 are on the post, 319 beside the wall.
    assert "".join(reply.lines[1:]) == f"{near}{near}&{far}{far}{far}"


@pytest.mark.parametrize("mode", [ScanMode.DISTANCES, ScanMode.SHORT_DISTANCES])
def test_single_scans_of_the_older_model_and_a_stream_after_them(mode):
    clock = VirtualClock()
    device = ScipDevice(room())
    scanner = Scip(LoopbackTransport(device, clock), clock=clock, mode=mode)
    scanner.identify()
    scans = [scanner.scan_once() for _ in range(20)]
    turns = np.array([scan.readings_mm[0] for scan in scans]) - 1000
    assert (np.diff(turns) >= 1).all()
    assert np.diff([scan.sequence for scan in scans]).tolist() == np.diff(turns).tolist()
    error = np.array([scan.stamp_s - device.turn_begin_s(turn) for scan, turn in zip(scans, turns, strict=True)])
    # 2 ms of the clock's own bounds, and 2000 ppm of the four seconds that this takes.
    assert np.abs(error).max() < 2e-3 + 8e-3
    scanner.start()
    assert len(collect(scanner, clock, 2.0)) >= 18
    assert scanner.scan_once().readings_mm.shape == (682,)
    assert collect(scanner, clock, 2.0) == []  # the stream is not asked for by itself


def test_an_older_model_refuses_echoes_in_words():
    clock = VirtualClock()
    scanner = Scip(LoopbackTransport(ScipDevice(room()), clock), clock=clock, mode=ScanMode.ECHOES)
    with pytest.raises(DeviceError, match="ND0044072500000, status 0E: it does not know the command"):
        scanner.start()
    with pytest.raises(DeviceError, match="no scan, status 0E: it does not know the command"):
        scanner.scan_once()


class Wired(LoopbackTransport):
    """A line that remembers its speed."""

    baud = 19200

    def set_baud(self, baud):
        self.baud = baud


def test_speed_of_the_serial_line_is_set_and_refusals_are_told_in_words():
    clock, device = VirtualClock(), ScipDevice(room())
    line = Wired(device, clock)
    scanner = Scip(line, clock=clock)
    assert scanner.identify().line_speed == "19200[bps]<-Default setting by user"
    scanner.set_speed(115200)
    assert device.speed == line.baud == 115200
    assert scanner.identify().line_speed == "115200[bps]"
    scanner.set_speed(115200)  # it has it already: no error
    with pytest.raises(DeviceError, match="refuses 38400 baud, status 04: this model does not have this speed"):
        scanner.set_speed(38400)
    with pytest.raises(DeviceError, match="refuses 12345 baud, status 02: it knows no such speed"):
        scanner.set_speed(12345)
    with pytest.raises(InputError, match="speed of 1000000 baud"):
        scanner.set_speed(1_000_000)
    assert device.speed == line.baud == 115200
    scanner.start()
    assert len(collect(scanner, clock, 2.0)) >= 18


def test_emulated_speeds():
    device = ScipDevice(room())
    device.connect(0.0)
    ask(device, "SCIP2.0\n", 0.0)
    # 019200 is what it has; texts without six digits are no number.
    told = {"019200": "03S", "250000": "00P", "9600": "01Q", "00960x": "01Q", "009600": "02R", "038400": "04T"}
    for k, (text, status) in enumerate(told.items()):
        assert ask(device, f"SS{text}\n", 1.0 + k) == f"SS{text}\n{status}\n\n"
    assert device.speed == 250000
    ask(device, "RS\n", 20.0)
    assert device.speed == 19200


def test_a_status_with_its_eighth_bit_flipped_is_a_damaged_scan_and_no_fault():
    class Flipping(ScipDevice):
        def _post(self, text: str, ready_s: float) -> None:
            # The sum counts six bits of a character; 0xB9 is a digit to those who ask Python.
            super()._post(text.replace("\n99b\n", "\n\xb99b\n"), ready_s)

    clock = VirtualClock()
    scanner = Scip(LoopbackTransport(Flipping(room()), clock), clock=clock)
    scanner.start()
    assert scanner.read(0.2) == []
    assert scanner.counts.refused > 0
    assert scanner.counts.laser_faults == 0


def test_a_scanner_whose_last_client_died_while_it_asked_for_its_clock_is_started_again():
    clock = VirtualClock()
    line = LoopbackTransport(ScipDevice(room()), clock)
    Scip(line, clock=clock).start()
    line.write(b"TM0\nTM1\nTM")
    next_one = Scip(line, clock=clock)
    assert next_one.start().steps == URG_04LX.steps
    assert collect(next_one, clock, 1.0)


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
