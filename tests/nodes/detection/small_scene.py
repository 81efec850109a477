"""A small noisy picture with a spot, people, lamps: what the tests of the detector look at."""

import numpy as np

from nodes.frames import Frame, PixelFormat, StampOrigin

WIDTH, HEIGHT = 320, 240
NOISE = 1.5


def light(x, y, *, width=1.6, peak=150.0, shape=(HEIGHT, WIDTH)):
    """(h, w) light of a round spot."""
    rows, columns = np.mgrid[: shape[0], : shape[1]]
    return peak * np.exp(-((columns - x) ** 2 + (rows - y) ** 2) / (2 * width**2))


class Scene:
    """Frames of a smooth background; every frame has its own noise."""

    def __init__(self, seed=0, level=60.0):
        self._rng = np.random.default_rng(seed)
        columns = np.arange(WIDTH) / WIDTH
        self.background = np.tile(level * (0.7 + 0.6 * columns), (HEIGHT, 1))
        self._sequence = 0

    def frame(self, *lights, scale=1.0):
        """The background, times `scale`, and lights (h, w) or (box, level) painted over it."""
        picture = scale * self.background
        for one in lights:
            if isinstance(one, tuple):
                (left, top, right, bottom), level = one
                picture = picture.copy()
                picture[top:bottom, left:right] = level
            else:
                picture = picture + one
        noisy = picture + self._rng.normal(0, NOISE, picture.shape)
        return self.of(np.clip(np.rint(noisy), 0, 255).astype(np.uint8))

    def of(self, image, pixel_format=PixelFormat.MONO, bits=8):
        """A frame of an image."""
        self._sequence += 1
        return Frame(self._sequence, self._sequence * 40_000_000, StampOrigin.ORDER, image, pixel_format, bits)
