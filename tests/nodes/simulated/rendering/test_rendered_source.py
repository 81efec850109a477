import numpy as np
import pytest

from network_calib.errors import InputError
from network_calib.synthetic import room
from nodes.devices.cameras.image_folder import ImageFolder, ImageOptions
from nodes.devices.cameras.video_file import VideoFile
from nodes.devices.errors import SourceError
from nodes.frames import PixelFormat, SourceCounts, StampOrigin
from nodes.simulated.loopback import VirtualClock
from nodes.simulated.rendering.compression import CompressedSource
from nodes.simulated.rendering.rendered_camera import FrameClock, RenderedCamera
from nodes.simulated.rendering.rendered_files import TRUTH_COLUMNS, write_images, write_truth, write_video
from nodes.simulated.rendering.rendered_source import RenderedSource
from nodes.simulated.rendering.room_scene import RoomScene
from nodes.simulated.rendering.sensor import SensorModel
from nodes.simulated.rendering.spot_image import Ball
from nodes.simulated.rendering.spot_path import SpotPath
from nodes.simulated.rendering.video_codec import VideoCodec

SCENE = RoomScene(ball=Ball(diameter_m=0.06, radiance=1.0), light=0.1)
N_FRAMES = 12


def camera(sensor=None, **clock):
    built = room("smart_room", rng=np.random.default_rng(1), n_frames=N_FRAMES)
    path, sensor = SpotPath.of(built), sensor or SensorModel()
    return RenderedCamera(built.cameras, 2, path, scene=SCENE, sensor=sensor, seed=1, clock=FrameClock(**clock))


@pytest.fixture(scope="module")
def mono():
    return camera(start_ns=10**18)


@pytest.fixture(scope="module")
def colour():
    return camera(SensorModel(pixel_format=PixelFormat.BGR))


def test_a_recording_gives_every_frame_each_time(mono):
    with RenderedSource(mono) as source:
        first, second = list(source), list(source)
        assert (source.name, source.size_px, source.rate_hz) == ("C2", (640, 480), 25.0)
    assert [frame.sequence for frame in first] == list(range(N_FRAMES))
    assert [frame.stamp_ns for frame in first] == [10**18 + k * 40_000_000 for k in range(N_FRAMES)]
    assert all((one.image == other.image).all() for one, other in zip(first, second, strict=True))
    assert source.counts == SourceCounts(delivered=N_FRAMES)
    with pytest.raises(SourceError, match="closed"):
        list(source)


def test_a_part_of_the_path_keeps_its_numbers(mono):
    assert [frame.sequence for frame in RenderedSource(mono, first=4, n_frames=3)] == [4, 5, 6]
    assert [frame.sequence for frame in RenderedSource(mono, first=10, n_frames=9)] == [10, 11]


def test_a_live_camera_keeps_its_pace(mono):
    clock = VirtualClock(now_s=100.0)
    arrived_s = []
    for frame in RenderedSource(mono, clock_s=clock, sleep=clock.sleep):
        arrived_s.append(clock())
        assert frame.origin is StampOrigin.CAMERA
    # Half of the exposure of 10 ms after each frame's middle.
    assert arrived_s == pytest.approx([100.005 + k / 25 for k in range(N_FRAMES)])


def test_a_slow_reader_of_a_live_camera_loses_frames_and_is_told(mono):
    clock = VirtualClock()
    source = RenderedSource(mono, clock_s=clock, sleep=clock.sleep)
    seen = []
    for frame in source:
        seen.append(frame.sequence)
        clock.sleep(0.1)
    # Frame 0 comes at 5 ms; at 105 ms frame 2 (due at 85 ms) is the newest, at 205 ms frame 5 exactly, ...
    assert seen[:2] == [0, 2]
    assert np.diff(seen).min() >= 2
    assert source.counts.dropped == seen[-1] + 1 - len(seen)
    assert source.counts.delivered == len(seen)


def test_closing_ends_a_live_iteration(mono):
    clock = VirtualClock()
    source = RenderedSource(mono, clock_s=clock, sleep=clock.sleep)
    seen = []
    for frame in source:
        seen.append(frame.sequence)
        if frame.sequence == 3:
            source.close()
    assert seen == [0, 1, 2, 3]


def spot_centroid(frame, truth):
    """Centre of the luma over the background within 12 px of the truth."""
    x, y = np.rint(truth.px).astype(int)
    rows, columns = np.mgrid[y - 12 : y + 13, x - 12 : x + 13]
    luma = frame.image[rows, columns].astype(float)
    light = np.maximum(luma - np.median(luma) - 20, 0)
    return np.array([(columns * light).sum(), (rows * light).sum()]) / light.sum()


@pytest.mark.parametrize("codec", [VideoCodec.H264, VideoCodec.H265])
def test_compressed_frames_stay_with_their_truth(mono, codec):
    source = CompressedSource(RenderedSource(mono), bit_rate=4_000_000, codec=codec)
    frames = list(source)
    assert [frame.sequence for frame in frames] == list(range(N_FRAMES))
    assert source.counts.delivered == N_FRAMES
    n_compared = 0
    for frame in frames:
        original, truth = mono.render(frame.sequence)
        assert (frame.pixel_format, frame.image.shape, frame.bits) == (PixelFormat.YUV420, (720, 640), 8)
        assert (frame.stamp_ns, frame.settings) == (original.stamp_ns, original.settings)
        # Limited range: 16 + 219 / 255 of each sample; quantisation by the codec leaves a few levels.
        assert frame.image[:480].mean() == pytest.approx(16 + 219 / 255 * original.image.mean(), abs=1.0)
        assert frame.image[480:].mean() == pytest.approx(128, abs=1)
        if truth.is_visible and (truth.px > 20).all() and (truth.px < np.array([620, 460])).all():
            # The spot moves by 1 to 4 px a frame: a shift of one frame would show.
            assert spot_centroid(frame, truth) == pytest.approx(truth.px, abs=0.35)
            n_compared += 1
    assert n_compared > 6


def test_fewer_bits_give_worse_pictures_and_the_same_bits_the_same_ones(mono):
    errors, images = [], []
    for bit_rate in (8_000_000, 100_000, 100_000):
        frames = list(CompressedSource(RenderedSource(mono), bit_rate=bit_rate))
        originals = [mono.render(k)[0].image.astype(float) for k in range(N_FRAMES)]
        luma = [(frame.image[:480] - 16.0) * 255 / 219 for frame in frames]
        errors.append(np.mean([np.square(a - b).mean() for a, b in zip(luma, originals, strict=True)]))
        images.append([frame.image.tobytes() for frame in frames])
    assert errors[1] > 1.5 * errors[0]
    assert images[1] == images[2]


def test_red_goes_into_the_second_chroma_plane(colour):
    (frame,) = CompressedSource(RenderedSource(colour, first=5, n_frames=1), bit_rate=8_000_000)
    truth = colour.truth(5)
    x, y = np.rint(truth.px / 2).astype(int)
    blue, red = frame.image[480:].reshape(2, 240, 320)
    assert red[y, x] > 150
    assert blue[y, x] < 125


@pytest.mark.parametrize(
    ("sensor", "codec"),
    [
        (SensorModel(), VideoCodec.FFV1),
        (SensorModel(bits=12), VideoCodec.FFV1),
        (SensorModel(pixel_format=PixelFormat.BGR), VideoCodec.FFV1),
    ],
)
def test_lossless_video_holds_every_sample(tmp_path, sensor, codec):
    cam = camera(sensor, start_ns=10**18)
    truths = write_video(cam, tmp_path / "cam.mkv", codec=codec, n_frames=3)
    with VideoFile(tmp_path / "cam.mkv") as video:
        frames = list(video)
    assert len(frames) == len(truths) == 3
    for frame, truth in zip(frames, truths, strict=True):
        original, _ = cam.render(truth.sequence)
        np.testing.assert_array_equal(frame.image, original.image)
        assert (frame.stamp_ns, frame.origin) == (original.stamp_ns, StampOrigin.TABLE)
        assert (frame.pixel_format, frame.bits) == (original.pixel_format, original.bits)


@pytest.mark.parametrize(("codec", "suffix"), [(VideoCodec.H264, "mp4"), (VideoCodec.H265, "mkv")])
def test_compressed_video_has_all_frames_and_times(tmp_path, colour, codec, suffix):
    path = tmp_path / f"cam.{suffix}"
    truths = write_video(colour, path, codec=codec, bit_rate=4_000_000)
    with VideoFile(path) as video:
        assert video.rate_hz == pytest.approx(25)
        frames = list(video)
    assert [frame.stamp_ns for frame in frames] == [truth.stamp_ns for truth in truths]
    assert len(frames) == N_FRAMES


def test_images_hold_every_sample(tmp_path):
    sensor = SensorModel(pixel_format=PixelFormat.BAYER_GBRG, bits=10)
    cam = camera(sensor, phase_s=0.007)
    write_images(cam, tmp_path / "cam0", n_frames=2)
    options = ImageOptions(bits=10, mosaic=PixelFormat.BAYER_GBRG)
    with ImageFolder(tmp_path / "cam0", options) as folder:
        for frame in folder:
            original, _ = cam.render(frame.sequence)
            np.testing.assert_array_equal(frame.image, original.image)
            assert (frame.stamp_ns, frame.origin) == (original.stamp_ns, StampOrigin.TABLE)
            assert (frame.pixel_format, frame.bits) == (PixelFormat.BAYER_GBRG, 10)


def test_the_truth_is_written_in_columns(tmp_path, mono):
    write_truth((mono.truth(k) for k in range(N_FRAMES)), tmp_path / "truth.csv")
    header, *lines = (tmp_path / "truth.csv").read_text().splitlines()
    assert header == ",".join(TRUTH_COLUMNS)
    row = dict(zip(TRUTH_COLUMNS, lines[3].split(","), strict=True))
    truth = mono.truth(3)
    assert (row["frame"], row["stamp_ns"], row["is_visible"]) == ("3", str(truth.stamp_ns), str(int(truth.is_visible)))
    # Four decimals or six digits: 5e-5 px and better.
    assert [float(row["x_px"]), float(row["y_px"])] == pytest.approx(truth.px, abs=5.1e-5)
    assert row["reflection_x_px"] == ""


def test_what_cannot_be_written_is_refused(tmp_path, mono):
    deep = camera(SensorModel(bits=12))
    with pytest.raises(InputError, match="h264 cannot hold mono with 12 bits"):
        write_video(deep, tmp_path / "deep.mp4")
    with pytest.raises(InputError, match="n_frames is 0"):
        write_images(mono, tmp_path / "none", n_frames=0)
    with pytest.raises(SourceError, match="cannot be written"):
        write_video(mono, tmp_path / "absent" / "cam.mp4", n_frames=1)
    (tmp_path / "file").write_text("")
    with pytest.raises(SourceError, match="cannot be made"):
        write_images(mono, tmp_path / "file" / "cam0", n_frames=1)
    with pytest.raises(InputError, match="loses nothing"):
        CompressedSource(RenderedSource(mono), bit_rate=1, codec=VideoCodec.FFV1)
    with pytest.raises(InputError, match="bit_rate is 0"):
        CompressedSource(RenderedSource(mono), bit_rate=0)
