import numpy as np
import pytest

from network_calib.candidates import Candidates
from network_calib.choose import choose
from network_calib.errors import InputError
from network_calib.formats.source import read_source
from network_calib.formats.svoboda import read_svoboda
from network_calib.formats.table import read_candidates, write_csv, write_npz
from network_calib.observations import Observations

HEAD = "camera,frame,x_px,y_px\n"


def assert_same(a, b):
    assert a.camera_names == b.camera_names
    for name in ("camera", "frame", "px", "stamp_ns"):
        assert np.array_equal(getattr(a, name), getattr(b, name)), name
    assert np.array_equal(a.sigma_px, b.sigma_px, equal_nan=True)


@pytest.mark.parametrize(("suffix", "write"), [("csv", write_csv), ("npz", write_npz)])
def test_table_reads_back_exactly(tmp_path, observations, suffix, write):
    path = tmp_path / f"table.{suffix}"
    write(observations, path)
    recording = read_source(path)
    assert_same(recording.observations, observations)
    assert recording.setups == ()


def test_digest_is_the_same_in_every_format_and_feels_one_bit(tmp_path, svoboda_folder, observations):
    plain = Observations.from_columns(
        observations.camera_names, camera=observations.camera, frame=observations.frame, px=observations.px
    )
    write_csv(plain, tmp_path / "a.csv")
    write_npz(plain, tmp_path / "a.npz")
    digests = {read_source(p).sha256 for p in (tmp_path / "a.csv", tmp_path / "a.npz")}
    digests.add(read_svoboda(svoboda_folder).sha256)
    assert len(digests) == 1
    plain.px[3, 1] = np.nextafter(plain.px[3, 1], np.inf)
    write_npz(plain, tmp_path / "b.npz")
    assert read_source(tmp_path / "b.npz").sha256 not in digests


@pytest.mark.parametrize("ending", ["\n", "\r\n"])
def test_quoted_blank_and_reordered_csv_reads_as_the_plain_one(tmp_path, ending):
    plain, odd = tmp_path / "plain.csv", tmp_path / "odd.csv"
    plain.write_text(HEAD + "C2,0,1,2\nC10,0,3,4\nC2,1,5,6.5\n")
    lines = ["y_px, x_px ,frame,camera", '2,1,0,"C2"', "", "6.5,5,1,C2", "4,3,0,C10", ""]
    odd.write_bytes(b"\xef\xbb\xbf" + ending.join(lines).encode())
    read = read_source(odd).observations
    assert_same(read, read_source(plain).observations)
    assert read.camera_names == ("C2", "C10")  # numbers inside names count by value


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("", "is empty, expected camera, x_px, y_px"),
        (HEAD, "has a header but no rows"),
        ("camera,frame,x_px\nC0,1,2\n", "line 1: columns y_px missing"),
        ("camera,x_px,y_px\nC0,1,2\n", "neither a column frame nor stamp_ns"),
        ("camera,frame,x_px,y_px,z\nC0,1,2,3,4\n", r"line 1: unknown columns \['z'\]"),
        ("camera,frame,x_px,y_px,y_px\nC0,1,2,3,4\n", "a column stands there twice"),
        (HEAD + "C0,0,1,2\nC0,1,1\n", "line 3: 3 fields, expected 4"),
        (HEAD + "C0,0,1,2\nC0,1,1,2,5\nC0,2,3\n", "line 3: 5 fields, expected 4"),
        (HEAD + "C0,0,1,2\n\nC0,one,1,2\n", "line 4, column frame: 'one', expected a whole number"),
        (HEAD + "C0,0,1,2\nC0,1.0,1,2\n", "line 3, column frame: '1.0', expected a whole number"),
        (HEAD + "C0,-1,1,2\n", "line 2, column frame: '-1', expected 0 or more"),
        (HEAD + "C0,99999999999999999999,1,2\n", "line 2, column frame: '9999.*' *, expected a whole number within 64"),
        (HEAD + "C0,0,nan,2\n", r"line 2, column x_px: 'nan', expected a number within \+-1e\+06"),
        (HEAD + "C0,0,1,1e300\nC1,0,1,inf\n", r"line 2, column y_px: '1e300', .*\(2 such values\)"),
        (HEAD + "C0,0,1_0,2\n", "line 2, column x_px: '1_0', expected a number"),
        (HEAD + "C0,0,,2\n", "line 2, column x_px: '', expected a number"),
        (HEAD + ",0,1,2\n", "line 2, column camera: empty"),
        (HEAD + "C0,0,1,2\nC0,0,3,4\n", "camera 'C0' has two rows in frame 0"),
        (HEAD + '"C0,0,1,2\n', "unexpected end of data"),
        ("camera,frame,x_px,y_px,sigma_px\nC0,0,1,2,-0.1\n", "line 2, column sigma_px: '-0.1', expected a number > 0"),
        ("camera,frame,x_px,y_px,sigma_px\nC0,0,1,2,0\n", "line 2, column sigma_px: '0', expected a number > 0"),
        ("camera,frame,x_px,y_px,score\nC0,0,1,2,1.5\n", "line 2, column score: '1.5', expected a number from 0 to 1"),
        ("camera,frame,x_px,y_px,score\nC0,0,1,2,\n", "line 2, column score: '', expected a number"),
        (
            "camera,frame,stamp_ns,x_px,y_px,score\nC0,0,1,1,2,0.5\nC0,0,2,1,2,0.4\n",
            "candidates of two stamps in frame 0: 1 and 2 ns",
        ),
    ],
)
def test_faulty_csv_is_refused_with_its_place(tmp_path, content, message):
    path = tmp_path / "spots.csv"
    path.write_text(content)
    with pytest.raises(InputError, match=rf"spots\.csv.*{message}"):
        read_source(path)


@pytest.mark.parametrize("content", [b"camera\xff,frame", b"camera,frame\x00"])
def test_csv_that_is_not_text_is_refused(tmp_path, content):
    (tmp_path / "spots.csv").write_bytes(content)
    with pytest.raises(InputError, match=r"spots\.csv is not (UTF-8 )?text"):
        read_source(tmp_path / "spots.csv")


def columns(**changed):
    """A good NPZ table of three rows, with changes; None takes a column out."""
    good = {
        "camera": np.array(["a", "b", "a"]),
        "frame": np.array([0, 0, 1]),
        "x_px": np.array([1.0, 2.0, 3.0]),
        "y_px": np.array([1.0, 2.0, 3.0]),
    }
    return {name: value for name, value in (good | changed).items() if value is not None}


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"y_px": None}, "arrays y_px missing"),
        ({"frame": None}, "neither a column frame nor stamp_ns"),
        ({"z": np.zeros(3)}, r"unknown arrays \['z'\]"),
        ({"y_px": np.zeros(2)}, "array y_px has 2 values, expected 3"),
        ({"y_px": np.zeros((3, 1))}, r"array y_px has shape \(3, 1\)"),
        ({"y_px": np.array(["1", "2", "3"])}, "array y_px is <U1, expected numbers"),
        ({"y_px": np.array([1.0, np.nan, 2.0])}, "array y_px, index 1: 'nan'"),
        ({"frame": np.array([0.0, 0.0, 1.0])}, "array frame is float64, expected whole numbers"),
        ({"frame": np.array([0, -1, 1])}, "array frame, index 1: '-1', expected 0 or more"),
        ({"frame": np.array([0, 2**63, 1], dtype=np.uint64)}, "array frame, index 1: '9223372036854775808'"),
        ({"camera": np.array([0, 1, 0])}, "an array camera_names of text is expected"),
        ({"camera": np.array([0, 2, 0]), "camera_names": np.array(["a", "b"])}, "camera index 0..2 outside 0..1"),
        ({"camera": np.array([0, 1, 0]), "camera_names": np.array(["a", "a"])}, "holds a name twice"),
        ({"camera": np.array([{}, {}, {}])}, "no readable NPZ table"),  # pickled objects stay unread
    ],
)
def test_faulty_npz_is_refused(tmp_path, changed, message):
    np.savez(tmp_path / "spots.npz", allow_pickle=True, **columns(**changed))
    with pytest.raises(InputError, match=message):
        read_source(tmp_path / "spots.npz")


def test_broken_npz_is_refused(tmp_path):
    path = tmp_path / "spots.npz"
    path.write_bytes(b"")
    with pytest.raises(InputError, match="no readable NPZ table"):
        read_source(path)
    np.savez(path, allow_pickle=True, **columns())
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2])
    with pytest.raises(InputError, match="no readable NPZ table"):
        read_source(path)


def test_small_npz_that_unpacks_beyond_the_limit_is_refused_unread(tmp_path, monkeypatch):
    path = tmp_path / "bomb.npz"
    np.savez_compressed(path, allow_pickle=True, **columns(x_px=np.zeros(200_000)))
    monkeypatch.setattr("network_calib.formats.table.MAX_FILE_BYTES", 1_000_000)
    assert path.stat().st_size < 10_000
    with pytest.raises(InputError, match=r"unpacks to 16[0-9]{5} bytes, expected at most 1000000"):
        read_source(path)


def test_huge_file_is_refused_unread(tmp_path):
    path = tmp_path / "huge.csv"
    with path.open("wb") as file:
        file.truncate(2**31 + 1)  # sparse: takes no room on the disk
    with pytest.raises(InputError, match="has 2147483649 bytes, expected at most 2147483648"):
        read_source(path)


def test_stamps_alone_are_grouped(tmp_path, observations):
    path = tmp_path / "spots.csv"
    write_csv(observations, path)
    rows = [line.split(",") for line in path.read_text().splitlines()]
    path.write_text("\n".join(",".join(row[:1] + row[2:]) for row in rows))
    recording = read_source(path)
    # The scene's stamps scatter by 1 ms about a 40 ms raster; a quarter interval is 10 ms. Frames without any spot
    # leave no number behind, so the groups equal the frames up to renumbering.
    expected = np.unique(observations.frame, return_inverse=True)[1]
    assert np.array_equal(recording.observations.frame, expected)
    assert np.array_equal(recording.observations.px, observations.px)
    assert "grouped by stamp" in recording.notes[0]


@pytest.fixture
def candidates():
    """Three cameras that see a way through a volume; beside every third detection of each stands a rival."""
    rng = np.random.default_rng(4)
    spots = np.cumsum(rng.normal(0, 0.2, (200, 3)), axis=0) % [2.0, 2.0, 3.0] + [-1.0, -1.0, 4.0]
    camera, frame = np.tile(np.arange(3), 200), np.repeat(np.arange(200), 3)
    centre = np.array([[-1.0, 0.0, 0.0], [0.0, 0.2, 0.5], [1.0, -0.1, 0.0]])[camera]
    in_cam = spots[frame] - centre
    px = 500 * in_cam[:, :2] / in_cam[:, 2:] + 500
    beside = np.flatnonzero((frame + camera) % 3 == 0)
    n = len(camera) + len(beside)
    return Candidates.from_columns(
        ("C0", "C1", "C2"),
        camera=np.append(camera, camera[beside]),
        frame=np.append(frame, frame[beside]),
        px=np.concatenate([px, rng.uniform(0, 999, (len(beside), 2))]),
        score=np.append(np.full(len(camera), 0.6), rng.uniform(0.7, 0.9, len(beside))),
        sigma_px=rng.uniform(0.1, 0.3, n),
        stamp_ns=10**18 + np.append(frame, frame[beside]) * 40_000_000,
    )


@pytest.mark.parametrize(("suffix", "write"), [("csv", write_csv), ("npz", write_npz)])
def test_candidates_read_back_exactly_and_are_chosen_from(tmp_path, candidates, suffix, write):
    path = tmp_path / f"table.{suffix}"
    write(candidates, path)
    read = read_candidates(path)
    assert_same(read, candidates)
    assert np.array_equal(read.score, candidates.score)
    sizes = dict.fromkeys(candidates.camera_names, (1000, 1000))
    chosen = choose(candidates, rng=np.random.default_rng(0), size_px=sizes)
    recording = read_source(path, size_px=sizes)
    assert_same(recording.observations, chosen.observations)
    (note,) = recording.notes
    assert f"of {chosen.n_several} pictures with several candidates" in note
    assert f"another than the best-scored in {chosen.n_preferred}" in note
    # 200 rivals score above the spot beside them and lie at random pixels.
    assert chosen.n_several == 200
    assert chosen.n_preferred > 180


def test_candidates_with_stamps_alone_are_grouped(tmp_path, candidates):
    path = tmp_path / "spots.csv"
    write_csv(candidates, path)
    rows = [line.split(",") for line in path.read_text().splitlines()]
    path.write_text("\n".join(",".join(row[:1] + row[2:]) for row in rows))
    assert_same(read_candidates(path), candidates)
    assert "grouped by stamp" in read_source(path).notes[0]


def test_single_scored_rows_read_as_the_plain_table(tmp_path):
    (tmp_path / "plain.csv").write_text(HEAD + "C0,0,1,2\nC1,0,3,4\n")
    (tmp_path / "scored.csv").write_text("camera,frame,x_px,y_px,score\nC0,0,1,2,0.1\nC1,0,3,4,1\n")
    plain, scored = read_source(tmp_path / "plain.csv"), read_source(tmp_path / "scored.csv")
    assert_same(plain.observations, scored.observations)
    assert (scored.notes, scored.sha256) == ((), plain.sha256)
    with pytest.raises(InputError, match=r"plain\.csv has no column score"):
        read_candidates(tmp_path / "plain.csv")
