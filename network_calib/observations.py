"""Spot observations as columns: what every camera saw, and when.

One row is one detection. Rows with the same `frame` were taken at one instant and so show one spot in space; a frame
number comes from a common trigger or from grouping stamps (`timing.py`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from network_calib.errors import InputError

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class Observations:
    """A table of K spot detections by C cameras, sorted by frame, then camera; at most one row for each pair.

    Attributes:
        camera_names: C names, in the order of the camera indices.
        camera: (K,) camera index, 0..C-1.
        frame: (K,) frame number; equal numbers mean one instant. Numbers need not be contiguous.
        px: (K, 2) pixel position x, y; the centre of the top-left pixel is (0, 0).
        sigma_px: (K,) the detector's standard deviation per axis; NaN where the detector gave none.
        stamp_ns: (K,) acquisition time on the publishing node's clock, or None where only frame numbers are known.
    """

    camera_names: tuple[str, ...]
    camera: IntArray
    frame: IntArray
    px: FloatArray
    sigma_px: FloatArray
    stamp_ns: IntArray | None = None

    @classmethod
    def from_columns(
        cls,
        camera_names: tuple[str, ...],
        *,
        camera: npt.ArrayLike,
        frame: npt.ArrayLike,
        px: npt.ArrayLike,
        sigma_px: npt.ArrayLike | None = None,
        stamp_ns: npt.ArrayLike | None = None,
    ) -> Observations:
        """Sort the columns and check them.

        Raises:
            InputError: lengths differ, a camera index is out of range, a position or sigma is not finite and positive,
                or one camera has two rows in one frame.
        """
        cam = np.asarray(camera, dtype=np.int64)
        frm = np.asarray(frame, dtype=np.int64)
        pos = np.asarray(px, dtype=np.float64).reshape(-1, 2)
        sig = np.full(len(cam), np.nan) if sigma_px is None else np.asarray(sigma_px, dtype=np.float64)
        stamp = None if stamp_ns is None else np.asarray(stamp_ns, dtype=np.int64)
        lengths = {len(cam), len(frm), len(pos), len(sig)} | (set() if stamp is None else {len(stamp)})
        if len(lengths) != 1:
            raise InputError(f"observation columns have different lengths: {sorted(lengths)}")
        if len(cam) and (cam.min() < 0 or cam.max() >= len(camera_names)):
            raise InputError(f"camera index {cam.min()}..{cam.max()} outside 0..{len(camera_names) - 1}")
        if not np.isfinite(pos).all():
            k = int(np.flatnonzero(~np.isfinite(pos).all(axis=1))[0])
            raise InputError(f"position of camera {camera_names[cam[k]]!r} in frame {frm[k]} is not finite: {pos[k]}")
        if (sig <= 0).any() or np.isinf(sig).any():
            k = int(np.flatnonzero((sig <= 0) | np.isinf(sig))[0])
            raise InputError(f"sigma_px of camera {camera_names[cam[k]]!r} in frame {frm[k]} is {sig[k]}, expected > 0")
        order = np.lexsort((cam, frm))
        cam, frm = cam[order], frm[order]
        twice = np.flatnonzero((np.diff(cam) == 0) & (np.diff(frm) == 0))
        if len(twice):
            k = int(twice[0])
            raise InputError(
                f"camera {camera_names[cam[k]]!r} has two rows in frame {frm[k]}, expected at most one",
                advice="Keep the strongest detection of each frame.",
            )
        return cls(camera_names, cam, frm, pos[order], sig[order], None if stamp is None else stamp[order])

    def __len__(self) -> int:
        return len(self.camera)

    @property
    def n_cameras(self) -> int:
        return len(self.camera_names)

    def select(self, is_kept: BoolArray) -> Observations:
        """The rows where `is_kept` (K,) holds."""
        stamp = None if self.stamp_ns is None else self.stamp_ns[is_kept]
        return replace(
            self,
            camera=self.camera[is_kept],
            frame=self.frame[is_kept],
            px=self.px[is_kept],
            sigma_px=self.sigma_px[is_kept],
            stamp_ns=stamp,
        )

    def n_views(self) -> IntArray:
        """(K,) how many cameras share each row's frame."""
        _, inverse, counts = np.unique(self.frame, return_inverse=True, return_counts=True)
        return counts[inverse]

    def in_frames_with_views(self, minimum: int) -> Observations:
        """The rows whose frame was seen by at least `minimum` cameras."""
        return self.select(self.n_views() >= minimum)
