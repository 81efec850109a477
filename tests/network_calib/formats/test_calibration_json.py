import json
import os
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import RigidTransform, Rotation

from network_calib.errors import InputError
from network_calib.formats.calibration_json import load, save
from network_calib.formats.shared_json import canonical_quaternion
from network_calib.result import PARAMETER_NAMES


def with_rotation(calibration, rotation):
    camera = calibration.cameras[1]
    pose = RigidTransform.from_components(camera.cam_from_world.translation, rotation)
    return replace(calibration, cameras=(calibration.cameras[0], replace(camera, cam_from_world=pose)))


def set_at(document, path, value):
    *way, last = path
    for step in way:
        document = document[step]
    if value is KeyError:
        del document[last]
    else:
        document[last] = value


def test_golden_file_of_schema_1_saves_to_the_same_bytes(golden, tmp_path):
    save(load(golden), tmp_path / "again.json")
    assert (tmp_path / "again.json").read_bytes() == golden.read_bytes()


def test_every_number_survives_exactly(calibration, tmp_path):
    save(calibration, tmp_path / "c.json")
    again = load(tmp_path / "c.json")
    for before, after in zip(calibration.cameras, again.cameras, strict=True):
        assert np.array_equal(before.intrinsics, after.intrinsics)
        assert np.array_equal(before.covariance, after.covariance)
        assert np.array_equal(before.cam_from_world.as_matrix(), after.cam_from_world.as_matrix())
        assert (before.name, before.size_px, before.lens) == (after.name, after.size_px, after.lens)
    assert repr(again.quality) == repr(calibration.quality)  # repr, because not-a-number is unequal to itself
    assert (again.world, again.warnings, again.provenance) == (
        calibration.world,
        calibration.warnings,
        calibration.provenance,
    )


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_any_rotation_is_stable_from_the_first_save_on(seed):
    rotation = Rotation.random(rng=np.random.default_rng(seed))
    quaternion = canonical_quaternion(rotation)
    # Rounding moves a component by no more than a few units in the last place of 1.
    assert np.abs(quaternion - rotation.as_quat(canonical=True)).max() < 1e-15
    held = RigidTransform.from_components((0, 0, 0), Rotation.from_quat(quaternion))
    assert np.array_equal(canonical_quaternion(held.rotation), quaternion)


@pytest.mark.parametrize("degrees", [0.0, 90.0, 180.0, 180.0 - 1e-13])
def test_special_rotations_are_stable_too(calibration, tmp_path, degrees):
    rotation = Rotation.from_rotvec(np.radians(degrees) * np.array([0.6, 0.0, 0.8]))
    save(with_rotation(calibration, rotation), tmp_path / "a.json")
    save(load(tmp_path / "a.json"), tmp_path / "b.json")
    assert (tmp_path / "a.json").read_bytes() == (tmp_path / "b.json").read_bytes()


def test_a_person_finds_names_units_and_sigma(golden):
    camera = json.loads(golden.read_text())["cameras"][1]
    assert camera["intrinsics"]["focal_x_px"] == 188.3
    assert list(camera["intrinsics"]["distortion"]) == ["k1", "k2", "k3", "k4"]
    assert list(camera["sigma"]) == list(PARAMETER_NAMES)
    assert camera["sigma"]["focal_px"] == pytest.approx(np.sqrt(camera["covariance"]["lower_triangle"][6][6]))
    assert set(camera["cam_from_world"]) == {"target", "source", "rotation_quat_xyzw", "translation"}


def test_numpy_scalars_are_written_as_numbers(calibration, tmp_path):
    quality = replace(calibration.quality, n_points=np.int64(7), chi2_per_dof=np.float64(1.0))
    save(replace(calibration, quality=quality), tmp_path / "c.json")
    assert load(tmp_path / "c.json").quality.n_points == 7


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        (("schema",), "spotcal.calibration/2", r'schema: "spotcal\.calibration/2", expected "spotcal\.calibration/1"'),
        (("world",), KeyError, r"\$\.world: missing"),
        (("worlds",), {}, r"\$\.worlds: unknown field"),
        (("world", "unit"), "mm", r'\$\.world\.unit: "mm", expected one of m, unit'),
        (("cameras",), [], r"\$\.cameras: camera names \[\], expected one or more"),
        (("cameras",), {}, r"\$\.cameras: {}, expected an array"),
        (("cameras", 1, "name"), "C0", r"camera names \['C0', 'C0',"),
        (("cameras", 0, "size_px"), [640], r"\$\.cameras\[0\]\.size_px: \[640\], expected an array of 2"),
        (("cameras", 0, "size_px", 0), 640.0, r"size_px\[0\]: 640\.0, expected a whole number >= 1"),
        (("cameras", 0, "size_px", 0), 10**400, r"at most 100000 px"),
        (("cameras", 0, "lens"), "k3", r"\.lens: \"k3\", expected one of none, k1"),
        (("cameras", 0, "intrinsics", "focal_x_px"), -1, r"focal_x_px: -1, expected a finite number in 0\.001"),
        (("cameras", 0, "intrinsics", "focal_x_px"), 10**400, r"focal_x_px: 1000.*, expected a finite number"),
        (("cameras", 0, "intrinsics", "focal_x_px"), True, r"focal_x_px: true, expected a number"),
        (("cameras", 0, "intrinsics", "distortion", "p1"), 0.1, r"distortion\.p1: 0\.1, expected 0, because the lens"),
        (("cameras", 0, "is_intrinsics_fixed"), 0, r"is_intrinsics_fixed: 0, expected true or false"),
        (("cameras", 1, "cam_from_world", "target"), "C0", r'target: "C0", expected "C1"'),
        (("cameras", 1, "cam_from_world", "rotation_quat_xyzw"), [0, 0, 0, 2], r"expected a unit quaternion"),
        (("cameras", 1, "cam_from_world", "translation", 0), 9, r"\.centre_in_world: .*, which the pose says"),
        (("cameras", 1, "cam_from_world", "translation", 0), None, r"translation\[0\]: null, expected a number"),
        (("cameras", 1, "sigma", "focal_px"), 9.0, r"\.sigma\.focal_px: 9\.0, expected .*, which the covariance says"),
        (("cameras", 1, "covariance", "lower_triangle", 6, 6), -1.0, r"expected variances >= 0"),
        (("cameras", 1, "covariance", "lower_triangle", 7, 6), 99.0, r"expected a positive semidefinite matrix"),
        (("cameras", 1, "covariance", "lower_triangle", 3), [0, 0], r"lower_triangle\[3\]: .*, expected an array of 4"),
        (("cameras", 1, "covariance", "covariance_parameters", 0), "x", r"parameters: .*, expected rotation_x"),
        (("cameras", 1, "quality", "fitted", "n"), -1, r"fitted\.n: -1, expected a whole number >= 0"),
        (("cameras", 1, "quality", "coverage"), 1.5, r"coverage: 1\.5, expected a finite number in 0\.\.1"),
        (("quality", "chi2_per_dof"), "1", r'\$\.quality\.chi2_per_dof: "1", expected a number'),
        (("warnings", 0, "advice"), None, r"\$\.warnings\[0\]\.advice: null, expected a string"),
        (("provenance", "seed"), 1.5, r"\$\.provenance\.seed: 1\.5, expected a whole number"),
    ],
)  # fmt: skip
def test_fault_is_refused_with_its_path(golden, tmp_path, path, value, message):
    document = json.loads(golden.read_text())
    set_at(document, path, value)
    (tmp_path / "c.json").write_text(json.dumps(document))
    with pytest.raises(InputError, match=message):
        load(tmp_path / "c.json")


def test_all_faults_are_told_at_once_and_each_once(golden, tmp_path):
    document = json.loads(golden.read_text())
    document["world"]["unit"] = "ft"
    del document["cameras"][0]["covariance"]["lower_triangle"]
    document["provenance"]["seed"] = "1"
    (tmp_path / "c.json").write_text(json.dumps(document))
    with pytest.raises(InputError) as caught:
        load(tmp_path / "c.json")
    lines = caught.value.message.splitlines()
    assert [line.strip().split(":")[0] for line in lines[1:]] == [
        "$.world.unit",
        "$.cameras[0].covariance.lower_triangle",
        "$.provenance.seed",
    ]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "is not valid JSON"),
        (b"\xff\xfe", "is not UTF-8 text"),
        (b"[" * 100_000, "is not valid JSON"),
        (b'{"schema": NaN}', "NaN is no JSON number"),
        (b'{"schema": 1, "schema": 2}', "the name 'schema' is given twice"),
        (b'{"schema": ' + b"9" * 5000 + b"}", "is not valid JSON"),
        (b"[]", r"\$: \[\], expected an object"),
        (b"null", r"\$: null, expected an object"),
    ],
)
def test_file_that_is_no_calibration_is_refused(tmp_path, content, message):
    (tmp_path / "c.json").write_bytes(content)
    with pytest.raises(InputError, match=message):
        load(tmp_path / "c.json")


def test_truncated_file_is_refused_at_every_length(golden, tmp_path):
    content = golden.read_bytes().rstrip()
    for length in range(0, len(content), 977):
        (tmp_path / "c.json").write_bytes(content[:length])
        with pytest.raises(InputError, match="is not valid JSON"):
            load(tmp_path / "c.json")


def test_what_could_not_be_loaded_is_not_saved_and_the_old_file_stays(calibration, tmp_path):
    path = tmp_path / "c.json"
    save(calibration, path)
    before = path.read_bytes()
    broken = replace(calibration, world=replace(calibration.world, scale_sigma=np.inf))
    with pytest.raises(InputError, match=r"\$\.world\.scale_sigma: Infinity, expected a finite number"):
        save(broken, path)
    assert path.read_bytes() == before
    assert os.listdir(tmp_path) == ["c.json"]


def test_interrupted_save_leaves_the_old_file_and_no_litter(calibration, tmp_path, monkeypatch):
    path = tmp_path / "c.json"
    save(calibration, path)
    before = path.read_bytes()

    def interrupt(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(os, "fsync", interrupt)
    with pytest.raises(KeyboardInterrupt):
        save(calibration, path)
    assert path.read_bytes() == before
    assert os.listdir(tmp_path) == ["c.json"]
