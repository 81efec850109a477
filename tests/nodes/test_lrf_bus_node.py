"""An LRF node on the bus: emulated instruments in virtual time, a journal on disk, and a bus that remembers."""

import signal
import subprocess
import sys
import threading
from collections import Counter

import numpy as np
import pytest

from nodes.bus import spotcal_pb2 as pb
from nodes.bus.checks import SCHEMA, parse_observation
from nodes.bus.keys import Keys, Kind, Verb
from nodes.devices.errors import LineLostError
from nodes.emulate import emulated_devices
from nodes.journal import Journal
from nodes.lrf.bus_acquisition import Surroundings
from nodes.lrf.bus_recorder import BusRecorder
from nodes.lrf.bus_runner import LrfRunner
from nodes.lrf.journalled import joined_tilts, read_journalled
from nodes.lrf_node import LrfDevices
from nodes.simulated.emulator_server import EmulatorServer
from nodes.simulated.platform import Waving
from nodes.site.model import LrfDeviceConfig
from tests.nodes.bus.buses import PATIENCE_S, listening, routed, wait_until
from tests.nodes.emulated_platform import emulated

UNIX_ZERO_S = 1_700_000_000.0
TILTS_RAD = tuple(np.radians((12.1, 35.0)).tolist())
CONFIG = LrfDeviceConfig(name="L0", scanner="a", tilt_unit="b", imu="c", plane_sigma_mm=100.0, rest_s=2.0)
KEYS = Keys("s1")


class Bus:
    """Journals as a node does, and holds every message to what the coordinator takes."""

    def __init__(self, journal):
        self.journal = journal
        self.seen = []
        self.on_message = lambda kind, message: None  # noqa: ARG005
        self.n_beats = 0

    @property
    def session(self):
        return self.journal.session

    def beat(self):
        self.n_beats += 1

    def observe(self, kind, message, *, stamp_ns):
        def build(sequence):
            header = message.header
            header.schema, header.node, header.boot = SCHEMA, "n", self.journal.boot
            header.sequence, header.stamp_ns, header.session = sequence, stamp_ns, self.session
            return message.SerializeToString()

        payload = self.journal.append(kind, KEYS.observation("n", kind), build)
        self.seen.append((kind, parse_observation(kind, payload, node="n", now_ns=stamp_ns)))
        self.on_message(kind, message)

    def of(self, kind):
        return [message for seen, message in self.seen if seen is kind]


class Platform:
    """A node on an emulated platform; its time goes on where it was when the node is started again."""

    def __init__(self, path, platform=None, devices=None):
        self.platform = platform or emulated(waving=Waving(away_s=4.5, period_s=6.0))
        self.journal = Journal(path)
        self.bus, self.stop = Bus(self.journal), threading.Event()
        clock = self.platform.clock
        recorder = BusRecorder(self.bus, "L0", offset_s=lambda: UNIX_ZERO_S)
        around = Surroundings(self.journal, self.stop, clock, clock.sleep)
        self.runner = LrfRunner(CONFIG, devices or self.platform.devices, self.bus, recorder, around)
        self.states = []

    def tell(self, verb, **fields):
        return self.runner.command(verb, pb.Command(**fields))

    def run_until(self, is_enough):
        """Run until a message is enough; the first stray status too late ends it in any case."""

        def look(kind, message):
            self.states.append(self.runner.status())
            too_late = self.platform.clock() > 2000
            if too_late or is_enough(kind, message):
                self.stop.set()

        self.bus.on_message = look
        self.stop.clear()
        self.runner.run()
        self.journal.close()


def tilts_told(kind, _message):
    return kind is Kind.TILTS


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """One whole acquisition, asked for by a command."""
    node = Platform(tmp_path_factory.mktemp("lrf") / "journal")
    node.journal.session = "walk"
    assert node.tell(Verb.TILTS, tilts_rad=TILTS_RAD, n_crossings=2).code == "OK"
    node.run_until(tilts_told)
    return node


def test_every_kind_of_observation_is_published(whole):
    counts = Counter(kind for kind, _ in whole.bus.seen)
    assert counts[Kind.LRF_INFO] == 1
    assert counts[Kind.TILT] == 2
    assert counts[Kind.TILTS] == 1
    assert counts[Kind.LRF_SPOT] >= 4
    assert whole.bus.seen[0][0] is Kind.LRF_INFO
    texts = [event.text for event in whole.bus.of(Kind.EVENT)]
    assert texts == [*["moving", "resting", "background", "collecting"] * 2, "done"]


def test_crossings_come_when_their_tilt_ends(whole):
    order = [(kind, message) for kind, message in whole.bus.seen if kind in (Kind.TILT, Kind.LRF_SPOT)]
    settings = [message.setting for _, message in order]
    assert settings == sorted(settings)
    assert next(kind for kind, message in order if message.setting == 1) is Kind.TILT
    assert all(spot.bias_bound_m == 0 for spot in whole.bus.of(Kind.LRF_SPOT))


def test_tilts_are_those_of_the_platform(whole):
    (told,) = whole.bus.of(Kind.TILTS)
    # The unit steps by 0.0514 deg and has 2 steps of play on its approach's side: the angle itself is known to a step.
    assert np.abs(np.array(told.angle_rad) - TILTS_RAD).max() < np.radians(2 * 0.0514)


def test_stamps_are_unix_time(whole):
    (first, *_) = whole.bus.of(Kind.LRF_SCAN)
    assert first.stamp_ns == pytest.approx(1e9 * UNIX_ZERO_S, abs=60e9)
    # The emulated scanner turns in 0.1 s; none is lost on a faultless line.
    scans = [scan.scan for scan in whole.bus.of(Kind.LRF_SCAN)]
    assert (np.diff(scans) == 1).all()


def test_every_sample_of_the_imu_is_in_one_batch(whole):
    batches = whole.bus.of(Kind.IMU)
    samples = [sample for batch in batches for sample in batch.sample]
    assert (np.diff(samples) == 1).all()
    seconds = 1e-9 * (batches[-1].arrival_ns[0] - batches[0].arrival_ns[0])
    assert 5 <= (len(batches) - 1) / seconds <= 10


def test_the_person_is_told_how_far_it_is(whole):
    tilting = [status for status in whole.states if status.n_settings]
    assert {status.n_settings for status in tilting} == {2}
    assert {status.setting for status in tilting} == {0, 1}
    assert {status.state for status in tilting} >= {"moving", "collecting"}
    assert any("of 2 crossings" in status.message for status in tilting)
    assert max(status.n_crossings for status in tilting) >= 2
    assert whole.runner.status().state == "watching"
    assert whole.bus.n_beats == whole.runner.status().n_frames


def test_a_node_that_was_killed_between_two_tilts_finishes_the_rest(whole, tmp_path):
    path = tmp_path / "journal"
    first = Platform(path)
    first.journal.session = "walk"
    first.tell(Verb.TILTS, tilts_rad=TILTS_RAD, n_crossings=2)
    first.run_until(lambda kind, message: kind is Kind.TILT and message.setting == 1)
    n_before = len(first.bus.of(Kind.LRF_SPOT))
    assert n_before >= 2

    second = Platform(path, first.platform)
    assert second.bus.session == "walk"
    second.tell(Verb.TILTS, tilts_rad=TILTS_RAD, n_crossings=2)
    second.run_until(tilts_told)
    assert {spot.setting for spot in second.bus.of(Kind.LRF_SPOT)} == {1}
    assert [(tilt.setting, tilt.tilt_rad) for tilt in second.bus.of(Kind.TILT)] == [(1, TILTS_RAD[1])]
    (told,), (undisturbed,) = second.bus.of(Kind.TILTS), whole.bus.of(Kind.TILTS)
    assert list(told.sources) == ["steps", "gravity"]
    assert "cut off" in told.notes[0]
    # Both are of the same steps; gravity and gyroscope weigh less than those.
    sigma_rad = np.sqrt(np.reshape(told.covariance_rad2, (2, 2)).diagonal())
    assert np.abs(np.array(told.angle_rad) - undisturbed.angle_rad).max() < 4 * sigma_rad.max()
    assert second.runner.status().n_detections == n_before + len(second.bus.of(Kind.LRF_SPOT))


def test_a_tilt_whose_crossings_were_not_all_journalled_is_not_finished(tmp_path):
    with Journal(tmp_path / "journal") as journal:
        journal.session = "walk"

        def append(kind, message):
            key = f"spotcal/@v1/lab/node/lrf/obs/{kind}"
            journal.append(kind, key, lambda _: message.SerializeToString())

        append(Kind.TILT, pb.TiltSample(lrf="L0", setting=0, tilt_rad=0.1, steps=7, has_steps=True))
        append(Kind.LRF_SPOT, pb.LrfSpot(lrf="L0", setting=0, stamp_ns=10**18, n_spots=2))
        assert read_journalled(journal, "walk").rests == []
        append(Kind.LRF_SPOT, pb.LrfSpot(lrf="L0", setting=0, stamp_ns=10**18, n_spots=2))
        assert len(read_journalled(journal, "walk").rests) == 1


def test_what_is_done_is_not_done_again(whole, tmp_path):
    path = tmp_path / "journal"
    path.write_bytes(whole.journal.path.read_bytes())
    node = Platform(path, whole.platform)
    n = 0

    def enough(kind, _message):
        nonlocal n
        n += kind is Kind.LRF_SCAN
        return n >= 3

    node.tell(Verb.TILTS, tilts_rad=TILTS_RAD)
    node.run_until(enough)
    assert not node.bus.of(Kind.TILT)
    assert not node.bus.of(Kind.LRF_SPOT)


def test_outside_of_a_session_nothing_is_published_and_inside_a_scan_a_second(tmp_path):
    node = Platform(tmp_path / "journal")
    scanner, n_read = node.platform.devices.scanner, 0
    read = scanner.read

    def counted(timeout_s):
        nonlocal n_read
        scans = read(timeout_s)
        n_read += len(scans)
        if n_read >= 30:
            node.journal.session = "walk"
        return scans

    scanner.read = counted
    n = 0

    def enough(kind, _message):
        nonlocal n
        n += kind is Kind.LRF_SCAN
        return n == 5

    node.run_until(enough)
    # An IMU sample may come with the reading in which the session began.
    assert next(kind for kind, _ in node.bus.seen if kind is not Kind.IMU) is Kind.LRF_INFO
    stamps_s = [1e-9 * scan.stamp_ns for scan in node.bus.of(Kind.LRF_SCAN)]
    assert (np.diff(stamps_s) > 0.99).all()
    assert node.bus.n_beats >= 30 + 40


def test_commands_that_cannot_be_obeyed_are_answered(tmp_path):
    node = Platform(tmp_path / "journal")
    assert node.tell(Verb.TILTS).code == "FAILED"
    assert node.tell(Verb.NEXT).code == "FAILED"
    assert node.tell(Verb.SNAPSHOT).code == "UNSUPPORTED"
    assert node.runner.status().state == "waiting"
    node.journal.close()


def test_next_ends_a_tilt_and_stop_the_acquisition(tmp_path):
    node = Platform(tmp_path / "journal")
    node.journal.session = "walk"
    node.tell(Verb.TILTS, tilts_rad=TILTS_RAD, n_crossings=50)
    replies = []

    def look(kind, message):
        status = node.runner.status()
        if status.n_crossings >= 2 and status.setting == 0 and not replies:
            replies.append(node.tell(Verb.NEXT).code)
        if kind is Kind.TILT and message.setting == 1:
            replies.append(node.tell(Verb.STOP).code)
        return kind is Kind.EVENT and "ended before" in message.text

    node.run_until(look)
    assert replies == ["OK", "OK"]
    assert 2 <= len(node.bus.of(Kind.LRF_SPOT)) < 50
    assert not node.bus.of(Kind.TILTS)


def test_a_scanner_that_is_unplugged_is_waited_for(tmp_path):
    platform = emulated()
    devices, n_failures = platform.devices, 0
    read = devices.scanner.read

    def failing(timeout_s):
        nonlocal n_failures
        if 5.0 < platform.clock() < 8.0:
            n_failures += 1
            raise LineLostError("a: gone")
        return read(timeout_s)

    devices.scanner.read = failing
    node = Platform(
        tmp_path / "journal", platform, LrfDevices(devices.scanner, devices.tilt, devices.imu, devices.reopen_scanner)
    )
    node.journal.session = "walk"
    node.run_until(lambda kind, message: kind is Kind.EVENT and message.text == "the scanner is back")
    assert n_failures
    assert node.bus.of(Kind.EVENT)[0].text == "a: gone"


def test_the_journal_tells_what_was_finished(whole):
    with Journal(whole.journal.path) as journal:
        held = read_journalled(journal, "walk")
    assert len(held.rests) == 2
    assert held.is_complete
    angles = joined_tilts(held, tilt=whole.platform.devices.tilt, axis_in_imu=np.array([0.0, 1.0, 0.0]))
    assert angles.sources == ("steps", "gravity")


def test_a_process_with_instruments_on_ptys_runs_until_it_is_told_to_end(tmp_path):
    server = EmulatorServer()
    for name, emulator in emulated_devices(seed=1).by_name.items():
        server.add_pty(emulator, tmp_path / name)
    text = f'[lrf]\nname = "L0"\nscanner = "{tmp_path}/urg"\ntilt_unit = "{tmp_path}/ptu"\nimu = "{tmp_path}/mti"\n'
    with Journal(tmp_path / "lrf.journal") as journal:
        journal.session = "walk"
    with server, routed() as endpoint, listening(endpoint, KEYS.observation("lrf", Kind.LRF_SCAN)) as (_, heard):
        head = f'node = "lrf"\nsite = "s1"\nrouter = ["{endpoint}"]\njournal = "lrf.journal"\n'
        (tmp_path / "lrf.toml").write_text(head + text, encoding="utf-8")
        arguments = [sys.executable, "-c", "from nodes.cli import main; main()", "lrf", "--config"]
        with subprocess.Popen([*arguments, str(tmp_path / "lrf.toml")], stderr=subprocess.PIPE, text=True) as process:
            try:
                assert process.stderr is not None
                assert process.stderr.readline() == "LRF node lrf runs\n"
                wait_until(lambda: len(heard.samples) > 1, "scans")
                process.send_signal(signal.SIGTERM)
                _, rest = process.communicate(timeout=PATIENCE_S)
            finally:
                process.kill()
    assert (process.returncode, rest) == (0, "")
    with Journal(tmp_path / "lrf.journal") as journal:
        n_rows = sum(span.last + 1 - span.first for span in journal.spans("walk"))
    assert n_rows >= len(heard.samples) + 1
