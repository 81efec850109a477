"""How near to the truth a spot is located, against the bound of Cramer and Rao, a centroid and OpenCV's blobs.

Every setting is drawn many times with the spot anywhere within a pixel. "RMS / bound" compares the root mean square
error with the smallest possible one; "stated / true" compares the root of the mean stated variance with the RMS.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from benchmarks.report import Row, Run, at_most, within
from benchmarks.spot_pictures import Picture
from benchmarks.spot_video import compressed
from network_calib.observations import FloatArray
from nodes.detection.noise_model import PROCESSED_CORRELATION_PX2, NoiseModel
from nodes.detection.profile import Localisation, localise

WIDTHS_PX = (0.5, 0.7, 1.0, 1.5, 2.0, 3.0)
SNRS = (5, 7, 10, 15, 20, 35, 50, 70, 100)
SMEARS_PX = (2, 5, 10, 20)
N_BOUNDS = 16  # positions within the pixel over which a bound is averaged


@dataclass(frozen=True, slots=True)
class Trials:
    """M spots that were found, in axes along and across their way (x and y where they stood still).

    Attributes:
        error_px: (M, 2) of the fit.
        stated_px2: (M, 2) variances that it stated.
        centroid_px: (M, 2) error of the centroid of what exceeds three standard deviations, weighted by brightness.
        phase_px: (M, 2) position within the pixel.
        smear_px: (M,) length told.
        smear_sigma_px: (M,) its standard deviation told; 0 where none was seen.
        bound_px2: (2,) variances of the bound.
        n: spots shown.
    """

    error_px: FloatArray
    stated_px2: FloatArray
    centroid_px: FloatArray
    phase_px: FloatArray
    smear_px: FloatArray
    smear_sigma_px: FloatArray
    bound_px2: FloatArray
    n: int

    @property
    def over_bound(self) -> FloatArray:
        """(2,) RMS over that of the bound."""
        return np.sqrt((self.error_px**2).mean(axis=0) / self.bound_px2)

    @property
    def stated_over_true(self) -> FloatArray:
        """(2,) root of the mean stated variance over the RMS."""
        return np.sqrt(self.stated_px2.mean(axis=0) / (self.error_px**2).mean(axis=0))

    @property
    def over_centroid(self) -> float:
        """RMS of the fit over that of the centroid."""
        return _rms(self.error_px) / _rms(self.centroid_px)

    def worst_bias_px(self, n_bins: int = 5) -> float:
        """Largest mean error over bins of the position within the pixel, either axis."""
        bins = np.minimum(((self.phase_px + 0.5) * n_bins).astype(int), n_bins - 1)
        means = [self.error_px[bins[:, axis] == b, axis].mean() for axis in (0, 1) for b in range(n_bins)]
        return float(np.abs(means).max())


def measure(run: Run) -> Iterator[Row]:
    """Noise, saturation, balls, smears, mosaics, compressed video, time."""
    n = run.pick(1500, 100)
    yield from _noise_limited(n, np.random.default_rng(1))
    yield from _saturated(n, np.random.default_rng(2))
    yield from _balls(n, np.random.default_rng(3))
    yield from _smeared(n, np.random.default_rng(4))
    yield from _mosaic(n, np.random.default_rng(5))
    yield from _compressed(run.pick(60, 8))
    yield from _times(np.random.default_rng(7))


def _noise_limited(n: int, rng: np.random.Generator) -> Iterator[Row]:
    for snr in SNRS:
        trials = [_tried(_still(width, snr), n, rng) for width in WIDTHS_PX]
        what = f"SNR {snr}, widths {WIDTHS_PX[0]}–{WIDTHS_PX[-1]} px"
        shares = ", ".join(f"{len(t.error_px) / t.n:.0%}" for t in trials)
        worst = max(float(t.over_bound.max()) for t in trials)
        yield at_most(f"{what}: RMS / bound, worst", worst, 1.15, note=f"found {shares}")
        yield _stated(what, trials)
        # Of the narrowest and dimmest only those are found that sit well on a pixel: a bias of its own. And the mean of
        # a bin is known only to its noise: at SNR 5 to 0.01 px.
        yield at_most(f"{what}: bias within the pixel, worst", max(t.worst_bias_px() for t in trials), 0.02, unit=" px")
        worst = max(t.over_centroid for t in trials)
        yield at_most(f"{what}: RMS of fit / of weighted centroid, worst", worst, 1.0)
    for name, gain in (("known", 1.0), ("estimated", None)):
        trials = [_tried(_still(1.5, snr, gain=1.0), n, rng, gain=gain) for snr in (5, 10, 30, 100)]
        what = f"photon noise, gain {name}, SNR 5–100, width 1.5 px"
        yield at_most(f"{what}: RMS / bound, worst", max(float(t.over_bound.max()) for t in trials), 1.15)
        yield _stated(what, trials)


def _saturated(n: int, rng: np.random.Generator) -> Iterator[Row]:
    for over in (2, 3, 5):
        spots = [replace(_still(w, 1), peak=over * 235.0, full_scale=255.0, gain=0.3) for w in (1.0, 2.0, 3.0)]
        trials = [_tried(spot, n, rng, gain=0.3) for spot in spots]
        what = f"peak {over} × full scale, widths 1–3 px"
        rms = max(_rms(t.error_px) for t in trials)
        yield at_most(f"{what}: RMS / bound, worst", max(float(t.over_bound.max()) for t in trials), 1.15)
        yield Row(f"{what}: RMS, worst; of the weighted centroid", f"{rms:.3g} px; {_centroid_rms(trials):.3g} px")
        yield _stated(what, trials)
        blooming = [_tried(spot, n, rng, gain=0.3, is_blooming=True) for spot in spots]
        rms, bias = max(_rms(t.error_px) for t in blooming), max(abs(t.error_px.mean(0)).max() for t in blooming)
        yield at_most(f"{what}, column bloomed by 6 px to one side: bias", float(bias), 0.02, unit=" px")
        yield Row(f"{what}, bloomed: RMS, worst; of the centroid", f"{rms:.3g} px; {_centroid_rms(blooming):.3g} px")


def _balls(n: int, rng: np.random.Generator) -> Iterator[Row]:
    for snr in (10, 50):
        trials = [_tried(replace(_still(1.5, snr), ball=1.5 * radius, shape=(31, 31)), n, rng) for radius in (1, 2, 3)]
        what = f"ball of 1–3 blurs, SNR {snr}"
        yield at_most(f"{what}: RMS / bound, worst", max(float(t.over_bound.max()) for t in trials), 1.15)
        yield at_most(f"{what}: bias within the pixel", max(t.worst_bias_px() for t in trials), 0.02, unit=" px")
        yield _stated(what, trials)


def _smeared(n: int, rng: np.random.Generator) -> Iterator[Row]:
    for length in SMEARS_PX:
        trials = [
            _tried(replace(_still(1.5, snr), half_way=length / 2, shape=(41, 41)), n // 2, rng) for snr in (10, 20, 50)
        ]
        what = f"smear of {length} px, SNR 10–50"
        yield at_most(f"{what}: RMS / bound, worst", max(float(t.over_bound.max()) for t in trials), 1.15)
        yield _stated(what, trials)
        yield Row(f"{what}: seen as smear; length told", "; ".join(_length(t) for t in trials))


def _mosaic(n: int, rng: np.random.Generator) -> Iterator[Row]:
    """Red of an RGGB mosaic; positions and widths in pixels of the sensor."""
    import cv2

    for kind in ("raw plane", "demosaiced"):
        errors, stated = [], []
        for _ in range(n):
            spot = _shown(replace(_still(2.0, 20), shape=(32, 32)), rng)
            picture = spot.sampled(rng).astype(np.uint8)
            if kind == "raw plane":
                noise = NoiseModel(spot.read_sigma**2, 0.0)
                found = localise(picture[::2, ::2], spot.background, noise=noise, full_scale=255)
                scale = 2.0
            else:
                # What OpenCV calls BG has red in the first pixel of the first row.
                red = np.ascontiguousarray(cv2.cvtColor(picture, cv2.COLOR_BayerBG2RGB)[..., 0], dtype=np.uint8)
                # Of four samples one is measured, two are means of two and one of four: 9/16 of the variance.
                noise = NoiseModel(spot.read_sigma**2 * 9 / 16, 0.0, PROCESSED_CORRELATION_PX2)
                found, scale = localise(red, spot.background, noise=noise, full_scale=255), 1.0
            if found is not None:
                errors.append(scale * found.px - spot.px)
                stated.append(scale**2 * found.covariance_px2.diagonal())
        error, variance = np.array(errors), np.array(stated)
        ratio = math.sqrt(variance.mean()) / _rms(error)
        what = f"red of a Bayer mosaic, {kind}, width 2 px, SNR 20"
        yield at_most(f"{what}: bias", float(np.abs(error.mean(0)).max()), 0.02, unit=" px")
        yield within(f"{what}: stated / true", ratio, 0.85, 1.15, note=f"RMS {_rms(error):.3g} px")


def _compressed(n_frames: int) -> Iterator[Row]:
    for width, peak in ((1.0, 120.0), (1.5, 120.0), (2.5, 120.0), (1.5, 60.0)):
        what = f"H.264 of 4 Mbit/s, 1080p, width {width} px, peak {peak:.0f} of 255"
        errors = compressed(width=width, peak=peak, n_frames=n_frames, rng=np.random.default_rng(6))
        yield at_most(f"{what}: RMS", _rms(errors.fit_px), 0.15, unit=" px", note=f"{errors.mbit_s:.1f} Mbit/s")
        ratio = math.sqrt(errors.stated_px2.mean()) / _rms(errors.fit_px)
        yield within(f"{what}: stated / true", ratio, 0.85, 1.15)
        for name, error in (
            ("OpenCV's blob detector", errors.blob_px),
            ("OpenCV's blob detector given the background", errors.light_blob_px),
            ("thresholded centroid", errors.thresholded_px),
            ("weighted centroid", errors.centroid_px),
        ):
            reach = 1.0 if name == "weighted centroid" else 0.5
            yield at_most(f"{what}: RMS / that of {name}", _rms(errors.fit_px) / _rms(error), reach)


def _times(rng: np.random.Generator) -> Iterator[Row]:
    for what, spot in (
        ("width 1.5 px, window 15²", _still(1.5, 30)),
        ("width 3 px, window 31²", replace(_still(3.0, 30), shape=(31, 31))),
        ("smear of 10 px, window 31²", replace(_still(1.5, 30), shape=(31, 31), half_way=5.0, angle=0.5)),
    ):
        window, noise = spot.sampled(rng), NoiseModel(spot.read_sigma**2, 0.0)
        rounds = []
        for _ in range(200):
            begin = time.perf_counter()
            for _ in range(10):
                localise(window, spot.background, noise=noise, full_scale=255)
            rounds.append((time.perf_counter() - begin) / 10)
        fast, usual = 1e3 * min(rounds), 1e3 * float(np.median(rounds))
        yield at_most(f"time of one spot, {what}", fast, 0.3, unit=" ms", note=f"best; median {usual:.2f} ms")


def _still(width: float, snr: float, *, gain: float = 0.0) -> Picture:
    """A spot whose brightest sample is `snr` standard deviations of its own noise, in a fitting window."""
    read = 2.0
    # peak = snr sqrt(read² + gain peak)
    peak = (gain * snr**2 + math.sqrt(gain**2 * snr**4 + 4 * snr**2 * read**2)) / 2
    n_px = 2 * math.ceil(4 * width + 3) + 1
    middle = n_px // 2
    return Picture((n_px, n_px), middle, middle, width, peak, read_sigma=read, gain=gain)


def _shown(spot: Picture, rng: np.random.Generator) -> Picture:
    """The spot somewhere within the pixel in the middle, its way in any direction."""
    x, y = (np.array(spot.shape[::-1]) // 2 + rng.uniform(-0.5, 0.5, 2)).tolist()
    return replace(spot, x=x, y=y, angle=float(rng.uniform(0, math.pi)))


def _tried(
    spot: Picture, n: int, rng: np.random.Generator, *, gain: float | None = 0.0, is_blooming: bool = False
) -> Trials:
    rows, bounds = [], []
    noise = NoiseModel(spot.read_sigma**2, gain)
    for i in range(n):
        shown = _shown(spot, rng)
        axes = _axes(shown)
        window = shown.sampled(rng)
        if is_blooming:
            _bloom(window, shown)
        found = localise(window, shown.background, noise=noise, full_scale=shown.full_scale)
        if i < N_BOUNDS:
            bounds.append((axes @ shown.bound() @ axes.T).diagonal())
        if found is not None:
            rows.append(_row(shown, found, axes, window))
    table = np.array(rows)
    return Trials(
        table[:, 0:2], table[:, 2:4], table[:, 4:6], table[:, 6:8], table[:, 8], table[:, 9], np.mean(bounds, axis=0), n
    )


def _axes(spot: Picture) -> FloatArray:
    """(2, 2) unit vectors along and across the way as rows."""
    if spot.half_way == 0:
        return np.eye(2)
    c, s = math.cos(spot.angle), math.sin(spot.angle)
    return np.array([[c, s], [-s, c]])


def _row(spot: Picture, found: Localisation, axes: FloatArray, window: FloatArray) -> FloatArray:
    light = window - spot.background
    bright = np.where(light > 3 * spot.read_sigma, light, 0.0)
    y, x = np.indices(spot.shape)
    centroid = np.array([(bright * x).sum(), (bright * y).sum()]) / bright.sum()
    return np.concatenate(
        [
            axes @ (found.px - spot.px),
            (axes @ found.covariance_px2 @ axes.T).diagonal(),
            axes @ (centroid - spot.px),
            spot.px - np.array(spot.shape[::-1]) // 2,
            [found.smear_px, found.smear_sigma_px],
        ]
    )


def _bloom(window: FloatArray, spot: Picture) -> None:
    """Charge spills down the middle column."""
    column = window[:, round(spot.x)]
    full = np.flatnonzero(column >= spot.full_scale)
    if len(full):
        column[full[-1] : full[-1] + 7] = spot.full_scale


def _stated(what: str, trials: list[Trials]) -> Row:
    """The ratio that is farthest from one; its reach."""
    ratios = np.concatenate([t.stated_over_true for t in trials])
    worst = float(ratios[np.argmax(np.abs(np.log(ratios)))])
    return within(f"{what}: stated / true, farthest from 1", worst, 0.85, 1.15)


def _length(trials: Trials) -> str:
    is_seen = trials.smear_sigma_px > 0
    lengths = trials.smear_px[is_seen]
    told = f", {lengths.mean():.2f} ± {lengths.std():.2f} px" if is_seen.any() else ""
    return f"{is_seen.mean():.0%}{told}"


def _centroid_rms(trials: list[Trials]) -> float:
    return max(_rms(t.centroid_px) for t in trials)


def _rms(error_px: FloatArray) -> float:
    """Per axis."""
    return float(np.sqrt((error_px**2).mean()))
