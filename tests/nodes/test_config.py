from dataclasses import replace

import numpy as np
import pytest

from network_calib.cameras import LensModel
from network_calib.errors import InputError
from network_calib.formats.source import read_source
from network_calib.formats.table import write_csv
from network_calib.room_setup import Knowledge, KnownCentres, KnownDistance, KnownPoints, UnitScale
from nodes.config import load_room, resolve

C0 = '[[cameras]]\nname = "C0"\n'


def room_of(tmp_path, text):
    (tmp_path / "room.toml").write_text(text)
    return load_room(tmp_path / "room.toml")


def faults_of(tmp_path, text):
    with pytest.raises(InputError) as caught:
        room_of(tmp_path, text)
    return [line.strip() for line in caught.value.message.splitlines()[1:]]


@pytest.fixture
def recording(smart_room):
    return read_source(smart_room)


@pytest.fixture
def with_rad(recording):
    """The recording as if it had brought board intrinsics."""
    given = np.array([450.0, 451.0, 320.0, 240.0, -0.3, 0.1, 0.001, 0.0])
    setups = tuple(replace(s, knowledge=Knowledge.INITIAL, intrinsics=given) for s in recording.setups)
    return replace(recording, setups=setups)


def test_all_faults_are_told_at_once_with_path_and_hint(tmp_path):
    text = """
        [[cameras]]
        name = "C0"
        size = [640, "480"]
        lense = "k1"
        [[cameras]]
        name = "C1"
        lens = "k3"
        focal = [1, -2]
        intrinsics = "fixed"
        [[cameras]]
        name = "C2"
        focal = 500
        centre = [1, 2, 3]
        intrinsics = "initial"
        sigma = {focl = 3}
        [anchor]
        kind = "stereo"
        cameras = ["C0", "C1"]
        baselin_m = 2.0
        [option]
        start = "auto"
        [options]
        n_repeats = 2.5
    """
    assert faults_of(tmp_path, text) == [
        "cameras[0].size[1]: '480', input should be a valid integer",
        "cameras[0].lense: unknown key (did you mean 'lens'?)",
        "cameras[1].lens: 'k3', input should be 'none', 'k1', 'k1_k2', 'k1_k2_p1_p2' or 'fisheye'",
        "cameras[1].focal[1]: -2, input should be greater than 0",
        "cameras[2].centre: [1, 2, 3], list should have at most 2 items after validation, not 3",
        "cameras[2].sigma.focal: field required",
        "cameras[2].sigma.centre: field required",
        "cameras[2].sigma.focl: unknown key (did you mean 'focal'?)",
        "anchor.baseline_m: field required",
        "anchor.baselin_m: unknown key (did you mean 'baseline_m'?)",
        "options.n_repeats: 2.5, input should be a valid integer",
        "option: unknown key (did you mean 'options'?)",
    ]


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        (C0 + C0, "room.toml: camera names given twice: C0"),
        (C0 + "centre = [1, 2]", "cameras[0]: centre given without focal"),
        (C0 + "focal = 400", 'cameras[0]: focal is given, so intrinsics must be "initial" or "fixed"'),
        (C0 + 'focal = 400\nintrinsics = "fixed"', "cameras[0]: fixed intrinsics need focal, centre and distortion"),
        (
            C0 + 'focal = 400\nintrinsics = "initial"\nlens = "k1"\ndistortion = [0.1, 0.2]',
            "cameras[0]: distortion has 2 terms, but lens k1 has 1",
        ),
        (C0 + "sigma = {focal = 1, centre = 1}", 'cameras[0]: sigma is given, so intrinsics must be "initial"'),
        (
            '[anchor]\nkind = "distance"\ncameras = ["C0", "C0"]\ndistance_m = 1',
            "room.toml: anchor.cameras names 'C0' twice, expected two cameras",
        ),
        (
            '[anchor]\nkind = "points"\npoints = [{frame = 1, xyz = [1, 2]}]',
            "anchor.points[0].xyz: [1, 2], list should have at least 3 items after validation, not 2",
        ),
        (C0 + "size = [640, nan]", "cameras[0].size[1]: nan, input should be a valid integer"),
        (C0 + "size = [640, 100001]", "cameras[0].size[1]: 100001, input should be less than or equal to 100000"),
    ],
)
def test_fault_is_told_with_its_path(tmp_path, text, fault):
    assert faults_of(tmp_path, text)[0] == fault


@pytest.mark.parametrize("kind", ["pints", "", "Stereo"])
def test_unknown_anchor_lists_the_known_ones(tmp_path, kind):
    (fault,) = faults_of(tmp_path, f'[anchor]\nkind = "{kind}"')
    assert fault.startswith("anchor: ")
    assert "'stereo', 'distance', 'centres', 'points', 'none'" in fault


@pytest.mark.parametrize(("content", "message"), [(b"x = ", "is not valid TOML"), (b"\xff", "is not UTF-8 text")])
def test_file_that_is_no_toml_is_refused(tmp_path, content, message):
    (tmp_path / "room.toml").write_bytes(content)
    with pytest.raises(InputError, match=message):
        load_room(tmp_path / "room.toml")


def test_without_configuration_the_recording_speaks(recording):
    resolved = resolve(recording, None)
    assert resolved.setups == recording.setups
    assert resolved.anchor == UnitScale()


def test_written_room_resolves_to_what_was_simulated(recording, smart_room):
    resolved = resolve(recording, load_room(smart_room / "room.toml"))
    assert all(setup.lens is LensModel.K1_K2 and setup.size_px == (640, 480) for setup in resolved.setups)
    anchor = resolved.anchor
    assert isinstance(anchor, KnownDistance)
    assert (anchor.camera_a, anchor.camera_b, anchor.is_stereo_pair) == ("C0", "C1", True)
    assert 0.3 < anchor.distance_m < 0.4  # the room's baseline is drawn from there


def test_given_intrinsics_sigma_and_group_arrive(recording, tmp_path):
    text = """
        [[cameras]]
        name = "C3"
        lens = "k1"
        intrinsics = "initial"
        focal = [400, 401]
        distortion = [-0.2]
        sigma = {focal = 4, centre = 2, distortion = 0.05}
        group = "wide"
        [options]
        start = "anchor"
        rejection = 5
        [world]
        floor_frames = [3, 4, 5]
    """
    resolved = resolve(recording, room_of(tmp_path, text))
    setup = resolved.setups[3]
    # No centre is given: the middle of 640 x 480 pixels, whose first has its centre at 0.
    assert setup.nominal_intrinsics().tolist() == [400, 401, 319.5, 239.5, -0.2, 0, 0, 0]
    assert setup.intrinsics_sigma is not None
    assert setup.intrinsics_sigma.tolist() == [4, 4, 2, 2, 0.05, 0.05, 0.05, 0.05]
    assert (setup.lens, setup.knowledge, setup.group) == (LensModel.K1, Knowledge.INITIAL, "wide")
    assert resolved.setups[0] == recording.setups[0]
    assert (resolved.options.start, resolved.options.rejection) == ("anchor", 5)
    assert resolved.options.floor_frames == (3, 4, 5)
    assert resolved.options.n_repeats == 3  # untouched default


def test_recorded_intrinsics_are_a_prior_until_fixed(with_rad):
    assert {setup.knowledge for setup in resolve(with_rad, None).setups} == {Knowledge.INITIAL}
    assert {setup.knowledge for setup in resolve(with_rad, None, fix_intrinsics=True).setups} == {Knowledge.FIXED}


def test_configuration_may_drop_or_fix_recorded_intrinsics(with_rad, tmp_path):
    text = C0 + 'intrinsics = "unknown"\n[[cameras]]\nname = "C1"\nintrinsics = "fixed"'
    setups = resolve(with_rad, room_of(tmp_path, text)).setups
    assert (setups[0].knowledge, setups[0].intrinsics) == (Knowledge.UNKNOWN, None)
    assert setups[1].knowledge is Knowledge.FIXED
    assert np.array_equal(setups[1].nominal_intrinsics(), with_rad.setups[1].nominal_intrinsics())


def test_lens_that_contradicts_recorded_distortion_is_refused(with_rad, tmp_path):
    with pytest.raises(InputError, match=r"'C0' has lens k1_k2, but the intrinsics given by the recording have"):
        resolve(with_rad, room_of(tmp_path, C0 + 'lens = "k1_k2"'))


def test_fixing_what_nobody_gave_is_refused(recording, tmp_path):
    with pytest.raises(InputError, match=r"neither the recording nor room\.toml gives intrinsics"):
        resolve(recording, None, fix_intrinsics=True)
    with pytest.raises(InputError, match="'C0' has intrinsics = 'fixed', but neither"):
        resolve(recording, room_of(tmp_path, C0 + 'intrinsics = "fixed"'))


def test_unknown_camera_is_told_with_the_nearest(recording, tmp_path):
    with pytest.raises(InputError, match=r"cameras: the recording has no camera 'C00' \(did you mean 'C0'\?\)"):
        resolve(recording, room_of(tmp_path, '[[cameras]]\nname = "C00"'))
    text = '[anchor]\nkind = "stereo"\ncameras = ["C0", "D1"]\nbaseline_m = 1'
    with pytest.raises(InputError, match=r"anchor\.cameras: the recording has no camera 'D1'"):
        resolve(recording, room_of(tmp_path, text))


def test_table_without_sizes_asks_for_them_and_takes_them(recording, tmp_path):
    write_csv(recording.observations, tmp_path / "spots.csv")
    table = read_source(tmp_path / "spots.csv")
    with pytest.raises(InputError, match=r"image size of 5 cameras is not known: C0, C1, C2, C3, C4"):
        resolve(table, None)
    text = "".join(f'[[cameras]]\nname = "C{k}"\nsize = [640, {480 + k}]\n' for k in range(5))
    assert [setup.size_px[1] for setup in resolve(table, room_of(tmp_path, text)).setups] == [480, 481, 482, 483, 484]


def test_nameless_recording_takes_names_in_order(smart_room, tmp_path):
    for name in ("points.dat", "IdMat.dat", "Res.dat"):
        (tmp_path / name).write_bytes((smart_room / name).read_bytes())
    recording = read_source(tmp_path)
    names = ["door", "window", "desk", "shelf", "sink"]
    text = "".join(f'[[cameras]]\nname = "{name}"\n' for name in names)
    resolved = resolve(recording, room_of(tmp_path, text))
    assert resolved.observations.camera_names == tuple(names)
    assert [setup.name for setup in resolved.setups] == names
    assert "named by the order" in resolved.notes[-1]


def test_centres_and_points_anchor_arrive(recording, tmp_path):
    text = '[anchor]\nkind = "centres"\ncentres = {C0 = [0, 0, 2], C2 = [4, 0, 2], C1 = [0, 3, 2]}'
    anchor = resolve(recording, room_of(tmp_path, text)).anchor
    assert isinstance(anchor, KnownCentres)
    assert anchor.names == ("C0", "C2", "C1")
    assert anchor.centres_in_world_m.tolist() == [[0, 0, 2], [4, 0, 2], [0, 3, 2]]
    points = ", ".join(f"{{frame = {k}, xyz = [{k}, 0, 1]}}" for k in (3, 5, 9))
    anchor = resolve(recording, room_of(tmp_path, f'[anchor]\nkind = "points"\npoints = [{points}]')).anchor
    assert isinstance(anchor, KnownPoints)
    assert anchor.frames == (3, 5, 9)
    assert anchor.points_in_world_m[2].tolist() == [9, 0, 1]


def test_centres_anchor_takes_those_of_the_recording(recording, tmp_path):
    room = room_of(tmp_path, '[anchor]\nkind = "centres"')
    with pytest.raises(InputError, match=r"neither room\.toml nor the recording gives any"):
        resolve(recording, room)
    known = KnownCentres(recording.observations.camera_names, np.zeros((5, 3)))
    assert resolve(replace(recording, known_centres=known), room).anchor is known


def test_tolerance_is_in_ms_outside_and_ns_inside(tmp_path):
    assert room_of(tmp_path, "[timing]\ntolerance_ms = 2.5").tolerance_ns == 2_500_000
    assert room_of(tmp_path, "").tolerance_ns is None
