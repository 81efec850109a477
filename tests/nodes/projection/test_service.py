"""Whatever comes is answered or refused, a calibration is swapped between two requests, the program ends well."""

import signal
import subprocess
import sys
import threading
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from lrf_stereo.noise import LrfNoise
from network_calib.errors import InputError
from nodes.bus import spotcal_pb2 as pb
from nodes.bus.session import open_bus
from nodes.coordinator.announcer import Announcer
from nodes.projection import Calibration, ProjectionClient
from nodes.projection.current import Current
from nodes.projection.desk import Desk
from nodes.projection.errors import ErrorCode, ProjectionError
from nodes.projection.points import CovarianceOf, LrfPoints, WorldPoints
from nodes.projection.questions import QUERY
from nodes.projection.requests import (
    BearingsAsked,
    CameraPixels,
    FloorAsked,
    ProjectAsked,
    RaysAsked,
    TriangulateAsked,
)
from nodes.projection.services import Service
from nodes.projection.wire import encode
from nodes.projection.wire_answers import bearings_of, projected_of
from tests.nodes.bus.buses import KEYS, options_of, routed, wait_until
from tests.nodes.projection.served import SITE, TILT_RAD, beams, calibration_of, serving, write_calibration

PATIENCE_S = 20.0
STAMP_NS = 1_700_000_000 * 10**9
CODES = set(ErrorCode) - {ErrorCode.FAILED}
RATE_RAD_S = 0.05


class Turning:
    """Tilts of an LRF that turns evenly from the stamp on, known to a milliradian; of others nothing is known."""

    def at(self, lrf, stamp_ns):
        if lrf != "L0":
            raise ProjectionError(ErrorCode.NO_TILT, f"no tilt of {lrf}")
        since_s = (np.asarray(stamp_ns) - STAMP_NS) / 1e9
        return np.where(since_s < 0, np.nan, TILT_RAD + RATE_RAD_S * since_s), np.full(len(since_s), 1e-3)


@pytest.fixture(scope="module")
def calibration():
    return Calibration.of(calibration_of(1), "a")


@pytest.fixture
def desk(calibration):
    return Desk(lambda: calibration, Turning())


def code_of(told):
    assert told.is_error
    return pb.ErrorReply.FromString(told.payload).code


def asked_of_all_kinds():
    px = np.array([[100.0, 120.0], [np.nan, 3.0]])
    few = replace(beams(), range_m=np.full(5, 2.0), bearing_rad=np.linspace(-1, 1, 5))
    return [
        (Service.PROJECT, ProjectAsked(few, ("C0", "C1"), CovarianceOf(), "a")),
        (Service.PROJECT, ProjectAsked(replace(few, tilt_rad=None, stamp_ns=STAMP_NS))),
        (Service.PROJECT, ProjectAsked(LrfPoints("L0", np.array([[2.0, 0.1, 0.0]]), TILT_RAD))),
        (Service.PROJECT, ProjectAsked(WorldPoints(np.ones((4, 3))), None, CovarianceOf(point_sigma_m=0.1))),
        (Service.LOCATE, RaysAsked("C0", px)),
        (Service.LOCATE, FloorAsked("C0", px, 0.5, (np.array([0.0, 0.0, 1.0]), 0.1))),
        (Service.LOCATE, TriangulateAsked({"C0": px, "C1": px}, 0.5, "a")),
        (Service.BEARINGS, BearingsAsked("L0", np.ones((4, 3)), TILT_RAD)),
        (Service.BEARINGS, BearingsAsked("L0", CameraPixels("C0", px), None, STAMP_NS)),
    ]


def test_every_kind_of_request_is_answered(desk):
    for service, asked in asked_of_all_kinds():
        told = desk.answer(service, encode(asked))
        assert not told.is_error, pb.ErrorReply.FromString(told.payload)


def test_ten_thousand_mutated_requests_get_an_answer_or_a_refusal_each(desk):
    """None of them may be the service's own fault, which would be FAILED."""
    rng = np.random.default_rng(4)
    good = [(service, encode(asked)) for service, asked in asked_of_all_kinds()]
    refused, n_answered = {}, 0
    for _ in range(10_000):
        service, payload = good[rng.integers(len(good))]
        told = desk.answer(service, mutated(payload, rng))
        if told.is_error:
            error = pb.ErrorReply.FromString(told.payload)
            refused[error.code] = refused.get(error.code, 0) + 1
            assert error.code in CODES, error
            assert error.message
        else:
            n_answered += 1
    # The mutations reach past the parser, and into every kind of refusal that a request can cause.
    assert n_answered > 1000
    assert set(refused) == CODES - {ErrorCode.NO_CALIBRATION, ErrorCode.TOO_LARGE}


def mutated(payload, rng):
    """Bytes changed, cut away, put in or repeated; or numbers of the columns that are no measurements."""
    data = bytearray(payload)
    match rng.integers(5):
        case 0:
            for at in rng.integers(len(data), size=rng.integers(1, 4)):
                data[at] = rng.integers(256)
        case 1:
            del data[rng.integers(len(data)) :]
        case 2:
            at = rng.integers(len(data))
            data[at:at] = rng.bytes(rng.integers(1, 9))
        case 3:
            data = bytearray(rng.bytes(rng.integers(200)))
        case _:
            at = rng.integers(max(1, len(data) - 8))
            data[at : at + 8] = np.float64(rng.choice([np.nan, np.inf, -np.inf, 1e308, -1e-308, 0.0])).tobytes()
    return bytes(data)


@pytest.mark.parametrize(
    ("service", "asked", "code"),
    [
        (Service.PROJECT, ProjectAsked(beams(), ("C0", "C9")), "UNKNOWN_CAMERA"),
        (Service.PROJECT, ProjectAsked(beams(lrf="L9")), "UNKNOWN_LRF"),
        (Service.PROJECT, ProjectAsked(beams(lrf="L9", tilt_rad=None, stamp_ns=STAMP_NS)), "UNKNOWN_LRF"),
        (Service.PROJECT, ProjectAsked(beams(tilt_rad=None)), "NO_TILT"),
        (Service.PROJECT, ProjectAsked(beams(), calibration_id="b"), "STALE_CALIBRATION"),
        (Service.PROJECT, ProjectAsked(WorldPoints(np.zeros((110_000, 3)))), "TOO_LARGE"),
        (Service.PROJECT, ProjectAsked(WorldPoints(np.zeros((50_000, 3))), None, CovarianceOf()), "TOO_LARGE"),
        (Service.LOCATE, RaysAsked("C9", np.zeros((1, 2))), "UNKNOWN_CAMERA"),
        (Service.LOCATE, FloorAsked("C0", np.zeros((1, 2)), np.nan), "BAD_REQUEST"),
        (Service.LOCATE, FloorAsked("C0", np.zeros((1, 2)), 1e200), "BAD_REQUEST"),
        (Service.PROJECT, ProjectAsked(beams(), None, CovarianceOf(noise=LrfNoise(1e200))), "BAD_REQUEST"),
        (Service.PROJECT, ProjectAsked(beams(), None, CovarianceOf(point_sigma_m=1e200)), "BAD_REQUEST"),
        (Service.LOCATE, FloorAsked("C0", np.zeros((1, 2)), 0.5, (np.zeros(3), 0.0)), "BAD_REQUEST"),
        (Service.LOCATE, TriangulateAsked({"C0": np.zeros((1, 2))}, 0.5), "BAD_REQUEST"),
        (Service.LOCATE, RaysAsked("C0", np.zeros((1, 2)), "b"), "STALE_CALIBRATION"),
        (Service.BEARINGS, BearingsAsked("L0", np.zeros((1, 3)), np.nan), "NO_TILT"),
        (Service.BEARINGS, BearingsAsked("L0", np.zeros((1, 3)), None), "NO_TILT"),
        (Service.BEARINGS, BearingsAsked("L0", np.zeros((1, 3)), None, STAMP_NS - 10**9), "NO_TILT"),
        (Service.BEARINGS, BearingsAsked("L9", np.zeros((1, 3)), None, STAMP_NS), "UNKNOWN_LRF"),
    ],
)
def test_what_cannot_be_answered_is_refused_with_its_code(desk, service, asked, code):
    assert code_of(desk.answer(service, encode(asked))) == code


def test_without_a_calibration_every_request_is_refused_as_that():
    desk = Desk(lambda: None, Turning())
    for service, asked in asked_of_all_kinds():
        assert code_of(desk.answer(service, encode(asked))) == "NO_CALIBRATION"


def test_a_defect_is_told_and_the_next_request_is_answered(calibration):
    class Broken:
        def at(self, lrf, stamp_ns):
            raise ZeroDivisionError(lrf, stamp_ns)

    desk = Desk(lambda: calibration, Broken())
    stamped = ProjectAsked(beams(tilt_rad=None, stamp_ns=STAMP_NS))
    assert code_of(desk.answer(Service.PROJECT, encode(stamped))) == "FAILED"
    assert not desk.answer(Service.PROJECT, encode(ProjectAsked(beams()))).is_error


def test_a_stamp_in_place_of_a_tilt_gives_each_beam_the_tilt_of_its_own_time(desk, calibration):
    scan = beams(tilt_rad=None, stamp_ns=STAMP_NS)
    told = projected_of(desk.answer(Service.PROJECT, encode(ProjectAsked(scan))).payload)
    # An URG-04LX: 97.66 us a step, and step 384 looks ahead.
    tilt_rad = TILT_RAD + RATE_RAD_S * 97.65625e-6 * np.arange(44, 726)
    # A stamp is rounded to a nanosecond.
    assert told.tilt_rad is not None
    np.testing.assert_allclose(told.tilt_rad, tilt_rad, atol=1e-10)
    here = calibration.project(replace(scan, tilt_rad=told.tilt_rad))
    np.testing.assert_array_equal(told.px, here.px)
    flat = LrfPoints("L0", np.column_stack([np.ones(1), -np.ones(1), np.zeros(1)]), None, STAMP_NS)
    told = projected_of(desk.answer(Service.PROJECT, encode(ProjectAsked(flat))).payload)
    # Minus 45 degrees is an eighth of a turn, 128 steps, before the front.
    assert told.tilt_rad == pytest.approx(TILT_RAD + RATE_RAD_S * 97.65625e-6 * (384 - 128), abs=1e-10)


def test_a_tilt_that_was_looked_up_is_as_uncertain_as_it_is_known(desk, calibration):
    scan = beams(tilt_rad=None, stamp_ns=STAMP_NS)
    exact = CovarianceOf(calibration=False)
    told = projected_of(desk.answer(Service.PROJECT, encode(ProjectAsked(scan, None, exact))).payload)
    assert exact.noise is not None
    expected = CovarianceOf(calibration=False, noise=replace(exact.noise, tilt_rad=1e-3))
    here = calibration.project(replace(scan, tilt_rad=told.tilt_rad), covariance=expected)
    np.testing.assert_array_equal(told.covariance_px2, here.covariance_px2)


def test_bearings_by_a_stamp_are_those_of_the_tilt_at_that_time(desk, calibration):
    points = np.array([[0.5, 0.2, 1.5], [0.1, 0.1, 2.0]])
    asked = BearingsAsked("L0", points, None, STAMP_NS + 2 * 10**9)
    told = bearings_of(desk.answer(Service.BEARINGS, encode(asked)).payload)
    np.testing.assert_array_equal(
        told.out_of_plane_m, calibration.bearings("L0", points, TILT_RAD + 2 * RATE_RAD_S).out_of_plane_m
    )


class Given:
    """A source of calibrations: one after the other, or a fault."""

    def __init__(self, *polls):
        self.polls = list(polls)

    def poll(self):
        polled = self.polls.pop(0)
        if isinstance(polled, Exception):
            raise polled
        return polled


def test_a_calibration_that_cannot_be_used_is_told_and_the_one_before_stays(calibration):
    said, current = [], Current()
    source = Given(InputError("no cameras"), calibration, None, InputError("half of it"))
    for _ in range(4):
        current.take_from(source, said.append)
    assert said == [
        "refused: no cameras",
        "answers under calibration a: 5 cameras, 1 LRFs",
        "refused: half of it; calibration a stays in force",
    ]
    assert current.get() is calibration


def test_the_calibration_is_swapped_under_load_and_no_request_is_lost(tmp_path):
    """Every answer names its calibration, and its numbers are those of the calibration that it names."""
    path = write_calibration(tmp_path / "calibration.json", seed=1)
    by_id = {}
    for seed in (1, 2):
        here = Calibration.load(write_calibration(tmp_path / f"{seed}.json", seed=seed))
        by_id[here.id] = here.project(beams()).px
    done, answers = threading.Event(), [[] for _ in range(4)]

    def ask(endpoint, mine):
        with ProjectionClient(SITE, router=[endpoint], timeout_s=PATIENCE_S) as client:
            while not done.is_set():
                answer = client.project(beams())
                mine.append((answer.calibration_id, np.array_equal(answer.px, by_id[answer.calibration_id], True)))

    with routed() as endpoint, serving(endpoint, path) as said:
        wait_until(lambda: len(said) == 2, "the service to answer")
        askers = [threading.Thread(target=ask, args=(endpoint, mine), daemon=True) for mine in answers]
        for asker in askers:
            asker.start()
        for swap in range(1, 5):
            n_before = [len(mine) for mine in answers]
            write_calibration(path, seed=1 + swap % 2)
            wait_until(lambda told=2 + swap: len(said) == told, "the new calibration")
            wait_until(lambda: all(len(m) > n for m, n in zip(answers, n_before, strict=True)), "answers")  # noqa: B023
        done.set()
        for asker in askers:
            asker.join(PATIENCE_S)
            assert not asker.is_alive()
    for mine in answers:
        assert all(is_of_its_calibration for _, is_of_its_calibration in mine)
        # Each asker has seen at least one swap each way.
        ids = [calibration_id for calibration_id, _ in mine]
        assert sum(a != b for a, b in pairwise(ids)) >= 2


def test_the_coordinators_calibration_is_taken_over_late_or_when_it_is_told(tmp_path):
    with routed() as endpoint, open_bus(options_of(endpoint)) as bus, Announcer(bus, KEYS, "S1") as coordinator:
        coordinator.tell_calibration("first", write_calibration(tmp_path / "1.json", seed=1).read_bytes())
        with (
            serving(endpoint, None) as said,
            ProjectionClient(SITE, router=[endpoint], timeout_s=PATIENCE_S) as client,
        ):
            wait_until(lambda: said[-1:] == ["answers under calibration first: 5 cameras, 1 LRFs"], "the first")
            assert client.project(beams()).calibration_id == "first"
            coordinator.tell_calibration("broken", b"{")
            wait_until(lambda: said[-1].startswith("refused: calibration 'broken'"), "the refusal")
            coordinator.tell_calibration("second", write_calibration(tmp_path / "2.json", seed=2).read_bytes())
            wait_until(lambda: said[-1].startswith("answers under calibration second"), "the second")
            answer = client.project(beams())
    assert answer.calibration_id == "second"
    expected = Calibration.load(tmp_path / "2.json").project(beams())
    np.testing.assert_array_equal(answer.px, expected.px)


def test_a_flood_of_junk_over_the_bus_is_refused_piece_by_piece_and_requests_are_answered_between(tmp_path):
    path = write_calibration(tmp_path / "calibration.json")
    rng = np.random.default_rng(5)
    with (
        routed() as endpoint,
        serving(endpoint, path),
        open_bus(options_of(endpoint)) as bus,
        ProjectionClient(SITE, router=[endpoint], timeout_s=PATIENCE_S) as client,
    ):
        client.project(beams())
        keys = (KEYS.project_service, KEYS.locate_service, KEYS.bearings_service)
        for round_ in range(200):
            replies = list(bus.get(keys[round_ % 3], payload=rng.bytes(int(rng.integers(500))), timeout=5.0, **QUERY))
            assert all(
                reply.ok is not None or pb.ErrorReply.FromString(reply.err.payload.to_bytes()).code for reply in replies
            )
            assert len(replies) == 1
            # And no payload at all.
            assert [r.ok for r in bus.get(keys[round_ % 3], timeout=5.0, **QUERY)] == [None]
        assert client.project(beams()).is_valid.any()


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_the_program_says_when_it_answers_and_ends_well_when_told(tmp_path, number):
    path = write_calibration(tmp_path / "calibration.json")
    spotcal = [sys.executable, "-c", "from nodes.cli import main; main()"]
    with routed() as endpoint:
        command = [*spotcal, "projection", "--calibration", str(path), "--site", SITE, "--router", endpoint]
        with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as process:
            try:
                assert process.stdout is not None
                assert process.stdout.readline().startswith("answers under calibration ")
                assert process.stdout.readline() == f"projection service answers at {KEYS.base}/svc\n"
                with ProjectionClient(SITE, router=[endpoint], timeout_s=PATIENCE_S) as client:
                    assert client.project(beams()).cameras == Calibration.load(path).camera_names
                process.send_signal(number)
                assert process.wait(PATIENCE_S) == 0
                assert process.stdout.read() == ""
            finally:
                process.kill()


def test_a_calibration_to_begin_with_must_be_one(spotcal, tmp_path):
    path = tmp_path / "c.json"
    status, _, err = spotcal("projection", "--calibration", path)
    assert (status, "no such file" in err) == (2, True), err
    path.write_text("{}", encoding="utf-8")
    status, _, err = spotcal("projection", "--calibration", path)
    assert (status, "$.cameras: missing" in err) == (2, True), err


def test_a_file_and_the_bus_together_are_refused(spotcal, tmp_path):
    status, _, err = spotcal("projection", "--calibration", tmp_path / "c.json", "--from-bus")
    assert (status, "--calibration and --from-bus: give one of them" in err) == (2, True)
