"""Priors on lenses: their derivatives, what is assumed of whom, and that a group is counted once."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from network_calib.camera_block import PART
from network_calib.camera_parameters import CameraParameters, free_columns
from network_calib.cameras import LensModel
from network_calib.priors import lens_prior, optics_of, prior_sigma
from network_calib.refine import intrinsics_groups
from network_calib.room_setup import CameraSetup, Knowledge
from tests.network_calib.scenes import setups_of, waved

GIVEN = np.array([500.0, 505.0, 320.0, 240.0, -0.2, 0.05, 0.001, 0.002])


def prior_of(setups, scene):
    columns = free_columns(
        tuple(setup.lens for setup in setups),
        is_pose_fixed=np.zeros(len(setups), dtype=bool),
        is_intrinsics_fixed=np.array([setup.knowledge is Knowledge.FIXED for setup in setups]),
        groups=intrinsics_groups(setups),
    )
    parameters = CameraParameters.from_cameras(scene.cameras, columns)
    return lens_prior(setups, parameters), parameters


@given(
    lenses=st.lists(st.sampled_from(LensModel), min_size=5, max_size=5),
    knowledge=st.lists(st.sampled_from(Knowledge), min_size=5, max_size=5),
    is_grouped=st.booleans(),
    seed=st.integers(0, 100),
)
def test_jacobian_is_the_derivative(lenses, knowledge, is_grouped, seed):
    scene, _ = waved("smart_room", n_frames=50)
    lens = lenses[0] if is_grouped else None
    setups = [
        CameraSetup(f"C{c}", (640, 480), lens or lenses[c], knowledge[c], GIVEN, group="all" if is_grouped else None)
        for c in range(5)
    ]
    prior, parameters = prior_of(setups, scene)
    residual, jacobian = prior.linearise({PART: parameters})
    assert jacobian.shape == (len(residual), 1)
    # Linear: a central difference is exact but for roundoff, at steps of the size of the numbers.
    step = np.random.default_rng(seed).uniform(-0.1, 0.1, parameters.size)
    ahead, _ = prior.linearise({PART: parameters.retract(step)})
    behind, _ = prior.linearise({PART: parameters.retract(-step)})
    expected = jacobian[:, 0] * step[prior.columns[:, 0]]
    np.testing.assert_allclose((ahead - behind) / 2, expected, rtol=1e-6, atol=1e-9)


def test_an_unknown_camera_has_no_prior_on_its_focal_length():
    setup = CameraSetup("C0", (640, 480))
    sigma = prior_sigma(setup)
    assert np.isinf(sigma[0])
    np.testing.assert_allclose(sigma[2:4], 32.0)  # 5 % of the longer side
    assert np.isfinite(sigma[4:]).all()


def test_given_intrinsics_are_believed_to_some_percent():
    sigma = prior_sigma(CameraSetup("C0", (640, 480), knowledge=Knowledge.INITIAL, intrinsics=GIVEN))
    assert sigma[0] == pytest.approx(15.0)  # 3 % of 500
    assert sigma[2] == pytest.approx(12.8)  # 2 % of 640
    unknown = prior_sigma(CameraSetup("C0", (640, 480)))
    assert (sigma <= unknown).all()


def test_given_sigmas_are_taken_as_they_are():
    own = np.array([2.0, 2.0, 3.0, 4.0, 0.1, 0.2, 0.3, 0.4])
    setup = CameraSetup("C0", (640, 480), knowledge=Knowledge.INITIAL, intrinsics=GIVEN, intrinsics_sigma=own)
    sigma = prior_sigma(setup)
    np.testing.assert_allclose(sigma[[0, 2, 3, 4, 5, 6, 7]], own[[0, 2, 3, 4, 5, 6, 7]])
    # Aspect is a quotient of two numbers of 2 px each: sqrt(8) / 500.
    assert sigma[1] == pytest.approx(np.sqrt(8) / 500)
    np.testing.assert_array_equal(own, [2.0, 2.0, 3.0, 4.0, 0.1, 0.2, 0.3, 0.4])


def test_the_prior_expects_what_was_given_and_the_image_centre_where_nothing_was():
    scene, _ = waved("smart_room", n_frames=50)
    setups = setups_of(scene)
    setups[1] = CameraSetup("C1", (640, 480), LensModel.K1_K2_P1_P2, Knowledge.INITIAL, GIVEN)
    prior, _ = prior_of(setups, scene)
    own = prior.camera == 1
    np.testing.assert_allclose(prior.expected[own], optics_of(GIVEN)[prior.entry[own]])
    assert 0 in prior.entry[own]  # the given focal length counts
    other = prior.camera == 0
    assert 0 not in prior.entry[other]
    np.testing.assert_allclose(prior.expected[other], [319.5, 239.5, 0, 0])


def test_a_shared_lens_is_assumed_once():
    scene, _ = waved("smart_room", n_frames=50)
    apart, _ = prior_of(setups_of(scene), scene)
    shared, _ = prior_of([CameraSetup(f"C{c}", (640, 480), LensModel.K1_K2, group="all") for c in range(5)], scene)
    assert len(apart.expected) == 5 * len(shared.expected)
    assert len(np.unique(shared.columns)) == len(shared.columns)


def test_fixed_intrinsics_leave_no_prior():
    scene, _ = waved("smart_room", n_frames=50)
    setups = [
        CameraSetup(f"C{c}", (640, 480), LensModel.K1_K2, Knowledge.FIXED, row)
        for c, row in enumerate(scene.cameras.intrinsics)
    ]
    prior, parameters = prior_of(setups, scene)
    residual, jacobian = prior.linearise({PART: parameters})
    assert residual.shape == (0,)
    assert jacobian.shape == (0, 1)
