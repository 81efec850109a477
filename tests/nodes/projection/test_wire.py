from dataclasses import fields, is_dataclass

import numpy as np
import pytest

from lrf_stereo.noise import LrfNoise
from nodes.bus import spotcal_pb2 as pb
from nodes.devices.errors import DeviceError
from nodes.projection.errors import ErrorCode, ProjectionError
from nodes.projection.points import Beams, Bearings, CovarianceOf, Located, LrfPoints, Projected, Rays, WorldPoints
from nodes.projection.requests import BearingsAsked, CameraPixels, FloorAsked, ProjectAsked, RaysAsked, TriangulateAsked
from nodes.projection.wire import encode
from nodes.projection.wire_answers import (
    bearings_of,
    encode_answer,
    encode_error,
    error_of,
    located_of,
    projected_of,
    rays_of,
)
from nodes.projection.wire_requests import MAX_REQUEST_BYTES, bearings_asked, locate_asked, project_asked

RNG = np.random.default_rng(2)
PX, XYZ = RNG.normal(size=(7, 2)), RNG.normal(size=(7, 3))
FLAT = XYZ * [1, 1, 0]
STAMP_NS = 1_700_000_000_123_456_789
VALID = RNG.random((2, 7)) < 0.5


def assert_same(one, other):
    """Equal to the last bit, NaN to NaN, all the way down."""
    if is_dataclass(one):
        assert type(one) is type(other)
        for field in fields(one):
            assert_same(getattr(one, field.name), getattr(other, field.name))
    elif isinstance(one, dict):
        assert list(one) == list(other)
        for key in one:
            assert_same(one[key], other[key])
    elif isinstance(one, tuple):
        assert len(one) == len(other)
        for a, b in zip(one, other, strict=True):
            assert_same(a, b)
    elif isinstance(one, np.ndarray):
        assert (one.dtype, one.shape) == (other.dtype, other.shape)
        np.testing.assert_array_equal(one, other)
    else:
        assert one == other


@pytest.mark.parametrize(
    "asked",
    [
        ProjectAsked(Beams("L0", XYZ[:, 0], XYZ[:, 1], 0.25)),
        ProjectAsked(
            Beams("L0", np.array([1.0, np.nan]), np.array([0.1, 0.2]), np.array([0.3, np.nan])),
            ("C1", "C0"),
            calibration_id="a",
        ),
        ProjectAsked(Beams("L0", np.ones(1), np.ones(1), stamp_ns=STAMP_NS), covariance=CovarianceOf()),
        ProjectAsked(LrfPoints("L0", FLAT, 0.25), covariance=CovarianceOf(noise=LrfNoise(1e-3, 2e-3, 3e-3, 4e-3))),
        ProjectAsked(LrfPoints("L0", FLAT, stamp_ns=0), covariance=CovarianceOf(calibration=False)),
        ProjectAsked(WorldPoints(XYZ), covariance=CovarianceOf(noise=None, point_sigma_m=0.02)),
        ProjectAsked(WorldPoints(np.empty((0, 3)))),
    ],
)
def test_a_projection_that_is_asked_for_arrives_as_it_was(asked):
    assert_same(project_asked(encode(asked)), asked)


@pytest.mark.parametrize(
    "asked",
    [
        RaysAsked("C0", PX, "a"),
        FloorAsked("C0", PX, 0.5),
        FloorAsked("C0", PX, 0.5, (np.array([0.0, 0.1, 1.0]), -0.7), "a"),
        TriangulateAsked({"C1": PX, "C0": PX + 1}, 0.5),
    ],
)
def test_pixels_that_are_asked_about_arrive_as_they_were(asked):
    assert_same(locate_asked(encode(asked)), asked)


@pytest.mark.parametrize("tilt", [(0.5, None), (None, STAMP_NS), (None, None)])
def test_bearings_that_are_asked_for_arrive_as_they_were(tilt):
    for points in (XYZ, np.empty((0, 3)), CameraPixels("C0", PX)):
        asked = BearingsAsked("L0", points, tilt[0], tilt[1], "a")
        assert_same(bearings_asked(encode(asked)), asked)


@pytest.mark.parametrize("tilt_rad", [None, 0.25, RNG.normal(size=7)])
@pytest.mark.parametrize("covariance_px2", [None, RNG.normal(size=(2, 7, 2, 2))])
# As the projector leaves it: all x, then all y.
@pytest.mark.parametrize("px", [RNG.normal(size=(2, 7, 2)), RNG.normal(size=(2, 2, 7)).transpose(1, 2, 0)])
def test_a_projection_comes_back_as_it_was(px, covariance_px2, tilt_rad):
    answer = Projected("a", ("C1", "C0"), px, VALID, RNG.normal(size=(2, 7)), covariance_px2, tilt_rad)
    back = projected_of(encode_answer(answer))
    assert_same(back, answer)
    # Whoever gets it may go on with it in place.
    back.px[0, 0] = 1.0


@pytest.mark.parametrize(
    ("answer", "read"),
    [
        (Rays("a", XYZ, -XYZ, VALID[0]), rays_of),
        (Located("a", XYZ, RNG.normal(size=(7, 3, 3)), VALID[0]), located_of),
        (Bearings("a", "L0", XYZ[:, 0], XYZ[:, 1], XYZ[:, 2], np.arange(-1, 6), VALID[0]), bearings_of),
    ],
)
def test_other_answers_come_back_as_they_were(answer, read):
    assert_same(read(encode_answer(answer)), answer)


@pytest.mark.parametrize("read", [projected_of, rays_of, located_of, bearings_of])
def test_an_answer_that_is_none_is_refused(read):
    cut = {
        projected_of: pb.ProjectReply(n_points=3, cameras=["C0"], px=bytes(40)),
        rays_of: pb.LocateReply(n_points=3, origin_m=bytes(64)),
        located_of: pb.LocateReply(n_points=3, xyz_m=bytes(64)),
        bearings_of: pb.BearingsReply(n_points=3, bearing_rad=bytes(8)),
    }
    for payload in (b"\xff", cut[read].SerializeToString()):
        with pytest.raises(DeviceError, match="an answer"):
            read(payload)


def test_a_refusal_comes_back_with_code_message_and_detail():
    error = error_of(encode_error(ErrorCode.UNKNOWN_CAMERA, "no C9", "C0, C1"))
    assert isinstance(error, ProjectionError)
    assert (error.code, error.message, error.detail) == (ErrorCode.UNKNOWN_CAMERA, "no C9", "C0, C1")


@pytest.mark.parametrize("payload", [b"\xff", b"", b"Timeout", encode_error("NEWER_CODE", "what", "")])
def test_a_refusal_that_cannot_be_read_is_told_as_it_stands(payload):
    assert isinstance(error_of(payload), DeviceError)


def test_what_an_asker_wrote_goes_back_short_and_without_what_a_terminal_obeys():
    told = pb.ErrorReply.FromString(encode_error("X", "no \x1b[2J" + "C" * 10**6, "\x07"))
    assert told.message.startswith("no \N{REPLACEMENT CHARACTER}[2JCCC")
    assert len(told.message) == 1000
    assert told.detail == "\N{REPLACEMENT CHARACTER}"


@pytest.mark.parametrize(
    ("read", "payload", "code"),
    [
        (project_asked, b"\xff\xff", "BAD_REQUEST"),
        (project_asked, b"", "BAD_REQUEST"),
        (locate_asked, b"", "BAD_REQUEST"),
        (project_asked, bytes(MAX_REQUEST_BYTES + 1), "TOO_LARGE"),
        (project_asked, pb.ProjectRequest(beams=pb.Beams(range_m=b"1234567")), "BAD_REQUEST"),
        (project_asked, pb.ProjectRequest(beams=pb.Beams(range_m=bytes(16), bearing_rad=bytes(8))), "BAD_REQUEST"),
        (
            project_asked,
            pb.ProjectRequest(beams=pb.Beams(range_m=bytes(8), bearing_rad=bytes(8), tilt_rad=bytes(16))),
            "BAD_REQUEST",
        ),
        (project_asked, pb.ProjectRequest(world_points=pb.WorldPoints(xyz_m=bytes(16))), "BAD_REQUEST"),
        (project_asked, pb.ProjectRequest(world_points=pb.WorldPoints(), cameras=["C0"] * 5000), "TOO_LARGE"),
        (
            project_asked,
            pb.ProjectRequest(
                world_points=pb.WorldPoints(), covariance=pb.CovarianceOf(noise=pb.LrfNoise(range_per_m=float("nan")))
            ),
            "BAD_REQUEST",
        ),
        (
            project_asked,
            pb.ProjectRequest(world_points=pb.WorldPoints(), covariance=pb.CovarianceOf(point_sigma_m=-1)),
            "BAD_REQUEST",
        ),
        (locate_asked, pb.LocateRequest(rays=pb.Pixels(px=bytes(8))), "BAD_REQUEST"),
        (
            locate_asked,
            pb.LocateRequest(triangulated=pb.SeenPixels(pixels=[pb.Pixels(camera="C0")] * 2)),
            "BAD_REQUEST",
        ),
        (bearings_asked, pb.BearingsRequest(tilt_rad=bytes(16), xyz_m=bytes(24)), "BAD_REQUEST"),
        (bearings_asked, pb.BearingsRequest(tilt_rad=bytes(8)), "BAD_REQUEST"),
    ],
)
def test_what_is_malformed_is_refused_with_its_code(read, payload, code):
    with pytest.raises(ProjectionError) as refused:
        read(payload if isinstance(payload, bytes) else payload.SerializeToString())
    assert refused.value.code == code
    assert refused.value.message


@pytest.mark.parametrize(
    ("told", "expected"),
    [
        (pb.CovarianceOf(), CovarianceOf()),
        (
            pb.CovarianceOf(is_measurement_exact=True, is_calibration_exact=True),
            CovarianceOf(calibration=False, noise=None),
        ),
    ],
)
def test_what_a_request_leaves_out_of_the_covariance_is_that_of_the_scanner(told, expected):
    asked = project_asked(pb.ProjectRequest(world_points=pb.WorldPoints(), covariance=told).SerializeToString())
    assert asked.covariance == expected
