"""What happens in a rendered room: its light, its furniture, who is in it, and what disturbs a spot detector."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from network_calib.errors import InputError
from nodes.simulated.rendering.spot_image import Ball, SpotColour


@dataclass(frozen=True, slots=True)
class RoomScene:
    """A room without its measures, which come from the cameras and the path.

    Radiances are levels of the sensor (1 = full scale) at `sensor.REFERENCE_EXPOSURE_S` and 0 dB. Defaults: nothing
    but the ball before black.

    Attributes:
        ball: the pointer's diffuser.
        light: radiance of a white surface in the room's mean light; 0: a black void without walls.
        n_lamps: shining lamps on the walls, brighter than full scale.
        lamp_radiance: of the lamps.
        n_windows: bright windows.
        window_radiance: of the windows, on the mean of their drift.
        window_drift: largest relative change of a window by clouds.
        window_drift_s: time that clouds take to come and go.
        gloss: part of light that the floor mirrors when looked at from above; more at flat angles (Schlick).
        gloss_blur_rad: blur of the floor's mirror images.
        has_person: somebody holds the pointer.
        clothes: reflectance of the person's clothes.
        n_screens: screens whose picture moves and flickers.
        screen_radiance: of their white.
        n_indicators: small red lamps that blink, each as large as a far spot.
        mains_flicker: relative amplitude of the room's light over the beat between mains and frame rate.
        mains_flicker_hz: frequency of that beat.
        switched_light: radiance of a white surface that a further light adds once it is switched on.
        switch_s: instant at which it is switched on; None: never.
    """

    ball: Ball = field(default_factory=Ball)
    light: float = 0.0
    n_lamps: int = 0
    lamp_radiance: float = 6.0
    n_windows: int = 0
    window_radiance: float = 1.2
    window_drift: float = 0.0
    window_drift_s: float = 20.0
    gloss: float = 0.0
    gloss_blur_rad: float = 0.004
    has_person: bool = False
    clothes: float = 0.25
    n_screens: int = 0
    screen_radiance: float = 0.7
    n_indicators: int = 0
    mains_flicker: float = 0.0
    mains_flicker_hz: float = 2.3
    switched_light: float = 0.0
    switch_s: float | None = None

    @property
    def is_void(self) -> bool:
        """No walls to be seen."""
        return self.light <= 0 and self.switched_light <= 0

    def light_at(self, time_s: float) -> float:
        """Radiance of a white surface at an instant: for what is drawn into the lit room."""
        return self.light * self.flicker_at(time_s) + (self.switched_light if self.is_switched_on(time_s) else 0.0)

    def flicker_at(self, time_s: float) -> float:
        """Factor of the room's light at an instant."""
        if self.mains_flicker == 0:
            return 1.0
        return 1 + self.mains_flicker * _wave(self.mains_flicker_hz * time_s)

    def window_at(self, time_s: float) -> float:
        """Factor of the windows' light at an instant: two slow waves."""
        turns = time_s / self.window_drift_s
        return 1 + self.window_drift * (0.7 * _wave(turns) + 0.3 * _wave(2.63 * turns))

    def is_switched_on(self, time_s: float) -> bool:
        """Whether the further light is on at an instant."""
        return self.switch_s is not None and time_s >= self.switch_s


def _wave(turns: float) -> float:
    return math.sin(2 * math.pi * turns)


CLEAN = RoomScene(light=0.25)
DARK_ROOM = RoomScene(
    ball=Ball(diameter_m=0.012, radiance=4.0, colour=SpotColour.GREEN, limb_exponent=1.0),
    light=0.02,
    gloss=0.03,
    has_person=True,
    clothes=0.5,
)
BRIGHT_OFFICE = RoomScene(
    ball=Ball(diameter_m=0.04, radiance=4.0),
    light=0.55,
    n_lamps=2,
    n_windows=2,
    window_drift=0.15,
    gloss=0.05,
    has_person=True,
    n_screens=1,
    mains_flicker=0.01,
)
HARD = RoomScene(
    ball=Ball(diameter_m=0.03, radiance=3.0),
    light=0.22,
    n_lamps=3,
    n_windows=2,
    window_drift=0.4,
    gloss=0.12,
    has_person=True,
    clothes=0.7,
    n_screens=2,
    n_indicators=2,
    mains_flicker=0.03,
    switched_light=0.2,
    switch_s=16.0,
)
SCENES = {"clean": CLEAN, "dark_room": DARK_ROOM, "bright_office": BRIGHT_OFFICE, "hard": HARD}


def scene_named(name: str) -> RoomScene:
    """One of the scenes by its name.

    Raises:
        InputError: an unknown name.
    """
    if name not in SCENES:
        raise InputError(f"no scene {name!r}, expected one of {', '.join(SCENES)}")
    return SCENES[name]
