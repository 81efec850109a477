"""The configuration beside a table, and files that are written whole or not at all."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from nodes.config import load_room
from nodes.config_model import DistanceAnchor
from nodes.room_file import keeps, room_beside, room_text, write_whole

NAMES = st.text(st.characters(blacklist_categories=("Cs",)), min_size=1).filter(str.strip)
SIZES = st.tuples(st.integers(1, 100_000), st.integers(1, 100_000))


@given(st.dictionaries(NAMES, SIZES, min_size=2, max_size=5))
def test_the_configuration_reads_back_whatever_the_names(tmp_path_factory, sizes_px):
    path = tmp_path_factory.getbasetemp() / "walk.toml"
    path.write_text(room_text(sizes_px, table="walk.csv"), encoding="utf-8")
    assert {camera.name: tuple(camera.size or ()) for camera in load_room(path).cameras} == sizes_px
    assert keeps(path, sizes_px)
    first = next(iter(sizes_px))
    assert not keeps(path, sizes_px | {first: (sizes_px[first][0] + 1, 5)})


def test_the_anchor_that_it_proposes_is_one_once_uncommented(tmp_path):
    lines = room_text({"C0": (640, 480), "C1": (640, 480)}, table="walk.csv").splitlines()
    start = lines.index("# [anchor]")
    lines[start : start + 4] = [line.removeprefix("# ") for line in lines[start : start + 4]]
    (tmp_path / "walk.toml").write_text("\n".join(lines))
    anchor = load_room(tmp_path / "walk.toml").anchor
    assert anchor == DistanceAnchor(kind="distance", cameras=["C0", "C1"], distance_m=0.35)


def test_only_a_table_has_a_configuration_beside_it(tmp_path):
    (tmp_path / "walk.toml").write_text("")
    assert room_beside(tmp_path / "walk.csv") == room_beside(tmp_path / "walk.npz") == tmp_path / "walk.toml"
    assert room_beside(tmp_path / "other.csv") is None
    assert room_beside(tmp_path / "walk") is None


def test_a_broken_configuration_is_not_kept(tmp_path):
    (tmp_path / "walk.toml").write_text("cameras = 5")
    assert not keeps(tmp_path / "walk.toml", {"C0": (1, 1)})


def test_a_file_is_whole_or_as_it_was(tmp_path):
    path = tmp_path / "folder" / "table.csv"
    write_whole(path, lambda one: one.write_text("first"))
    assert path.read_text() == "first"

    def half(one):
        one.write_text("sec")
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_whole(path, half)
    assert path.read_text() == "first"
    assert list(path.parent.iterdir()) == [path]


def test_a_file_is_as_readable_as_any_other(tmp_path):
    write_whole(tmp_path / "a.csv", lambda one: one.write_text("x"))
    (tmp_path / "b.csv").write_text("x")
    assert (tmp_path / "a.csv").stat().st_mode == (tmp_path / "b.csv").stat().st_mode
