"""Clients and service over a router, all in this process: numbers, refusals, and what happens when one is away."""

import asyncio
import threading
import time
from dataclasses import replace

import numpy as np
import pytest

from nodes.bus.session import open_router
from nodes.devices.errors import DeviceError
from nodes.projection import AsyncProjectionClient, Calibration, ProjectionClient
from nodes.projection.errors import ErrorCode, ProjectionError
from nodes.projection.points import CovarianceOf, LrfPoints, WorldPoints
from tests.nodes.bus.buses import free_endpoint, routed, wait_until
from tests.nodes.projection.served import SITE, TILT_RAD, beams, serving, write_calibration
from tests.nodes.projection.test_wire import assert_same

PATIENCE_S = 20.0


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    return write_calibration(tmp_path_factory.mktemp("calibration") / "calibration.json")


@pytest.fixture(scope="module")
def endpoint(path):
    with routed() as endpoint, serving(endpoint, path) as said:
        wait_until(lambda: len(said) == 2, "the service to answer")
        yield endpoint


@pytest.fixture
def client(endpoint):
    with ProjectionClient(SITE, router=[endpoint], timeout_s=PATIENCE_S) as client:
        yield client


@pytest.fixture(scope="module")
def here(path):
    return Calibration.load(path)


def questions(here):
    """Every kind of question, as (method, arguments, keywords)."""
    world = WorldPoints(here.project(beams()).px[0, :40].mean() * np.ones((3, 3)) * 1e-3)
    c0, c1 = here.camera_names[:2]
    scan = beams()
    flat = LrfPoints("L0", np.column_stack([np.full(4, 2.0), [0.0, 0.1, -0.1, np.nan], np.zeros(4)]), TILT_RAD)
    px = np.array([[100.0, 120.0], [np.nan, 3.0], [200.25, 90.5]])
    return [
        ("project", (scan,), {}),
        ("project", (scan, [c1, c0]), {"covariance": CovarianceOf()}),
        ("project", (replace(scan, tilt_rad=np.full(len(scan), TILT_RAD) + 1e-3),), {}),
        ("project", (flat,), {"covariance": CovarianceOf(calibration=False)}),
        ("project", (world,), {"covariance": CovarianceOf(noise=None, point_sigma_m=0.01)}),
        ("rays", (c0, px), {}),
        ("floor_points", (c0, px), {"sigma_px": 0.7}),
        ("floor_points", (c0, px), {"plane": ([0.0, 0.6, 0.8], 1.0)}),
        ("triangulate", ({c0: px, c1: px + 7.0},), {"sigma_px": 0.7}),
        ("bearings", ("L0", np.ones((3, 3)), TILT_RAD), {}),
        ("bearings_of_pixels", ("L0", c0, px, TILT_RAD), {}),
    ]


def test_the_service_gives_the_numbers_of_the_calibration_in_process_to_the_last_bit(client, here):
    n_valid = 0
    for method, arguments, keywords in questions(here):
        told = getattr(client, method)(*arguments, **keywords)
        assert_same(told, getattr(here, method)(*arguments, **keywords))
        assert told.calibration_id == here.id
        n_valid += (told.is_seen if method.startswith("bearings") else told.is_valid).sum()
    # Otherwise equal numbers would say little.
    assert n_valid > 1000


def test_many_questions_at_a_time_by_asyncio_give_the_same_numbers(endpoint, here):
    async def ask_all():
        async with AsyncProjectionClient(SITE, router=[endpoint], timeout_s=PATIENCE_S) as client:
            asked = questions(here) * 5
            return await asyncio.gather(*(getattr(client, method)(*args, **more) for method, args, more in asked))

    for told, (method, arguments, keywords) in zip(asyncio.run(ask_all()), questions(here) * 5, strict=True):
        assert_same(told, getattr(here, method)(*arguments, **keywords))


def test_the_event_loop_goes_on_while_nobody_answers():
    """Of a site without a service: asked again and again, until the time is over; meanwhile the loop turns."""

    async def turns_while_asking(endpoint):
        turns = 0
        async with AsyncProjectionClient("nobody", router=[endpoint], timeout_s=0.5) as client:
            asking = asyncio.create_task(client.project(beams()))
            while not asking.done():
                await asyncio.sleep(0.005)
                turns += 1
            with pytest.raises(DeviceError, match=r"no projection service of site nobody answered within 0\.5 s"):
                asking.result()
        return turns

    with routed() as endpoint:
        # Blocked by a reply that does not come, it would turn once or twice: 100 fit, a tenth of them must.
        assert asyncio.run(turns_while_asking(endpoint)) >= 10


def test_a_refusal_by_the_service_is_raised_by_both_clients(client, endpoint):
    with pytest.raises(ProjectionError) as refused:
        client.project(beams(), ["C9"])
    assert (refused.value.code, "C9" in refused.value.message) == (ErrorCode.UNKNOWN_CAMERA, True)

    async def ask():
        async with AsyncProjectionClient(SITE, router=[endpoint], timeout_s=PATIENCE_S) as asker:
            with pytest.raises(ProjectionError) as refused:
                await asker.project(beams(lrf="L9"))
            return refused.value.code

    assert asyncio.run(ask()) == ErrorCode.UNKNOWN_LRF


def test_only_the_calibration_that_was_named_answers(client, here):
    assert client.project(beams(), calibration_id=here.id).calibration_id == here.id
    with pytest.raises(ProjectionError, match=f"calibration older is not in force, {here.id} is") as refused:
        client.rays(here.camera_names[0], [[1.0, 2.0]], calibration_id="older")
    assert (refused.value.code, refused.value.detail) == (ErrorCode.STALE_CALIBRATION, here.id)


def test_what_would_not_fit_into_a_message_is_refused_at_either_end(client):
    # 24 bytes a point and 25 a pixel: a request may have 4 MiB, an answer 12 MiB.
    for n_points, told in ((200_000, "a request of 48000.. bytes"), (120_000, "120000 points in 5 cameras")):
        with pytest.raises(ProjectionError, match=told) as refused:
            client.project(WorldPoints(np.zeros((n_points, 3))))
        assert refused.value.code == ErrorCode.TOO_LARGE
    assert client.project(WorldPoints(np.zeros((100_000, 3)))).px.shape == (5, 100_000, 2)


def test_a_client_that_asks_before_the_service_runs_gets_its_answer(path, here):
    with routed() as endpoint, ProjectionClient(SITE, router=[endpoint], timeout_s=PATIENCE_S) as client:
        told = []
        asking = threading.Thread(target=lambda: told.append(client.project(beams())), daemon=True)
        asking.start()
        time.sleep(0.2)
        assert not told
        with serving(endpoint, path):
            asking.join(PATIENCE_S)
    assert_same(told[0], here.project(beams()))


def test_client_and_service_connect_again_when_the_router_was_away(path, here):
    endpoint = free_endpoint()
    router = open_router((endpoint,))
    router.__enter__()
    try:
        with serving(endpoint, path), ProjectionClient(SITE, router=[endpoint], timeout_s=PATIENCE_S) as client:
            client.project(beams())
            router.__exit__(None, None, None)
            router = open_router((endpoint,))
            router.__enter__()
            assert_same(client.project(beams()), here.project(beams()))
    finally:
        router.__exit__(None, None, None)


def test_without_a_router_the_client_says_so():
    with (
        pytest.raises(DeviceError, match="no router answered"),
        ProjectionClient(SITE, router=[free_endpoint()], timeout_s=0.2),
    ):
        pass


def test_a_client_outside_its_block_says_so(endpoint):
    with ProjectionClient(SITE, router=endpoint) as client:
        pass
    with pytest.raises(DeviceError, match="not connected"):
        client.project(beams())
