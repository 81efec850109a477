"""Stamp tables: every fault names the file and the line."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from network_calib.errors import InputError
from nodes.devices.cameras.stamp_table import read_image_stamps, read_video_stamps, video_table_beside

VIDEO_FAULTS = {
    "frame,stamp_ns\n": "no rows",
    "": "",
    "frame,stamps_ns\n0,1\n": "line 1",
    "frame,stamp_ns,x\n0,1,2\n": "line 1",
    "frame,stamp_ns\n0,10\n1,20\n2,20\n": "line 4, column stamp_ns: '20'",
    "frame,stamp_ns\n0,10\n0,20\n": "line 3, column frame: '0'",
    "frame,stamp_ns\n0,10\n1,9\n": "line 3, column stamp_ns: '9'",
    "frame,stamp_ns\n0,10\n1,2.5e9\n": "line 3, column stamp_ns: '2.5e9'",
    "frame,stamp_ns\n0,10\n1,\n": "line 3, column stamp_ns: ''",
    "frame,stamp_ns\n0,-5\n": "line 2, column stamp_ns: '-5'",
    "frame,stamp_ns\n0,10\n1\n": "line 3: 1 fields",
    "frame,stamp_ns\n0,99999999999999999999\n": "line 2, column stamp_ns",
}


@pytest.mark.parametrize("text", VIDEO_FAULTS)
def test_faults_of_video_tables_are_named(tmp_path, text):
    path = tmp_path / "walk.stamps.csv"
    path.write_text(text)
    with pytest.raises(InputError) as caught:
        read_video_stamps(path)
    assert str(path) in caught.value.message
    assert VIDEO_FAULTS[text] in caught.value.message


@given(
    rows=st.lists(
        st.tuples(st.integers(0, 10**6), st.integers(0, 2**63 - 1)),
        min_size=1,
        unique_by=(lambda row: row[0], lambda row: row[1]),
    )
)
def test_rising_tables_are_read_exactly(rows, tmp_path_factory):
    frames, stamps = (sorted(column) for column in zip(*rows, strict=True))
    path = tmp_path_factory.getbasetemp() / "rising.csv"
    lines = "".join(f"{s},{f}\n" for f, s in zip(frames, stamps, strict=True))
    path.write_text(f"stamp_ns,frame\n{lines}")
    table = read_video_stamps(path)
    assert (table.frame.tolist(), table.stamp_ns.tolist()) == (frames, stamps)


def test_two_tables_beside_a_video_are_one_too_many(tmp_path):
    video = tmp_path / "walk.mp4"
    assert video_table_beside(video) is None
    video.with_suffix(".csv").write_text("frame,stamp_ns\n0,0\n")
    assert video_table_beside(video) == tmp_path / "walk.csv"
    video.with_suffix(".stamps.csv").write_text("frame,stamp_ns\n0,0\n")
    with pytest.raises(InputError, match="one stamp table"):
        video_table_beside(video)
    video.with_suffix(".csv").write_text("camera,x_px,y_px,frame\n")
    assert video_table_beside(video) == tmp_path / "walk.stamps.csv"


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("file,stamp_ns\na.png,1\nb.png,2\na.png,3\n", "line 4, column file: 'a.png' stands there twice"),
        ("frame,stamp_ns\n7,1\n7,2\n", "line 3, column frame: 7 stands there twice"),
        ("stamp_ns\n1\n", "neither a column file nor frame"),
        ("file,stamp_ns\na.png,one\n", "line 2, column stamp_ns: 'one'"),
    ],
)
def test_faults_of_image_tables_are_named(tmp_path, text, expected):
    path = tmp_path / "stamps.csv"
    path.write_text(text)
    with pytest.raises(InputError) as caught:
        read_image_stamps(path)
    assert str(path) in caught.value.message
    assert expected in caught.value.message


def test_an_image_without_a_row_is_named(tmp_path):
    path = tmp_path / "stamps.csv"
    path.write_text("file,stamp_ns\na1.png,5\n")
    table = read_image_stamps(path)
    assert table.row("a1.png", 1) == (2, 5)
    with pytest.raises(InputError, match=r"no row for file a2\.png"):
        table.row("a2.png", 2)


def test_forbidden_table_is_refused(tmp_path, as_nobody):
    path = tmp_path / "stamps.csv"
    path.write_text("frame,stamp_ns\n0,0\n")
    path.chmod(0)
    with as_nobody(), pytest.raises(InputError, match="Permission denied"):
        read_video_stamps(path)
