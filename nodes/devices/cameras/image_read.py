"""Reading one image file, whole or not at all.

OpenCV refuses a file that is cut. Flipped bits are found where the format has checksums (PNG), not in JPEG, BMP, PGM.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from nodes.devices.errors import SourceError
from nodes.frames import ImageArray, PixelFormat

_MAX_BYTES = 2**30
_ADVICE = "Copy it again, or delete it: the frame then counts as lost."


class DamagedImageError(SourceError):
    """An image file that cannot be read, or that holds no image."""


def read_image(path: Path) -> tuple[ImageArray, PixelFormat]:
    """The samples as they are stored, without transparency and without the rotation that EXIF may ask for.

    Returns:
        (h, w) MONO or (h, w, 3) BGR, uint8 or uint16.

    Raises:
        DamagedImageError: names the file.
    """
    try:
        n_bytes = path.stat().st_size
        if n_bytes > _MAX_BYTES:
            raise DamagedImageError(f"{path} has {n_bytes} bytes, expected an image of at most {_MAX_BYTES}")
        data = path.read_bytes()
    except OSError as error:
        raise DamagedImageError(f"{path} cannot be read: {error.strerror}", advice=_ADVICE) from None
    image = _decoded(data)
    if image is None:
        what = "is empty (0 bytes)" if not data else "is no image that can be read, or it is damaged"
        raise DamagedImageError(f"{path} {what}", advice=_ADVICE)
    if image.dtype not in (np.uint8, np.uint16):
        raise SourceError(f"{path} has {image.dtype} samples, expected 8 or 16 bits without sign")
    if image.ndim == 2:
        return image, PixelFormat.MONO
    return np.ascontiguousarray(image[:, :, :3]), PixelFormat.BGR


def _decoded(data: bytes) -> npt.NDArray | None:
    # OpenCV tells of a damaged image on standard error, without its name; the error raised here has it.
    level = cv2.utils.logging.getLogLevel()
    cv2.utils.logging.setLogLevel(0)
    try:
        return cv2.imdecode(np.frombuffer(data, dtype=np.uint8), cv2.IMREAD_UNCHANGED) if data else None
    except cv2.error:
        return None
    finally:
        cv2.utils.logging.setLogLevel(level)
