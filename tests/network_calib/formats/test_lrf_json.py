import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from network_calib.errors import InputError
from network_calib.formats.calibration_json import load, save
from network_calib.formats.shared_json import canonical_quaternion


def test_lrf_survives_bit_for_bit(lrf_calibration, tmp_path):
    save(lrf_calibration, tmp_path / "a.json")
    again = load(tmp_path / "a.json")
    save(again, tmp_path / "b.json")
    assert (tmp_path / "a.json").read_bytes() == (tmp_path / "b.json").read_bytes()
    (before,), (after,) = lrf_calibration.lrfs, again.lrfs
    for name in before.__slots__:
        if name == "world_from_lrf":
            # A quaternion and a matrix round differently, once.
            np.testing.assert_allclose(after.world_from_lrf.as_matrix(), before.world_from_lrf.as_matrix(), atol=1e-15)
        else:
            assert name == "out_of_plane_rms_m" or np.array_equal(getattr(after, name), getattr(before, name)), name
    assert np.isnan(after.out_of_plane_rms_m)


def test_file_without_lrfs_has_no_such_field(calibration, tmp_path):
    save(calibration, tmp_path / "a.json")
    assert "lrfs" not in json.loads((tmp_path / "a.json").read_text())
    assert load(tmp_path / "a.json").lrfs == ()


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        (("name",), 3, r"\$\.lrfs\[0\]\.name: 3, expected a string"),
        (("held",), ["dx"], r'held\[0\]: "dx", expected one of rotation_x_rad'),
        (("axis", "direction_in_world"), [0, 0, 2], r"direction_in_world: \[0, 0, 2\], expected a unit vector"),
        (("axis", "point_in_world"), [0, 1, 1], r"point_in_world: .*, expected the point of the axis that is nearest"),
        (("instrument", "range_scale"), 0, r"instrument\.range_scale: 0, expected a number > 0"),
        (("paper", "dx_m"), None, r"paper\.dx_m: null, expected a number"),
        (("paper_sigma", "dz_m"), -1, r"paper_sigma\.dz_m: -1, expected a finite number in 0"),
        (("tilts", "sigma_rad"), [0.0], r"tilts\.sigma_rad: \[0\.0\], expected an array of 3"),
        (("sigma", "tilt_gain"), 9.0, r"sigma\.tilt_gain: 9\.0, expected .*, which the covariance says"),
        (("world_from_lrf", "target"), "L0", r'target: "L0", expected "world'),
        (("sightings", "n_inliers"), 1.5, r"n_inliers: 1\.5, expected a whole number"),
        (("sightings", "range_rms_m"), -1, r"range_rms_m: -1, expected a finite number in 0"),
        (("tilt",), 1, r"\$\.lrfs\[0\]\.tilt: unknown field"),
    ],
)
def test_fault_is_refused_with_its_path(lrf_calibration, tmp_path, path, value, message):
    save(lrf_calibration, tmp_path / "a.json")
    document = json.loads((tmp_path / "a.json").read_text())
    place = document["lrfs"][0]
    for step in path[:-1]:
        place = place[step]
    place[path[-1]] = value
    (tmp_path / "b.json").write_text(json.dumps(document))
    with pytest.raises(InputError, match=message):
        load(tmp_path / "b.json")


def test_clock_offset_may_be_missing_and_then_is_held_at_zero(lrf_calibration, tmp_path):
    save(lrf_calibration, tmp_path / "a.json")
    document = json.loads((tmp_path / "a.json").read_text())
    lrf = document["lrfs"][0]
    for fields in (lrf["instrument"], lrf["sigma"]):
        del fields["clock_offset_s"]
    lrf["covariance"]["covariance_parameters"].pop()
    lrf["covariance"]["lower_triangle"].pop()
    (tmp_path / "b.json").write_text(json.dumps(document))
    (before,), (after,) = lrf_calibration.lrfs, load(tmp_path / "b.json").lrfs
    assert after.instrument.tolist() == [*before.instrument[:4].tolist(), 0.0]
    assert np.array_equal(after.covariance[:14, :14], before.covariance[:14, :14])
    assert not after.covariance[14].any()
    assert after.held == ("clock_offset_s", *before.held)
    # Missing in one place only is a fault.
    document["lrfs"][0]["instrument"]["clock_offset_s"] = 0.0
    (tmp_path / "b.json").write_text(json.dumps(document))
    with pytest.raises(InputError, match=r"covariance_parameters: .*\n.*lower_triangle: .*, expected an array of 15"):
        load(tmp_path / "b.json")


def test_lrf_in_a_world_without_metres_or_given_twice_is_refused(lrf_calibration, tmp_path):
    unscaled = replace(lrf_calibration, world=replace(lrf_calibration.world, unit="unit"))
    with pytest.raises(InputError, match=r"\$\.lrfs: in a world of unit unit, expected m"):
        save(unscaled, tmp_path / "a.json")
    with pytest.raises(InputError, match=r"LRF names \['L0', 'L0'\], expected one or more, unique"):
        save(replace(lrf_calibration, lrfs=lrf_calibration.lrfs * 2), tmp_path / "a.json")


@pytest.mark.parametrize("exponent", range(-9, 0))
def test_quaternion_of_a_small_turn_settles(exponent):
    # One that wandered: its length is a hair below one, w is too near to 1 to make up for it, so the others grow.
    turns = [[1.489116238395636e-05, -3.4066675828088876e-07, -4.435320464282385e-05, 0.9999999989054653]]
    rng = np.random.default_rng(9)
    turns += Rotation.from_rotvec(10.0**exponent * rng.normal(size=(20, 3))).as_quat(canonical=True).tolist()
    for turn in turns:
        first = canonical_quaternion(Rotation.from_quat(turn))
        held = RigidTransform.from_components((0, 0, 0), Rotation.from_quat(first)).rotation
        assert np.array_equal(canonical_quaternion(held), first)
        # Components grow until the length, 1e-16 short, is one: by 1e-16 / q, where q > 5e-3 or the grid stops them.
        assert np.abs(first - turn).max() < 2e-14
