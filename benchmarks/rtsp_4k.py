"""A 4K camera at 30 frames a second over RTSP: frames that come through, and where the processor's time goes."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import av
import numpy as np

from benchmarks.report import Row, Run, at_most
from nodes.devices.cameras.live_options import LiveOptions
from nodes.devices.cameras.live_video import open_live
from nodes.frames import Frame
from nodes.spot_detector import SpotDetector
from tests.nodes.devices.rtsp_server import RtspServer, why_not

SIZE_PX, RATE_HZ = (3840, 2160), 30
# What surveillance cameras send at this size and rate.
BITS_PER_S = 12_000_000
# So much is coded, and repeated: it begins with a key frame.
N_CODED = 60
# The consumer is not judged before the source has given this many: the detector then knows the background.
N_WARM = 60


@dataclass(frozen=True, slots=True)
class Received:
    """One stretch of live video.

    Attributes:
        n_expected: frames that the camera sent meanwhile, by the sequence numbers.
        n_missing: of these, never handed out.
        cpu_ms: of this whole process, per frame that was sent.
        consumer_ms: of the thread that uses the frames, per frame that was handed out.
        age_ms: median from capture to delivery, by the camera's stamps.
    """

    n_expected: int
    n_missing: int
    cpu_ms: float
    consumer_ms: float
    age_ms: float


def measure(run: Run) -> Iterator[Row]:
    """Frames lost, and processor time of decoding, handing over and detecting."""
    if reason := why_not():
        yield Row("4K RTSP", f"not measured: {reason}")
        return
    seconds = run.pick(20, 4)
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "4k.mkv"
        _write_video(file, seconds=seconds + 12)
        decode_ms = _decode_ms(file)
        plain = _received(file, seconds, lambda _frame: None)
        detected = _received(file, seconds, SpotDetector().process)
    size = f"H.264 {SIZE_PX[0]} x {SIZE_PX[1]}, {RATE_HZ} Hz, {BITS_PER_S / 1e6:g} Mbit/s, {seconds} s"
    yield at_most(f"{size}: frames lost", _lost_percent(plain), 1.0, unit=" %", note=_frames(plain))
    yield at_most(
        f"{size}, with detector: frames lost", _lost_percent(detected), 1.0, unit=" %", note=_frames(detected)
    )
    yield _time_row("decoding", decode_ms)
    yield _time_row("receiving, stamping, copying, queue", plain.cpu_ms - decode_ms)
    yield _time_row("detector", detected.consumer_ms)
    yield at_most("processor, all three: share of one core", detected.cpu_ms * RATE_HZ / 10, 100, unit=" %")
    yield Row("capture to delivery, median", f"{plain.age_ms:.0f} ms; with detector {detected.age_ms:.0f} ms")


def _received(file: Path, seconds: float, use: Callable[[Frame], object]) -> Received:
    n_frames = round(seconds * RATE_HZ)
    with RtspServer(file=file) as server, open_live(server.url("file"), LiveOptions(n_queued=8)) as source:
        first = last = None
        cpu_s = consumer_s = 0.0
        ages_ns: list[int] = []
        for frame in source:
            use(frame)
            if first is None and len(ages_ns) == N_WARM:
                first, cpu_s, consumer_s = frame.sequence, time.process_time(), time.thread_time()
                ages_ns.clear()
            ages_ns.append(time.time_ns() - frame.stamp_ns)
            last = frame.sequence
            if first is not None and last - first >= n_frames:
                break
        cpu_s, consumer_s = time.process_time() - cpu_s, time.thread_time() - consumer_s
    assert first is not None
    assert last is not None
    n_given, n_expected = len(ages_ns) - 1, last - first
    return Received(
        n_expected,
        n_expected - n_given,
        1e3 * cpu_s / n_expected,
        1e3 * consumer_s / n_given,
        float(np.median(ages_ns)) / 1e6,
    )


def _decode_ms(file: Path) -> float:
    """Processor time of decoding alone, per frame, threads as in a live source."""
    with av.open(file) as container:
        container.streams.video[0].codec_context.thread_count = LiveOptions().n_decoder_threads
        begin_s = time.process_time()
        n_frames = sum(1 for _ in zip(range(4 * N_CODED), container.decode(video=0), strict=False))
    return 1e3 * (time.process_time() - begin_s) / n_frames


def _write_video(file: Path, *, seconds: float) -> None:
    """A noisy still scene with a moving spot, as a camera's encoder would send it."""
    packets, codec = _coded()
    with av.open(file, "w") as container:
        stream = container.add_stream("libx264", rate=RATE_HZ)
        stream.width, stream.height = SIZE_PX
        stream.pix_fmt, stream.codec_context.extradata = "yuv420p", codec.extradata
        for number in range(round(seconds * RATE_HZ)):
            packet = av.Packet(packets[number % N_CODED])
            packet.pts = packet.dts = number
            packet.time_base, packet.stream = Fraction(1, RATE_HZ), stream
            packet.is_keyframe = number % N_CODED == 0
            container.mux(packet)


def _coded() -> tuple[list[bytes], av.VideoCodecContext]:
    codec = av.CodecContext.create("libx264", "w")
    assert isinstance(codec, av.VideoCodecContext)
    codec.width, codec.height = SIZE_PX
    codec.pix_fmt, codec.time_base, codec.bit_rate, codec.gop_size = (
        "yuv420p",
        Fraction(1, RATE_HZ),
        BITS_PER_S,
        N_CODED,
    )
    # Deblocking and arithmetic coding as in a camera; `ultrafast` would leave out both and be decoded in half the time.
    codec.options = {"preset": "superfast", "tune": "zerolatency", "bf": "0"}
    rng = np.random.default_rng(0)
    width, height = SIZE_PX
    scene = np.kron(rng.integers(20, 90, (height // 8, width // 8)), np.ones((8, 8))).astype(np.int16)
    packets: list[bytes] = []
    for number in range(N_CODED):
        image = np.full((height * 3 // 2, width), 128, np.uint8)
        image[:height] = np.clip(scene + rng.integers(-2, 3, scene.shape, dtype=np.int16), 0, 255)
        left = 100 + 50 * number
        image[1000:1012, left : left + 12] = 250
        frame = av.VideoFrame.from_ndarray(image, format="yuv420p")
        frame.pts = number
        packets += map(bytes, codec.encode(frame))
    return packets + [bytes(packet) for packet in codec.encode(None)], codec


def _lost_percent(received: Received) -> float:
    return 100 * received.n_missing / received.n_expected


def _frames(received: Received) -> str:
    return f"{received.n_missing} of {received.n_expected}"


def _time_row(what: str, per_frame_ms: float) -> Row:
    return Row(f"processor, {what}", f"{per_frame_ms:.1f} ms a frame ({per_frame_ms * RATE_HZ / 10:.0f} % of one core)")
