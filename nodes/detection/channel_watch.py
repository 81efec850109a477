"""One channel of one camera: its background, and the spots that stand out of it."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from network_calib.errors import InputError
from nodes.detection.background import Background, Box, Survey
from nodes.detection.background_learner import BackgroundLearner
from nodes.detection.candidates import Candidate, CandidateFinder
from nodes.detection.channel import Plane, SampleArray, channel_of
from nodes.detection.noise_model import PROCESSED_CORRELATION_PX2, NoiseModel
from nodes.detection.profile import Localisation, localise
from nodes.detection.spots import Channel, DetectorOptions, FloatArray, Spot
from nodes.frames import Frame, PixelFormat

# The profile is fitted on the core and so much around it: where a Gaussian has fallen to a few percent of its height.
FIT_RADII = 1.2
FIT_MARGIN = 2
# The fit is tried once more where it has fallen to a quarter.
TIGHT_RADII = 0.5
# A fit that strays so far from the core, or is so much wider, is one of something else.
STRAY_RADII = 0.5
STRAY_WIDTHS = 1.5
# Noise makes either background look smoother by chance, and the learnt one is right unless somebody hides it.
PLAINLY_SMOOTHER = 0.5
# Where none succeeds, one standard deviation of the middle of the core, in its half lengths.
UNFITTED_SIGMA = 0.25
UNFITTED_FACTOR = 0.7
# A core longer than so many of its radii is taken for smeared.
LONG_RADII = 1.5
# Half the width of a Gaussian at half of its height, in standard deviations.
HALF_WIDTH_SIGMAS = 1.18
# What comes in colour was interpolated between the samples of a mosaic, or compressed.
PROCESSED = (PixelFormat.BGR, PixelFormat.YUV420)


class ChannelWatch:
    """Learns and watches one channel.

    Attributes:
        channel: which one.
        background: None until it was learnt.
    """

    def __init__(self, channel: Channel, options: DetectorOptions, background: Background | None = None) -> None:
        self.channel = channel
        self.background: Background | None = None
        self._options = options
        self._learner: BackgroundLearner | None = None
        self._finder: CandidateFinder | None = None
        self._buffer: SampleArray | None = None
        self._correlation_px2 = 1.0
        if background is not None:
            self._adopt(background)

    def read(self, frame: Frame) -> Plane:
        """The channel of a frame; its samples are valid until the next frame is read.

        Raises:
            InputError: the frame does not fit the background that was handed in, or is no image.
        """
        plane = channel_of(frame, self.channel, self._options.channel_weights, out=self._buffer)
        if frame.pixel_format in PROCESSED:
            self._correlation_px2 = PROCESSED_CORRELATION_PX2
        if not np.may_share_memory(plane.samples, frame.image):
            self._buffer = plane.samples
        if self.background is not None and plane.samples.shape != self.background.shape:
            raise InputError(
                f"the background was learnt on {_size(self.background.shape)} samples of channel {self.channel}, "
                f"but frame {frame.sequence} has {_size(plane.samples.shape)}",
                advice="learn the background anew from this camera's frames",
            )
        return plane

    def learn_anew(self, *, is_empty: bool) -> None:
        """Begin to learn with the next plane, as if nothing were known; `is_empty`: the spot is not in the planes."""
        self._learner = BackgroundLearner(self.channel, is_empty=is_empty)

    def add(self, plane: Plane) -> None:
        """Learn from a plane; `learn_anew` comes before."""
        assert self._learner is not None
        self._learner.add(plane)

    def finish(self) -> Background:
        """Watch from now on with what was learnt."""
        assert self._learner is not None
        background = self._learner.background()
        self._learner = None
        self._adopt(background)
        return background

    def survey(self, plane: Plane) -> Survey:
        """The plane beside what was learnt."""
        assert self.background is not None
        return self.background.survey(plane.samples)

    def candidates(self, plane: Plane, survey: Survey) -> list[Candidate]:
        """Where the spot may be, best first."""
        assert self.background is not None
        if self._finder is None:
            max_radius = self._options.max_radius_px / plane.step_px
            self._finder = CandidateFinder(plane, max_radius=max_radius)
        return self._finder.find(plane, self.background, survey)

    def spot(self, plane: Plane, candidate: Candidate, score: float) -> Spot:
        """The candidate with its place to a part of a pixel; vaguer where no profile of a spot fits."""
        for margin in _margins(candidate):
            found = self._localise(plane, _box_around(candidate, plane, margin))
            if found is not None and _is_of(found, candidate):
                return _fitted(found, plane, score)
        return _unfitted(candidate, plane, UNFITTED_FACTOR * score)

    def _localise(self, plane: Plane, box: Box) -> Localisation | None:
        assert self.background is not None
        part = slice(box[1], box[3]), slice(box[0], box[2])
        window, learnt = plane.samples[part].astype(np.float64), self.background.mean[part].astype(np.float64)
        # Of one sample, the spread is known to a fifth only; the window's mean serves all of them.
        variance = float(np.square(self.background.spread[part]).mean())
        behind = _sides(window)
        rest = behind - _sides(learnt)
        middle, rest_middle = float(np.median(behind)), float(np.median(rest))
        # Before a person, the learnt background is wrong, and the person often smoother than what he hides.
        is_hidden = _roughness(behind, middle) < PLAINLY_SMOOTHER * _roughness(rest, rest_middle)
        try:
            return localise(
                window,
                middle if is_hidden else learnt,
                noise=NoiseModel(variance, correlation_px2=self._correlation_px2),
                full_scale=plane.full_scale,
                origin_px=(box[0], box[1]),
            )
        except np.linalg.LinAlgError:
            return None  # samples that tell of no place at all

    def _adopt(self, background: Background) -> None:
        mask = self._options.mask
        if mask is not None:
            step = max(round(mask.shape[0] / background.shape[0]), 1)
            if mask[::step, ::step].shape != background.shape:
                raise InputError(
                    f"the mask has {_size(mask.shape)} pixels, the pictures {_size(background.shape)}",
                    advice="make the mask from a picture of this camera",
                )
            background.watch_only(mask[::step, ::step])
        self.background = background


def _margins(candidate: Candidate) -> tuple[int, int]:
    """Around the core, in samples: the first is best, the second stays clear of what is beside the spot."""
    return math.ceil(FIT_RADII * candidate.radius) + FIT_MARGIN, math.ceil(TIGHT_RADII * candidate.radius)


def _box_around(candidate: Candidate, plane: Plane, margin: int) -> Box:
    left, top, right, bottom = candidate.box
    rows, columns = plane.samples.shape
    return max(left - margin, 0), max(top - margin, 0), min(right + margin, columns), min(bottom + margin, rows)


def _sides(window: npt.NDArray[np.generic]) -> FloatArray:
    """The samples along the four sides."""
    return np.concatenate([window[0], window[-1], window[:, 0], window[:, -1]]).astype(np.float64)


def _roughness(values: FloatArray, middle: float) -> float:
    return float(np.abs(values - middle).mean())


def _is_of(found: Localisation, candidate: Candidate) -> bool:
    """Whether a fit is one of the candidate, and not of something beside it or behind it."""
    distance = math.hypot(found.px[0] - candidate.px[0], found.px[1] - candidate.px[1])
    return distance < 1 + STRAY_RADII * candidate.length and found.width_px < 1 + STRAY_WIDTHS * candidate.radius


def _fitted(found: Localisation, plane: Plane, score: float) -> Spot:
    return Spot(
        px=plane.image_px(found.px),
        covariance_px2=plane.step_px**2 * found.covariance_px2,
        score=score,
        peak=found.peak / plane.full_scale,
        width_px=plane.step_px * found.width_px,
        smear_px=plane.step_px * found.smear_px,
        is_saturated=found.is_saturated,
    )


def _unfitted(candidate: Candidate, plane: Plane, score: float) -> Spot:
    """A spot with no Gaussian profile, half hidden or before an edge: the middle of its core, vaguely."""
    sigma = plane.step_px * UNFITTED_SIGMA * candidate.length
    left, top, right, bottom = candidate.box
    is_long = candidate.length > LONG_RADII * candidate.radius
    return Spot(
        px=plane.image_px(candidate.px),
        covariance_px2=sigma**2 * np.eye(2),
        score=score,
        peak=candidate.height / plane.full_scale,
        width_px=plane.step_px * candidate.radius / HALF_WIDTH_SIGMAS,
        smear_px=2 * plane.step_px * (candidate.length - candidate.radius) if is_long else 0.0,
        is_saturated=bool(plane.samples[top:bottom, left:right].max() >= plane.full_scale),
    )


def _size(shape: tuple[int, ...]) -> str:
    return f"{shape[1]} x {shape[0]}"
