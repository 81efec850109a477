"""`ProjectionClient` for asyncio: many questions at a time, and the event loop never waits for the bus."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, suppress
from types import TracebackType
from typing import Self, TypeVar

import numpy.typing as npt
import zenoh

from nodes.bus.keys import Keys
from nodes.bus.session import DEFAULT_ENDPOINT, BusOptions, TlsFiles
from nodes.devices.errors import DeviceError
from nodes.projection import questions
from nodes.projection.points import Bearings, CovarianceOf, Located, Points, Projected, Rays, rows
from nodes.projection.questions import AGAIN_S, ASK_S, MAX_UNDER_WAY, QUERY, Question
from nodes.projection.requests import CameraPixels
from nodes.projection.services import service_key

T = TypeVar("T")


class AsyncProjectionClient:
    """For the `async with` block of one event loop; otherwise as `ProjectionClient`, whose methods it awaits."""

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
        self._under_way = asyncio.Semaphore(MAX_UNDER_WAY)
        self._session: zenoh.Session | None = None

    async def __aenter__(self) -> Self:
        opening = questions.session_within(self._bus, self._timeout_s)
        self._session = await asyncio.to_thread(self._stack.enter_context, opening)
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self.close()

    async def close(self) -> None:
        """Leave the bus."""
        self._session = None
        await asyncio.to_thread(self._stack.close)

    async def project(
        self,
        points: Points,
        cameras: Sequence[str] | None = None,
        *,
        covariance: CovarianceOf | None = None,
        calibration_id: str = "",
    ) -> Projected:
        """As `ProjectionClient.project`."""
        return await self._ask(questions.project(points, cameras, covariance, calibration_id))

    async def rays(self, camera: str, px: npt.ArrayLike, *, calibration_id: str = "") -> Rays:
        """As `ProjectionClient.rays`."""
        return await self._ask(questions.rays(camera, px, calibration_id))

    async def floor_points(
        self,
        camera: str,
        px: npt.ArrayLike,
        *,
        sigma_px: float = 0.5,
        plane: questions.Plane | None = None,
        calibration_id: str = "",
    ) -> Located:
        """As `ProjectionClient.floor_points`."""
        return await self._ask(questions.floor_points(camera, px, sigma_px, plane, calibration_id))

    async def triangulate(
        self, pixels: Mapping[str, npt.ArrayLike], sigma_px: float = 0.5, *, calibration_id: str = ""
    ) -> Located:
        """As `ProjectionClient.triangulate`."""
        return await self._ask(questions.triangulate(pixels, sigma_px, calibration_id))

    async def bearings(
        self,
        lrf: str,
        xyz_in_world: npt.ArrayLike,
        tilt_rad: float | None = None,
        *,
        stamp_ns: int | None = None,
        calibration_id: str = "",
    ) -> Bearings:
        """As `ProjectionClient.bearings`."""
        return await self._ask(questions.bearings(lrf, xyz_in_world, tilt_rad, stamp_ns, calibration_id))

    async def bearings_of_pixels(
        self,
        lrf: str,
        camera: str,
        px: npt.ArrayLike,
        tilt_rad: float | None = None,
        *,
        stamp_ns: int | None = None,
        calibration_id: str = "",
    ) -> Bearings:
        """As `ProjectionClient.bearings_of_pixels`."""
        pixels = CameraPixels(camera, rows(px, 2, "px"))
        return await self._ask(questions.bearings(lrf, pixels, tilt_rad, stamp_ns, calibration_id))

    async def _ask(self, question: Question[T]) -> T:
        end_s = time.monotonic() + self._timeout_s
        key = service_key(self._keys, question.service)
        while (left_s := end_s - time.monotonic()) > 0:
            async with self._under_way:
                reply = await self._reply(key, question.payload, min(left_s, ASK_S))
            payload = None if reply is None else questions.payload_of(reply)
            if payload is not None:
                return question.read(payload)
            await asyncio.sleep(min(AGAIN_S, max(end_s - time.monotonic(), 0)))
        raise questions.no_answer(self._keys.site, self._timeout_s)

    async def _reply(self, key: str, request: bytes, timeout_s: float) -> zenoh.Reply | None:
        """The one reply; None when there is none."""
        if self._session is None:
            raise DeviceError("the projection client is not connected", advice="Use it within its `async with` block.")
        loop = asyncio.get_running_loop()
        first: asyncio.Future[zenoh.Reply | None] = loop.create_future()

        def settle(reply: zenoh.Reply | None) -> None:
            if not first.done():
                first.set_result(reply)

        def come(reply: zenoh.Reply) -> None:
            # In Zenoh's own thread, which hands over and goes on; a thread for each question would cost more.
            _hand_over(loop, settle, reply)

        handler = zenoh.handlers.Callback(come, lambda: _hand_over(loop, settle, None), indirect=False)
        try:
            self._session.get(key, handler, payload=request, timeout=timeout_s, **QUERY)
        except zenoh.ZError as error:
            raise DeviceError(f"the projection service could not be asked: {error}") from None
        return await first


def _hand_over(
    loop: asyncio.AbstractEventLoop, settle: Callable[[zenoh.Reply | None], None], reply: zenoh.Reply | None
) -> None:
    with suppress(RuntimeError):  # the loop has ended; nobody waits
        loop.call_soon_threadsafe(settle, reply)
