"""The spot detector of one camera: frames in, spots with their uncertainty out. No device, file or bus."""

from __future__ import annotations

from collections.abc import Container, Iterable, Sequence

from network_calib.errors import InputError
from nodes.detection.advice import ExposureWatch, FrameFacts
from nodes.detection.background import Background, Box, Survey
from nodes.detection.candidates import Candidate
from nodes.detection.channel import Plane, auto_channels
from nodes.detection.channel_choice import ChannelChoice
from nodes.detection.channel_watch import ChannelWatch
from nodes.detection.dwelling import Dwelling
from nodes.detection.fixtures import Fixtures
from nodes.detection.ranking import ranked
from nodes.detection.spots import Advice, Channel, Detections, DetectorOptions, DetectorState, Spot
from nodes.frames import Frame, PixelFormat

# The light changed when so much of the picture is nothing that was expected there, in so many frames running.
CHANGED_SHARE = 0.4
N_CHANGED_FRAMES = 2
# Half a second tells the new light, and the spot moves on in that time.
N_RELEARNING_FRAMES = 12
# With so much of the picture changed, by clouds or a door, the background learns faster.
HURRY_SHARE = 0.12
N_HURRY_FRAMES = 10
# Within so many frames after a change of light, the background forgets what was in its few frames by chance.
N_SETTLING_FRAMES = 100
# Around a core lies a halo that must not be learnt either, in radii of the core.
HALO_RADII = 3.0
# What is less like a spot than this may be learnt.
MIN_SPARED_SCORE = 0.1
MIN_SCORE = 0.03
# The second-best candidates are told where the best does not leave them far behind.
MIN_SHARE = 0.2
# Colour of half the resolution must let the spot stand out so many times more than luma to be preferred.
COLOUR_ADVANTAGE = 2.0
# Glare comes and goes slowly: it is measured once in so many frames.
BLIND_PERIOD = 32


class SpotDetector:
    """Finds the bright spot in the frames of one camera.

    Memory does not grow with the number of frames. The same frames give the same spots, bit for bit.

    Attributes:
        options: how it works.
        state: what it does with the next frame, unless that shows a change of light.
    """

    def __init__(self, options: DetectorOptions | None = None, *, backgrounds: Sequence[Background] = ()) -> None:
        """Begin.

        Args:
            options: how to work.
            backgrounds: learnt before, by `learn_from` or by another detector (`learnt`); not changed. Watching then
                begins with the first frame.

        Raises:
            InputError: no frame may be used for learning, and no background is given.
        """
        self.options = options or DetectorOptions()
        if self.options.n_learning_frames < 1 and not backgrounds:
            raise InputError(
                "`n_learning_frames` is 0 and no background was learnt before",
                advice="give at least 20 frames of the scene without the spot",
            )
        self.state = DetectorState.WATCHING if backgrounds else DetectorState.LEARNING
        self._watches = [ChannelWatch(one.channel, self.options, one.copy()) for one in backgrounds]
        self._choice: ChannelChoice | None = None
        self._exposure = ExposureWatch()
        self._dwelling: Dwelling | None = None
        self._fixtures = Fixtures()
        self._likeness: tuple[object, ...] | None = None
        self._blind_share = 0.0
        self._n_changed = self._n_settling = self._n_collected = self._n_watched = 0

    @property
    def channels(self) -> tuple[Channel, ...]:
        """The channels looked at: several while `Channel.AUTO` has not decided; none before the first frame."""
        return tuple(watch.channel for watch in self._watches)

    def process(self, frame: Frame) -> Detections:
        """Find the spots of the next frame.

        Raises:
            InputError: the frame is of another size or format than the first, or than the background or the mask.
        """
        self._begin(frame)
        planes = [watch.read(frame) for watch in self._watches]
        spots: tuple[Spot, ...] = ()
        surveys: list[Survey] = []
        if self.state is DetectorState.WATCHING:
            surveys = [watch.survey(plane) for watch, plane in zip(self._watches, planes, strict=True)]
            self._heed_light(max(survey.changed_share for survey in surveys))
        state = self.state
        if state is not DetectorState.WATCHING:
            self._collect(planes)
        elif self._n_changed == 0:
            spots = self._watch(planes, surveys)
        self._note(frame, state, spots, planes[0])
        return Detections(frame.sequence, frame.stamp_ns, state, spots)

    def advice(self) -> tuple[Advice, ...]:
        """What may be better about the picture, from the last ten seconds or so."""
        return self._exposure.advice()

    def relearn(self) -> None:
        """Learn the background anew from the next frames; a spot that keeps moving may be in them."""
        self._learn_anew(DetectorState.LEARNING, is_empty=False)

    def learnt(self) -> tuple[Background, ...]:
        """Copies of the backgrounds, one for each channel looked at; none before they were learnt."""
        return tuple(watch.background.copy() for watch in self._watches if watch.background is not None)

    def _begin(self, frame: Frame) -> None:
        """Prepare for frames like the first; refuse others."""
        likeness = (*frame.size_px, frame.pixel_format, frame.bits)
        if self._likeness is None:
            self._watches = self._watches or [ChannelWatch(one, self.options) for one in _channels(self.options, frame)]
            is_coarse = frame.pixel_format is PixelFormat.YUV420
            self._choice = ChannelChoice(len(self._watches), advantage=COLOUR_ADVANTAGE if is_coarse else 1.0)
            self._likeness = likeness
            if self.state is DetectorState.LEARNING:
                self._learn_anew(DetectorState.LEARNING, is_empty=True)
        elif likeness != self._likeness:
            raise InputError(
                f"frame {frame.sequence} is {_words(likeness)}, the frames before were {_words(self._likeness)}",
                advice="set the camera to one resolution and format, and start the detector again",
            )

    def _heed_light(self, share: float) -> None:
        """Learn faster, or anew, where so much of the picture has changed."""
        self._n_changed = self._n_changed + 1 if share > CHANGED_SHARE else 0
        self._n_settling = max(self._n_settling - 1, N_HURRY_FRAMES if share > HURRY_SHARE else 0)
        if self._n_changed == N_CHANGED_FRAMES:
            self._learn_anew(DetectorState.RELEARNING, is_empty=False)

    def _learn_anew(self, state: DetectorState, *, is_empty: bool) -> None:
        self.state = state
        self._n_changed = self._n_collected = 0
        for watch in self._watches:
            watch.learn_anew(is_empty=is_empty)

    def _collect(self, planes: Sequence[Plane]) -> None:
        """Learn from a frame that is not watched."""
        for watch, plane in zip(self._watches, planes, strict=True):
            watch.add(plane)
        self._n_collected += 1
        n_frames = self.options.n_learning_frames if self.state is DetectorState.LEARNING else 0
        if self._n_collected >= max(n_frames, N_RELEARNING_FRAMES):
            for watch in self._watches:
                watch.finish()
            self.state = DetectorState.WATCHING
            self._n_settling = N_SETTLING_FRAMES

    def _watch(self, planes: Sequence[Plane], surveys: Sequence[Survey]) -> tuple[Spot, ...]:
        """Spots of the channel in which they stand out most."""
        assert self._choice is not None
        if self._dwelling is None:
            self._dwelling = Dwelling(planes[0].samples.shape)
        watched = zip(self._watches, planes, surveys, strict=True)
        found = [watch.candidates(plane, survey) for watch, plane, survey in watched]
        best = self._choice.best(found)
        order = ranked(found[best], self._dwelling)
        spots = self._spots(self._watches[best], planes[best], order)
        self._dwelling.note([one.px for _, one in order])
        still = self._fixtures.note([one.px for one in found[best]])
        spared = [_spared(one, still if k == best else ()) for k, one in enumerate(found)]
        self._learn(planes, spared)
        if len(self._watches) > 1 and (chosen := self._choice.vote(found)) is not None:
            self._watches = [self._watches[chosen]]
        return spots

    def _learn(self, planes: Sequence[Plane], spared: Sequence[Sequence[Box]]) -> None:
        """Let the backgrounds follow the scene, but for what may be the spot in each channel."""
        self._n_watched += 1
        for watch, plane, boxes in zip(self._watches, planes, spared, strict=True):
            assert watch.background is not None
            watch.background.learn(plane.samples, without=boxes, is_hurried=self._n_settling > 0)

    def _spots(self, watch: ChannelWatch, plane: Plane, order: Sequence[tuple[float, Candidate]]) -> tuple[Spot, ...]:
        worth = [pair for pair in order if pair[0] >= max(MIN_SCORE, MIN_SHARE * order[0][0])]
        spots = [watch.spot(plane, candidate, score) for score, candidate in worth[: self.options.max_candidates]]
        # A spot without a profile has lost some of its score.
        return tuple(sorted(spots, key=lambda spot: -spot.score))

    def _note(self, frame: Frame, state: DetectorState, spots: tuple[Spot, ...], plane: Plane) -> None:
        background = self._watches[0].background
        if background is not None and self._n_watched % BLIND_PERIOD == 0:
            self._blind_share = background.blind_share()
        self._exposure.note(
            FrameFacts(
                state=state,
                spot=spots[0] if spots else None,
                brightness=plane.brightness(),
                blind_share=self._blind_share,
                exposure_s=frame.settings.exposure_s or self.options.exposure_s,
            )
        )


def learn_from(frames: Iterable[Frame], options: DetectorOptions | None = None) -> tuple[Background, ...]:
    """Learn the background from a whole recording in which the spot moves about: the first of two passes.

    Some two dozen frames spread over the recording are looked at together; memory does not grow with its length.

    Args:
        frames: all of the recording, or every n-th frame of it.
        options: the channel and its weights count.

    Returns:
        For `SpotDetector(options, backgrounds=...)`, which then begins with the first frame again.

    Raises:
        InputError: there is no frame, or they are not all of one size and format.
    """
    options = options or DetectorOptions()
    watches: list[ChannelWatch] = []
    for frame in frames:
        if not watches:
            watches = [ChannelWatch(one, options) for one in _channels(options, frame)]
            for watch in watches:
                watch.learn_anew(is_empty=False)
        for watch in watches:
            watch.add(watch.read(frame))
    if not watches:
        raise InputError("no frame to learn the background from")
    return tuple(watch.finish() for watch in watches)


def _channels(options: DetectorOptions, frame: Frame) -> tuple[Channel, ...]:
    if options.channel is Channel.AUTO and options.channel_weights is None:
        return auto_channels(frame.pixel_format)
    return (options.channel,)


def _spared(candidates: Sequence[Candidate], fixtures: Container[int]) -> list[Box]:
    """What must not be learnt: the cores of candidates, each with its halo, but for those with these numbers."""
    boxes = []
    for k, one in enumerate(candidates):
        if one.score >= MIN_SPARED_SCORE and k not in fixtures:
            halo = round(HALO_RADII * one.radius) + 1
            left, top, right, bottom = one.box
            boxes.append((left - halo, top - halo, right + halo, bottom + halo))
    return boxes


def _words(likeness: tuple[object, ...]) -> str:
    return "{} x {} px {} with {} bits".format(*likeness)
