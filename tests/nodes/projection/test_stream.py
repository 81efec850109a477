import time
from dataclasses import replace

import numpy as np
import pytest
from foxglove_schemas_protobuf.ImageAnnotations_pb2 import ImageAnnotations

from lrf_stereo.noise import LrfNoise
from nodes.bus import spotcal_pb2 as pb
from nodes.bus.checks import MessageError
from nodes.bus.keys import Kind
from nodes.bus.session import open_bus
from nodes.projection.foxglove_stream import scan_annotations
from nodes.projection.mailbox import Mailbox
from nodes.projection.points import Beams, CovarianceOf
from nodes.projection.scan_desk import ScanDesk
from nodes.projection.scan_message import read_scan
from nodes.projection.stream import ProjectionStream, trouble
from nodes.projection.tilt_table import TiltTable
from nodes.projection.tilt_track import STEP_SIGMA_RAD
from nodes.simulation.lrf_simulation import LRF_NAME
from tests.nodes.bus.buses import KEYS, listening, options_of, routed, wait_until
from tests.nodes.projection import scanned_site as site

NOW_NS = 1_700_000_000 * 10**9
S_NS = 10**9


@pytest.fixture(scope="module")
def truth():
    return site.scene()


@pytest.fixture(scope="module")
def calibration(truth):
    return site.calibration_of(truth)


@pytest.fixture(scope="module")
def readings(truth):
    return site.ranges_mm(truth).tolist()


def key(kind):
    return KEYS.observation(site.NODE, kind)


def desk_of(calibration, *messages):
    """A desk that was told of the LRF's steps and of more."""
    desk = ScanDesk(lambda: calibration, TiltTable(), lambda: NOW_NS + 3600 * S_NS)
    kinds = {pb.LrfInfo: Kind.LRF_INFO, pb.TiltSample: Kind.TILT, pb.NodeEvent: Kind.EVENT}
    for message in (site.info(NOW_NS), *messages):
        desk.take(key(kinds[type(message)]), message.SerializeToString())
    return desk


def anyone(_):
    return True


def projected(desk, scan, *, is_wanted=anyone):
    """What a subscriber of each camera reads."""
    messages = list(desk.project(key(Kind.LRF_SCAN), scan.SerializeToString(), is_wanted=is_wanted))
    return {message.camera: read_scan(message.SerializeToString()) for message in messages}


def test_a_scan_at_rest_is_where_the_calibration_puts_it(calibration, readings):
    desk = desk_of(calibration, site.tilt(NOW_NS))
    seen = projected(desk, site.scan(NOW_NS + S_NS, readings, number=7))
    range_m = np.where(site.STEPS.is_range(np.array(readings)), 1e-3 * np.array(readings), np.nan)
    beams = Beams(LRF_NAME, range_m, site.STEPS.bearings_rad, site.TILT_RAD)
    noise = LrfNoise(bearing_rad=site.STEPS.step_rad / np.sqrt(12), tilt_rad=STEP_SIGMA_RAD)
    expected = calibration.project(beams, covariance=CovarianceOf(noise=noise))
    sigma_px = expected.sigma_px
    assert {name for name, valid in zip(expected.cameras, expected.is_valid, strict=True) if valid.any()} == set(seen)
    for row, name in enumerate(expected.cameras):
        rows = seen[name].step - site.STEPS.first_step
        assert np.array_equal(seen[name].is_valid, expected.is_valid[row, rows])
        assert seen[name].is_valid[[0, -1]].all()
        assert expected.is_valid[row].sum() == seen[name].is_valid.sum()
        # The same numbers, but for the order of sums where fewer cameras are projected at once.
        assert np.allclose(seen[name].px, expected.px[row, rows], atol=1e-9, equal_nan=True)
        # float32, and the tilt's sigma, a part of it, is brought up by as much as 2 %.
        assert np.allclose(seen[name].sigma_px, sigma_px[row, rows], rtol=0.021, equal_nan=True)
        assert np.allclose(seen[name].range_m, range_m[rows], rtol=1e-7, equal_nan=True)
        assert (seen[name].scan, seen[name].calibration_id, seen[name].lrf) == (7, "c1", LRF_NAME)


def test_beams_carry_their_own_times_on_the_cameras_clock(calibration, readings):
    desk = desk_of(calibration, site.tilt(NOW_NS))
    stamp_ns = NOW_NS + S_NS
    for one in projected(desk, site.scan(stamp_ns, readings)).values():
        after_s = site.STEPS.time_s(one.step) + site.CLOCK_OFFSET_S
        assert np.abs((one.stamp_ns - stamp_ns) - 1e9 * after_s).max() <= 1


def test_while_it_moves_each_beam_has_the_tilt_of_its_own_time(calibration, readings):
    # From rest to rest in 1 s by 0.5 rad; the sweep of a scan takes 0.1 s of it.
    begin_ns, turn_rad = NOW_NS + S_NS, 0.5
    messages = site.tilt(NOW_NS, 0.2), site.moving(begin_ns), site.tilt(begin_ns + S_NS, 0.2 + turn_rad, 1)
    desk = desk_of(calibration, *messages)
    stamp_ns = begin_ns + S_NS // 4
    seen = projected(desk, site.scan(stamp_ns, readings))
    assert seen
    range_m = np.where(site.STEPS.is_range(np.array(readings)), 1e-3 * np.array(readings), np.nan)
    bearing_rad = site.STEPS.bearings_rad
    tilt_rad = 0.2 + turn_rad * (0.25 + site.STEPS.beam_time_s(bearing_rad))
    own = calibration.project(Beams(LRF_NAME, range_m, bearing_rad, tilt_rad))
    one_tilt = calibration.project(Beams(LRF_NAME, range_m, bearing_rad, 0.2 + turn_rad * 0.25))
    for name, one in seen.items():
        row, rows = own.cameras.index(name), one.step - site.STEPS.first_step
        # Beam times are whole nanoseconds: 1e-9 s times 0.5 rad/s times some hundred px.
        assert np.allclose(one.px, own.px[row, rows], atol=1e-6, equal_nan=True)
        error_px = np.linalg.norm(one.px - one_tilt.px[row, rows], axis=1)[one.is_valid]
        assert error_px.max() > 1.0
        # The way between the rests is not known, by 0.11 rad and more: of what the error is made, all but beams that
        # end near the axis, which a tilt hardly moves.
        assert np.nanmedian(one.sigma_px) > 3.0


@pytest.mark.parametrize(
    ("messages", "counted"),
    [((), "n_without_tilt"), ((site.tilt(NOW_NS), site.moving(NOW_NS + 1)), "n_without_tilt")],
)
def test_a_scan_without_a_known_tilt_is_counted_not_guessed(calibration, readings, messages, counted):
    desk = desk_of(calibration, *messages)
    assert not projected(desk, site.scan(NOW_NS + S_NS, readings))
    assert getattr(desk.counts, counted) == 1
    assert "without a known tilt" in trouble(desk.counts)


def test_scans_that_cannot_be_projected_are_counted(calibration, readings):
    tilt, scan = site.tilt(NOW_NS), site.scan(NOW_NS + S_NS, readings)
    desk = desk_of(None, tilt)
    assert not projected(desk, scan)
    assert desk.counts.n_uncalibrated == 1
    desk = desk_of(calibration, tilt)
    assert not projected(desk, site.scan(NOW_NS + S_NS, readings[:-1]))
    assert desk.counts.n_without_info == 1
    assert not list(desk.project(key(Kind.LRF_SCAN), b"\xff\xff", is_wanted=anyone))
    assert desk.counts.n_refused == 1
    other = replace(calibration.result, lrfs=(replace(calibration.result.lrfs[0], name="L9"),))
    desk = desk_of(type(calibration).of(other, "c9"), tilt)
    assert not projected(desk, scan)
    assert desk.counts.n_uncalibrated == 1


def test_only_cameras_that_somebody_listens_to_are_projected(calibration, readings):
    desk = desk_of(calibration, site.tilt(NOW_NS))
    asked = []
    seen = projected(
        desk, site.scan(NOW_NS + S_NS, readings), is_wanted=lambda name: not asked.append(name) and name == "C1"
    )
    assert set(seen) == {"C1"}
    assert set(asked) <= set(calibration.camera_names)


def test_a_new_calibration_is_used_from_the_next_scan_on(truth, calibration, readings):
    current = [calibration]
    desk = desk_of(None, site.tilt(NOW_NS))
    desk = ScanDesk(lambda: current[0], desk._tilts, lambda: NOW_NS + 3600 * S_NS)
    desk.take(key(Kind.LRF_INFO), site.info(NOW_NS).SerializeToString())
    scan = site.scan(NOW_NS + S_NS, readings)
    assert {one.calibration_id for one in projected(desk, scan).values()} == {"c1"}
    current[0] = site.calibration_of(truth, name="c2")
    assert {one.calibration_id for one in projected(desk, scan).values()} == {"c2"}


def test_the_newest_scan_of_each_scanner_wins_and_nothing_else_is_lost():
    mailbox = Mailbox()
    for k in range(5):
        mailbox.put_scan("a", bytes([k]))
        mailbox.put("tilt", bytes([k]))
    mailbox.put_scan("b", b"b")
    come = mailbox.collect(0.0)
    assert [(letter.key, letter.payload) for letter in come.scans] == [("a", b"\4"), ("b", b"b")]
    assert [letter.payload for letter in come.others] == [bytes([k]) for k in range(5)]
    assert mailbox.n_replaced == 4
    assert mailbox.collect(0.0).scans == ()


@pytest.mark.parametrize("spoil", [b"\xff", {"n_beams": 3}, {"px": b"x"}, {"step_s": float("nan")}])
def test_a_message_that_is_no_projection_is_refused(spoil):
    message = pb.Projection(n_beams=1, px=bytes(16), range_m=bytes(4), sigma_px=bytes(4), is_valid=b"\1", step_s=1e-4)
    assert len(read_scan(message.SerializeToString()).px) == 1
    if isinstance(spoil, dict):
        for field, value in spoil.items():
            setattr(message, field, value)
    with pytest.raises(MessageError):
        read_scan(spoil if isinstance(spoil, bytes) else message.SerializeToString())


def test_viewers_count_pixels_from_the_corner_and_see_near_beams_red():
    px, is_valid = np.array([[-0.5, -0.5], [10.0, 20.0], [3.0, 3.0]]), np.array([True, True, False])
    told = scan_annotations(1_500_000_000, px, np.array([0.1, 5.6, 1.0]), is_valid, longest_m=5.6)
    (points,) = told.points
    assert [(p.x, p.y) for p in points.points] == [(0.0, 0.0), (10.5, 20.5)]
    near, far = points.outline_colors
    assert near.r - near.b > 0.8
    assert far.b - far.r > 0.8
    assert (told.timestamp.seconds, told.timestamp.nanos) == (1, 500_000_000)
    assert not scan_annotations(0, px, np.ones(3), np.zeros(3, bool), longest_m=5.6).points


def test_over_the_bus_every_camera_gets_its_scan_and_the_status_tells(calibration, readings):
    with (
        routed() as endpoint,
        listening(endpoint, KEYS.projection("C1")) as (_, scans),
        listening(endpoint, KEYS.projection_annotations("C1")) as (_, annotations),
        listening(endpoint, KEYS.status("projection")) as (_, status),
        open_bus(options_of(endpoint)) as at_stream,
        open_bus(options_of(endpoint)) as at_node,
        ProjectionStream(at_stream, KEYS, lambda: calibration) as stream,
    ):
        now_ns = time.time_ns()

        def tell(kind, message):
            at_node.put(key(kind), message.SerializeToString())

        def nudge():
            # Until all subscriptions have met, what is published goes nowhere.
            tell(Kind.LRF_INFO, site.info(now_ns))
            tell(Kind.TILT, site.tilt(now_ns))
            tell(Kind.LRF_SCAN, site.scan(time.time_ns(), readings, number=3))
            return bool(scans.samples and annotations.samples)

        wait_until(nudge, "a scan in C1")
        one = read_scan(scans.samples[0][1])
        assert (one.camera, one.scan) == ("C1", 3)
        (points,) = ImageAnnotations.FromString(annotations.samples[0][1]).points
        assert np.allclose([[p.x, p.y] for p in points.points], one.px[one.is_valid] + 0.5)
        wait_until(lambda: any(m.state == "projecting" for m in status.messages(pb.NodeStatus)), "its status")
        assert stream.counts().n_failed == 0
        at_node.put(key(Kind.LRF_SCAN), b"\xff")
        wait_until(lambda: stream.counts().n_refused > 0, "a refusal")


def test_cameras_too_far_from_every_point_are_left_out_and_no_other(truth, calibration, readings):
    tilts = TiltTable()
    tilts.take(site.tilt(NOW_NS))
    scan = site.scan(NOW_NS + S_NS, readings)
    everywhere = projected(desk_of(calibration, site.tilt(NOW_NS)), scan)
    centres = dict(zip(calibration.camera_names, truth.cameras.centres_in_world, strict=True))

    def nearest_m(name):
        """Of the points that the camera sees."""
        one = everywhere[name]
        bearing_rad, range_m = site.STEPS.bearing_rad(one.step[one.is_valid]), one.range_m[one.is_valid]
        return np.linalg.norm(
            truth.scanner.points_in_world(range_m, bearing_rad, site.TILT_RAD) - centres[name], axis=1
        ).min()

    distances_m = {name: nearest_m(name) for name in everywhere}
    limit_m = (min(distances_m.values()) + max(distances_m.values())) / 2
    desk = ScanDesk(lambda: calibration, tilts, lambda: NOW_NS + 3600 * S_NS, max_distance_m=limit_m)
    desk.take(key(Kind.LRF_INFO), site.info(NOW_NS).SerializeToString())
    near = projected(desk, scan)
    assert {name for name, distance_m in distances_m.items() if distance_m <= limit_m} <= set(near)
    # In place of points, boxes around pieces of the scan are looked at, so that some more may stay; not the farthest.
    assert max(distances_m, key=lambda name: distances_m[name]) not in near
