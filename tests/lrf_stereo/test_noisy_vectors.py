"""Vectors beside each other: what Gaussian numbers with a common mean say of each, by dense algebra."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lrf_stereo.noisy_vectors import NoisyVectors


def drawn(seed, n=12, *, size=0.3, mean=0.2, noise=0.1):
    """Vectors around a mean, measured with noise of any shape."""
    rng = np.random.default_rng(seed)
    root = noise * rng.standard_normal((n, 3, 3))
    value = mean * rng.standard_normal(3) + size * rng.standard_normal((n, 3))
    value += np.einsum("nij,nj->ni", root, rng.standard_normal((n, 3)))
    return NoisyVectors.of(value, root @ root.transpose(0, 2, 1)), root @ root.transpose(0, 2, 1)


@given(st.integers(0, 10_000))
def test_each_vector_is_what_all_measurements_together_say(seed):
    vectors, noise = drawn(seed)
    n = len(noise)
    usual = vectors.usual(1.0)
    # Prior of all vectors at once: own variance, and one mean for all; then what measuring them leaves.
    prior = usual.variance * np.eye(3 * n) + vectors.size2() * np.kron(np.ones((n, n)), np.eye(3))
    total = prior + np.zeros((3 * n, 3 * n))
    for k in range(n):
        total[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] += noise[k]
    gain = prior @ np.linalg.inv(total)
    expected, left = (gain @ vectors.value.ravel()).reshape(n, 3), prior - gain @ prior
    mean, covariance = vectors.expected(usual)
    # The rounds of mean and size settle to some 1e-6 of 0.3.
    assert mean == pytest.approx(expected, abs=1e-5)
    for k in range(n):
        own = left[3 * k : 3 * k + 3, 3 * k : 3 * k + 3]
        assert covariance[k] == pytest.approx(own, abs=1e-5)


def test_size_is_the_likeliest():
    vectors, noise = drawn(3, 40, mean=0.0)

    def likelihood(size2):
        total = noise + size2 * np.eye(3)
        distance = np.einsum("ni,ni->n", vectors.value, np.linalg.solve(total, vectors.value[:, :, None])[:, :, 0])
        return -0.5 * (distance + np.linalg.slogdet(total)[1]).sum()

    best = vectors.size2()
    assert likelihood(best) > max(likelihood(best * 1.01), likelihood(best / 1.01))


def test_nothing_but_noise_is_nothing():
    rng = np.random.default_rng(1)
    vectors = NoisyVectors.of(0.5 * rng.standard_normal((50, 3)), np.tile(np.eye(3), (50, 1, 1)))
    usual = vectors.usual(1.0)
    assert (usual.variance, usual.mean.tolist(), usual.mean_covariance.any()) == (0.0, [0.0] * 3, False)
    mean, covariance = vectors.expected(usual)
    assert not mean.any()
    assert not covariance.any()


def test_without_a_measurement_the_given_variance_stands():
    usual = NoisyVectors.of(np.empty((0, 3)), np.empty((0, 3, 3))).usual(0.09)
    assert (usual.variance, usual.mean.tolist()) == (0.09, [0.0] * 3)


def test_exact_measurements_stay_what_they_are():
    value = np.random.default_rng(2).standard_normal((5, 3))
    vectors = NoisyVectors.of(value, np.zeros((5, 3, 3)))
    mean, covariance = vectors.expected(vectors.usual(1.0))
    assert mean == pytest.approx(value, abs=1e-14)
    assert not covariance.any()
