"""The spot in one camera at one instant: its light in the image, and the truth about it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from nodes.simulated.rendering.camera_view import CameraView
from nodes.simulated.rendering.person import Person
from nodes.simulated.rendering.room_background import mirrored_part
from nodes.simulated.rendering.room_layout import RoomLayout
from nodes.simulated.rendering.room_scene import RoomScene
from nodes.simulated.rendering.sensor import SensorModel
from nodes.simulated.rendering.spot_image import Beams, Patch, beams_of_ball, n_instants_for, patch_of
from nodes.simulated.rendering.spot_path import BallPath

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]
# The floor is z = 0: its mirror image of the room is below it.
MIRROR = np.array([1.0, 1.0, -1.0])
UPRIGHT = np.ones(3)
NOWHERE = np.full(2, np.nan)


@dataclass(frozen=True, slots=True)
class SpotTruth:
    """What a perfect detector would have to say of one frame.

    Two positions, because they differ by what no detector can know: perspective shifts the middle of a near ball's
    disc from the image of its centre, a curved smear and a half-hidden ball have their light elsewhere.

    Attributes:
        sequence: number of the frame.
        stamp_ns: mid-exposure.
        px: (2,) projection of the ball's centre at mid-exposure, which is what a calibration wants. NaN: the pointer is
            off or outside of what the lens can see.
        centroid_px: (2,) centre of the light that the unhidden part of the ball throws into the image plane during the
            exposure, before saturation and noise. NaN: none.
        is_visible: the pointer is on, `px` lies in the image, and more than half of the disc is not hidden.
        visible_part: part of the disc that nothing hides, weighted by its light; 0 when off.
        peak: highest level of the spot's light over the background before saturation; 1 is full scale.
        background: level of the room (without the person) at `px` and the pixels next to it, the highest. From 1 on the
            picture is white there already, and nobody can see the spot.
        smear_px: length of its way during the exposure.
        radius_px: of the ball's disc, without blur.
        reflection_px: (2,) projection of the mirrored centre at mid-exposure where the floor shows it, else None.
    """

    sequence: int
    stamp_ns: int
    px: FloatArray
    centroid_px: FloatArray
    is_visible: bool
    visible_part: float
    peak: float
    background: float
    smear_px: float
    radius_px: float
    reflection_px: FloatArray | None


@dataclass(frozen=True, slots=True)
class SpotLight:
    """Light to be added to the image, and where it comes from.

    Attributes:
        px: (2,) projection of the centre at mid-exposure.
        centroid_px: (2,) see `SpotTruth`.
        visible_part: see `SpotTruth`.
        smear_px: see `SpotTruth`.
        radius_px: see `SpotTruth`.
        patches: sharp image and the lens's glare.
    """

    px: FloatArray
    centroid_px: FloatArray
    visible_part: float
    smear_px: float
    radius_px: float
    patches: tuple[Patch, ...]

    @property
    def peak(self) -> float:
        """Highest level; the glare's own top lies under the sharp image and is counted where both are."""
        if not self.patches:
            return 0.0
        sharp = self.patches[0].values
        glare = self.patches[1].values.max() if len(self.patches) > 1 else 0.0
        return float(sharp.max() + glare)


NO_LIGHT = SpotLight(NOWHERE, NOWHERE, visible_part=0.0, smear_px=0.0, radius_px=0.0, patches=())


@dataclass(frozen=True, slots=True)
class SpotOptics:
    """One camera's view of the ball in one room.

    Attributes:
        view: the camera.
        path: the ball's way.
        scene: the ball and the floor's gloss.
        sensor: exposure and blur.
        layout: furniture that hides.
    """

    view: CameraView
    path: BallPath
    scene: RoomScene
    sensor: SensorModel
    layout: RoomLayout

    def spot(self, time_s: float, person: Person | None) -> SpotLight | None:
        """The ball's light at mid-exposure `time_s`; None when the pointer is off or outside of the lens's view."""
        if not self.path.is_shining(time_s):
            return None
        eye = self.view.centre_in_world

        def is_hidden(targets: FloatArray) -> BoolArray:
            hidden = self.layout.hides(eye, targets)
            return hidden | person.hides(eye, targets) if person is not None else hidden

        level, sigma_px = self.scene.ball.radiance * self.sensor.brightness, self.sensor.psf_sigma_px
        return self._light(time_s, UPRIGHT, level=level, sigma_px=sigma_px, is_hidden=is_hidden)

    def reflection(self, time_s: float, person: Person | None) -> SpotLight | None:
        """The ball's mirror image in the floor; None where there is none or something hides it."""
        if self.scene.gloss == 0 or not self.path.is_shining(time_s):
            return None
        ball, eye = self.path.at(np.array([time_s]))[0], self.view.centre_in_world
        mirrored = ball * MIRROR
        if not (ball[2] > 0 and eye[2] > 0 and self._is_floor_clear(mirrored, person)):
            return None
        cosine = np.array((eye[2] - mirrored[2]) / np.linalg.norm(mirrored - eye))
        level = self.scene.ball.radiance * self.sensor.brightness * float(mirrored_part(self.scene.gloss, cosine))
        sigma_px = float(np.hypot(self.sensor.psf_sigma_px, self.scene.gloss_blur_rad * self.view.focal_px))
        return self._light(time_s, MIRROR, level=level, sigma_px=sigma_px, is_hidden=_nothing)

    def _light(
        self,
        time_s: float,
        turn: FloatArray,
        *,
        level: float,
        sigma_px: float,
        is_hidden: Callable[[FloatArray], BoolArray],
    ) -> SpotLight | None:
        """Light of the ball, or of its mirror image by `turn`, over the exposure; None outside of the lens's view."""
        exposure_s = self.sensor.exposure_s
        ends = self.path.at(time_s + exposure_s * np.array([-0.5, 0.0, 0.5])) * turn
        ends_px, is_seen = self.view.project(ends)
        if not is_seen[1]:
            return None
        smear_px = float(np.nansum(np.linalg.norm(np.diff(ends_px, axis=0), axis=1)))
        n = n_instants_for(smear_px, sigma_px)
        places = self.path.at(time_s + exposure_s * ((np.arange(n) + 0.5) / n - 0.5)) * turn
        beams, visible_part = beams_of_ball(
            self.view, places, self.scene.ball, level=level, sigma_px=sigma_px, is_hidden=is_hidden
        )
        distance_m = float(np.linalg.norm(ends[1] - self.view.centre_in_world))
        radius_px = self.view.focal_px * self.scene.ball.diameter_m / 2 / distance_m
        patches = self._patches(beams, sigma_px)
        return SpotLight(ends_px[1], beams.centroid_px, visible_part, smear_px, radius_px, patches)

    def _is_floor_clear(self, mirrored: FloatArray, person: Person | None) -> bool:
        """Whether light gets from the ball to the floor, and from there to the camera as if from `mirrored` (3,)."""
        eye, ball = self.view.centre_in_world, mirrored * MIRROR
        floor = eye + (mirrored - eye) * (eye[2] / (eye[2] - mirrored[2]))
        if (floor[:2] < self.layout.low[:2]).any() or (floor[:2] > self.layout.high[:2]).any():
            return False
        is_hidden = self.layout.hides(eye, floor[None]) | self.layout.hides(floor, ball[None])
        if person is not None:
            is_hidden |= person.hides(eye, floor[None]) | person.hides(floor, ball[None], body_only=True)
        return not is_hidden[0]

    def _patches(self, beams: Beams, sigma_px: float) -> tuple[Patch, ...]:
        """The sharp image, then the skirt of scattered light: one wide Gaussian as broad as the beams themselves."""
        part, size_px = self.sensor.glare_part, self.view.size_px
        sharp = Beams(beams.px, beams.weight * (1 - part), beams.spread_px)
        patches = [patch_of(sharp, sigma_px=sigma_px, size_px=size_px)]
        if part > 0 and beams.total > 0:
            glare = Beams(beams.centroid_px[None], np.array([part * beams.total]), beams.size_px)
            patches.append(patch_of(glare, sigma_px=self.sensor.glare_sigma_px, size_px=size_px))
        return tuple(patch for patch in patches if patch is not None)


def _nothing(targets: FloatArray) -> BoolArray:
    return np.zeros(len(targets), dtype=bool)


def truth_of(
    sequence: int,
    stamp_ns: int,
    view: CameraView,
    spot: SpotLight | None,
    reflection: SpotLight | None,
    *,
    background: float,
) -> SpotTruth:
    """The truth about a frame from its light; a mirror image outside of the image is none."""
    mirrored = reflection.px if reflection is not None and view.is_in_image(reflection.px) else None
    spot = NO_LIGHT if spot is None else spot
    return SpotTruth(
        sequence=sequence,
        stamp_ns=stamp_ns,
        px=spot.px,
        centroid_px=spot.centroid_px,
        is_visible=view.is_in_image(spot.px) and spot.visible_part > 0.5,
        visible_part=spot.visible_part,
        peak=spot.peak,
        background=background,
        smear_px=spot.smear_px,
        radius_px=spot.radius_px,
        reflection_px=mirrored,
    )
