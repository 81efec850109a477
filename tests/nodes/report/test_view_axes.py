from dataclasses import replace

import numpy as np

from nodes.report.view_axes import view_axes


def test_a_lent_frame_is_levelled_by_the_mean_of_the_cameras_up_directions(calibration):
    lent = replace(calibration, world=replace(calibration.world, name=calibration.cameras[0].name))
    axes_in_world, labels = view_axes(lent)
    np.testing.assert_allclose(axes_in_world @ axes_in_world.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(axes_in_world) > 0
    up = -np.mean([camera.cam_from_world.rotation.as_matrix()[1] for camera in lent.cameras], axis=0)
    np.testing.assert_allclose(axes_in_world[2], up / np.linalg.norm(up), atol=1e-12)
    assert labels[0] == f"right of {lent.world.name}"


def test_a_world_of_its_own_is_looked_at_along_its_axes(calibration):
    axes_in_world, labels = view_axes(replace(calibration, world=replace(calibration.world, name="floor")))
    np.testing.assert_array_equal(axes_in_world, np.eye(3))
    assert labels == ("x", "y", "z")
