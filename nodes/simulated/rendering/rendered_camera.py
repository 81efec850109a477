"""A camera that looks into a simulated room: any frame by its number, with the truth about the spot beside it.

A frame depends on the seed, the camera and its number alone, never on which frames were rendered before.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from network_calib.cameras import Cameras
from network_calib.errors import InputError
from nodes.frames import Frame, StampOrigin
from nodes.simulated.rendering.camera_view import CameraView
from nodes.simulated.rendering.person import Person, draw_person, draw_shadow, person_at
from nodes.simulated.rendering.room_layout import layout_of
from nodes.simulated.rendering.room_scene import RoomScene
from nodes.simulated.rendering.room_view import RoomView
from nodes.simulated.rendering.sensor import SensorModel, bloom, develop, surplus_of
from nodes.simulated.rendering.spot_path import BallPath
from nodes.simulated.rendering.spot_truth import SpotLight, SpotOptics, SpotTruth, truth_of

Float32Array = npt.NDArray[np.float32]
# Frames cut their noise out of one long strip of it, each at its own random place: drawing it anew would take longer
# than all the rest. Two frames see the same number at the same pixel once in two million.
SPARE_NOISE = 1 << 21
# Charge of a saturated spot runs over at most so far along its columns.
BLOOM_REACH_PX = 60
HOT_PIXEL_LEVEL = 0.6


@dataclass(frozen=True, slots=True)
class FrameClock:
    """When a camera exposes, and what its clock says then.

    Attributes:
        rate_hz: frames a second; None: as the path's points.
        phase_s: frame k is exposed around k / rate_hz + phase_s on the path's clock.
        start_ns: this camera's clock at the path's time 0.
    """

    rate_hz: float | None = None
    phase_s: float = 0.0
    start_ns: int = 0

    def __post_init__(self) -> None:
        if self.rate_hz is not None and not self.rate_hz > 0:
            raise InputError(f"rate_hz is {self.rate_hz}, expected more than 0")


AS_THE_PATH = FrameClock()


class RenderedCamera:
    """One camera of a room.

    Attributes:
        name: of the camera.
        rate_hz: frames a second.
        n_frames: frames until the path ends; later ones show the pointer going straight on.
        sensor: the chip.
        scene: what is in the room.
        view: its projection.
        layout: where the room's things are.

    Args:
        cameras: the true cameras.
        index: which of them.
        path: the spot's way.
        scene: what else is in the room.
        sensor: the chip.
        seed: the same for all cameras of a room, so that they look into the same one.
        clock: when it exposes.

    Raises:
        InputError: an index that is no camera.
    """

    def __init__(
        self,
        cameras: Cameras,
        index: int,
        path: BallPath,
        *,
        scene: RoomScene,
        sensor: SensorModel,
        seed: int,
        clock: FrameClock = AS_THE_PATH,
    ) -> None:
        if not 0 <= index < len(cameras):
            raise InputError(f"camera index is {index}, expected 0 to {len(cameras) - 1}")
        self.name = cameras.names[index]
        self.rate_hz = path.rate_hz if clock.rate_hz is None else clock.rate_hz
        self.sensor, self.scene = sensor, scene
        self.n_frames = max(1, int(len(path) / path.rate_hz * self.rate_hz))
        self._path, self._clock = path, clock
        self._seed = [seed, index]
        self.view = CameraView.of(cameras, index)
        self.layout = layout_of(scene, cameras, path, seed=seed)
        self._optics = SpotOptics(self.view, path, scene, sensor, self.layout)
        self._room = RoomView(self.view, scene, sensor, self.layout, seed=seed)
        self._person_turn_rad = float(np.random.default_rng([seed, 0x9E]).uniform(0, 2 * np.pi))
        rng = np.random.Generator(np.random.SFC64(np.random.SeedSequence([*self._seed, 0])))
        width, height = self.size_px
        self._noise = rng.standard_normal(width * height + SPARE_NOISE if sensor.has_noise else 0, dtype=np.float32)
        self._response = 1 + np.float32(sensor.response_spread) * rng.standard_normal((height, width), dtype=np.float32)
        self._hot_pixels = rng.integers(0, width * height, sensor.n_hot_pixels)
        self._plane = np.empty((height, width), dtype=np.float32)

    @property
    def size_px(self) -> tuple[int, int]:
        """Width and height."""
        return self.view.size_px

    @property
    def period_s(self) -> float:
        """From frame to frame."""
        return 1 / self.rate_hz

    def stamp_ns(self, sequence: int) -> int:
        """Mid-exposure of a frame on this camera's clock."""
        return self._clock.start_ns + round(self._time_s(sequence) * 1e9)

    def render(self, sequence: int) -> tuple[Frame, SpotTruth]:
        """One frame and the truth about it; its image is the caller's own."""
        truth = self._draw(sequence)
        noise = None
        if self.sensor.has_noise:
            rng = np.random.Generator(np.random.SFC64(np.random.SeedSequence([*self._seed, 1 + sequence])))
            noise = self._noise[int(rng.integers(0, SPARE_NOISE)) :]
        image = develop(self.sensor, self._plane, noise)
        frame = Frame(
            sequence=sequence,
            stamp_ns=truth.stamp_ns,
            origin=StampOrigin.CAMERA,
            image=image,
            pixel_format=self.sensor.pixel_format,
            bits=self.sensor.bits,
            settings=self.sensor.settings,
        )
        return frame, truth

    def light(self, sequence: int) -> tuple[Float32Array, SpotTruth]:
        """The levels (h, w) on the chip before noise, saturation and quantisation, and the truth."""
        truth = self._draw(sequence)
        return self._plane.copy(), truth

    def truth(self, sequence: int) -> SpotTruth:
        """The truth about a frame without rendering it."""
        _, spot, reflection = self._lights(sequence)
        return self._truth(sequence, spot, reflection)

    def _time_s(self, sequence: int) -> float:
        return sequence / self.rate_hz + self._clock.phase_s

    def _lights(self, sequence: int) -> tuple[Person | None, SpotLight | None, SpotLight | None]:
        """Who is in the room, the spot's light, and its mirror image's."""
        time_s, scene, person = self._time_s(sequence), self.scene, None
        if scene.has_person:
            person = person_at(self._path, time_s, clothes=scene.clothes, phase_rad=self._person_turn_rad)
        return person, self._optics.spot(time_s, person), self._optics.reflection(time_s, person)

    def _draw(self, sequence: int) -> SpotTruth:
        """Fill the plane with the light of a frame."""
        time_s, plane, bgr = self._time_s(sequence), self._plane, self.scene.ball.colour.bgr
        person, spot, reflection = self._lights(sequence)
        self._room.draw(time_s, plane)
        for patch in reflection.patches if reflection is not None else ():
            self._room.add(plane, patch, bgr)
        if person is not None and not self.scene.is_void:
            shadow = draw_shadow(self.view, person)
            if shadow is not None:
                self._room.draw_shadow(plane, shadow)
            drawn = draw_person(self.view, person, blur_px=max(1.0, self.sensor.psf_sigma_px))
            if drawn is not None:
                self._room.draw_person(plane, drawn, time_s)
        if spot is not None and spot.patches:
            self._add_spot(spot)
        if self.sensor.response_spread > 0:
            plane *= self._response
        plane.reshape(-1)[self._hot_pixels] += np.float32(HOT_PIXEL_LEVEL)
        return self._truth(sequence, spot, reflection)

    def _truth(self, sequence: int, spot: SpotLight | None, reflection: SpotLight | None) -> SpotTruth:
        background = 0.0 if spot is None else self._room.level_at(spot.px, self._time_s(sequence))
        stamp_ns = self.stamp_ns(sequence)
        return truth_of(sequence, stamp_ns, self.view, spot, reflection, background=background)

    def _add_spot(self, spot: SpotLight) -> None:
        """Add the spot's light, and let run over what it brings beyond full scale; the room's own has run before."""
        patch, blooming = spot.patches[0], np.float32(self.sensor.blooming)
        rows = slice(max(patch.y - BLOOM_REACH_PX, 0), patch.y + len(patch.values) + BLOOM_REACH_PX)
        around = self._plane[rows, patch.x : patch.x + patch.values.shape[1]]
        before = surplus_of(around)
        for light in spot.patches:
            self._room.add(self._plane, light, self.scene.ball.colour.bgr)
        if blooming > 0:
            bloom(around, blooming * (surplus_of(around) - before))
