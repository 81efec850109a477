"""Losses: the laws that iteratively reweighted least squares rests on."""

import numpy as np
import pytest

from network_calib.robust_loss import CauchyLoss, HuberLoss, SquaredLoss

# Around Huber's corner at 1.5^2 = 2.25, where the slope jumps in its derivative, but on neither side of a difference.
SQUARED = np.array([0.0, 1e-12, 0.01, 0.5, 2.0, 2.3, 10.0, 1e4])


@pytest.mark.parametrize("loss", [CauchyLoss(2.4), CauchyLoss(0.5), HuberLoss(1.5)])
def test_weight_is_the_slope_of_the_cost(loss):
    # Central differences err by h^2 rho''' / 6 < 1e-9 here and by roundoff 1e-16 rho / h < 1e-11 relative.
    h = 1e-5 * np.maximum(SQUARED, 1.0)
    low = np.maximum(SQUARED - h, 0)
    slope = (loss.cost(SQUARED + h) - loss.cost(low)) / (SQUARED + h - low)
    # At s = 0 the difference is one-sided: half a step of rho'' = 1 / c^2 <= 4.
    np.testing.assert_allclose(loss.weight(SQUARED), slope, rtol=4e-5)


@pytest.mark.parametrize("loss", [CauchyLoss(2.4), HuberLoss(1.5), SquaredLoss()])
def test_a_loss_starts_as_the_square(loss):
    small = np.array([0.0, 1e-9, 1e-6])
    np.testing.assert_allclose(loss.cost(small), small, rtol=1e-5)
    weight = loss.weight(small)
    np.testing.assert_allclose(np.ones(3) if weight is None else weight, 1.0, rtol=1e-5)


@pytest.mark.parametrize(("loss", "power"), [(CauchyLoss(2.4), 0.1), (HuberLoss(1.5), 0.5)])
def test_gross_errors_pull_with_bounded_force(loss, power):
    # The pull on a residual of length r is weight * r; Huber's stays at c, Cauchy's falls to nothing.
    far = np.array([1e8, 1e10])
    pull = loss.weight(far) * np.sqrt(far)
    assert (pull <= 1.5 * (1 + 1e-12)).all()
    assert loss.cost(far)[1] / loss.cost(far)[0] < 100**power * 1.3


def test_huber_has_no_step_at_its_corner():
    loss = HuberLoss(1.5)
    corner = np.array([2.25 * (1 - 1e-12), 2.25 * (1 + 1e-12)])
    assert np.ptp(loss.cost(corner)) < 1e-10
    weight = loss.weight(corner)
    assert weight is not None
    assert np.ptp(weight) < 1e-10
