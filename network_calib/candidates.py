"""Candidates for the spot: detections of which a camera may have several in one frame, each with a score."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from network_calib.errors import InputError
from network_calib.observations import BoolArray, FloatArray, IntArray, Observations


@dataclass(frozen=True, slots=True)
class Candidates:
    """A table of K candidates by C cameras, sorted by frame, then camera, then falling score, then position.

    Attributes:
        camera_names: C names, in the order of the camera indices.
        camera: (K,) camera index, 0..C-1.
        frame: (K,) frame number; equal numbers mean one instant.
        px: (K, 2) pixel position x, y; the centre of the top-left pixel is (0, 0).
        sigma_px: (K,) the detector's standard deviation per axis; NaN where it gave none.
        score: (K,) 0..1, how like the spot the candidate is.
        stamp_ns: (K,) acquisition time, or None where only frame numbers are known.
    """

    camera_names: tuple[str, ...]
    camera: IntArray
    frame: IntArray
    px: FloatArray
    sigma_px: FloatArray
    score: FloatArray
    stamp_ns: IntArray | None = None

    @classmethod
    def from_columns(
        cls,
        camera_names: tuple[str, ...],
        *,
        camera: npt.ArrayLike,
        frame: npt.ArrayLike,
        px: npt.ArrayLike,
        score: npt.ArrayLike,
        sigma_px: npt.ArrayLike | None = None,
        stamp_ns: npt.ArrayLike | None = None,
    ) -> Candidates:
        """Sort the columns and check them.

        Raises:
            InputError: lengths differ, a camera index is out of range, a position, sigma or score is no such number, or
                the rows of one camera and frame bear different stamps.
        """
        frm = np.asarray(frame, dtype=np.int64)
        # Each row as an instant of its own: the checks of single observations, without "at most one in a frame".
        rows = Observations.from_columns(
            camera_names,
            camera=camera,
            frame=np.arange(len(frm)),
            px=px,
            sigma_px=sigma_px,
            stamp_ns=stamp_ns,
        )
        scores = np.asarray(score, dtype=np.float64)
        if len(scores) != len(frm):
            raise InputError(f"score has {len(scores)} values, expected {len(frm)}")
        is_wrong = ~((scores >= 0) & (scores <= 1))
        if is_wrong.any():
            k = int(np.flatnonzero(is_wrong)[0])
            name = camera_names[rows.camera[k]]
            raise InputError(f"score of camera {name!r} in frame {frm[k]} is {scores[k]}, expected 0 to 1")
        order = np.lexsort((rows.px[:, 1], rows.px[:, 0], -scores, rows.camera, frm))
        stamp = None if rows.stamp_ns is None else rows.stamp_ns[order]
        table = cls(
            camera_names, rows.camera[order], frm[order], rows.px[order], rows.sigma_px[order], scores[order], stamp
        )
        table._refuse_uneven_stamps()
        return table

    def __len__(self) -> int:
        return len(self.camera)

    @property
    def n_cameras(self) -> int:
        return len(self.camera_names)

    @property
    def is_best(self) -> BoolArray:
        """(K,) the row is the best-scored of its camera and frame."""
        return np.concatenate([[True], self._is_elsewhere])[: len(self)]

    @property
    def group(self) -> IntArray:
        """(K,) number of each row's camera and frame, from 0 in the order of the rows."""
        return np.cumsum(self.is_best) - 1

    def observations(self, is_kept: BoolArray) -> Observations:
        """The rows where `is_kept` (K,) holds, at most one of a camera in a frame, as observations.

        Raises:
            InputError: there are two.
        """
        return Observations.from_columns(
            self.camera_names,
            camera=self.camera[is_kept],
            frame=self.frame[is_kept],
            px=self.px[is_kept],
            sigma_px=self.sigma_px[is_kept],
            stamp_ns=None if self.stamp_ns is None else self.stamp_ns[is_kept],
        )

    @property
    def _is_elsewhere(self) -> BoolArray:
        """(K - 1,) a row's camera or frame is another than that of the row before."""
        return (np.diff(self.camera) != 0) | (np.diff(self.frame) != 0)

    def _refuse_uneven_stamps(self) -> None:
        if self.stamp_ns is None:
            return
        uneven = np.flatnonzero(~self._is_elsewhere & (np.diff(self.stamp_ns) != 0))
        if len(uneven):
            k = int(uneven[0])
            raise InputError(
                f"camera {self.camera_names[self.camera[k]]!r} has candidates of two stamps in frame {self.frame[k]}: "
                f"{self.stamp_ns[k]} and {self.stamp_ns[k + 1]} ns",
                advice="Candidates of one camera in one frame are of one picture, so they have one stamp.",
            )
