"""Focal ratios of all cameras from the verified fundamental matrices (self-calibration without a rank-4 upgrade).

With D = diag(ratio, ratio, 1), E = D_b F D_a is an essential matrix when both ratios are right: its two singular
values are equal. Restricted to the complements of its null vectors, E is then a 2x2 rotation or reflection, so what is
left of the other kind is a residual of two numbers, smooth through zero. Each pair's residual is whitened by the
covariance of its F, which lets a pair whose axes meet or whose spots lie in a plane say only what it knows; the pairs
are then solved together. One pair alone (Bougnoux's formula) fails when two optical axes meet, which is how rooms are
watched; where all meet, principal points off the image centre still move the common scale of the ratios by up to a
third, and what follows has to expect that.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from network_calib.observations import BoolArray, FloatArray, IntArray
from network_calib.pairs import PairGraph

# Standard deviation of log(ratio) before the data: lenses from 0.37 to 2.7 times the longer image side at two sigma.
PRIOR_LOG_SIGMA = 0.5
# What a bend of one term leaves of a lens moves a singular value by about a hundredth.
MODEL_SIGMA = 0.01
GRID_LOG = np.linspace(-1.2, 1.2, 17)
N_STEPS = 12
MAX_PAIRS = 600


@dataclass(frozen=True, slots=True)
class _Evidence:
    """P pairs: ends (P, 2), matrices (P, 3, 3) and the covariance (P, 9, 9) of their entries."""

    ends: IntArray
    fundamental: FloatArray
    spread: FloatArray

    def of(self, camera: np.intp) -> _Evidence:
        own = (self.ends == camera).any(axis=1)
        return _Evidence(self.ends[own], self.fundamental[own], self.spread[own])


def focal_ratios(graph: PairGraph, is_focal_known: BoolArray) -> FloatArray:
    """Joint robust estimate over all verified pairs.

    Args:
        graph: verified pairs with their information.
        is_focal_known: (C,) cameras whose ratio is 1.

    Returns:
        (C,) ratios: true over nominal focal length.
    """
    log_ratio = np.zeros(len(is_focal_known))
    pairs = sorted(graph.pairs, key=lambda pair: -pair.n_inliers)[:MAX_PAIRS]
    free = np.flatnonzero(~is_focal_known)
    if not free.size or not pairs:
        return np.exp(log_ratio)
    fundamental = np.array([pair.fundamental for pair in pairs])
    spread = _covariances(fundamental, np.array([pair.information for pair in pairs]))
    evidence = _Evidence(np.array([(pair.a, pair.b) for pair in pairs]), fundamental, spread)
    # The common ratio first: a coordinate alone can settle in the wrong valley.
    trials = np.where(is_focal_known, 0.0, GRID_LOG[:, None])
    log_ratio = trials[int(np.argmin(_costs(evidence, trials)))]
    for _ in range(2):
        for camera in free:
            trials = np.tile(log_ratio, (len(GRID_LOG) + 1, 1))
            trials[1:, camera] = GRID_LOG
            log_ratio = trials[int(np.argmin(_costs(evidence.of(camera), trials)))]
        log_ratio = _descend(evidence, log_ratio, free)
    return np.exp(log_ratio)


def _covariances(fundamental: FloatArray, information: FloatArray) -> FloatArray:
    """(P, 9, 9) covariance of the entries of F, on the manifold of rank 2 and norm 1."""
    n_pairs = len(fundamental)
    u, _, vt = np.linalg.svd(fundamental)
    null = (u[:, :, 2, None] * vt[:, 2, None, :]).reshape(n_pairs, 9, 1)
    own = fundamental.reshape(n_pairs, 9, 1)
    fixed = own @ own.swapaxes(1, 2) + null @ null.swapaxes(1, 2)
    size = np.trace(information, axis1=1, axis2=2)[:, None, None] + 1e-12
    return np.linalg.inv(information + size * (fixed + 1e-10 * np.eye(9))) - fixed / size


def _costs(evidence: _Evidence, trials: FloatArray) -> FloatArray:
    """(T,) robust costs, with the prior, of trial log ratios (T, C)."""
    ends, n_trials = evidence.ends, len(trials)
    tiled = _Evidence(
        np.tile(ends, (n_trials, 1)),
        np.tile(evidence.fundamental, (n_trials, 1, 1)),
        np.tile(evidence.spread, (n_trials, 1, 1)),
    )
    z, covariance, _ = _residuals(tiled, trials[:, ends[:, 0]].ravel(), trials[:, ends[:, 1]].ravel())
    # Cauchy with a scale of 2 sigma.
    cost = 4 * np.log1p(_squared(z, covariance) / 4)
    return cost.reshape(n_trials, len(ends)).sum(axis=1) + (trials**2).sum(axis=1) / PRIOR_LOG_SIGMA**2


def _residuals(evidence: _Evidence, log_a: FloatArray, log_b: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """What is left of the other kind at log ratios (P,) of the first and the second cameras.

    Returns:
        (P, 2) residuals, (P, 2, 2) covariances, (P, 2, 2) slopes by the two log ratios.
    """
    scale = _diagonal(log_b)[:, :, None] * _diagonal(log_a)[:, None, :]
    essential = scale * evidence.fundamental
    u, s, vt = np.linalg.svd(essential)
    # In the basis of its singular vectors E is diag(s1, s2): (s1 - s2, 0) is left of the other kind.
    total = (s[:, 0] + s[:, 1])[:, None, None]
    first = (s[:, 0] - s[:, 1])[:, None, None] / total
    u1, u2, v1, v2 = u[:, :, 0, None], u[:, :, 1, None], vt[:, 0, None, :], vt[:, 1, None, :]
    by_first = (u1 * v1 * (1 - first) - u2 * v2 * (1 + first)) / total
    by_second = (u1 * v2 + u2 * v1) / total
    by_essential = np.stack([by_first, by_second], axis=1)
    by_f = (by_essential * scale[:, None]).reshape(-1, 2, 9)
    covariance = by_f @ evidence.spread @ by_f.swapaxes(1, 2) + MODEL_SIGMA**2 * np.eye(2)
    product = by_essential * essential[:, None]
    slope = np.stack([product[..., :2].sum(axis=(2, 3)), product[..., :2, :].sum(axis=(2, 3))], axis=2)
    return np.concatenate([first[:, 0], np.zeros_like(first[:, 0])], axis=1), covariance, slope


def _diagonal(log_ratio: FloatArray) -> FloatArray:
    ratio = np.exp(log_ratio)
    return np.stack([ratio, ratio, np.ones_like(ratio)], axis=-1)


def _squared(z: FloatArray, covariance: FloatArray) -> FloatArray:
    return (z * np.linalg.solve(covariance, z[..., None])[..., 0]).sum(axis=1)


def _descend(evidence: _Evidence, log_ratio: FloatArray, free: IntArray) -> FloatArray:
    """Levenberg-Marquardt on the free log ratios."""
    ends = evidence.ends
    cost, damping = _costs(evidence, log_ratio[None])[0], 1e-2
    for _ in range(N_STEPS):
        z, covariance, slope = _residuals(evidence, log_ratio[ends[:, 0]], log_ratio[ends[:, 1]])
        weight = 1 / (1 + _squared(z, covariance) / 4)
        whitened = np.linalg.solve(covariance, np.concatenate([slope, z[..., None]], axis=2)) * weight[:, None, None]
        product = slope.swapaxes(1, 2) @ whitened
        hessian, gradient = np.zeros((len(log_ratio),) * 2), np.zeros(len(log_ratio))
        np.add.at(hessian, (ends[:, :, None], ends[:, None, :]), product[:, :, :2])
        np.add.at(gradient, ends, product[:, :, 2])
        hessian = hessian[np.ix_(free, free)] + np.eye(len(free)) / PRIOR_LOG_SIGMA**2
        gradient = gradient[free] + log_ratio[free] / PRIOR_LOG_SIGMA**2
        trial = log_ratio.copy()
        step = np.linalg.solve(hessian + damping * np.diag(hessian.diagonal()), gradient)
        trial[free] = np.clip(trial[free] - step, 2 * GRID_LOG[0], 2 * GRID_LOG[-1])
        trial_cost = _costs(evidence, trial[None])[0]
        if trial_cost >= cost:
            damping *= 10
            continue
        is_done = cost - trial_cost < 1e-3 * cost
        log_ratio, cost, damping = trial, trial_cost, damping / 10
        if is_done:
            break
    return log_ratio
