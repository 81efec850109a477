"""A camera node on a real bus, with recordings for cameras; and processes of it that are killed and told to end."""

import io
import signal
import subprocess
import sys
import threading
import time
from collections import Counter
from contextlib import contextmanager

import cv2
import numpy as np
import pytest
from rich.console import Console

from nodes import camera_node
from nodes.bus import spotcal_pb2 as pb
from nodes.bus.checks import SCHEMA, parse_observation, parse_status
from nodes.bus.client import send_command
from nodes.bus.keys import Kind, Verb
from nodes.camera.feeds import LiveFeed
from nodes.camera_node import run_camera_node
from nodes.detection.spots import DetectorOptions
from nodes.devices.cameras.open_source import open_source
from nodes.devices.errors import SourceError
from nodes.frames import Frame, PixelFormat, SourceCounts, StampOrigin
from nodes.journal import Journal
from nodes.site.load import load_camera_node
from nodes.spot_detector import SpotDetector
from tests.nodes.bus.buses import KEYS, PATIENCE_S, SITE, free_endpoint, listening, routed, wait_until
from tests.nodes.detection.small_scene import Scene, light

N_LEARNING, N_FRAMES = 12, 40
SPOTCAL = [sys.executable, "-c", "from nodes.cli import main; main()"]


@pytest.fixture(scope="module")
def pictures(tmp_path_factory):
    """The empty room, then the spot on its way: 25 pictures a second."""
    folder = tmp_path_factory.mktemp("pictures")
    scene = Scene()
    for k in range(N_FRAMES):
        lights = [] if k < N_LEARNING else [light(40 + 5 * k, 60 + 3 * k)]
        cv2.imwrite(str(folder / f"{k:04d}.png"), scene.frame(*lights).image)
    return folder


@pytest.fixture(scope="module")
def undisturbed(pictures):
    """Sequences of the watched frames, with the places of their spots."""
    detector = SpotDetector(DetectorOptions(n_learning_frames=N_LEARNING))
    with open_source(pictures) as source:
        found = [detector.process(frame) for frame in source]
    return {one.sequence: [tuple(spot.px.tolist()) for spot in one.spots] for one in found[N_LEARNING:]}


def written(folder, pictures, endpoint, n_cameras=1):
    """A configuration file."""
    text = f'node = "n1"\nsite = "{SITE}"\nrouter = ["{endpoint}"]\njournal = "n1.journal"\n'
    for k in range(n_cameras):
        text += f'[[cameras]]\nname = "C{k}"\nsource = "{pictures}"\nn_learning = {N_LEARNING}\n'
    path = folder / "camera.toml"
    path.write_text(text, encoding="utf-8")
    return path


def command(session="", **fields):
    out = pb.Command(**fields)
    out.header.schema, out.header.node, out.header.boot = SCHEMA, "coordinator", b"0" * 16
    out.header.stamp_ns, out.header.session = time.time_ns(), session
    return out


@contextmanager
def running(config):
    """The node in a thread; gives what it returned at the end."""
    stop, out = threading.Event(), []
    console = Console(file=io.StringIO())
    thread = threading.Thread(target=lambda: out.append(run_camera_node(config, stop=stop, console=console)))
    thread.start()
    try:
        yield out
    finally:
        stop.set()
        thread.join(PATIENCE_S)
        assert not thread.is_alive()


@contextmanager
def process_of(path):
    """The node as a process that runs, and surely ends."""
    arguments = [*SPOTCAL, "camera", "--config", str(path)]
    with subprocess.Popen(arguments, stderr=subprocess.PIPE, text=True) as process:
        try:
            assert process.stderr is not None
            assert process.stderr.readline() == "camera node n1 runs\n"
            yield process
        finally:
            process.kill()


def told(batches):
    """By camera: sequences of frames with the places of their spots; how often each frame was told of."""
    spots, counts = {}, {}
    for batch in batches:
        by_frame = spots.setdefault(batch.camera, {})
        counts.setdefault(batch.camera, Counter()).update(batch.frame_sequence)
        for k, sequence in enumerate(batch.frame_sequence):
            places = zip(batch.spot_frame, batch.x_px, batch.y_px, strict=True)
            by_frame[sequence] = [(x, y) for frame, x, y in places if frame == k]
    return spots, counts


def n_frames(batches):
    return sum(len(batch.frame_sequence) for batch in batches)


def journalled(path, session="walk"):
    """All batches that a journal holds of a session."""
    with Journal(path) as journal:
        boots = dict.fromkeys(span.boot for span in journal.spans(session))
        rows = [row for boot in boots for row in journal.rows(session, boot, 0, 2**40, max_bytes=2**40)]
    return [pb.SpotBatch.FromString(payload) for _, key, payload in rows if key.endswith("/spots")]


def test_a_session_from_its_start_to_its_end(pictures, undisturbed, tmp_path):
    with routed() as endpoint:
        config = load_camera_node(written(tmp_path, pictures, endpoint, n_cameras=2))
        with listening(endpoint, KEYS.observation("n1", Kind.SPOTS)) as (session, heard), running(config) as ended:

            def ask(verb, **fields):
                return send_command(session, KEYS, "n1", verb, command(**fields), timeout_s=PATIENCE_S)

            statuses = []
            subscriber = session.declare_subscriber(KEYS.status("n1"), lambda s: statuses.append(s.payload.to_bytes()))
            assert ask(Verb.RELEARN).code == "FAILED"
            assert ask(Verb.EXPOSURE, number=0.01).code == "UNSUPPORTED"
            assert ask(Verb.SNAPSHOT, number=2).code == "FAILED"
            assert not heard.samples
            assert ask(Verb.START, session="walk").code == "OK"
            assert ask(Verb.START, session="walk").code == "OK"
            picture = ask(Verb.SNAPSHOT, number=1)
            assert picture.code == "OK"
            decoded = cv2.imdecode(np.frombuffer(picture.content, np.uint8), cv2.IMREAD_COLOR)
            assert decoded is not None
            assert decoded.shape == (240, 320, 3)
            last = max(undisturbed)

            def is_done():
                spots, _ = told(heard.messages(pb.SpotBatch))
                return all(last in spots.get(camera, {}) for camera in ("C0", "C1"))

            wait_until(is_done, "all frames")
            wait_until(lambda: len(statuses) > 1, "a second status")
            assert ask(Verb.STOP, session="walk").code == "OK"
            subscriber.undeclare()
    assert ended == [True]
    spots, counts = told(heard.messages(pb.SpotBatch))
    assert spots == {"C0": undisturbed, "C1": undisturbed}
    assert {n for camera in counts.values() for n in camera.values()} == {1}
    for _, payload, _ in heard.samples:
        parse_observation(Kind.SPOTS, payload, node="n1", now_ns=time.time_ns())
    seen = [parse_status(payload, node="n1", now_ns=time.time_ns()) for payload in statuses]
    assert {status.state for status in seen} <= {"waiting", "learning", "watching"}
    assert seen[-1].role == "camera"


def test_without_a_router_everything_is_journalled(pictures, undisturbed, tmp_path, monkeypatch):
    config = load_camera_node(written(tmp_path, pictures, free_endpoint()))
    with Journal(tmp_path / "n1.journal") as journal:
        journal.session = "walk"
    seen, observe = set(), camera_node.BusNode.observe

    def noted(bus, kind, message, *, stamp_ns):
        observe(bus, kind, message, stamp_ns=stamp_ns)
        seen.update(message.frame_sequence)

    monkeypatch.setattr(camera_node.BusNode, "observe", noted)
    with running(config) as ended:
        wait_until(lambda: max(undisturbed) in seen, "the last frame")
    spots, _ = told(journalled(tmp_path / "n1.journal"))
    assert spots == {"C0": undisturbed}
    assert ended == [True]


def test_killed_again_and_again_no_frame_is_missing_or_doubled(pictures, undisturbed, tmp_path):
    path, journal = tmp_path, tmp_path
    for seconds in (0.9, 1.1, 1.3, 1.5, 2.0, 3.0):
        folder = tmp_path / f"killed after {seconds} s"
        folder.mkdir()
        path, journal = written(folder, pictures, free_endpoint()), folder / "n1.journal"
        with Journal(journal) as held:
            held.session = "walk"
        # The recording lasts 1.6 s, of which the first 0.5 s are learnt from: killed in between, on most machines.
        with process_of(path) as process:
            time.sleep(seconds)
            process.kill()
        if 0 < n_frames(journalled(journal)) < len(undisturbed):
            break
    with process_of(path) as process:
        time.sleep(0.2)
        process.kill()
    # Whoever is slow is given longer and longer; each process begins behind what the journal holds.
    batches = []
    for seconds in (1, 2, 4, 8):
        with process_of(path) as process:
            time.sleep(seconds)
            process.send_signal(signal.SIGTERM)
            _, rest = process.communicate(timeout=PATIENCE_S)
        assert (process.returncode, rest) == (0, "")
        batches = journalled(journal)
        if n_frames(batches) >= len(undisturbed):
            break
    spots, counts = told(batches)
    assert spots == {"C0": undisturbed}
    assert set(counts["C0"].values()) == {1}
    assert len({batch.header.boot for batch in batches}) > 1


class Dying:
    """Three frames, then the camera is gone."""

    name, size_px, rate_hz, counts = "dying", (32, 24), 30.0, SourceCounts()

    def __iter__(self):
        for k in range(3):
            yield Frame(k, time.time_ns(), StampOrigin.DRIVER, np.zeros((24, 32), np.uint8), PixelFormat.MONO)
        raise SourceError("rtsp://***@host: away for more than 600 s")

    def close(self):
        pass

    def __enter__(self):
        return self

    def __exit__(self, kind, error, trace):
        self.close()


def test_a_camera_that_fails_for_good_ends_the_node_and_the_bus_is_told(pictures, tmp_path, monkeypatch):
    monkeypatch.setattr(camera_node, "open_feed", lambda camera, mark: LiveFeed(Dying()))  # noqa: ARG005
    # Long enough for the node to find its router first.
    monkeypatch.setattr(camera_node, "TELLING_S", PATIENCE_S)
    with routed() as endpoint:
        config = load_camera_node(written(tmp_path, pictures, endpoint))
        with listening(endpoint, KEYS.status("n1")) as (_, heard), running(config) as ended:
            wait_until(lambda: any(s.state == "fault" for s in heard.messages(pb.NodeStatus)), "the fault")
    (status, *_) = [status for status in heard.messages(pb.NodeStatus) if status.state == "fault"]
    assert "away for more than 600 s" in status.message
    assert ended == [False]


def test_a_source_that_is_not_there_is_said_at_once(pictures, tmp_path, spotcal):
    path = written(tmp_path, pictures, free_endpoint())
    path.write_text(path.read_text().replace(str(pictures), "/no/such/folder"))
    status, _, err = spotcal("camera", "--config", str(path))
    assert status == 2
    assert "/no/such/folder does not exist" in err
