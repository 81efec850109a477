"""Pictures of a spot whose truth is known, and the smallest error that any estimate from them can have.

The light is summed over many points of each pixel, of the spot's way and of its disc; nothing here is shared with the
detector, which integrates by the error function.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from network_calib.observations import FloatArray

SAMPLES_PER_PX = 8


@dataclass(frozen=True, slots=True)
class Picture:
    """A spot in a window.

    Attributes:
        shape: height and width of the window, px.
        x: of the spot's middle, px.
        y: the same.
        width: standard deviation of the blur, px.
        peak: brightest value of the spot if it sat in the middle of a pixel, counts over the background.
        half_way: half the length of the way during the exposure, px.
        angle: of the way, rad.
        ball: radius of a uniformly bright disc that is blurred, px.
        background: counts.
        read_sigma: counts.
        gain: counts per photo-electron; 0: no photon noise.
        full_scale: where samples are cut off, counts.
    """

    shape: tuple[int, int]
    x: float
    y: float
    width: float
    peak: float
    half_way: float = 0.0
    angle: float = 0.0
    ball: float = 0.0
    background: float = 20.0
    read_sigma: float = 2.0
    gain: float = 0.0
    full_scale: float = 1e9

    @property
    def px(self) -> FloatArray:
        """(2,) where the spot is."""
        return np.array([self.x, self.y])

    def light(self) -> FloatArray:
        """(h, w) counts of the spot alone, without noise."""
        centred = replace(self, x=0.0, y=0.0, shape=(1, 1))
        return self.peak * self._profile() / float(centred._profile()[0, 0])

    def sampled(self, rng: np.random.Generator) -> FloatArray:
        """(h, w) whole counts as a sensor delivers them."""
        light = self.light()
        if self.gain:
            light = rng.poisson(light / self.gain).astype(np.float64) * self.gain
        noisy = light + self.background + rng.normal(0.0, self.read_sigma, self.shape)
        return np.minimum(np.round(noisy), self.full_scale).astype(np.float64)

    def bound(self) -> FloatArray:
        """(2, 2) of Cramer and Rao for x, y; all else is unknown too, and full samples tell nothing."""
        names = ["x", "y", "width", "peak", *(("half_way", "angle") if self.half_way else ())]
        steps = [1e-3 * max(1.0, abs(getattr(self, name))) if name == "peak" else 1e-3 for name in names]
        columns = [self._difference(name, step) for name, step in zip(names, steps, strict=True)]
        jacobian = np.array([*columns, np.ones(self.shape)]).reshape(len(names) + 1, -1)
        light = self.light().ravel()
        weight = 1.0 / (self.read_sigma**2 + 1 / 12 + self.gain * light)
        weight[light + self.background >= self.full_scale] = 0.0
        information = (jacobian * weight) @ jacobian.T
        return np.linalg.inv(information)[:2, :2].astype(np.float64)

    def _difference(self, name: str, step: float) -> FloatArray:
        value = getattr(self, name)
        above, below = (replace(self, **{name: value + sign * step}) for sign in (1, -1))
        return (above.light() - below.light()) / (2 * step)

    def _profile(self) -> FloatArray:
        """(h, w) share of the light in each pixel."""
        points = self._points()
        across = _shares(self.shape[1], self.x + points[:, 0], self.width)
        down = _shares(self.shape[0], self.y + points[:, 1], self.width)
        return down.T @ across / len(points)

    def _points(self) -> FloatArray:
        """(K, 2) points of the way and of the disc, relative to the middle, px."""
        disc = np.stack(np.meshgrid(_spread(12), _spread(12)), axis=-1).reshape(-1, 2)
        disc = disc[(disc**2).sum(axis=1) < 1] if self.ball else np.zeros((1, 2))
        along = _spread(1 + 2 * int(np.ceil(2 * self.half_way / self.width)))[:, None, None] * self.half_way
        return (along * [np.cos(self.angle), np.sin(self.angle)] + self.ball * disc).reshape(-1, 2)


def _spread(n: int) -> FloatArray:
    """(n,) evenly over -1..1."""
    return (2 * np.arange(n) + 1) / n - 1


def _shares(n_px: int, centres: FloatArray, width: float) -> FloatArray:
    """(K, n) share of a Gaussian at each of K centres that falls on each of n pixels."""
    fine = (np.arange(n_px * SAMPLES_PER_PX) + 0.5) / SAMPLES_PER_PX - 0.5
    density = np.exp(-0.5 * ((fine - centres[:, None]) / width) ** 2) / (width * np.sqrt(2 * np.pi))
    return density.reshape(len(centres), n_px, SAMPLES_PER_PX).mean(axis=2)
