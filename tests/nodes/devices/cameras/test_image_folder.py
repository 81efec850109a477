"""Folders of images: order, numbers, samples, stamps, and what is refused."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from network_calib.errors import InputError
from nodes.devices.cameras.image_folder import ImageFolder, ImageOptions
from nodes.devices.cameras.image_names import Numbering
from nodes.devices.errors import SourceError
from nodes.frames import PixelFormat, StampOrigin

RNG = np.random.default_rng(8)
BGR = RNG.integers(0, 256, (24, 32, 3), dtype=np.uint8)
MONO = RNG.integers(0, 256, (24, 32), dtype=np.uint8)
DEEP = RNG.integers(0, 1 << 12, (24, 32), dtype=np.uint16)


def fill(folder: Path, names: list[str], image: Any = MONO) -> Path:
    folder.mkdir(exist_ok=True)
    for name in names:
        assert cv2.imwrite(str(folder / name), image)
    return folder


def refusal(folder, options=None, **named):
    with pytest.raises(SourceError) as caught, ImageFolder(folder, options, **named) as source:
        list(source)
    assert caught.value.advice
    return caught.value.message


@pytest.mark.parametrize("suffix", [".png", ".bmp", ".tif", ".tiff", ".PNG"])
@pytest.mark.parametrize("image", [BGR, MONO], ids=["bgr", "mono"])
def test_lossless_formats_keep_every_sample(tmp_path, suffix, image):
    folder = fill(tmp_path / "a", [f"0{suffix}"], image)
    frame = next(iter(ImageFolder(folder)))
    assert frame.pixel_format is (PixelFormat.BGR if image.ndim == 3 else PixelFormat.MONO)
    assert frame.bits == 8
    np.testing.assert_array_equal(frame.image, image)


@pytest.mark.parametrize("suffix", [".png", ".tif", ".pgm"])
def test_deep_images_keep_every_sample(tmp_path, suffix):
    folder = fill(tmp_path / "a", [f"0{suffix}"], DEEP)
    assert next(iter(ImageFolder(folder))).bits == 16
    frame = next(iter(ImageFolder(folder, ImageOptions(bits=12))))
    assert (frame.bits, frame.image.dtype) == (12, np.uint16)
    np.testing.assert_array_equal(frame.image, DEEP)
    assert "expected less than 1024 for bits = 10" in refusal(folder, ImageOptions(bits=10))


def test_jpeg_and_transparency(tmp_path):
    assert next(iter(ImageFolder(fill(tmp_path / "a", ["0.jpg"])))).pixel_format is PixelFormat.MONO
    clear = np.dstack([BGR, np.zeros_like(MONO)])
    np.testing.assert_array_equal(next(iter(ImageFolder(fill(tmp_path / "b", ["0.png"], clear)))).image, BGR)


def test_a_mosaic_is_told_on_request(tmp_path):
    folder = fill(tmp_path / "a", ["0.pgm"])
    frame = next(iter(ImageFolder(folder, ImageOptions(mosaic=PixelFormat.BAYER_GBRG))))
    assert frame.pixel_format is PixelFormat.BAYER_GBRG


@given(
    numbers=st.lists(st.integers(0, 10**6), min_size=2, max_size=12, unique=True),
    prefix=st.sampled_from(["", "cam1_", "2024-05-06 room 3 "]),
    is_padded=st.booleans(),
)
def test_order_and_sequence_are_those_of_the_numbers(numbers, prefix, is_padded, tmp_path_factory):
    folder = tmp_path_factory.mktemp("numbers")
    for number in numbers:
        text = f"{number:07d}" if is_padded else f"{number}"
        cv2.imwrite(str(folder / f"{prefix}{text}.pgm"), np.full((2, 2), number % 251, np.uint8))
    with ImageFolder(folder) as source:
        frames = list(source)
        dropped = source.counts.dropped
    assert [frame.sequence for frame in frames] == sorted(numbers)
    assert [int(frame.image[0, 0]) for frame in frames] == [number % 251 for number in sorted(numbers)]
    step = np.gcd.reduce(np.diff(sorted(numbers)))
    assert dropped == (max(numbers) - min(numbers)) // step + 1 - len(numbers)


def test_the_group_of_digits_that_differs_last_counts(tmp_path):
    a = ImageFolder(fill(tmp_path / "a", ["0007_cam2.png", "0012_cam2.png"]))
    assert [frame.sequence for frame in a] == [7, 12]
    b = ImageFolder(fill(tmp_path / "b", ["20240506_120001_3.png", "20240506_120002_4.png"]))
    assert [frame.sequence for frame in b] == [3, 4]
    assert next(iter(ImageFolder(fill(tmp_path / "c", ["cam2_0005.png"])))).sequence == 5


def test_cameras_in_one_folder_are_told_apart_by_a_pattern(tmp_path):
    folder = tmp_path / "both"
    for camera in (1, 2):
        fill(folder, [f"cam{camera}_{number:04d}.png" for number in (8, 9, 10)], np.full((4, 6), camera, np.uint8))
    for camera in (1, 2):
        with ImageFolder(folder, pattern=f"cam{camera}_*") as source:
            assert [(frame.sequence, int(frame.image[0, 0])) for frame in source] == [(k, camera) for k in (8, 9, 10)]
    message = refusal(folder)
    assert "cam1_0008.png and cam2_0008.png both have the number 8" in message
    assert "no image among 6 fits the pattern 'cam3_*'" in refusal(folder, pattern="cam3_*")


def test_other_files_and_hidden_ones_are_left_alone(tmp_path):
    folder = fill(tmp_path / "a", ["1.png", "2.png"])
    for name in (".3.png", "Thumbs.db", "notes.txt"):
        (folder / name).write_bytes(b"x")
    (folder / "raw").mkdir()
    assert len(list(ImageFolder(folder))) == 2


def test_stamps_from_the_rate(tmp_path):
    folder = fill(tmp_path / "a", ["f10.png", "f12.png", "f13.png"])
    with ImageFolder(folder, ImageOptions(rate_hz=30)) as source:
        frames = list(source)
        assert (source.rate_hz, source.counts.dropped) == (30, 1)
        assert any("no times" in note for note in source.info.notes)
    assert [frame.stamp_ns for frame in frames] == [333_333_333, 400_000_000, 433_333_333]
    assert {frame.origin for frame in frames} == {StampOrigin.ORDER}


@pytest.mark.parametrize("column", ["file", "frame"])
def test_stamps_from_a_table(tmp_path, column):
    folder = fill(tmp_path / "a", ["f1.png", "f2.png", "f10.png"])
    keys = ["f10.png", "f1.png", "f2.png", "f99.png"] if column == "file" else [10, 1, 2, 99]
    rows = zip(keys, (3_000_000_000, 1_000_000_000, 1_040_000_000, 1), strict=True)
    (folder / "stamps.csv").write_text(f"{column},stamp_ns\n" + "".join(f"{key},{stamp}\n" for key, stamp in rows))
    with ImageFolder(folder) as source:
        frames = list(source)
        assert source.info.stamp_origin is StampOrigin.TABLE
    assert [(f.sequence, f.stamp_ns) for f in frames] == [(1, 10**9), (2, 1_040_000_000), (10, 3 * 10**9)]


def test_a_table_that_does_not_fit_is_refused(tmp_path):
    folder = fill(tmp_path / "a", ["f1.png", "f2.png", "f3.png"])
    (folder / "stamps.csv").write_text("file,stamp_ns\nf1.png,5\nf2.png,9\nf3.png,9\n")
    with pytest.raises(InputError, match=r"stamps\.csv, line 4, column stamp_ns: 9 for f3\.png, expected more than 9"):
        ImageFolder(folder)
    (folder / "stamps.csv").write_text("frame,stamp_ns\n1,5\n3,9\n")
    with pytest.raises(InputError, match=r"no row for frame 2 \(f2\.png\)"):
        ImageFolder(folder)


def test_names_may_be_stamps(tmp_path):
    stamps = [1_403_636_579_763_555_584, 1_403_636_579_813_555_456]
    folder = fill(tmp_path / "a", [f"{stamp}.png" for stamp in stamps])
    assert "looks like an instant in ns" in refusal(folder)
    frames = list(ImageFolder(folder, ImageOptions(numbering=Numbering.STAMP_NS)))
    assert [(frame.sequence, frame.stamp_ns) for frame in frames] == list(enumerate(stamps))


def test_names_without_numbers_come_in_their_natural_order(tmp_path):
    for value, name in enumerate(["a9.png", "a10.png", "b.png"]):
        fill(tmp_path / "a", [name], np.full((4, 4), value, np.uint8))
    frames = list(ImageFolder(tmp_path / "a", ImageOptions(numbering=Numbering.NONE)))
    assert [(frame.sequence, int(frame.image[0, 0])) for frame in frames] == [(0, 0), (1, 1), (2, 2)]


def test_folders_without_usable_images_are_refused(tmp_path):
    (tmp_path / "empty").mkdir()
    assert "it holds nothing" in refusal(tmp_path / "empty")
    (tmp_path / "empty" / "walk.mp4").write_bytes(b"x")
    assert "1 x .mp4" in refusal(tmp_path / "empty")
    fill(tmp_path / "cams", [])
    fill(tmp_path / "cams" / "cam1", ["1.png"])
    assert "it holds the folders cam1" in refusal(tmp_path / "cams")
    assert "does not exist" in refusal(tmp_path / "none")
    assert "not a folder" in refusal(tmp_path / "cams" / "cam1" / "1.png")


def test_names_that_tell_no_number_are_refused(tmp_path):
    assert "no number in the name left.png" in refusal(fill(tmp_path / "a", ["left.png", "1.png"]))
    assert "do not only differ in their numbers" in refusal(fill(tmp_path / "b", ["a1.png", "b2.png"]))


@pytest.mark.parametrize(
    ("other", "words"),
    [
        (np.zeros((24, 34), np.uint8), "34 x 24, grey, 8 bits, expected 32 x 24, grey, 8 bits"),
        (BGR, "32 x 24, colour, 8 bits"),
        (DEEP, "32 x 24, grey, 16 bits"),
    ],
)
def test_images_that_differ_in_kind_are_named(tmp_path, other, words):
    folder = fill(tmp_path / "a", ["1.png", "2.png"])
    fill(folder, ["3.png"], other)
    with ImageFolder(folder) as source:
        delivered = []
        with pytest.raises(SourceError) as caught:
            delivered.extend(iter(source))
    assert str(folder / "3.png") in caught.value.message
    assert words in caught.value.message


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".bmp", ".tif", ".pgm"])
@given(share=st.floats(0, 0.97))
def test_a_cut_image_is_named(suffix, share, tmp_path_factory):
    folder = tmp_path_factory.getbasetemp() / f"cut{suffix}"
    smooth = cv2.GaussianBlur(RNG.integers(0, 256, (96, 128), dtype=np.uint8), (0, 0), 2)
    fill(folder, ["1" + suffix, "2" + suffix, "3" + suffix], smooth)
    data = (folder / f"2{suffix}").read_bytes()
    (folder / f"2{suffix}").write_bytes(data[: int(len(data) * share)])
    assert str(folder / f"2{suffix}") in refusal(folder)
    with ImageFolder(folder, ImageOptions(skip_damaged=True)) as source:
        assert [frame.sequence for frame in source] == [1, 3]
        assert (source.counts.delivered, source.counts.dropped) == (2, 1)


def test_text_and_forbidden_images_are_named(tmp_path, as_nobody):
    folder = fill(tmp_path / "a", ["1.png"])
    (folder / "2.png").write_text("no image")
    assert "2.png is no image" in refusal(folder)
    (folder / "2.png").unlink()
    (folder / "1.png").chmod(0)
    folder.chmod(0o755)
    for parent in (tmp_path, tmp_path.parent):
        parent.chmod(0o755)
    with as_nobody():
        assert "Permission denied" in refusal(folder)


def test_float_images_are_refused(tmp_path):
    folder = fill(tmp_path / "a", ["1.tif"], np.zeros((4, 4), np.float32))
    with pytest.raises(SourceError, match="float32 samples, expected 8 or 16 bits"):
        ImageFolder(folder)


@pytest.mark.parametrize(
    "wrong", [{"bits": 8}, {"bits": 14}, {"rate_hz": 0.0}, {"rate_hz": float("inf")}, {"mosaic": PixelFormat.YUV420}]
)
def test_options_that_cannot_be_are_refused(wrong):
    with pytest.raises(InputError, match=str(next(iter(wrong)))):
        ImageOptions(**wrong)


def test_iterating_again_begins_anew_and_close_ends(tmp_path):
    source = ImageFolder(fill(tmp_path / "a", ["1.png", "2.png", "4.png"]))
    first = iter(source)
    next(first)
    assert [frame.sequence for frame in source] == [1, 2, 4]
    source.close()
    assert list(first) == []
    with pytest.raises(SourceError, match="closed"):
        next(iter(source))
