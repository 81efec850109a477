"""Video files: samples, times, what is told of them, and what is refused."""

import os
import socket
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from network_calib.errors import InputError
from nodes.devices.cameras.video_file import VideoFile
from nodes.devices.cameras.video_open import VideoOptions
from nodes.devices.cameras.video_probe import ns_from_pts
from nodes.devices.errors import SourceError
from nodes.frames import PixelFormat, StampOrigin
from tests.nodes.devices.video_writer import HEIGHT, WIDTH, picture, pictures, planar, samples_of, write_video

FRAME_NS = 40_000_000


@pytest.fixture
def plain(tmp_path):
    """Twelve frames of H.264 at 25 Hz."""
    path = tmp_path / "plain.mp4"
    write_video(path, pictures("yuv420p", 12), codec="libx264")
    return path


def frames_of(path, options=None):
    with VideoFile(path, options) as source:
        return list(source)


@pytest.mark.parametrize(
    ("name", "codec", "format_name", "bits"),
    [
        ("a.mp4", "libx264", "yuv420p", 8),
        ("a.mkv", "libx265", "yuv420p", 8),
        ("a.mkv", "ffv1", "yuv420p", 8),
        ("a.mkv", "ffv1", "yuv420p10le", 10),
        ("a.mkv", "ffv1", "yuv420p12le", 12),
        ("a.mkv", "ffv1", "yuv420p16le", 16),
        ("a.mp4", "libx264", "yuv420p10le", 10),
    ],
)
def test_420_is_delivered_sample_for_sample(tmp_path, name, codec, format_name, bits):
    path = tmp_path / name
    write_video(path, pictures(format_name, 5), codec=codec)
    frames = frames_of(path)
    assert len(frames) == 5
    for number, frame in enumerate(frames):
        assert (frame.pixel_format, frame.bits, frame.is_full_range) == (PixelFormat.YUV420, bits, False)
        assert frame.size_px == (WIDTH, HEIGHT)
        np.testing.assert_array_equal(frame.image, planar(picture(number, format_name)))


@pytest.mark.parametrize(("format_name", "bits"), [("gray", 8), ("gray10le", 10), ("gray12le", 12), ("gray16le", 16)])
def test_gray_is_delivered_sample_for_sample(tmp_path, format_name, bits):
    path = tmp_path / "gray.mkv"
    write_video(path, pictures(format_name, 3))
    for number, frame in enumerate(frames_of(path)):
        assert (frame.pixel_format, frame.bits) == (PixelFormat.MONO, bits)
        expected = samples_of(picture(number, format_name), 0, width=WIDTH, height=HEIGHT)
        assert frame.image.dtype == expected.dtype
        np.testing.assert_array_equal(frame.image, expected)


@pytest.mark.parametrize(("format_name", "bits"), [("gbrp10le", 10), ("gbrp12le", 12), ("gbrp16le", 16)])
def test_deep_colour_is_delivered_sample_for_sample(tmp_path, format_name, bits):
    path = tmp_path / "deep.mkv"
    write_video(path, pictures(format_name, 2))
    for number, frame in enumerate(frames_of(path)):
        made = picture(number, format_name)
        blue, green, red = (samples_of(made, k, width=WIDTH, height=HEIGHT) for k in (1, 0, 2))
        assert (frame.pixel_format, frame.bits) == (PixelFormat.BGR, bits)
        np.testing.assert_array_equal(frame.image, np.stack([blue, green, red], axis=-1))


@pytest.mark.parametrize(("name", "codec", "format_name"), [("a.mkv", "ffv1", "bgr0"), ("a.avi", "rawvideo", "bgr24")])
def test_rgb_is_delivered_sample_for_sample(tmp_path, name, codec, format_name):
    path = tmp_path / name
    write_video(path, pictures(format_name, 2), codec=codec)
    n_samples = 4 if format_name == "bgr0" else 3
    for number, frame in enumerate(frames_of(path)):
        packed = samples_of(picture(number, format_name), 0, width=WIDTH * n_samples, height=HEIGHT)
        assert (frame.pixel_format, frame.bits) == (PixelFormat.BGR, 8)
        np.testing.assert_array_equal(frame.image, packed.reshape(HEIGHT, WIDTH, n_samples)[..., :3])


def test_mjpeg_is_full_range(tmp_path):
    path = tmp_path / "usb.avi"
    white = av.VideoFrame(WIDTH, HEIGHT, "yuvj420p")
    for plane, value in zip(white.planes, (255, 128, 128), strict=True):
        plane.update(bytes([value]) * plane.buffer_size)
    write_video(path, [white], codec="mjpeg")
    frame = frames_of(path)[0]
    assert frame.is_full_range
    assert frame.image[:HEIGHT].min() >= 254  # JPEG codes the mean of a flat block to within half a step


def test_odd_sizes_come_as_bgr(tmp_path):
    path = tmp_path / "odd.mkv"
    write_video(path, pictures("yuv420p", 1, width=63, height=47))
    frame = frames_of(path)[0]
    assert (frame.pixel_format, frame.image.shape, frame.size_px) == (PixelFormat.BGR, (47, 63, 3), (63, 47))


@given(
    pts=st.integers(-(2**62), 2**62),
    numerator=st.integers(1, 10**6),
    denominator=st.integers(1, 10**9),
)
def test_ns_from_pts_is_the_nearest_whole_number(pts, numerator, denominator):
    stamp_ns = ns_from_pts(pts, Fraction(numerator, denominator))
    # In whole numbers: 2 |stamp - pts * base * 1e9| <= 1.
    assert 2 * abs(stamp_ns * denominator - pts * numerator * 10**9) <= denominator


@given(pts=st.integers(0, 2**40), denominator=st.sampled_from([1, 1000, 25, 12800, 10**6, 10**9]))
def test_ns_from_pts_is_exact_where_a_tick_is_whole_ns(pts, denominator):
    assert ns_from_pts(pts, Fraction(1, denominator)) == pts * (10**9 // denominator)


def test_constant_rate(plain):
    with VideoFile(plain) as source:
        frames = list(source)
        assert source.rate_hz == 25.0
        assert (source.counts.delivered, source.counts.dropped, source.counts.late) == (12, 0, 0)
    assert [frame.stamp_ns for frame in frames] == [k * FRAME_NS for k in range(12)]
    assert [frame.sequence for frame in frames] == list(range(12))
    assert {frame.origin for frame in frames} == {StampOrigin.FILE}


def test_variable_rate_keeps_every_time(tmp_path):
    pts = [0, 3003, 6006, 9010, 40_000, 43_003, 46_006, 90_001]
    path = tmp_path / "vfr.mp4"
    options = {"bf": "0"}
    write_video(path, pictures("yuv420p", 8), codec="libx264", pts=pts, time_base=Fraction(1, 90_000), options=options)
    with VideoFile(path) as source:
        stamps = [frame.stamp_ns for frame in source]
        counts = source.counts
    assert stamps == [round(Fraction(time, 90_000) * 10**9) for time in pts]
    assert counts.late == 2  # the two pauses are longer than two periods of the mean rate, the others shorter
    assert counts.dropped == 0


def test_each_iteration_begins_anew_and_disturbs_no_other(plain):
    with VideoFile(plain) as source:
        first, second = iter(source), iter(source)
        a = [next(first) for _ in range(4)]
        b = [next(second) for _ in range(2)]
        a += list(first)
        b += list(second)
    assert [frame.stamp_ns for frame in a] == [frame.stamp_ns for frame in b]
    assert all(np.array_equal(x.image, y.image) for x, y in zip(a, b, strict=True))


def test_frames_own_their_memory(plain):
    with VideoFile(plain) as source:
        kept = list(source)
        for again, frame in zip(source, kept, strict=True):
            assert not np.shares_memory(again.image, frame.image)
            np.testing.assert_array_equal(again.image, frame.image)


def test_close_ends_the_iteration_and_refuses_another(plain):
    source = VideoFile(plain)
    frames = iter(source)
    next(frames)
    source.close()
    source.close()
    assert list(frames) == []
    with pytest.raises(SourceError, match="closed"):
        next(iter(source))


def test_info(plain):
    with VideoFile(plain) as source:
        info = source.info
    assert (info.kind, info.size_px, info.rate_hz, info.n_frames) == ("video", (WIDTH, HEIGHT), 25.0, 12)
    assert (info.codec, info.coded_format, info.pixel_format) == ("h264", "yuv420p", PixelFormat.YUV420)
    assert info.duration_s == pytest.approx(0.48, abs=1e-9)
    assert (info.stamp_origin, info.bits, info.created_ns, info.notes) == (StampOrigin.FILE, 8, None, ())


def test_creation_time_is_told_but_not_used(tmp_path):
    path = tmp_path / "dated.mkv"
    with av.open(str(path), "w") as container:
        container.metadata["creation_time"] = "2024-05-06T07:08:09.250000Z"
        stream = container.add_stream("ffv1", rate=25)
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "gray"
        container.mux(stream.encode(picture(0, "gray")))
        container.mux(stream.encode(None))
    with VideoFile(path) as source:
        assert source.info.created_ns == 1_714_979_289_250_000_000
        assert next(iter(source)).stamp_ns == 0


def test_a_stream_without_times_is_numbered_and_says_so(tmp_path):
    path = tmp_path / "raw.h264"
    write_video(path, pictures("yuv420p", 6), codec="libx264")
    with VideoFile(path) as source:
        frames = list(source)
        assert any("no times" in note for note in source.notes)
    assert {frame.origin for frame in frames} == {StampOrigin.ORDER}
    assert [frame.stamp_ns for frame in frames] == [k * FRAME_NS for k in range(6)]


def test_avi_with_reordered_frames_keeps_their_order(tmp_path):
    flats = pictures("yuv420p", 9)
    for number, flat in enumerate(flats):
        flat.planes[0].update(bytes([20 + 20 * number]) * flat.planes[0].buffer_size)
    path = tmp_path / "b.avi"
    options = {"preset": "medium", "qp": "4", "bf": "2", "x264-params": "b-adapt=0"}
    write_video(path, flats, codec="libx264", options=options)
    with av.open(str(path)) as container:  # or the test would test nothing
        assert container.streams.video[0].codec_context.has_b_frames
    frames = frames_of(path)
    assert [frame.stamp_ns for frame in frames] == [k * FRAME_NS for k in range(9)]
    luma = np.array([frame.image[:HEIGHT].mean() for frame in frames])
    np.testing.assert_allclose(luma, 20 + 20 * np.arange(9), atol=2)  # a flat block at this quantiser: within a step


def test_second_track(tmp_path):
    path = tmp_path / "two.mkv"
    with av.open(str(path), "w") as container:
        streams = [container.add_stream("ffv1", rate=25) for _ in range(2)]
        for stream, format_name in zip(streams, ("gray", "gray16le"), strict=True):
            stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, format_name
        for stream, format_name in zip(streams, ("gray", "gray16le"), strict=True):
            container.mux(stream.encode(picture(0, format_name)))
            container.mux(stream.encode(None))
    assert frames_of(path, VideoOptions(track=1))[0].bits == 16
    with VideoFile(path) as source:
        assert any("2 video tracks" in note for note in source.notes)
        assert next(iter(source)).bits == 8
    with pytest.raises(SourceError, match=r"track 2 of 2 video tracks, expected 0\.\.1"):
        VideoFile(path, VideoOptions(track=2))


def test_table_beside_gives_stamps_and_numbers(plain):
    rows = [(k if k < 5 else k + 3, 1_700_000_000_000_000_000 + k * 33_000_001) for k in range(12)]
    text = "frame,stamp_ns\n" + "".join(f"{frame},{stamp}\n" for frame, stamp in rows)
    plain.with_suffix(".csv").write_text(text)
    with VideoFile(plain) as source:
        frames = list(source)
        assert source.info.stamp_origin is StampOrigin.TABLE
    assert [(frame.sequence, frame.stamp_ns) for frame in frames] == rows
    assert {frame.origin for frame in frames} == {StampOrigin.TABLE}


@pytest.mark.parametrize("n_rows", [11, 13])
def test_table_of_another_length_is_refused(tmp_path, n_rows):
    for name, codec in (("a.mp4", "libx264"), ("b.mkv", "ffv1")):  # with and without a count in the header
        path = tmp_path / name
        write_video(path, pictures("yuv420p", 12), codec=codec)
        table = path.with_suffix(".stamps.csv")
        table.write_text("frame,stamp_ns\n" + "".join(f"{k},{k}\n" for k in range(n_rows)))
        with pytest.raises(InputError, match=f"{n_rows} rows for the 12 frames") as caught:
            VideoFile(path)
        assert table.name in caught.value.message
        assert ("line 14" in caught.value.message) == (n_rows == 13)


def test_spot_table_beside_is_left_alone(plain):
    plain.with_suffix(".csv").write_text("camera,frame,stamp_ns,x_px,y_px\na,0,0,1,1\n")
    assert frames_of(plain)[0].origin is StampOrigin.FILE


def test_changing_size_ends_with_an_error(tmp_path):
    path, small, large = (tmp_path / name for name in ("join.h264", "small.h264", "large.h264"))
    write_video(small, pictures("yuv420p", 3), codec="libx264")
    write_video(large, pictures("yuv420p", 3, width=96, height=64), codec="libx264")
    path.write_bytes(small.read_bytes() + large.read_bytes())
    delivered = []
    with VideoFile(path) as source, pytest.raises(SourceError, match="96 x 64 pixels, expected 64 x 48") as caught:
        delivered.extend(iter(source))
    assert "frame 3" in caught.value.message
    assert caught.value.advice


HELLO = b"hello world, this is no video\n" * 200


@pytest.mark.parametrize(
    ("name", "data", "expected"),
    [
        ("empty.mkv", b"", "is empty"),
        ("text.mp4", HELLO, "no video that can be read"),
        ("text.txt", HELLO, "no video"),
        ("zeros.avi", bytes(9000), "no video that can be read"),
        ("list.mp4", b"ffconcat version 1.0\nfile plain.mp4\n", "no video"),
        ("play.mp4", b"#EXTM3U\n#EXT-X-TARGETDURATION:1\n#EXTINF:1,\nplain.mp4\n#EXT-X-ENDLIST\n", "no video"),
    ],
)
def test_what_is_no_video_is_refused(plain, name, data, expected):
    path = plain.with_name(name)
    path.write_bytes(data)
    with pytest.raises(SourceError, match=expected) as caught:
        VideoFile(path)
    assert str(path) in caught.value.message
    assert caught.value.advice


def test_missing_file_and_folder_are_refused(tmp_path):
    with pytest.raises(SourceError, match="does not exist"):
        VideoFile(tmp_path / "no.mp4")
    with pytest.raises(SourceError, match="not a file"):
        VideoFile(tmp_path)


@pytest.mark.parametrize("name", ["none.mp4", "none.mkv", "none.avi"])
def test_zero_frames_are_refused(tmp_path, name):
    path = tmp_path / name
    with av.open(str(path), "w") as container:
        stream = container.add_stream("mpeg4", rate=25)
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv420p"
        container.start_encoding()
    with pytest.raises(SourceError, match=r"no frames|no video|before its first"):
        VideoFile(path)


def test_sound_alone_is_refused(tmp_path):
    path = tmp_path / "sound.mkv"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("pcm_s16le", rate=8000)
        sound = av.AudioFrame.from_ndarray(np.zeros((1, 800), np.int16), format="s16", layout="mono")
        sound.sample_rate = 8000
        container.mux(stream.encode(sound))
        container.mux(stream.encode(None))
    with pytest.raises(SourceError, match=r"holds no video \(audio\)"):
        VideoFile(path)


def test_a_name_with_a_colon_is_no_address(plain, monkeypatch):
    monkeypatch.chdir(plain.parent)
    plain.rename("http:camera.mp4")
    assert len(frames_of(Path("http:camera.mp4"))) == 12


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("list.m3u8", "#EXTM3U\n#EXT-X-TARGETDURATION:1\n#EXTINF:1,\n{}\n#EXT-X-ENDLIST\n"),
        ("list.ffconcat", "ffconcat version 1.0\nfile '{}'\n"),
    ],
)
def test_a_playlist_reaches_no_address(tmp_path, name, text):
    with socket.create_server(("127.0.0.1", 0)) as server:
        path = tmp_path / name
        path.write_text(text.format(f"http://127.0.0.1:{server.getsockname()[1]}/secret.ts"))
        with pytest.raises(SourceError):
            VideoFile(path)
        server.setblocking(False)
        with pytest.raises(BlockingIOError):
            server.accept()


def test_forbidden_file_is_refused(plain, as_nobody):
    plain.chmod(0)
    with as_nobody(), pytest.raises(SourceError, match="Permission denied") as caught:
        VideoFile(plain)
    assert "chmod" in caught.value.advice
    assert os.access(plain.parent, os.R_OK)
