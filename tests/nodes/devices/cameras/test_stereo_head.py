"""Stereo heads: cutting both views apart, exactly, and giving them to two consumers."""

import threading
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from nodes.devices.cameras.stereo_head import N_WAITING, StereoHead, paired, split_stereo
from nodes.devices.cameras.stereo_split import StereoLayout, split_image
from nodes.devices.cameras.video_file import VideoFile
from nodes.devices.errors import SourceError
from nodes.frames import Frame, PixelFormat, SourceCounts, StampOrigin
from tests.nodes.devices.video_writer import picture, pictures, samples_of, write_video

MONO, BGR, YUV420 = PixelFormat.MONO, PixelFormat.BGR, PixelFormat.YUV420
CUTTING = (StereoLayout.LEFT_RIGHT, StereoLayout.TOP_BOTTOM, StereoLayout.LINES)


class LiveSource:
    """A source that cannot begin anew, and delivers the same memory again and again."""

    def __init__(self, frames):
        self.name, self.rate_hz, self.counts = "head", 30.0, SourceCounts()
        self.size_px = frames[0].size_px
        self._frames, self._memory = iter(frames), frames[0].image.copy()
        self.is_closed = False

    def __iter__(self):
        for frame in self._frames:
            self._memory[...] = frame.image
            yield replace(frame, image=self._memory)
            self._memory[...] = 0

    def close(self):
        self.is_closed = True

    def __enter__(self):
        return self

    def __exit__(self, kind, error, trace):
        self.close()


def frame_of(image, pixel_format=MONO, sequence=0, stamp_ns=0, bits=8):
    return Frame(sequence, stamp_ns, StampOrigin.CAMERA, image, pixel_format, bits)


def numbered(n_frames, *, first=0, step_ns=10):
    images = [np.full((4, 8), k % 256, np.uint8) for k in range(first, first + n_frames)]
    return [frame_of(image, sequence=k, stamp_ns=step_ns * k) for k, image in enumerate(images, start=first)]


def yuv420_of(luma, u, v):
    return np.concatenate([luma.ravel(), u.ravel(), v.ravel()]).reshape(-1, luma.shape[1])


def join(layout, left, right):
    """Both views of one plane as the head sends them."""
    if layout is StereoLayout.LEFT_RIGHT:
        return np.concatenate([left, right], axis=1)
    if layout is StereoLayout.TOP_BOTTOM:
        return np.concatenate([left, right], axis=0)
    return np.stack([left, right], axis=1).reshape(-1, *left.shape[1:])


@given(
    layout=st.sampled_from(CUTTING),
    halves=st.tuples(st.integers(1, 9), st.integers(1, 9)),
    channels=st.sampled_from([None, 3]),
    dtype=st.sampled_from([np.uint8, np.uint16]),
    seed=st.integers(0, 2**31),
)
def test_cutting_undoes_joining(layout, halves, channels, dtype, seed):
    shape = halves if channels is None else (*halves, channels)
    left, right = np.random.default_rng(seed).integers(0, 255, (2, *shape)).astype(dtype)
    frame = frame_of(join(layout, left, right), MONO if channels is None else BGR)
    cut = split_image(frame, layout)
    np.testing.assert_array_equal(cut[0], left)
    np.testing.assert_array_equal(cut[1], right)


@given(
    layout=st.sampled_from(CUTTING[:2]),
    halves=st.tuples(st.integers(1, 6), st.integers(1, 6)),
    dtype=st.sampled_from([np.uint8, np.uint16]),
    seed=st.integers(0, 2**31),
)
def test_cutting_undoes_joining_with_chroma(layout, halves, dtype, seed):
    rng = np.random.default_rng(seed)
    height, width = 2 * halves[0], 2 * halves[1]
    luma = rng.integers(0, 255, (2, height, width)).astype(dtype)
    chroma = rng.integers(0, 255, (2, 2, height // 2, width // 2)).astype(dtype)
    joined = yuv420_of(join(layout, *luma), join(layout, *chroma[0]), join(layout, *chroma[1]))
    cut = split_image(frame_of(joined, YUV420), layout)
    for side in (0, 1):
        np.testing.assert_array_equal(cut[side], yuv420_of(luma[side], chroma[0, side], chroma[1, side]))


def test_lines_share_their_chroma():
    luma = np.arange(8 * 4, dtype=np.uint8).reshape(8, 4)
    u = np.array([[10, 20], [12, 23], [0, 0], [0, 255]], np.uint8)
    cut = split_image(frame_of(yuv420_of(luma, u, u + np.uint8(1)), YUV420), StereoLayout.LINES)
    for side in (0, 1):
        np.testing.assert_array_equal(cut[side][:4], luma[side::2])
        np.testing.assert_array_equal(cut[side][4:5], [[11, 22, 0, 128]])
    assert cut[0].shape == (6, 4)


@pytest.mark.parametrize(
    ("layout", "pixel_format", "size_px", "words"),
    [
        (StereoLayout.LEFT_RIGHT, MONO, (7, 4), "width is 7 px, expected a multiple of 2"),
        (StereoLayout.LEFT_RIGHT, YUV420, (6, 4), "width is 6 px, expected a multiple of 4"),
        (StereoLayout.TOP_BOTTOM, BGR, (6, 5), "height is 5 px, expected a multiple of 2"),
        (StereoLayout.LINES, YUV420, (8, 6), "height is 6 px, expected a multiple of 4"),
        (StereoLayout.LEFT_RIGHT, PixelFormat.BAYER_RGGB, (6, 4), "width is 6 px, expected a multiple of 4"),
        (StereoLayout.LINES, PixelFormat.BAYER_RGGB, (8, 8), "mosaic belong together"),
    ],
)
def test_images_that_cannot_be_halved_are_refused(layout, pixel_format, size_px, words):
    width, height = size_px
    shape = (height * 3 // 2, width) if pixel_format is YUV420 else (height, width)
    image = np.zeros((*shape, 3) if pixel_format is BGR else shape, np.uint8)
    head = StereoHead(LiveSource([frame_of(image, pixel_format)]), layout)
    with pytest.raises(SourceError, match=words):
        next(head.pairs())


def test_a_recording_that_cannot_be_halved_is_refused_and_closed_at_once(tmp_path):
    path = tmp_path / "head.mkv"
    write_video(path, pictures("yuv420p", 1, width=66, height=48))
    source = VideoFile(path)
    with pytest.raises(SourceError, match="width is 66 px, expected a multiple of 4"):
        StereoHead(source, StereoLayout.LEFT_RIGHT)
    with pytest.raises(SourceError, match="closed"):
        next(iter(source))


@pytest.fixture
def recording(tmp_path):
    path = tmp_path / "head.mkv"
    write_video(path, pictures("gray", 20))
    return path


def test_views_of_a_recording_are_read_each_from_the_beginning(recording):
    left, right = split_stereo(VideoFile(recording), StereoLayout.LEFT_RIGHT)
    lefts, rights = list(left), list(right)
    assert len(lefts) == len(rights) == left.counts.delivered == 20
    assert (left.size_px, left.rate_hz, left.name) == ((32, 48), 25.0, "head.mkv (left)")
    assert (right.info.kind, right.info.size_px, right.name) == ("stereo", (32, 48), "head.mkv (right)")
    for k, (a, b) in enumerate(zip(lefts, rights, strict=True)):
        whole = samples_of(picture(k, "gray"), 0, width=64, height=48)
        np.testing.assert_array_equal(np.concatenate([a.image, b.image], axis=1), whole)
        assert (a.sequence, a.stamp_ns, a.origin) == (b.sequence, b.stamp_ns, b.origin) == (k, k * 40_000_000, a.origin)


def test_the_source_is_closed_with_the_second_view(recording):
    source = VideoFile(recording)
    left, right = split_stereo(source, StereoLayout.TOP_BOTTOM)
    left.close()
    left.close()
    assert list(left) == []
    assert len(list(right)) == 20
    right.close()
    with pytest.raises(SourceError, match="closed"):
        next(iter(source))


@pytest.mark.parametrize("is_swapped", [False, True])
def test_pairs_come_in_lock_step(recording, is_swapped):
    with StereoHead(VideoFile(recording), StereoLayout.LEFT_RIGHT, is_swapped=is_swapped) as head:
        pairs = list(head.pairs())
    first = samples_of(picture(0, "gray"), 0, width=64, height=48)
    assert len(pairs) == 20
    np.testing.assert_array_equal(pairs[0][is_swapped].image, first[:, :32])


def test_alternating_frames_are_paired_by_their_number():
    frames = numbered(11)
    arriving = [frames[k] for k in (1, 2, 3, 4, 7, 8, 9, 10)]  # 0, 5 and 6 were lost
    head = StereoHead(LiveSource(arriving), StereoLayout.ALTERNATING)
    pairs = [(a.image[0, 0], b.image[0, 0], a.sequence, b.sequence, a.stamp_ns, b.stamp_ns) for a, b in head.pairs()]
    assert pairs == [(2, 3, 1, 1, 20, 20), (8, 9, 4, 4, 80, 80)]
    assert (head.view_size_px, head.view_rate_hz) == ((8, 4), 15.0)


def test_live_views_in_turn_get_every_frame():
    left, right = split_stereo(LiveSource(numbered(30)), StereoLayout.LEFT_RIGHT)
    lefts, rights = iter(left), iter(right)
    for k in range(30):
        sides = (lefts, rights) if k % 3 else (rights, lefts)
        a, b = (next(side) for side in sides)
        assert a.sequence == b.sequence == k
        assert a.image.min() == a.image.max() == b.image.min() == k
    assert next(lefts, None) is None
    assert next(rights, None) is None


def test_a_live_view_that_is_not_asked_loses_its_oldest_frames():
    left, right = split_stereo(LiveSource(numbered(30)), StereoLayout.LEFT_RIGHT)
    rights = iter(right)
    assert next(rights).sequence == 0
    assert [frame.sequence for frame in left] == list(range(30))
    assert [frame.sequence for frame in rights] == list(range(30 - N_WAITING, 30))
    assert (right.counts.delivered, right.counts.dropped) == (1 + N_WAITING, 29 - N_WAITING)


def test_a_live_view_keeps_its_frame_while_the_other_goes_on():
    left, right = split_stereo(LiveSource(numbered(6)), StereoLayout.TOP_BOTTOM)
    lefts, rights = iter(left), iter(right)
    kept = [next(lefts), next(lefts)]
    kept += [next(rights) for _ in range(5)]
    assert [(frame.image.min(), frame.image.max()) for frame in kept] == [(k, k) for k in (0, 1, 0, 1, 2, 3, 4)]


def test_two_threads_share_a_live_head():
    left, right = split_stereo(LiveSource(numbered(400)), StereoLayout.TOP_BOTTOM)
    seen = ([], [])

    def consume(side, view):
        seen[side].extend((frame.sequence, int(frame.image.min()), int(frame.image.max())) for frame in view)

    threads = [threading.Thread(target=consume, args=(k, view)) for k, view in enumerate((left, right))]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(timeout=60)
    for side, view in enumerate((left, right)):
        numbers = [number for number, _, _ in seen[side]]
        assert numbers == sorted(set(numbers))
        assert numbers[-1] == 399
        # Frames before the first that a view delivers are not counted: a live source begins with its first frame.
        assert view.counts.delivered + view.counts.dropped == 400 - numbers[0]
        assert all(low == high == number % 256 for number, low, high in seen[side])


def test_an_error_of_the_source_reaches_the_views():
    class Failing(LiveSource):
        def __iter__(self):
            yield from super().__iter__()
            raise SourceError("the cable is out")

    left, _ = split_stereo(Failing(numbered(2)), StereoLayout.LEFT_RIGHT)
    frames = iter(left)
    assert [next(frames).sequence for _ in range(2)] == [0, 1]
    with pytest.raises(SourceError, match="the cable is out"):
        next(frames)


@given(
    is_kept=st.lists(st.tuples(st.booleans(), st.booleans()), max_size=30),
    offset_ns=st.integers(-400, 400),
    jitter_seed=st.integers(0, 2**31),
)
def test_two_devices_are_paired_by_their_stamps(is_kept, offset_ns, jitter_seed):
    jitter = np.random.default_rng(jitter_seed).integers(-40, 41, (len(is_kept), 2))
    image = np.zeros((2, 2), np.uint8)
    sides = [
        [
            frame_of(image, sequence=k, stamp_ns=1000 * k + side * offset_ns + int(jitter[k, side]))
            for k, kept in enumerate(is_kept)
            if kept[side]
        ]
        for side in (0, 1)
    ]
    if all(sides):
        got = [(a.sequence, b.sequence) for a, b in paired(*map(LiveSource, sides), tolerance_ns=490)]
        # Offset and both jitters together stay within the tolerance, and it below half the frame interval of 1000.
        assert got == [(k, k) for k, kept in enumerate(is_kept) if all(kept)]
