"""What both clients share: a question on its way, and what to make of a reply."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

import numpy as np
import numpy.typing as npt
import zenoh

from nodes.bus.client import TIMEOUT
from nodes.bus.qos import COMMAND
from nodes.bus.session import BusOptions, open_bus
from nodes.devices.errors import DeviceError
from nodes.projection.points import Bearings, CovarianceOf, Located, Points, Projected, Rays, rows
from nodes.projection.requests import BearingsAsked, CameraPixels, FloorAsked, ProjectAsked, RaysAsked, TriangulateAsked
from nodes.projection.services import Service
from nodes.projection.wire import encode
from nodes.projection.wire_answers import bearings_of, error_of, located_of, projected_of, rays_of

T = TypeVar("T")
Plane = tuple[npt.ArrayLike, float]
# No reply at all means that nobody answers just now; a reply may get lost on a full line, and then nobody tells.
AGAIN_S, ASK_S = 0.05, 2.0
MAX_UNDER_WAY = 16
# Of the requests to Zenoh: as urgent as a command, no reply held back for a later one. A reply of more than 64 KiB is
# lost now and then where it may be dropped. Blocking harms others only when an asker freezes with more replies under
# way than the network's buffers hold, some MB: hence a bound on the questions under way.
QUERY: dict[str, Any] = {
    "target": zenoh.QueryTarget.BEST_MATCHING,
    "consolidation": zenoh.ConsolidationMode.NONE,
    "congestion_control": zenoh.CongestionControl.BLOCK,
    "priority": COMMAND.priority,
    "express": COMMAND.express,
}


@dataclass(frozen=True, slots=True)
class Question(Generic[T]):
    """A question on its way.

    Attributes:
        service: that it goes to.
        payload: as it travels.
        read: makes the answer of a reply's payload.
    """

    service: Service
    payload: bytes
    read: Callable[[bytes], T]


def project(
    points: Points, cameras: Sequence[str] | None, covariance: CovarianceOf | None, calibration_id: str
) -> Question[Projected]:
    """Where do points appear?"""
    names = None if cameras is None else tuple(cameras)
    return Question(Service.PROJECT, encode(ProjectAsked(points, names, covariance, calibration_id)), projected_of)


def rays(camera: str, px: npt.ArrayLike, calibration_id: str) -> Question[Rays]:
    """Along which lines do pixels look?"""
    return Question(Service.LOCATE, encode(RaysAsked(camera, rows(px, 2, "px"), calibration_id)), rays_of)


def floor_points(
    camera: str, px: npt.ArrayLike, sigma_px: float, plane: Plane | None, calibration_id: str
) -> Question[Located]:
    """Where do these meet a plane?"""
    given = None if plane is None else (rows(np.asarray(plane[0])[None], 3, "normal")[0], plane[1])
    asked = FloorAsked(camera, rows(px, 2, "px"), sigma_px, given, calibration_id)
    return Question(Service.LOCATE, encode(asked), located_of)


def triangulate(pixels: Mapping[str, npt.ArrayLike], sigma_px: float, calibration_id: str) -> Question[Located]:
    """Where do those of several cameras meet?"""
    given = {camera: rows(px, 2, f"px of {camera}") for camera, px in pixels.items()}
    return Question(Service.LOCATE, encode(TriangulateAsked(given, sigma_px, calibration_id)), located_of)


def bearings(
    lrf: str,
    points: npt.ArrayLike | CameraPixels,
    tilt_rad: float | None,
    stamp_ns: int | None,
    calibration_id: str,
) -> Question[Bearings]:
    """Which beams meet these points, or the lines of these pixels?"""
    given = points if isinstance(points, CameraPixels) else rows(points, 3, "xyz_in_world")
    return Question(
        Service.BEARINGS, encode(BearingsAsked(lrf, given, tilt_rad, stamp_ns, calibration_id)), bearings_of
    )


def payload_of(reply: zenoh.Reply) -> bytes | None:
    """Of a reply; None when the time was over.

    Raises:
        ProjectionError: the service refused.
        DeviceError: the reply is an error that cannot be read.
    """
    if reply.ok is not None:
        return reply.ok.payload.to_bytes()
    told = b"" if reply.err is None else reply.err.payload.to_bytes()
    if told == TIMEOUT:
        return None
    raise error_of(told)


def no_answer(site: str, timeout_s: float) -> DeviceError:
    """Nobody answered."""
    return DeviceError(
        f"no projection service of site {site} answered within {timeout_s:g} s",
        advice="Does `spotcal projection` run, and does it reach the same router?",
    )


@contextmanager
def session_within(bus: BusOptions, timeout_s: float) -> Iterator[zenoh.Session]:
    """A session, when a router answers in time.

    Raises:
        DeviceError: none did.
        InputError: an address that is none.
    """
    over = threading.Event()
    timer = threading.Timer(timeout_s, over.set)
    timer.daemon = True
    timer.start()
    try:
        with open_bus(bus, stop=over) as session:
            timer.cancel()
            yield session
    finally:
        timer.cancel()
