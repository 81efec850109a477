"""From recordings to a table: the whole way to a calibration, and everything that may be wrong with recordings."""

import multiprocessing

import cv2
import numpy as np
import pytest

from network_calib.formats.calibration_json import load
from network_calib.formats.source import read_source
from network_calib.formats.table import read_candidates
from network_calib.room_setup import KnownDistance
from network_calib.synthetic import Sighting, room
from nodes import cli
from nodes.camera.camera_detections import CameraDetections
from nodes.camera.detect import write_detected
from nodes.camera.detect_camera import CameraJob, detect_camera
from nodes.camera.lasting_advice import LastingAdvice
from nodes.camera.matching_frames import candidates_of, match_frames
from nodes.config import load_room
from nodes.demo_truth import compare_with_truth
from nodes.detection.spots import Advice, AdviceKind
from nodes.detector_settings import DetectorSettings, NamedSource
from nodes.frames import StampOrigin
from nodes.simulation.video_simulation import VideoPlan, camera_of
from tests.nodes.small_videos import small_camera, small_room, write_small_videos

N_SHORT = 40


@pytest.fixture(scope="module")
def walk(tmp_path_factory):
    """Five videos of the smart room, 320 x 240: room, folder, truth of each frame."""
    folder = tmp_path_factory.mktemp("walk")
    built = small_room("smart_room", n_frames=250)
    return built, folder, write_small_videos(built, folder)


@pytest.fixture(scope="module")
def pair(tmp_path_factory):
    """The stereo pair for 40 frames: folder with A.mkv and B.mkv."""
    folder = tmp_path_factory.mktemp("pair")
    built = small_room("stereo_only", n_frames=N_SHORT)
    write_small_videos(built, folder)
    for name, camera in (("A", "C0"), ("B", "C1")):
        (folder / f"{camera}.mkv").rename(folder / f"{name}.mkv")
    return folder


def seen(candidates, camera):
    return np.unique(candidates.frame[candidates.camera == camera])


def test_five_videos_become_a_calibration(walk, spotcal, tmp_path):
    built, folder, truths = walk
    table, result = tmp_path / "walk.csv", tmp_path / "calibration.json"
    videos = [folder / f"{name}.mkv" for name in built.cameras.names]
    status, out, err = spotcal("detect", *videos, "--out", table)
    assert status == 0, err
    assert "320 x 240" in out
    assert "frame 0 of each must show the same instant" in err
    _check_spots(read_candidates(table), truths)

    # The user adds the one thing that no camera tells.
    room = table.with_suffix(".toml")
    anchor = KnownDistance("C0", "C1", built.baseline_m)
    lines = f'[anchor]\nkind = "distance"\ncameras = ["C0", "C1"]\ndistance_m = {anchor.distance_m}\n'
    room.write_text(lines + room.read_text())
    status, _, err = spotcal("calibrate", table, "--out", result)
    assert status == 0, err
    calibration = load(result)
    # A detector of 0.03 px on clean frames, without compression; 0.2 px is what a calibration lives from.
    assert calibration.quality.holdout.rms_px <= 0.2
    observations = read_source(table).observations
    everything = np.ones(len(observations), dtype=bool)
    comparison = compare_with_truth(calibration, built, Sighting(observations, everything, observations.frame)).cameras
    # Chance that a centre (3 degrees of freedom) is out by more than 3 sigma: 2.9 %, of any of four 11 %; seeds are
    # fixed, so it is drawn once. A sigma that is half too small would show at 6.
    assert comparison.centre_in_sigma.max() <= 3.0
    assert comparison.focal_in_sigma.max() <= 3.5


def _check_spots(candidates, truths):
    """At least 97 of 100 visible spots are found, where they are; next to nothing else is."""
    n_visible = n_found = 0
    for camera, of_camera in enumerate(truths):
        rows = candidates.camera == camera
        best = rows & candidates.is_best
        px = {int(frame): px for frame, px in zip(candidates.frame[best], candidates.px[best], strict=True)}
        for truth in of_camera:
            n_visible += truth.is_visible
            found = px.get(truth.sequence)
            # Half-way out of the picture, or smeared: a pixel.
            n_found += truth.is_visible and found is not None and np.linalg.norm(found - truth.px) < 1.0
    assert n_found >= 0.97 * n_visible
    assert len(candidates) <= 1.03 * n_visible


def test_the_table_is_the_same_however_many_processes_read(pair, spotcal, tmp_path):
    for jobs, out in ((1, "1.csv"), (2, "2.npz")):
        status, _, err = spotcal("detect", pair / "A.mkv", pair / "B.mkv", "--out", tmp_path / out, "--jobs", jobs)
        assert status == 0, err
    for name in ("frame", "camera", "px", "sigma_px", "score"):
        both = [getattr(read_candidates(tmp_path / file), name) for file in ("1.csv", "2.npz")]
        assert np.array_equal(*both), name


def test_names_masks_and_learning_frames_are_obeyed(pair, spotcal, tmp_path):
    black = np.zeros((240, 320), np.uint8)
    (tmp_path / "black.png").write_bytes(cv2.imencode(".png", black)[1].tobytes())
    sources = [f"{name}={pair / file}" for name, file in (("door", "A.mkv"), ("gate", "B.mkv"), ("hall", "A.mkv"))]
    arguments = ("--mask", f"door={tmp_path / 'black.png'}", "--background", "first:10", "--jobs", 1)
    status, _, err = spotcal("detect", *sources, "--out", tmp_path / "t.csv", *arguments)
    assert status == 0, err
    # A camera without any spot cannot be calibrated, and is left out.
    assert "note: door: no spot was found in its 40 frames" in err
    assert [camera.name for camera in load_room(tmp_path / "t.toml").cameras] == ["gate", "hall"]
    candidates = read_candidates(tmp_path / "t.csv")
    assert candidates.camera_names == ("gate", "hall")
    # Frames that were learnt from have no spot.
    assert candidates.frame.min() >= 10


def test_what_the_user_wrote_beside_the_table_stays(tmp_path):
    recordings = [_one_spot(name) for name in ("A", "B")]
    candidates = candidates_of(recordings, match_frames(recordings))
    room = tmp_path / "t.toml"
    assert write_detected(tmp_path / "t.csv", candidates, recordings) == ()
    room.write_text(room.read_text() + "# mine\n")
    (note,) = write_detected(tmp_path / "t.csv", candidates, recordings)
    assert "stays as it is" in note
    assert room.read_text().endswith("# mine\n")
    room.write_text('[[cameras]]\nname = "other"\nsize = [1, 1]\n')
    (note,) = write_detected(tmp_path / "t.csv", candidates, recordings)
    assert "t.toml.bak" in note
    assert 'name = "other"' in (tmp_path / "t.toml.bak").read_text()
    assert [camera.name for camera in load_room(room).cameras] == ["A", "B"]


def _one_spot(name):
    one, zero = np.ones(1), np.zeros(1, dtype=np.int64)
    return CameraDetections(name, name, (640, 480), 25.0, StampOrigin.FILE, zero, zero, zero, np.ones((1, 2)), one, one)


def test_images_are_matched_by_the_numbers_in_their_names(spotcal, tmp_path):
    built = small_room("stereo_only", n_frames=N_SHORT)
    truths = {}
    for index, first in ((0, 0), (1, 5)):
        folder = tmp_path / f"C{index}"
        folder.mkdir()
        camera = small_camera(built, index)
        for k in range(first, 30):
            frame, truths[index, k] = camera.render(k)
            (folder / f"f_{k:04d}.png").write_bytes(cv2.imencode(".png", frame.image)[1].tobytes())
    status, _, err = spotcal("detect", tmp_path / "C0", tmp_path / "C1", "--out", tmp_path / "images.csv", "--jobs", 1)
    assert status == 0, err
    assert "the recordings differ in length (frames: C0 30, C1 25)" in err
    found = read_candidates(tmp_path / "images.csv")
    assert set(found.camera) == {0, 1}
    for camera, frame, px in zip(found.camera, found.frame, found.px, strict=True):
        # A spot moves by some 3 px from frame to frame: one number off would show.
        assert np.linalg.norm(px - truths[camera, frame].px) < 1.0


def test_stamps_of_tables_beside_the_videos_match_the_frames(spotcal, tmp_path):
    built = small_room("stereo_only", n_frames=N_SHORT)
    write_small_videos(built, tmp_path, with_stamps=True, n_frames=N_SHORT)
    # C1's recorder was started 5 frames later, which only its stamps tell, 3 ms off the raster of the other's.
    rows = [line.split(",") for line in (tmp_path / "C1.stamps.csv").read_text().splitlines()]
    late = [",".join((frame, str(int(stamp) + 5 * 40_000_000 + 3_000_000))) for frame, stamp in rows[1:]]
    (tmp_path / "C1.stamps.csv").write_text("\n".join([",".join(rows[0]), *late]))
    status, _, err = spotcal(
        "detect", tmp_path / "C0.mkv", tmp_path / "C1.mkv", "--out", tmp_path / "t.csv", "--jobs", 1
    )
    assert status == 0, err
    assert f"frames are matched by their stamps: {N_SHORT + 5} instants" in err
    candidates = read_candidates(tmp_path / "t.csv")
    assert candidates.stamp_ns is not None
    assert seen(candidates, 1).max() == N_SHORT + 4
    offset = candidates.stamp_ns - candidates.frame * 40_000_000
    assert set(offset[candidates.camera == 1] - offset[candidates.camera == 0].min()) == {3_000_000}


def test_interrupting_leaves_nothing_behind(pair, spotcal, tmp_path, monkeypatch):
    shown = []

    def show(_bars, camera, n_passed, *, is_done):
        shown.append((camera, n_passed, is_done))
        if any(n_passed):
            raise KeyboardInterrupt

    monkeypatch.setattr("nodes.camera.detect.Bars.show", show)
    status, _, _ = spotcal("detect", pair / "A.mkv", pair / "B.mkv", "--out", tmp_path / "t.csv", "--jobs", 1)
    assert status == cli.EXIT_INTERRUPTED
    assert shown
    assert list(tmp_path.iterdir()) == []
    assert multiprocessing.active_children() == []


@pytest.fixture
def faulty(tmp_path):
    """Recordings with one fault each, in a folder of their own."""
    folder = tmp_path / "faulty"
    folder.mkdir()
    (folder / "text.mp4").write_text("no video at all")
    (folder / "nothing.mp4").write_bytes(b"")
    (folder / "empty").mkdir()
    (folder / "dark").mkdir()
    (folder / "sizes").mkdir()
    for k in range(30):
        small = cv2.imencode(".png", np.full((240, 320), 9, np.uint8))[1].tobytes()
        large = cv2.imencode(".png", np.full((480, 640), 9, np.uint8))[1].tobytes()
        (folder / "dark" / f"{k:03d}.png").write_bytes(small)
        (folder / "sizes" / f"{k:03d}.png").write_bytes(small if k < 20 else large)
    return folder


@pytest.mark.parametrize(
    ("first", "second", "message"),
    [
        ("PAIR/A.mkv", "text.mp4", "text.mp4"),
        ("PAIR/A.mkv", "nothing.mp4", "nothing.mp4"),
        ("PAIR/A.mkv", "empty", "empty"),
        ("PAIR/A.mkv", "absent.mp4", "absent.mp4 does not exist"),
        ("PAIR/A.mkv", "sizes", "640 x 480"),
        ("dark", "C1=dark", "no spot was found: dark in 30 frames, C1 in 30 frames"),
        ("PAIR/A.mkv", "dark", "a spot was found in A alone, a network needs two cameras or more"),
    ],
)
def test_a_recording_at_fault_is_one_message(faulty, pair, spotcal, tmp_path, monkeypatch, first, second, message):
    monkeypatch.chdir(faulty)
    before = sorted(tmp_path.rglob("*"))
    status, out, err = spotcal(
        "detect", first.replace("PAIR", str(pair)), second, "--out", tmp_path / "t.csv", "--jobs", 1
    )
    assert status == 2
    assert message in err
    assert "Traceback" not in out + err
    assert sorted(tmp_path.rglob("*")) == before


def test_a_cut_recording_is_used_as_far_as_it_goes(pair, spotcal, tmp_path):
    whole = (pair / "A.mkv").read_bytes()
    (tmp_path / "A.mkv").write_bytes(whole[: len(whole) * 2 // 3])
    status, _, err = spotcal("detect", tmp_path / "A.mkv", pair / "B.mkv", "--out", tmp_path / "t.csv", "--jobs", 1)
    assert status == 0, err
    assert "A.mkv is cut and ends early" in err
    assert "the recordings differ in length" in err


def test_the_way_is_told_to_whoever_waits(pair):
    told = []
    job = CameraJob(NamedSource("A", str(pair / "A.mkv")), DetectorSettings())
    detections = detect_camera(job, lambda which, count: told.append((which, count)))
    assert told == [(which, count) for which in (0, 1) for count in range(1, N_SHORT + 1)]
    assert (detections.n_frames, detections.size_px, detections.rate_hz) == (N_SHORT, (320, 240), 25.0)
    assert (np.diff(detections.picture) >= 0).all()


def test_spots_of_unknown_place_are_left_out(pair, monkeypatch):
    job = CameraJob(NamedSource("A", str(pair / "A.mkv")), DetectorSettings())
    every = detect_camera(job, lambda *_: None)
    limit_px = float(np.median(every.sigma_px))
    monkeypatch.setattr("nodes.camera.detect_camera.MAX_SIGMA_PX", limit_px)
    kept = detect_camera(job, lambda *_: None)
    assert np.array_equal(kept.px, every.px[every.sigma_px <= limit_px])
    assert 0 < len(kept.px) < len(every.px)


def test_jpeg_images_of_a_dark_room_keep_the_spots(tmp_path):
    # One small green spot, somebody who carries it through a dark room, and what JPEG does to both.
    n_frames = 80
    built = room("smart_room", rng=np.random.default_rng(4), n_frames=n_frames)
    camera = camera_of(built, 2, VideoPlan("images", "dark_room", 4, n_frames))
    truths = []
    for k in range(n_frames):
        frame, truth = camera.render(k)
        truths.append(truth)
        for kind, quality in (("png", []), ("jpg", [cv2.IMWRITE_JPEG_QUALITY, 90])):
            (tmp_path / kind).mkdir(exist_ok=True)
            coded = cv2.imencode(f".{kind}", frame.image, quality)[1]
            (tmp_path / kind / f"{k:04d}.{kind}").write_bytes(coded.tobytes())
    shares = []
    for kind in ("png", "jpg"):
        found = detect_camera(CameraJob(NamedSource("C2", str(tmp_path / kind)), DetectorSettings()), lambda *_: None)
        near = {
            int(picture)
            for picture, px in zip(found.picture, found.px, strict=True)
            if np.linalg.norm(px - truths[picture].px) < 2.0
        }
        visible = {truth.sequence for truth in truths if truth.is_visible}
        assert len(visible) > 60
        shares.append(len(near & visible) / len(visible))
        # False detections: next to none in the dark.
        assert len(found.picture) - len(near) <= 0.02 * n_frames
    clean, jpeg = shares
    assert jpeg >= 0.95
    assert jpeg >= clean - 1 / 60  # as good as on clean frames, to one spot


def test_only_lasting_advice_is_passed_on():
    lasting, passing = Advice(AdviceKind.SATURATED, "first"), Advice(AdviceKind.NOTHING_SEEN, "gone")
    advice = LastingAdvice()
    advice.note((lasting,))
    advice.note((lasting, passing))
    advice.note((Advice(AdviceKind.SATURATED, "latest"),))
    assert advice.messages() == ("latest",)
