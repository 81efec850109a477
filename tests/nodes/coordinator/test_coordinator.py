import io
import json
import os
import signal
import subprocess
import sys
import threading
import time
from contextlib import contextmanager
from hashlib import sha256
from pathlib import Path

import pytest
from rich.console import Console

from network_calib.errors import InputError
from network_calib.formats.calibration_json import load
from network_calib.synthetic import compare
from nodes.bus import spotcal_pb2 as pb
from nodes.bus.keys import Kind, Verb, parse_observation
from nodes.bus.session import BusOptions, open_bus
from nodes.coordinator.coordinator import Coordinator
from nodes.coordinator.phases import Phase, Press, resumed
from nodes.coordinator.run import DONE, FAILED, INTERRUPTED, plan_of, run_coordinator
from nodes.coordinator.session_folder import STATE, Saved, SessionFolder, choose_session, newest_session
from nodes.coordinator.worker_process import WorkerProcess
from nodes.devices.errors import DeviceError
from nodes.recording.reader import rows
from tests.nodes.bus.buses import routed
from tests.nodes.coordinator.acted_site import KEYS, SITE, acted_site

# Far above what anything here takes on a busy machine, so that only a fault reaches it.
PATIENCE_S = 90.0


@pytest.fixture(autouse=True)
def one_thread(monkeypatch):
    """The spawned interpreters of a busy machine."""
    monkeypatch.setenv("OMP_NUM_THREADS", "1")


def told(message_type, sample):
    return message_type.FromString(sample.payload.to_bytes())


def saved_in(folder):
    saved = folder.load()
    assert saved is not None
    return saved


def newest_in(data):
    newest = newest_session(data)
    assert newest is not None
    return newest


@contextmanager
def listening(endpoint):
    """States and calibrations that are told on the bus."""
    states, results = [], []
    with open_bus(BusOptions(SITE, (endpoint,))) as bus:
        bus.declare_subscriber(
            KEYS.session_state, lambda s: states.append(pb.SessionState.FromString(bytes(s.payload)))
        )
        bus.declare_subscriber(KEYS.calibration, lambda s: results.append(told(pb.Calibration, s)))
        yield bus, states, results


def run(config, *, stop=None, **options):
    out = io.StringIO()
    plan = plan_of(config, session=None, is_auto=True, out=None, **options)
    status = run_coordinator(plan, stop=stop or threading.Event(), console=Console(file=out, width=200))
    return status, plan.folder, out.getvalue()


def recorded(folder):
    """(boot, sequence, payload) of every observation in the recording."""
    found = []
    for row in rows(folder.path):
        key = parse_observation(row.key)
        if key is not None:
            message = {Kind.SPOTS: pb.SpotBatch, Kind.TILTS: pb.TiltSettings}[key.kind].FromString(row.payload)
            found.append((message.header.boot, message.header.sequence, row.payload))
    return sorted(found)


def wait_until(is_so, what):
    end_s = time.monotonic() + PATIENCE_S
    while not is_so():
        assert time.monotonic() < end_s, f"waited in vain: {what}"
        time.sleep(0.02)


def test_a_session_from_the_first_node_to_the_calibration(tmp_path):
    with (
        routed() as endpoint,
        acted_site(tmp_path, endpoint, seconds=5, has_lrf=True) as site,
        listening(endpoint) as (_, states, results),
    ):
        status, folder, told = run(site.config)
        assert status == DONE, told
        # Every row of every journal once, byte by byte.
        assert recorded(folder) == site.rows(folder.path.name)
        assert [node.told[-1] for node in site.nodes] == [Verb.STOP] * 6
        assert Verb.TILTS in site.nodes[-1].told
        wait_until(lambda: bool(results), "the calibration on the bus")
    phases = [state.phase for state in states]
    assert phases == sorted(phases)
    assert set(phases) >= {1, 2, 4, 5}
    calibration = load(folder.calibration)
    errors = compare(calibration.as_cameras(), site.waved.truth.cameras, align="rigid")
    sigma_m = max(float(camera.sigma[3:6].max()) for camera in calibration.cameras)
    assert sigma_m < 5e-3  # the target that waving was ended by
    assert errors.centre_m.max() < 5 * sigma_m
    text = folder.calibration.read_bytes()
    assert results[0].id == sha256(text).hexdigest()[:16]
    assert (results[0].calibration_json, results[0].is_final) == (text, True)
    assert folder.aniposelib.is_file()
    assert folder.report.is_file()
    assert saved_in(folder).phase is Phase.DONE
    with pytest.raises(InputError, match="is done"):
        plan_of(site.config, session=folder.path.name, is_auto=True, out=None)


def test_who_is_missing_is_waited_for_and_named(tmp_path):
    stop = threading.Event()
    with (
        routed() as endpoint,
        acted_site(tmp_path, endpoint, seconds=1, expected=["late"]) as site,
        listening(endpoint) as (bus, states, _),
    ):
        thread = threading.Thread(
            target=lambda: (
                wait_until(lambda: any(s.message == "waiting for late" for s in states), "the missing node's name"),
                stop.set(),
            )
        )
        thread.start()
        status, folder, told = run(site.config, stop=stop)
        thread.join()
        replies = list(bus.get(KEYS.calibration_service, timeout=1.0))
    assert status == INTERRUPTED
    assert "idle: waiting for late" in told
    assert not any(reply.ok for reply in replies)
    assert saved_in(folder).phase is Phase.IDLE
    assert newest_in(site.data)[0] == folder


def test_what_cannot_be_solved_fails_with_the_reason_and_keeps_the_recording(tmp_path):
    with (
        routed() as endpoint,
        acted_site(tmp_path, endpoint, seconds=0.2, max_waving_s=1.5) as site,
    ):
        status, folder, told = run(site.config)
        assert recorded(folder) == site.rows(folder.path.name)
    assert status == FAILED
    assert saved_in(folder).phase is Phase.FAILED
    assert saved_in(folder).warning.splitlines()[0] in told
    assert not folder.calibration.exists()


def test_killed_in_the_middle_it_goes_on_and_nothing_is_lost_or_doubled(tmp_path):
    spotcal = Path(sys.executable).with_name("spotcal")
    command = [str(spotcal), "coordinator", "--auto", "--config", str(tmp_path / "site.toml")]
    with (
        routed() as endpoint,
        acted_site(tmp_path, endpoint, seconds=6) as site,
        listening(endpoint) as (_, states, _),
    ):
        first = subprocess.Popen(command, stdout=subprocess.DEVNULL)
        try:
            wait_until(lambda: any(s.phase == pb.SESSION_PHASE_WAVING for s in states), "waving")
            children = children_of(first.pid)
        finally:
            first.kill()
            first.wait()
        assert children
        wait_until(lambda: not any(is_running(child) for child in children), "the end of the orphans")
        folder, saved = newest_in(site.data)
        assert saved.phase is Phase.WAVING
        done = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE_S, check=False)
        assert done.returncode == DONE, done.stdout + done.stderr
        assert f"session {saved.session} goes on from waving" in done.stdout
        assert recorded(folder) == site.rows(saved.session)
        # A node that is told to start twice learns its background once.
        assert all(node.told.count(Verb.START) == 1 for node in site.nodes)
    assert folder.calibration.is_file()


def test_by_keys_and_stopped_by_one_it_keeps_everything(tmp_path):
    with (
        routed() as endpoint,
        acted_site(tmp_path, endpoint, seconds=3, min_waving_s=60.0) as site,
        open_bus(BusOptions(SITE, (endpoint,))) as bus,
    ):
        plan = plan_of(site.config, session="by-hand", is_auto=False, out=tmp_path / "elsewhere")
        with Coordinator(bus, plan, has_keys=True) as coordinator:
            follow(coordinator, lambda: coordinator.view().message.startswith("all nodes are there"))
            assert coordinator.view().phase is Phase.IDLE
            coordinator.step(Press.ON)
            follow(coordinator, lambda: coordinator.state.phase is Phase.WAVING)
            coordinator.step(Press.RELEARN)
            follow(coordinator, lambda: all(Verb.RELEARN in node.told for node in site.nodes))
            follow(coordinator, lambda: coordinator.state.phase is Phase.WAVING)
            coordinator.step(Press.QUIT)
            assert coordinator.is_over
            wait_until(lambda: all(node.told[-1] is Verb.STOP for node in site.nodes), "STOP at every node")
        kept = set(site.rows("by-hand"))
    folder = SessionFolder(tmp_path / "elsewhere" / "by-hand")
    assert saved_in(folder).was_stopped
    assert set(recorded(folder)) <= kept
    again = plan_of(site.config, session="by-hand", is_auto=False, out=tmp_path / "elsewhere")
    assert again.is_resumed
    assert resumed(again.saved.state, again.rules, now_s=0.0, was_stopped=True).state.phase is Phase.BACKGROUND


def follow(coordinator, is_so):
    def stepped():
        coordinator.step()
        return is_so()

    wait_until(stepped, "what was to come")


def test_without_a_terminal_somebody_has_to_say_auto(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "stdin", io.StringIO())
    config = tmp_path / "site.toml"
    config.write_text('name = "acted"\n')
    plan = plan_of(config, session=None, is_auto=False, out=None)
    with pytest.raises(InputError, match="no terminal"):
        run_coordinator(plan, stop=threading.Event(), console=Console(file=io.StringIO()))


def test_told_to_end_while_no_router_answers(tmp_path):
    config = tmp_path / "site.toml"
    config.write_text('name = "acted"\nrouter = ["tcp/127.0.0.1:1"]\n')
    stop = threading.Event()
    stop.set()
    assert run(config, stop=stop)[0] == INTERRUPTED


class TestSessionFolder:
    SAVED = Saved("one", 100.0, Phase.WAVING, 110.0, "begun without C3", was_stopped=True)

    def test_state_round_trip(self, tmp_path):
        folder = SessionFolder(tmp_path / "one")
        assert folder.load() is None
        folder.save(self.SAVED)
        assert folder.load() == self.SAVED
        assert os.listdir(folder.path) == [STATE]

    @pytest.mark.parametrize(
        "change",
        [{"phase": "dancing"}, {"since_s": "soon"}, {"begun_s": float("nan")}, {"session": "../x"}, {"version": 2}],
    )
    def test_a_state_that_is_none_is_refused(self, tmp_path, change):
        folder = SessionFolder(tmp_path / "one")
        folder.save(self.SAVED)
        path = folder.path / STATE
        path.write_text(json.dumps({**json.loads(path.read_text()), **change}))
        with pytest.raises(InputError, match=r"state\.json is no state"):
            folder.load()
        assert newest_session(tmp_path) is None

    def test_cut_off(self, tmp_path):
        folder = SessionFolder(tmp_path / "one")
        folder.save(self.SAVED)
        path = folder.path / STATE
        path.write_text(path.read_text()[:-10])
        with pytest.raises(InputError):
            folder.load()

    def test_the_newest_goes_on_unless_it_is_finished(self, tmp_path):
        for name, begun_s, phase in [("a", 1.0, Phase.WAVING), ("b", 3.0, Phase.TILTS), ("c", 2.0, Phase.IDLE)]:
            SessionFolder(tmp_path / name).save(Saved(name, begun_s, phase, begun_s))
        folder, saved = choose_session(tmp_path, None, now_s=0.0)
        assert saved is not None
        assert (folder.path.name, saved.phase) == ("b", Phase.TILTS)
        assert choose_session(tmp_path, "a", now_s=0.0)[0].path.name == "a"
        SessionFolder(tmp_path / "b").save(Saved("b", 3.0, Phase.FAILED, 4.0))
        folder, saved = choose_session(tmp_path, None, now_s=1e9)
        assert saved is None
        assert folder.path.name.startswith("2001-09-0")
        with pytest.raises(InputError, match="cannot stand in a key"):
            choose_session(tmp_path, "../x", now_s=0.0)


class TestWorkerProcess:
    def test_is_ended_in_the_middle_of_a_call(self):
        with WorkerProcess() as worker:
            pid = process_id(worker)
            future = worker.submit(time.sleep, 3600)
        assert not is_running(pid)
        assert future.done()
        with pytest.raises(DeviceError):
            worker.submit(time.sleep, 0)

    def test_is_started_again_when_it_was_killed(self):
        with WorkerProcess() as worker:
            pid = process_id(worker)
            os.kill(pid, signal.SIGKILL)
            wait_until(lambda: not is_running(pid), "the end of the process")
            wait_until(lambda: _survives(worker, pid), "another process")


def _survives(worker, pid):
    try:
        return process_id(worker) != pid
    except Exception:  # the pool has not seen the end yet
        return False


def process_id(worker):
    return int(worker.submit(os.readlink, "/proc/self").result(PATIENCE_S))


def children_of(pid):
    with open(f"/proc/{pid}/task/{pid}/children") as file:
        return [int(child) for child in file.read().split()]


def is_running(pid):
    try:
        with open(f"/proc/{pid}/stat") as file:
            return file.read().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False
