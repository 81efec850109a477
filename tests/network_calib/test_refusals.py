"""What must not be calibrated is refused, with the reason, the cameras by name, and what to do."""

from dataclasses import replace

import numpy as np
import pytest

from network_calib.calibrate import calibrate
from network_calib.cameras import LensModel
from network_calib.errors import DegenerateError, FlatError, InputError, SpotcalError
from network_calib.optimum import solved_rays
from network_calib.refusals import refuse_disagreement, refuse_flat, refuse_unobservable
from network_calib.room_setup import CameraSetup, Knowledge, KnownDistance, Options
from network_calib.spots import SpotViews
from tests.network_calib.scenes import setups_of, stereo_anchor, waved, with_frames_shifted

QUICK = Options(n_repeats=1)


def refusal(observations, setups, **arguments):
    with pytest.raises(SpotcalError) as caught:
        calibrate(observations, setups, options=arguments.pop("options", QUICK), **arguments)
    assert caught.value.advice  # says what to do next
    return caught.value


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(("missing", "false_detections"), [(0.0, 0.0), (0.3, 0.1)])
def test_waving_in_a_plane(seed, missing, false_detections):
    scene, seen = waved("planar_waving", n_frames=800, seed=seed, missing=missing, false_detections=false_detections)
    error = refusal(seen.observations, setups_of(scene), anchor=stereo_anchor(scene))
    assert "in a plane" in error.message
    assert "near and far, high and low" in error.advice


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize(("missing", "false_detections"), [(0.0, 0.0), (0.3, 0.1)])
def test_waving_along_a_line(seed, missing, false_detections):
    scene, seen = waved("line_waving", n_frames=600, seed=seed, missing=missing, false_detections=false_detections)
    error = refusal(seen.observations, setups_of(scene), anchor=stereo_anchor(scene))
    assert "along a line" in error.message
    assert "near and far, high and low" in error.advice


def test_a_plane_is_enough_when_all_lenses_are_known():
    scene, seen = waved("planar_waving", n_frames=800)
    setups = [
        replace(setup, knowledge=Knowledge.FIXED, intrinsics=row)
        for setup, row in zip(setups_of(scene), scene.cameras.intrinsics, strict=True)
    ]
    views = SpotViews.of(seen.observations)
    everything = np.ones(len(views.point), dtype=bool)
    rays, _ = solved_rays(scene.cameras, views)
    refuse_flat(setups, views, rays, everything)
    with pytest.raises(FlatError, match="plane"):
        refuse_flat([*setups[:4], setups_of(scene)[4]], views, rays, everything)


@pytest.mark.parametrize("name", ["smart_room", "ring_room", "facing_cameras", "wide_fisheye", "tele_beside_wide"])
def test_a_volume_is_not_taken_for_a_plane(name):
    scene, seen = waved(name)
    views = SpotViews.of(seen.observations)
    refuse_flat(setups_of(scene), views, solved_rays(scene.cameras, views)[0], np.ones(len(views.point), dtype=bool))


def test_islands_are_named_with_the_pair_to_bridge():
    scene, seen = waved("two_islands", n_frames=800)
    error = refusal(seen.observations, setups_of(scene))
    assert "2 unconnected groups: C0, C1, C2 | C3, C4, C5" in error.message
    first, second = error.advice.removeprefix("Wave where ").split(" both see")[0].split(" and ")
    assert first in {"C0", "C1", "C2"}
    assert second in {"C3", "C4", "C5"}
    assert "they share 0 spots" in error.advice


def test_two_cameras_with_unknown_lenses():
    scene, seen = waved("stereo_only", n_frames=400)
    error = refusal(seen.observations, setups_of(scene), anchor=stereo_anchor(scene))
    assert "C0 and C1 alone do not determine their focal lengths" in error.message
    assert "intrinsics" in error.advice


def test_too_few_points_names_the_camera():
    scene, seen = waved("smart_room", n_frames=400)
    observations = seen.observations
    rows = np.flatnonzero(observations.camera == 3)
    is_kept = ~np.isin(np.arange(len(observations)), rows[21:])
    error = refusal(observations.select(is_kept), setups_of(scene))
    assert "C3: 21 detections" in error.message
    assert "C0" not in error.message


def test_many_points_that_nobody_shares_are_too_few():
    scene, seen = waved("smart_room", n_frames=400)
    apart = with_frames_shifted(seen.observations, 2, 10_000)
    error = refusal(apart, setups_of(scene))
    own = (seen.observations.camera == 2).sum()
    assert f"C2: {own} detections, 0 in frames that another camera saw too" in error.message


def test_nothing_at_all_is_too_few():
    scene, seen = waved("smart_room", n_frames=400)
    error = refusal(seen.observations.select(np.zeros(len(seen.observations), dtype=bool)), setups_of(scene))
    assert "C0: 0 detections" in error.message


def test_setups_of_other_cameras():
    scene, seen = waved("smart_room", n_frames=400)
    setups = setups_of(scene)
    setups[1] = replace(setups[1], name="door")
    with pytest.raises(InputError, match="door"):
        calibrate(seen.observations, setups, options=QUICK)
    with pytest.raises(InputError, match="C4"):
        calibrate(seen.observations, setups_of(scene)[:4], options=QUICK)


def test_one_camera_alone():
    scene, seen = waved("smart_room", n_frames=400)
    alone = seen.observations.select(seen.observations.camera == 0)
    error = refusal(replace(alone, camera_names=("C0",)), setups_of(scene)[:1])
    assert "two cameras or more, got 1" in error.message


def test_an_anchor_that_names_no_camera_is_refused_before_the_solve():
    scene, seen = waved("smart_room", n_frames=400)
    anchor = KnownDistance("C0", "C7", 1.0, is_stereo_pair=True)
    for start in ("anchor", "factorisation"):
        with pytest.raises(InputError, match="'C7'; the room has C0, C1, C2, C3, C4"):
            calibrate(seen.observations, setups_of(scene), anchor=anchor, options=Options(start=start, n_repeats=1))


def test_an_unknown_start_is_refused():
    scene, seen = waved("smart_room", n_frames=400)
    with pytest.raises(InputError, match="unknown start 'magic', expected auto, factorisation or anchor"):
        calibrate(seen.observations, setups_of(scene), options=Options(start="magic"))


def test_a_given_lens_that_cannot_have_seen_a_detection():
    scene, seen = waved("smart_room", n_frames=400)
    setups = setups_of(scene)
    folded = scene.cameras.intrinsics[2].copy()
    folded[4] = -3.0
    setups[2] = CameraSetup("C2", (640, 480), LensModel.K1, Knowledge.FIXED, folded)
    with pytest.raises(InputError, match="camera C2: no ray leads to pixel"):
        calibrate(seen.observations, setups, options=QUICK)


@pytest.mark.parametrize(("camera", "n_frames"), [(3, 10), (0, 10), (3, 30)])
def test_a_camera_out_of_step_by_many_frames_is_named(camera, n_frames):
    scene, seen = waved("smart_room", n_frames=1200, missing=0.3, false_detections=0.1)
    shifted = with_frames_shifted(seen.observations, camera, n_frames)
    error = refusal(shifted, setups_of(scene), anchor=stereo_anchor(scene))
    assert f"frame numbers of C{camera} are {n_frames} too high" in error.message
    others = {f"C{c}" for c in range(5)} - {f"C{camera}"}
    assert not any(f"frame numbers of {name}" in error.message for name in others)


@pytest.mark.parametrize("camera", [0, 2])
def test_a_camera_with_a_mirrored_image_is_named(camera):
    scene, seen = waved("smart_room", n_frames=600)
    px = seen.observations.px.copy()
    own = seen.observations.camera == camera
    px[own, 0] = 639 - px[own, 0]
    error = refusal(replace(seen.observations, px=px), setups_of(scene))
    assert f"the image of C{camera} seems mirrored" in error.message


def test_a_camera_that_follows_another_light_is_named():
    scene, seen = waved("smart_room", n_frames=600)
    rng = np.random.default_rng(0)
    px = seen.observations.px.copy()
    own = seen.observations.camera == 4
    px[own] = [200.0, 300.0] + 5 * rng.standard_normal((own.sum(), 2))
    error = refusal(replace(seen.observations, px=px), setups_of(scene))
    assert "C4" in error.message


def test_a_focal_length_that_is_uncertain_by_a_tenth_is_refused():
    setups = [CameraSetup(name, (640, 480)) for name in ("A", "B")]
    refuse_unobservable(setups, np.array([500.0, 500.0]), np.array([49.0, 1.0]))
    with pytest.raises(DegenerateError, match=r"A \(500 ± 51 px\)"):
        refuse_unobservable(setups, np.array([500.0, 500.0]), np.array([51.0, 1.0]))


def test_a_camera_that_mostly_disagrees_is_named():
    refuse_disagreement(["A", "B", "C"], np.array([0.6, 0.9, 0.9]), np.array([0.2, 0.3, 0.9]))
    with pytest.raises(DegenerateError, match="A") as caught:
        refuse_disagreement(["A", "B", "C"], np.array([0.4, 0.9, 0.9]), np.array([0.2, 0.3, 0.9]))
    assert "B" not in caught.value.message
    with pytest.raises(DegenerateError, match="C"):
        refuse_disagreement(["A", "B", "C"], np.array([0.9, 0.9, 0.9]), np.array([0.2, 0.3, 9.0]))
    # All noisy alike: no camera stands out, and still no detector is like that.
    with pytest.raises(DegenerateError, match="B"):
        refuse_disagreement(["A", "B", "C"], np.array([0.9, 0.9, 0.9]), np.array([3.0, 4.0, 6.0]))
