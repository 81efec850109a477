"""The one door for what arrives: a message is whole and within its bounds, or refused with the reason.

One in eight mutated protobuf messages still parses, so every field is held to what it may be. A refusal names the
field; who counts it stands in `coordinator/` and in the nodes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import TypeVar

import numpy as np
from google.protobuf.message import DecodeError, Message

from nodes.bus import spotcal_pb2 as pb
from nodes.bus.keys import NAME, Kind

M = TypeVar("M", bound=Message)
SCHEMA = 1
BOOT_BYTES = 16
MAX_MESSAGE_BYTES = 4 * 2**20
MAX_FRAMES, MAX_SPOTS, MAX_BEAMS, MAX_SAMPLES, MAX_TILTS = 4096, 32768, 65536, 8192, 256
MAX_TEXT = 4096
MAX_SIDE_PX = 100_000
# Stamps before 2000 or after 2200 are no time of an observation; an int64 ends in 2262.
EARLIEST_NS, LATEST_NS = 946_684_800 * 10**9, 7_258_118_400 * 10**9
# No clock of a site is so far ahead: a message from the future would order itself behind everything.
MAX_AHEAD_NS = 60 * 10**9
MAX_SEQUENCE = 2**53
FEW = 32
# Asked for at every message; the enumerations' own lists are made anew each time.
CLOCK_SOURCES, STAMP_ORIGINS = frozenset(pb.ClockSource.values()), frozenset(pb.StampOrigin.values())


class MessageError(Exception):
    """A message that is refused.

    Attributes:
        reason: field and fault, in a few words; the same fault gives the same words, so that refusals can be counted.
    """

    def __init__(self, reason: str) -> None:
        super().__init__(reason)
        self.reason = reason


TYPES: dict[Kind, type[Message]] = {
    Kind.SPOTS: pb.SpotBatch,
    Kind.LRF_INFO: pb.LrfInfo,
    Kind.LRF_SCAN: pb.LrfScan,
    Kind.LRF_SPOT: pb.LrfSpot,
    Kind.TILT: pb.TiltSample,
    Kind.TILTS: pb.TiltSettings,
    Kind.IMU: pb.ImuBatch,
    Kind.EVENT: pb.NodeEvent,
}
Observation = (
    pb.SpotBatch | pb.LrfInfo | pb.LrfScan | pb.LrfSpot | pb.TiltSample | pb.TiltSettings | pb.ImuBatch | pb.NodeEvent
)


def parse_observation(kind: Kind, payload: bytes, *, node: str, now_ns: int) -> Observation:
    """An observation as published under a node's key.

    Args:
        kind: as the key says.
        payload: as it arrived.
        node: as the key says; the header must say the same.
        now_ns: this machine's clock, to refuse what comes from the future.

    Raises:
        MessageError: refused.
    """
    message = parse(TYPES[kind], payload, node=node, now_ns=now_ns)
    _CHECKS[kind](message)
    if _newest_ns(message) > now_ns + MAX_AHEAD_NS:  # pyright: ignore[reportArgumentType]
        raise MessageError("stamps: in the future")
    return message  # pyright: ignore[reportReturnType]


def _newest_ns(message: Observation) -> int:
    match message:
        case pb.SpotBatch():
            return max(message.frame_stamp_ns)
        case pb.ImuBatch():
            return max(message.arrival_ns)
        case pb.LrfScan() | pb.LrfSpot():
            return message.stamp_ns
    return message.header.stamp_ns


def parse_status(payload: bytes, *, node: str, now_ns: int) -> pb.NodeStatus:
    """A node's status.

    Raises:
        MessageError: refused.
    """
    status = parse(pb.NodeStatus, payload, node=node, now_ns=now_ns)
    _text("role", status.role)
    _text("state", status.state)
    _text("message", status.message)
    if len(status.advice) > 64:
        raise MessageError("advice: too many")
    for advice in status.advice:
        _text("advice", advice)
    _numbers("rate_hz", [status.rate_hz], 0, 1e6)
    _numbers("temperature_c", [status.temperature_c], -300, 1000)
    _numbers("plane_sigma_m", [status.plane_sigma_m], 0, 1e6)
    return status


def parse(message_type: type[M], payload: bytes, *, node: str | None, now_ns: int) -> M:
    """A message with a good header; its other fields are still to be checked.

    Raises:
        MessageError: refused.
    """
    if len(payload) > MAX_MESSAGE_BYTES:
        raise MessageError("message: too large")
    message = message_type()
    try:
        message.ParseFromString(payload)
    except (DecodeError, ValueError):
        raise MessageError("message: no protobuf of its type") from None
    check_header(message.header, node=node, now_ns=now_ns)  # pyright: ignore[reportAttributeAccessIssue]
    return message


def check_header(header: pb.Header, *, node: str | None, now_ns: int) -> None:
    """Hold a header to its bounds.

    Raises:
        MessageError: refused.
    """
    if header.schema != SCHEMA:
        raise MessageError("header.schema: unknown version")
    if NAME.fullmatch(header.node) is None:
        raise MessageError("header.node: no name")
    if node is not None and header.node != node:
        raise MessageError("header.node: not the key's")
    if len(header.boot) != BOOT_BYTES:
        raise MessageError("header.boot: not 16 bytes")
    if header.sequence > MAX_SEQUENCE:
        raise MessageError("header.sequence: too large")
    if header.session and NAME.fullmatch(header.session) is None:
        raise MessageError("header.session: no name")
    if header.clock.source not in CLOCK_SOURCES:
        raise MessageError("header.clock.source: unknown")
    _numbers("header.clock.sigma_s", [header.clock.sigma_s], 0, 1e9)
    _stamps("header.stamp_ns", [header.stamp_ns])
    if header.stamp_ns > now_ns + MAX_AHEAD_NS:
        raise MessageError("header.stamp_ns: in the future")


def _spots(m: pb.SpotBatch) -> None:
    _name("camera", m.camera)
    if not (0 < m.width_px <= MAX_SIDE_PX and 0 < m.height_px <= MAX_SIDE_PX):
        raise MessageError("width_px, height_px: no image")
    _numbers("rate_hz", [m.rate_hz], 0, 1e6)
    if m.origin not in STAMP_ORIGINS:
        raise MessageError("origin: unknown")
    n, k = len(m.frame_sequence), len(m.spot_frame)
    if not 0 < n <= MAX_FRAMES:
        raise MessageError("frame_sequence: none, or too many")
    if k > MAX_SPOTS:
        raise MessageError("spot_frame: too many")
    _lengths("frame_stamp_ns", [m.frame_stamp_ns], n)
    _lengths("x_px, y_px, sigma_px, score", [m.x_px, m.y_px, m.sigma_px, m.score], k)
    _stamps("frame_stamp_ns", m.frame_stamp_ns)
    sequence = list(m.frame_sequence)
    if sequence[-1] > MAX_SEQUENCE or any(b <= a for a, b in pairwise(sequence)):
        raise MessageError("frame_sequence: does not rise")
    frame = list(m.spot_frame)
    if (frame and frame[-1] >= n) or any(b < a for a, b in pairwise(frame)):
        raise MessageError("spot_frame: no frame of the batch, or falls")
    _numbers("x_px", m.x_px, -0.5, m.width_px - 0.5)
    _numbers("y_px", m.y_px, -0.5, m.height_px - 0.5)
    _numbers("sigma_px", m.sigma_px, 1e-6, 1e3)
    _numbers("score", m.score, 0, 1)


def _lrf_info(m: pb.LrfInfo) -> None:
    _name("lrf", m.lrf)
    for field in ("product", "serial", "firmware"):
        _text(field, getattr(m, field))
    if not (0 < m.steps_per_turn <= MAX_BEAMS and m.first_step < m.last_step < m.steps_per_turn):
        raise MessageError("first_step, last_step, steps_per_turn: no scan")
    if abs(m.front_step) > m.steps_per_turn:
        raise MessageError("front_step: beyond a turn")
    _numbers("range_min_m", [m.range_min_m], 0, 1e4)
    _numbers("range_max_m", [m.range_max_m], 1e-3, 1e4)
    if m.range_min_m >= m.range_max_m:
        raise MessageError("range_min_m, range_max_m: no range")
    _numbers("turn_s", [m.turn_s], 1e-4, 10)


def _lrf_scan(m: pb.LrfScan) -> None:
    _name("lrf", m.lrf)
    if not 0 < len(m.readings_mm) <= MAX_BEAMS:
        raise MessageError("readings_mm: none, or too many")
    if m.intensity:
        _lengths("intensity", [m.intensity], len(m.readings_mm))
    _stamps("stamp_ns", [m.stamp_ns])
    _numbers("sigma_s", [m.sigma_s], 0, 1e6)
    _numbers("device_s", [m.device_s], 0, 1e12)
    _numbers("readings_mm", m.readings_mm, 0, 1e7)


def _lrf_spot(m: pb.LrfSpot) -> None:
    _name("lrf", m.lrf)
    _setting(m.setting)
    _stamps("stamp_ns", [m.stamp_ns])
    _numbers("range_m", [m.range_m], 1e-3, 1e3)
    _numbers("bearing_rad", [m.bearing_rad], -2 * np.pi, 2 * np.pi)
    _numbers("range_sigma_m, bearing_sigma_rad", [m.range_sigma_m, m.bearing_sigma_rad], 1e-9, 10)
    _numbers("out_of_plane_sigma_m", [m.out_of_plane_sigma_m], 1e-9, 10)
    _numbers("bias_bound_m", [m.bias_bound_m], 0, 1)
    _numbers("n_spots", [m.n_spots], 0, MAX_SPOTS)


def _tilt(m: pb.TiltSample) -> None:
    _name("lrf", m.lrf)
    _setting(m.setting)
    _numbers("tilt_rad", [m.tilt_rad], -2 * np.pi, 2 * np.pi)
    if abs(m.steps) > MAX_SEQUENCE:
        raise MessageError("steps: too large")


def _tilts(m: pb.TiltSettings) -> None:
    _name("lrf", m.lrf)
    n = len(m.angle_rad)
    if not 0 < n <= MAX_TILTS:
        raise MessageError("angle_rad: none, or too many")
    _lengths("covariance_rad2", [m.covariance_rad2], n * n)
    _numbers("angle_rad", m.angle_rad, -2 * np.pi, 2 * np.pi)
    _numbers("covariance_rad2", m.covariance_rad2, -10, 10)
    covariance = np.array(m.covariance_rad2).reshape(n, n)
    if not np.allclose(covariance, covariance.T, atol=1e-15) or np.linalg.eigvalsh(covariance)[0] < -1e-12:
        raise MessageError("covariance_rad2: no covariance")
    if len(m.sources) > 16 or len(m.notes) > 64:
        raise MessageError("sources, notes: too many")
    for text in (*m.sources, *m.notes):
        _text("sources, notes", text)


def _imu(m: pb.ImuBatch) -> None:
    _name("lrf", m.lrf)
    n = len(m.sample)
    if not 0 < n <= MAX_SAMPLES:
        raise MessageError("sample: none, or too many")
    _lengths("device_s, arrival_ns", [m.device_s, m.arrival_ns], n)
    _lengths("rate_rad_s, acceleration_m_s2", [m.rate_rad_s, m.acceleration_m_s2], 3 * n)
    _stamps("arrival_ns", m.arrival_ns)
    _numbers("device_s", m.device_s, 0, 1e12)
    _numbers("rate_rad_s", m.rate_rad_s, -1e3, 1e3)
    _numbers("acceleration_m_s2", m.acceleration_m_s2, -1e4, 1e4)


def _event(m: pb.NodeEvent) -> None:
    _text("text", m.text)


_CHECKS: dict[Kind, Callable[..., None]] = {
    Kind.SPOTS: _spots,
    Kind.LRF_INFO: _lrf_info,
    Kind.LRF_SCAN: _lrf_scan,
    Kind.LRF_SPOT: _lrf_spot,
    Kind.TILT: _tilt,
    Kind.TILTS: _tilts,
    Kind.IMU: _imu,
    Kind.EVENT: _event,
}


def _numbers(field: str, values: Sequence[float], low: float, high: float) -> None:
    # NumPy begins to pay beyond some ten values; most messages hold fewer. Both comparisons are false for NaN, too.
    if len(values) <= FEW:
        is_within = all(low <= value <= high for value in values)
    else:
        array = np.asarray(values, dtype=np.float64)
        is_within = bool(((array >= low) & (array <= high)).all())
    if not is_within:
        raise MessageError(f"{field}: out of bounds")


def _stamps(field: str, values: Sequence[int]) -> None:
    if any(not EARLIEST_NS <= value <= LATEST_NS for value in values):
        raise MessageError(f"{field}: no time of an observation")


def _lengths(field: str, columns: Sequence[Sequence[object]], n: int) -> None:
    if any(len(column) != n for column in columns):
        raise MessageError(f"{field}: wrong length")


def _text(field: str, value: str) -> None:
    # Both blocks of control characters: a terminal obeys either.
    if len(value) > MAX_TEXT or any((ord(c) < 32 and c not in "\n\t") or 127 <= ord(c) < 160 for c in value):
        raise MessageError(f"{field}: too long, or control characters")


def _name(field: str, value: str) -> None:
    if NAME.fullmatch(value) is None:
        raise MessageError(f"{field}: no name")


def _setting(value: int) -> None:
    if value >= MAX_TILTS:
        raise MessageError("setting: too large")
