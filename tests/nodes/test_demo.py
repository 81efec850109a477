"""The demonstration's parts; the whole takes minutes and is run by `scripts/demo`."""

import io
import signal
import sys
import time
from dataclasses import replace

import numpy as np
import pytest
from rich.console import Console

from lrf_stereo.scanner import TiltingScanner
from network_calib.errors import InputError
from network_calib.result import CalibratedLrf
from network_calib.synthetic import Sighting, observe, room
from nodes.bus import spotcal_pb2 as pb
from nodes.demo import tilts_of
from nodes.demo_files import write_demo
from nodes.demo_person import REACTION_S, WAVE_S, DemoPerson
from nodes.demo_processes import Children
from nodes.demo_truth import compare_cameras, compare_lrf, compare_with_truth, lrf_truth_table, truth_table, verdict_of
from nodes.devices.errors import DeviceError
from nodes.simulated.smart_room import World, write_world
from nodes.simulated.smart_room_events import LEAD_S, EventFile, Move, Rest, Stop, Wave
from nodes.simulated.smart_room_geometry import SmartRoom
from nodes.simulation.lrf_simulation import true_lrf
from nodes.simulation.spots_simulation import truth_calibration
from nodes.site.load import load_camera_node, load_lrf_node, load_site

TILTS_RAD = tuple(np.radians([2.0, 12.0, 23.0]).tolist())
START_S = 1.8e9


@pytest.fixture(scope="module")
def sighted():
    rng = np.random.default_rng(2)
    built = room("smart_room", rng=rng, n_frames=100)
    return built, observe(built, rng=rng, sigma_px=0.2, missing=0.2, false_detections=0.1)


def in_first_frame(built, sighting: Sighting):
    truth = truth_calibration(built, sighting, noise_px=0.2, seed=0)
    to_world = truth.cameras[0].cam_from_world.inv()
    cameras = tuple(replace(c, cam_from_world=c.cam_from_world * to_world) for c in truth.cameras)
    return replace(truth, cameras=cameras)


def with_focal_error(truth, *, error_px, sigma_px):
    camera = truth.cameras[2]
    covariance = np.diag([0.0] * 6 + [sigma_px**2] + [0.0] * 7)
    wrong = replace(camera, intrinsics=camera.intrinsics + np.eye(8)[0] * error_px, covariance=covariance)
    return replace(truth, cameras=(*truth.cameras[:2], wrong, *truth.cameras[3:]))


def test_comparison_finds_no_error_in_the_truth_and_flags_a_wrong_focal_length(sighted):
    built, sighting = sighted
    truth = in_first_frame(built, sighting)
    comparison = compare_with_truth(truth, built, sighting)
    # Five metres in double precision, through a few products.
    assert comparison.cameras.errors.centre_m.max() < 1e-12
    assert comparison.cameras.is_as_predicted
    wrong = compare_cameras(with_focal_error(truth, error_px=4.0, sigma_px=0.3), built.cameras)
    # Half of 4 px (the mean of x and y) over 0.3 px.
    assert wrong.focal_in_sigma[2] == pytest.approx(2 / 0.3, rel=1e-9)
    assert not wrong.is_as_predicted


def in_frame_of_first(scanner, cameras) -> TiltingScanner:
    """The scanner in the first camera's frame, in which calibrations are."""
    cam_from_world = cameras.cam_from_world[0]
    return TiltingScanner(
        world_from_lrf=cam_from_world * scanner.world_from_lrf,
        axis_direction_in_world=cam_from_world.rotation.apply(scanner.axis_direction_in_world),
        axis_point_in_world=cam_from_world.apply(scanner.axis_point_in_world),
        reference_tilt_rad=scanner.reference_tilt_rad,
    )


@pytest.fixture(scope="module")
def calibrated(sighted):
    """The truth of the smart room as a calibration, with its LRF."""
    smart = SmartRoom.of(1)
    built = replace(sighted[0], cameras=smart.cameras)
    truth = in_first_frame(built, sighted[1])
    lrf = true_lrf(in_frame_of_first(smart.scanner, smart.cameras), np.array(TILTS_RAD))
    return smart, replace(truth, lrfs=(lrf,))


def compared(smart, calibration, lrf: CalibratedLrf):
    return compare_lrf(calibration, lrf, smart.cameras, smart.scanner, TILTS_RAD)


def test_true_lrf_projects_to_the_true_pixels(calibrated):
    smart, calibration = calibrated
    comparison = compared(smart, calibration, calibration.lrfs[0])
    assert (comparison.n_points > 200).all()
    # Pixels of metres in double precision, some 500 px a radian.
    assert comparison.p95_px.max() < 1e-8


def test_lrf_that_is_moved_by_a_centimetre_is_off_by_its_pixels(calibrated):
    smart, calibration = calibrated
    lrf = calibration.lrfs[0]
    from scipy.spatial.transform import RigidTransform

    moved = RigidTransform.from_translation(np.array([0.01, 0.0, 0.0]))
    wrong = replace(
        lrf,
        world_from_lrf=moved * lrf.world_from_lrf,
        axis_point_in_world=lrf.axis_point_in_world + np.array([0.01, 0.0, 0.0]),
    )
    comparison = compared(smart, calibration, wrong)
    # 1 cm at 2 to 6 m before lenses of some 450 px: 0.75 to 2.2 px, less where it is along the line of sight.
    assert ((comparison.median_px > 0.4) & (comparison.median_px < 2.5)).all()
    verdict = verdict_of(calibration, compare_cameras(calibration, smart.cameras), [comparison])
    assert any("points of L0 at 12.0" in one for one in verdict.missed)


def test_verdict_is_good_of_the_truth_and_names_what_is_missed(calibrated):
    smart, calibration = calibrated
    comparison = compared(smart, calibration, calibration.lrfs[0])
    good = replace(calibration.quality, holdout=replace(calibration.quality.holdout, rms_px=0.1))
    calibration = replace(calibration, quality=good)
    cameras = compare_cameras(calibration, smart.cameras)
    assert verdict_of(calibration, cameras, [comparison]).missed == ()
    assert verdict_of(calibration, cameras, []).missed == ("no LRF was calibrated",)
    bad = replace(good, holdout=replace(good.holdout, rms_px=0.25))
    (missed,) = verdict_of(replace(calibration, quality=bad), cameras, [comparison]).missed
    assert "0.250 px" in missed
    unknown = replace(good, holdout=replace(good.holdout, rms_px=float("nan")))
    assert verdict_of(replace(calibration, quality=unknown), cameras, [comparison]).missed


def test_tables_show_every_camera_and_tilt(calibrated):
    smart, calibration = calibrated
    file = io.StringIO()
    console = Console(file=file, width=120)
    console.print(truth_table(compare_cameras(calibration, smart.cameras)))
    console.print(lrf_truth_table([compared(smart, calibration, calibration.lrfs[0])]))
    for told in (*smart.cameras.names, "2.00", "12.00", "23.00"):
        assert told in file.getvalue()


def test_tilts_are_those_at_which_the_unit_stayed(tmp_path):
    events = EventFile(tmp_path)
    for event in (Rest(1.0, 0.19), Move(1.02), Rest(1.3, 0.21), Move(20.0), Rest(21.0, 0.4)):
        events.append(event)
    assert tilts_of(tmp_path) == (0.21, 0.4)


def test_configuration_files_are_valid_and_a_second_demo_takes_the_folder(tmp_path):
    for _ in range(2):
        files = write_demo(tmp_path / "out", seed=1, rate_hz=20.0)
        site = load_site(files.site)
        cameras = [load_camera_node(path) for path in files.cameras.values()]
        lrf = load_lrf_node(files.lrf)
        assert {node.name for node in site.nodes} == {*files.cameras, lrf.node}
        assert [camera.name for camera in site.cameras] == [node.cameras[0].name for node in cameras]
        assert {tuple(each.router) for each in (site, lrf, *cameras)} == {(files.endpoint,)}
        (files.session / "left").mkdir(parents=True)
    assert not (write_demo(tmp_path / "out", seed=1, rate_hz=20.0).session).exists()


def test_folder_of_somebody_else_is_refused(tmp_path):
    (tmp_path / "sessions").mkdir()
    with pytest.raises(InputError, match="no demonstration made"):
        write_demo(tmp_path, seed=1, rate_hz=20.0)
    assert (tmp_path / "sessions").is_dir()


def told(phase):
    return pb.SessionState(phase=phase).SerializeToString()


def test_person_waves_when_told_again_when_it_was_not_enough_and_stops(tmp_path):
    write_world(tmp_path, World(1, START_S, 20.0))
    now = [START_S + 3.01]
    person, events = DemoPerson(tmp_path, clock_s=lambda: now[0]), EventFile(tmp_path)
    person.step()
    person.hear(b"\xff\xff no message")
    person.hear(told(pb.SESSION_PHASE_BACKGROUND))
    person.step()
    assert events.new() == []
    person.hear(told(pb.SESSION_PHASE_WAVING))
    person.step()
    person.step()
    (wave,) = events.new()
    assert isinstance(wave, Wave)
    # On the grid of 50 ms, at the next frame after the reaction; the epoch's seconds are known to 2.4e-7.
    assert wave.begin_s == pytest.approx(START_S + 4.25, abs=1e-6)
    assert wave.begin_s - now[0] >= REACTION_S > LEAD_S
    now[0] = wave.begin_s + WAVE_S
    person.step()
    (again,) = events.new()
    assert isinstance(again, Wave)
    now[0] = again.begin_s + 5.0
    person.hear(told(pb.SESSION_PHASE_TILTS))
    person.step()
    person.step()
    assert events.new() == [Stop(now[0] + LEAD_S)]


PRINTING = "import time; print('I am here', flush=True); time.sleep(100)"
STUBBORN = (
    "import signal, subprocess, sys, time; signal.signal(signal.SIGTERM, signal.SIG_IGN);"
    "child = subprocess.Popen([sys.executable, '-c', 'import time; time.sleep(100)']); print(child.pid, flush=True);"
    "time.sleep(100)"
)


def wait_for(is_there):
    end_s = time.monotonic() + 20
    while not is_there():
        assert time.monotonic() < end_s
        time.sleep(0.02)


def test_children_are_ended_and_their_lines_told(tmp_path):
    lines = []
    with Children(tmp_path) as children:
        child = children.start("speaker", (sys.executable, "-c", PRINTING), echo=lines.append)
        wait_for(lambda: lines)
        children.check()
    assert lines == ["I am here"]
    assert child.tail() == "I am here"
    assert child.process.returncode == -signal.SIGTERM


def test_child_that_dies_is_told_with_its_last_words(tmp_path):
    with Children(tmp_path) as children:
        child = children.start("speaker", (sys.executable, "-c", "print('farewell'); raise SystemExit(3)"))
        child.process.wait(timeout=20)
        children.check(but=child)
        with pytest.raises(DeviceError, match=r"speaker ended by itself with status 3(.|\n)*farewell"):
            children.check()


def test_child_that_does_not_listen_is_killed_with_its_own_children(tmp_path, monkeypatch):
    monkeypatch.setattr("nodes.demo_processes.ENDING_S", 0.3)
    with Children(tmp_path) as children:
        child = children.start("stubborn", (sys.executable, "-c", STUBBORN))
        wait_for(lambda: child.log.stat().st_size)
        grandchild = int(child.tail())
    assert child.process.returncode == -signal.SIGKILL
    # It has ended, or waits for its new parent to take note of it.
    path = f"/proc/{grandchild}/stat"
    wait_for(lambda: _is_gone(path))


def _is_gone(path):
    try:
        with open(path, encoding="ascii") as file:
            return file.read().rsplit(")", 1)[1].split()[0] == "Z"
    except FileNotFoundError:
        return True
