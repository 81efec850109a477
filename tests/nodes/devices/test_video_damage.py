"""Cut and damaged video files: everything whole before the cut, nothing built on damage, and all of it counted."""

import av
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from nodes.devices.cameras.video_cut import is_cut
from nodes.devices.cameras.video_file import VideoFile
from nodes.devices.cameras.video_open import VideoOptions
from nodes.devices.errors import SourceError
from nodes.frames import SourceCounts
from tests.nodes.devices.video_writer import HEIGHT, LOSSLESS, WIDTH, pictures, planar, write_video

N_FRAMES, GOP = 30, 10
FAST_START = {"movflags": "faststart"}
# Container, codec, encoder options, container options. The last frame before a cut may take the one that waits in the
# decoder with it, where the container does not tell that the packet is cut.
KINDS = {
    "ffv1.mkv": ("ffv1", {}, {}),
    "h264.mkv": ("libx264", {"g": str(GOP)}, {}),
    "h264.mp4": ("libx264", {"g": str(GOP)}, FAST_START),
    "h265.mp4": ("libx265", {"x265-params": f"lossless=1:log-level=none:keyint={GOP}"}, FAST_START),
    "h264.ts": ("libx264", {"g": str(GOP), "preset": "medium", "bf": "2"}, {}),
    "raw.avi": ("rawvideo", {}, {}),
}


@pytest.fixture(scope="module", params=KINDS)
def whole(request, tmp_path_factory):
    path = tmp_path_factory.mktemp("whole") / request.param
    codec, options, container_options = KINDS[request.param]
    write_video(
        path,
        pictures("yuv420p", N_FRAMES),
        codec=codec,
        options=options,
        container_options=container_options,
    )
    return path


@pytest.fixture(scope="module")
def truth():
    return [planar(frame) for frame in pictures("yuv420p", N_FRAMES)]


def opened(path, options=None):
    with VideoFile(path, options) as source:
        return list(source), source.counts, source.notes


def test_a_whole_file_is_not_called_cut(whole):
    frames, counts, notes = opened(whole)
    assert (len(frames), counts.dropped, notes) == (N_FRAMES, 0, ())
    assert not is_cut(whole)


def test_a_cut_file_gives_everything_whole_before_the_cut(whole, truth):
    data = whole.read_bytes()
    cut = whole.with_stem("cut")
    for share in (0.35, 0.61, 0.83, 0.97):
        cut.write_bytes(data[: int(len(data) * share)])
        frames, counts, notes = opened(cut)
        numbers = [frame.sequence for frame in frames]
        assert numbers == sorted(set(numbers))
        for frame in frames:
            np.testing.assert_array_equal(frame.image, truth[frame.sequence])
        # Random samples make frames of nearly equal size, so the share of the bytes is that of the frames within two;
        # up to three of those before the cut are coded behind the cut frame, or lost with it in the decoder.
        assert share * N_FRAMES - 5 <= len(frames) <= share * N_FRAMES + 1
        assert numbers[: len(frames) - 3] == list(range(len(frames) - 3))
        assert len(frames) + counts.dropped <= N_FRAMES
        if whole.suffix != ".ts":  # a transport stream does not say how long it was to be
            assert len(frames) + counts.dropped == N_FRAMES
            assert any("is cut and ends early" in note for note in notes)


@pytest.mark.parametrize("kind", ["h264.mkv", "raw.avi", "ffv1.mkv"])
@given(n_bytes=st.integers(0, 20_000))
def test_a_file_cut_anywhere_gives_whole_frames_or_one_clear_error(kind, n_bytes, tmp_path_factory):
    path = tmp_path_factory.getbasetemp() / f"anywhere_{kind}"
    if not path.is_file():
        write_video(path, pictures("yuv420p", 3, width=48, height=32), codec=KINDS[kind][0])
    cut = path.with_stem("anywhere_cut")
    data = path.read_bytes()
    n_kept = n_bytes % len(data)
    cut.write_bytes(data[:n_kept])
    refusal = None
    try:
        frames, counts, _ = opened(cut)
    except SourceError as error:
        refusal, frames, counts = error, [], SourceCounts()
    if refusal is not None:
        assert str(cut) in refusal.message
        assert refusal.advice
        return
    assert frames
    assert len(frames) + counts.dropped <= 3
    for number, frame in enumerate(frames):
        expected = planar(pictures("yuv420p", 3, width=48, height=32)[number])
        np.testing.assert_array_equal(frame.image, expected)


def test_mp4_without_its_index_is_refused(tmp_path):
    path = tmp_path / "broken_off.mp4"
    write_video(path, pictures("yuv420p", 9), codec="libx264")
    data = path.read_bytes()
    path.write_bytes(data[: len(data) * 2 // 3])
    with pytest.raises(SourceError, match="MP4 file without its index") as caught:
        VideoFile(path)
    assert "MKV" in caught.value.advice


def test_a_cut_packet_takes_one_whole_frame_with_it_at_most(tmp_path):
    path = tmp_path / "reordered.ts"
    options = {"g": str(GOP), "preset": "medium", "qp": "10", "bf": "2", "x264-params": "b-adapt=0"}
    write_video(path, pictures("yuv420p", N_FRAMES), codec="libx264", options=options)
    with av.open(str(path)) as container:  # or no frame would wait in the decoder
        assert container.streams.video[0].codec_context.has_b_frames
    data = path.read_bytes()
    for share in (0.42, 0.55, 0.71):
        path.write_bytes(data[: int(len(data) * share)])
        with av.open(str(path)) as container:
            n_packets = sum(packet.size > 0 for packet in container.demux(video=0))
        assert n_packets - 2 <= len(opened(path)[0]) <= n_packets


def test_faulty_jpegs_are_left_out_and_spoil_no_other(tmp_path):
    path = tmp_path / "usb.avi"
    write_video(path, pictures("yuvj420p", N_FRAMES), codec="mjpeg")
    whole = [frame.image for frame in opened(path)[0]]
    data = path.read_bytes()
    for share in (0.3, 0.5, 0.7):
        place = int(len(data) * share)
        # 0xff stands in coded data only where a marker follows: no decoder can take 300 of them for a picture.
        path.write_bytes(data[:place] + b"\xff" * 300 + data[place + 300 :])
        frames, counts, notes = opened(path)
        assert len(frames) + counts.dropped == N_FRAMES
        assert 1 <= counts.dropped <= 2
        assert any("damaged" in note for note in notes)
        for frame in frames:
            np.testing.assert_array_equal(frame.image, whole[frame.sequence])


@pytest.fixture(scope="module")
def transport(tmp_path_factory):
    """A transport stream without reordering, and the place of each packet that begins a frame."""
    path = tmp_path_factory.mktemp("ts") / "walk.ts"
    write_video(path, pictures("yuv420p", N_FRAMES), codec="libx264", options={"g": str(GOP), "bf": "0"})
    return path


def without_bytes(path, first, last):
    """The file without its transport packets from one share of it to another."""
    data = path.read_bytes()
    a, b = (int(len(data) * share) // 188 * 188 for share in (first, last))
    damaged = path.with_stem("damaged")
    damaged.write_bytes(data[:a] + data[b:])
    return damaged


def test_lost_packets_leave_a_gap_up_to_the_next_key_frame(transport, truth):
    damaged = without_bytes(transport, 0.45, 0.455)  # within frame 13 of 30
    frames, counts, notes = opened(damaged)
    for frame in frames:
        np.testing.assert_array_equal(frame.image, truth[round(frame.stamp_ns / 4e7) - round(frames[0].stamp_ns / 4e7)])
    numbers = [frame.sequence for frame in frames]
    lost = sorted(set(range(N_FRAMES)) - set(numbers))
    assert lost == list(range(lost[0], 2 * GOP))  # one gap, and it ends where the next group begins
    assert 12 <= lost[0] <= 14
    assert counts.dropped == len(lost)
    assert counts.late == 1
    assert any("left out" in note for note in notes)


@pytest.mark.parametrize("name", ["h264.mkv", "h264.mp4", "h264.ts", "h265.mkv"])
def test_a_frame_that_the_recorder_never_got_spoils_none_that_is_delivered(tmp_path, truth, name):
    path, missing = tmp_path / name, 13
    encoder = "libx265" if name.startswith("h265") else "libx264"
    group = {"x265-params": f"lossless=1:log-level=none:keyint={GOP}:bframes=0"} if encoder == "libx265" else {}
    with av.open(str(path), "w") as container:
        stream = container.add_stream(encoder, rate=25, options=LOSSLESS[encoder] | {"g": str(GOP), "bf": "0"} | group)
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv420p"
        packets = []
        for number, frame in enumerate(pictures("yuv420p", N_FRAMES)):
            frame.pts = number
            packets += stream.encode(frame)
        packets += stream.encode(None)
        container.mux([packet for number, packet in enumerate(packets) if number != missing])
    frames, counts, _ = opened(path)
    first = frames[0].stamp_ns
    numbers = [round((frame.stamp_ns - first) / 4e7) for frame in frames]
    for number, frame in zip(numbers, frames, strict=True):
        np.testing.assert_array_equal(frame.image, truth[number])
    assert numbers == [*range(missing), *range(2 * GOP, N_FRAMES)]
    assert counts.dropped in (2 * GOP - missing - 1, 2 * GOP - missing)


@pytest.mark.parametrize(
    ("codec", "options", "n_spoilt"),
    [
        ("mpeg2video", {"g": "1", "q": "2"}, 1),
        ("libx265", {"x265-params": f"log-level=none:keyint={GOP}:qp=10"}, GOP),
    ],
)
def test_a_lost_transport_packet_spoils_none_that_is_delivered(tmp_path, codec, options, n_spoilt):
    path = tmp_path / "lossy.ts"
    write_video(path, pictures("yuv420p", N_FRAMES), codec=codec, options=options)
    whole = {frame.stamp_ns: frame.image for frame in opened(path)[0]}
    n_packets = path.stat().st_size // 188
    for place in range(n_packets // 3, n_packets // 2, n_packets // 40):
        frames, counts, _ = opened(without_bytes(path, (place + 0.5) / n_packets, (place + 1.5) / n_packets))
        for frame in frames:
            np.testing.assert_array_equal(frame.image, whole[frame.stamp_ns])
        # The spoilt ones up to the next key frame, and those before and after the lost packet, of which either may be
        # the damaged one.
        assert N_FRAMES - n_spoilt - 2 <= len(frames) < N_FRAMES
        assert counts.dropped <= n_spoilt + 2


@pytest.mark.parametrize(
    ("codec", "options"),
    [
        # Open groups: frames that are shown before the second key frame need some before it, which are not there.
        ("libx264", {"g": str(GOP), "qp": "10", "bf": "2", "x264-params": "open-gop=1:b-adapt=0"}),
        ("libx265", {"x265-params": f"log-level=none:keyint={GOP}:qp=10:open-gop=1:bframes=4:b-adapt=0"}),
        ("mpeg4", {"g": str(GOP), "q": "2", "sc_threshold": "1000000000"}),
    ],
)
def test_a_recording_that_begins_between_key_frames_begins_with_the_next(tmp_path, codec, options):
    path = tmp_path / "late.mkv"
    flats = pictures("yuv420p", N_FRAMES)
    for number, flat in enumerate(flats):
        flat.planes[0].update(bytes([20 + 7 * number]) * flat.planes[0].buffer_size)
    write_video(path, flats, codec=codec, options=options)
    whole = {frame.stamp_ns: frame.image for frame in opened(path)[0]}
    late = path.with_stem("later")
    with av.open(str(path)) as container, av.open(str(late), "w") as rest:
        stream = rest.add_stream_from_template(container.streams.video[0])
        packets = [packet for packet in container.demux(video=0) if packet.size]
        second = next(packet.pts for packet in packets[4:] if packet.is_keyframe)
        assert not packets[4].is_keyframe
        for packet in packets[4:]:
            packet.stream = stream
            rest.mux(packet)
    frames, counts, _ = opened(late)
    assert second is not None
    assert frames[0].stamp_ns == second * 10**6  # Matroska counts in ms
    assert counts.dropped > 0
    for frame in frames:
        np.testing.assert_array_equal(frame.image, whole[frame.stamp_ns])
    assert len(frames) == sum(stamp_ns >= second * 10**6 for stamp_ns in whole)


def test_what_a_decoder_marks_as_faulty_is_left_out(tmp_path):
    path = tmp_path / "dvr.mkv"
    write_video(path, pictures("yuv420p", N_FRAMES), codec="mpeg2video", options={"g": "1", "q": "2"})
    whole = [frame.image for frame in opened(path)[0]]
    data = path.read_bytes()
    for share in (0.3, 0.5, 0.7):
        place = int(len(data) * share)
        path.write_bytes(data[:place] + bytes(300) + data[place + 300 :])
        frames, counts, _ = opened(path)
        assert len(frames) + counts.dropped == N_FRAMES
        for frame in frames:
            np.testing.assert_array_equal(frame.image, whole[frame.sequence])


def test_what_a_raw_stream_loses_is_counted(tmp_path):
    path = tmp_path / "raw.h264"
    write_video(path, pictures("yuv420p", N_FRAMES), codec="libx264", options={"bf": "0"})
    data = path.read_bytes()
    path.write_bytes(data[: len(data) * 2 // 3])
    with av.open(str(path)) as container:
        n_packets = sum(packet.size > 0 for packet in container.demux(video=0))
    frames, counts, _ = opened(path)
    assert len(frames) == n_packets - 1
    assert counts.dropped == 1


def test_loss_is_counted_when_the_next_frame_comes(transport):
    with VideoFile(without_bytes(transport, 0.45, 0.455)) as source:
        seen = [(frame.sequence, source.counts) for frame in source]
    for number, (sequence, counts) in enumerate(seen, start=1):
        assert counts.delivered == number
        assert counts.delivered + counts.dropped == sequence + 1


def test_damaged_frames_are_delivered_on_request(transport, truth):
    damaged = without_bytes(transport, 0.45, 0.455)
    n_whole = len(opened(damaged)[0])
    frames, counts, notes = opened(damaged, VideoOptions(keep_damaged=True))
    assert len(frames) > n_whole
    assert len(frames) + counts.dropped == N_FRAMES
    assert any("leniently" in note for note in notes)
    assert not all(np.array_equal(frame.image, truth[frame.sequence]) for frame in frames)


def test_stamp_table_holds_its_rows_across_damage(transport):
    damaged = without_bytes(transport, 0.45, 0.455)
    table = damaged.with_suffix(".stamps.csv")
    table.write_text("frame,stamp_ns\n" + "".join(f"{k},{10**9 + 1000 * k}\n" for k in range(N_FRAMES)))
    try:
        frames, counts, _ = opened(damaged)
    finally:
        table.unlink()
    assert frames[-1].sequence == N_FRAMES - 1
    assert all(frame.stamp_ns == 10**9 + 1000 * frame.sequence for frame in frames)
    assert counts.dropped == N_FRAMES - len(frames)


def test_times_that_go_back_are_left_out(tmp_path, transport):
    path = tmp_path / "joined.ts"
    path.write_bytes(transport.read_bytes() * 2)
    frames, counts, notes = opened(path)
    stamps = [frame.stamp_ns for frame in frames]
    assert stamps == sorted(set(stamps))
    assert len(frames) == N_FRAMES
    assert counts.dropped >= N_FRAMES - 1
    assert any("not later than" in note for note in notes)
