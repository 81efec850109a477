"""Every frame stands in one message, in order, and every message passes the coordinator's door."""

import time
from dataclasses import replace

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from nodes.bus import spotcal_pb2 as pb
from nodes.bus.checks import SCHEMA, parse_observation
from nodes.bus.keys import Kind
from nodes.camera.spot_batches import BatchOptions, SpotBatcher
from nodes.detection.spots import Spot
from nodes.frames import Frame, PixelFormat, StampOrigin

T0_NS = 1_700_000_000 * 10**9
SPAN_NS = 80_000_000
IMAGE = np.zeros((48, 64), np.uint8)


def frame(sequence, stamp_ns, origin=StampOrigin.DRIVER):
    return Frame(sequence, T0_NS + stamp_ns, origin, IMAGE, PixelFormat.MONO)


def spot(x=10.0, y=20.0, sigma=0.1, score=0.5):
    return Spot(np.array([x, y]), sigma**2 * np.eye(2), score, 0.5, 1.0, 0.0, False)


def batched(frames, spots=lambda frame: [], rate_hz=30.0):  # noqa: ARG005
    batcher = SpotBatcher(BatchOptions("C0", rate_hz, SPAN_NS))
    out = [batch for one in frames for batch in batcher.add(one, spots(one), n_dropped=3)]
    return out + batcher.flush()


def checked(batch):
    """As the coordinator takes it."""
    batch.header.schema, batch.header.node, batch.header.boot = SCHEMA, "n", b"0" * 16
    batch.header.stamp_ns = batch.frame_stamp_ns[0]
    parsed = parse_observation(Kind.SPOTS, batch.SerializeToString(), node="n", now_ns=time.time_ns())
    assert isinstance(parsed, pb.SpotBatch)
    return parsed


@given(
    steps=st.lists(st.tuples(st.integers(-3, 4), st.integers(0, 200_000_000)), max_size=40),
    rate_hz=st.sampled_from([0.0, 30.0, 200.0]),
)
def test_no_frame_is_lost_or_doubled(steps, rate_hz):
    # Sequences may fall: a camera that was connected again counts anew.
    walk = np.maximum(np.cumsum([(0, 0), *steps], axis=0), 0).tolist()
    frames = [frame(k, ns) for k, ns in walk]
    batches = batched(frames, rate_hz=rate_hz)
    told = [(k, ns) for batch in batches for k, ns in zip(batch.frame_sequence, batch.frame_stamp_ns, strict=True)]
    assert told == [(one.sequence, one.stamp_ns) for one in frames]
    for batch in batches:
        checked(batch)


def test_messages_are_of_50_to_100_ms():
    for rate_hz in (15.0, 30.0, 60.0, 200.0):
        frames = [frame(k, round(1e9 * k / rate_hz)) for k in range(300)]
        n = [len(batch.frame_sequence) for batch in batched(frames, rate_hz=rate_hz)[:-1]]
        # A message spans from its first frame to the next message's first.
        assert all(0.050 <= count / rate_hz <= 0.134 for count in n), (rate_hz, n)
        if rate_hz > 20:
            assert all(count / rate_hz <= 0.100 + 1e-9 for count in n)


def test_spots_stand_with_their_frame():
    seen = {1: [spot(1.0), spot(2.0)], 2: [spot(3.0)]}
    (batch,) = batched([frame(k, k * 10**6) for k in range(4)], lambda one: seen.get(one.sequence, []))
    assert list(batch.spot_frame) == [1, 1, 2]
    assert list(batch.x_px) == [1.0, 2.0, 3.0]
    assert (batch.width_px, batch.height_px, batch.n_dropped) == (64, 48, 3)


def test_what_the_door_would_refuse_is_left_out():
    bad = [spot(x=-0.6), spot(y=47.6), spot(sigma=5.0), spot(x=np.nan), spot(sigma=1e-9), spot(score=1.0 + 1e-12)]
    (batch,) = batched([frame(0, 0)], lambda _: bad)
    assert len(checked(batch).x_px) == 1


def test_an_other_kind_of_stamp_begins_a_message():
    first, second = batched([frame(0, 0, StampOrigin.ARRIVAL), frame(1, 1000, StampOrigin.CAMERA)])
    assert first.origin != second.origin


def test_a_camera_of_another_size_begins_a_message():
    large = replace(frame(1, 1000), image=np.zeros((96, 128), np.uint8))
    assert [batch.width_px for batch in batched([frame(0, 0), large])] == [64, 128]
