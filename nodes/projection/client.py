"""Ask the projection service: NumPy in, NumPy out, the same questions and the same numbers as `Calibration`."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from types import TracebackType
from typing import Self, TypeVar

import numpy.typing as npt
import zenoh

from nodes.bus.keys import Keys
from nodes.bus.session import DEFAULT_ENDPOINT, BusOptions, TlsFiles
from nodes.devices.errors import DeviceError
from nodes.projection import questions
from nodes.projection.points import Bearings, CovarianceOf, Located, Points, Projected, Rays, rows
from nodes.projection.questions import AGAIN_S, ASK_S, QUERY, Question
from nodes.projection.requests import CameraPixels
from nodes.projection.services import service_key

T = TypeVar("T")


class ProjectionClient:
    """For the `with` block; any thread may ask. It connects again by itself, and asks again when nobody answered.

    Every method raises ProjectionError when the service refuses (its `code` says why) and DeviceError when none
    answers in time. `calibration_id`, where given, is the only calibration that is answered under.

    Args:
        site: name, as the service was given it.
        router: addresses; the first that answers is taken.
        tls: certificates, where the site has any.
        timeout_s: for connecting, and for each answer.
    """

    def __init__(
        self,
        site: str,
        *,
        router: Sequence[str] = (DEFAULT_ENDPOINT,),
        tls: TlsFiles | None = None,
        timeout_s: float = 5.0,
    ) -> None:
        self._keys = Keys(site)
        self._bus = BusOptions(site, (router,) if isinstance(router, str) else tuple(router), tls)
        self._timeout_s = timeout_s
        self._stack = ExitStack()
        self._session: zenoh.Session | None = None

    def __enter__(self) -> Self:
        self._session = self._stack.enter_context(questions.session_within(self._bus, self._timeout_s))
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Leave the bus."""
        self._session = None
        self._stack.close()

    def project(
        self,
        points: Points,
        cameras: Sequence[str] | None = None,
        *,
        covariance: CovarianceOf | None = None,
        calibration_id: str = "",
    ) -> Projected:
        """Where N points appear in all cameras, or in those named.

        Beams and LRF points that give a stamp and no tilt are projected with what the service knows of the tilt.
        """
        return self._ask(questions.project(points, cameras, covariance, calibration_id))

    def rays(self, camera: str, px: npt.ArrayLike, *, calibration_id: str = "") -> Rays:
        """Lines along which pixels (N, 2) look."""
        return self._ask(questions.rays(camera, px, calibration_id))

    def floor_points(
        self,
        camera: str,
        px: npt.ArrayLike,
        *,
        sigma_px: float = 0.5,
        plane: questions.Plane | None = None,
        calibration_id: str = "",
    ) -> Located:
        """Where these meet a plane, (normal, offset) with normal . x = offset in the world; by default z = 0."""
        return self._ask(questions.floor_points(camera, px, sigma_px, plane, calibration_id))

    def triangulate(
        self, pixels: Mapping[str, npt.ArrayLike], sigma_px: float = 0.5, *, calibration_id: str = ""
    ) -> Located:
        """Points from their pixels (N, 2) in two or more cameras, NaN where a camera does not see one."""
        return self._ask(questions.triangulate(pixels, sigma_px, calibration_id))

    def bearings(
        self,
        lrf: str,
        xyz_in_world: npt.ArrayLike,
        tilt_rad: float | None = None,
        *,
        stamp_ns: int | None = None,
        calibration_id: str = "",
    ) -> Bearings:
        """Which beams of a scanner meet points (N, 3), at a tilt or at the tilt that it had at a stamp."""
        return self._ask(questions.bearings(lrf, xyz_in_world, tilt_rad, stamp_ns, calibration_id))

    def bearings_of_pixels(
        self,
        lrf: str,
        camera: str,
        px: npt.ArrayLike,
        tilt_rad: float | None = None,
        *,
        stamp_ns: int | None = None,
        calibration_id: str = "",
    ) -> Bearings:
        """Which beams end where pixels (N, 2) look: where their lines meet the scan plane."""
        pixels = CameraPixels(camera, rows(px, 2, "px"))
        return self._ask(questions.bearings(lrf, pixels, tilt_rad, stamp_ns, calibration_id))

    def _ask(self, question: Question[T]) -> T:
        end_s = time.monotonic() + self._timeout_s
        key = service_key(self._keys, question.service)
        while (left_s := end_s - time.monotonic()) > 0:
            payload = self._reply(key, question.payload, min(left_s, ASK_S))
            if payload is not None:
                return question.read(payload)
            time.sleep(min(AGAIN_S, max(end_s - time.monotonic(), 0)))
        raise questions.no_answer(self._keys.site, self._timeout_s)

    def _reply(self, key: str, request: bytes, timeout_s: float) -> bytes | None:
        """The payload of the one reply; None when there is none."""
        if self._session is None:
            raise DeviceError("the projection client is not connected", advice="Use it within its `with` block.")
        try:
            for reply in self._session.get(key, payload=request, timeout=timeout_s, **QUERY):
                return questions.payload_of(reply)
        except zenoh.ZError as error:
            raise DeviceError(f"the projection service could not be asked: {error}") from None
        return None
