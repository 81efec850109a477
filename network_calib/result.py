"""The result: a calibrated network that carries its own quality. Immutable; files are in `formats/`."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform

from network_calib.cameras import Cameras, LensModel
from network_calib.observations import FloatArray

# Order of the parameters in a camera's covariance: rotation about the camera's own axes (x_in_cam turns by +omega),
# centre in the world frame, then intrinsics. `aspect` is focal_y / focal_x.
PARAMETER_NAMES = (
    *("rotation_x_rad", "rotation_y_rad", "rotation_z_rad"),
    *("centre_x", "centre_y", "centre_z"),
    *("focal_px", "aspect", "centre_x_px", "centre_y_px", "d0", "d1", "d2", "d3"),
)


@dataclass(frozen=True, slots=True)
class ErrorSummary:
    """Reprojection error, the Euclidean distance in the image, over `n` observations; NaN when n is 0."""

    n: int
    mean_px: float
    rms_px: float
    median_px: float
    p95_px: float

    @classmethod
    def of(cls, error_px: FloatArray) -> ErrorSummary:
        """Summarise (n,) distances."""
        if not len(error_px):
            return cls(0, np.nan, np.nan, np.nan, np.nan)
        return cls(
            n=len(error_px),
            mean_px=float(error_px.mean()),
            rms_px=float(np.sqrt((error_px**2).mean())),
            median_px=float(np.median(error_px)),
            p95_px=float(np.percentile(error_px, 95)),
        )


@dataclass(frozen=True, slots=True)
class CameraQuality:
    """How well one camera was seen and fitted.

    Attributes:
        n_observations: detections in frames with two views or more.
        fitted: error of the inliers that were fitted.
        holdout: error of frames that were triangulated but not fitted (an extra fit without them).
        noise_sigma_px: estimated detection noise per axis.
        coverage: share of the image (8 x 6 cells) that holds an inlier.
    """

    n_observations: int
    fitted: ErrorSummary
    holdout: ErrorSummary
    noise_sigma_px: float
    coverage: float


@dataclass(frozen=True, slots=True)
class CalibratedCamera:
    """One camera with its uncertainty and quality.

    Attributes:
        name: camera name.
        size_px: image width, height.
        lens: lens model.
        intrinsics: (8,) as in `network_calib.cameras`.
        cam_from_world: pose.
        covariance: (14, 14) in the order of PARAMETER_NAMES; rows of what was held fixed are zero.
        is_intrinsics_fixed: given intrinsics were held.
        quality: figures of this camera.
    """

    name: str
    size_px: tuple[int, int]
    lens: LensModel
    intrinsics: FloatArray
    cam_from_world: RigidTransform
    covariance: FloatArray
    is_intrinsics_fixed: bool
    quality: CameraQuality

    @property
    def sigma(self) -> FloatArray:
        """(14,) standard deviations in the order of PARAMETER_NAMES."""
        return np.sqrt(np.maximum(np.diag(self.covariance), 0.0))

    @property
    def centre_in_world(self) -> FloatArray:
        """(3,) projection centre."""
        return self.cam_from_world.inv().translation


@dataclass(frozen=True, slots=True)
class Doubt:
    """Something doubtful that the user must see: a stable code, what was found with numbers, what to do."""

    code: str
    message: str
    advice: str


@dataclass(frozen=True, slots=True)
class NetworkQuality:
    """Figures of the whole network.

    Attributes:
        n_points: latent spots fitted.
        n_observations: detections in frames with two views or more.
        n_inliers: of them, fitted.
        fitted: error of the inliers.
        holdout: error of the left-out segments, triangulated but never fitted.
        chi2_per_dof: weighted sum of squares over degrees of freedom with the noise that was known or estimated.
        spot_sigma_median: predicted standard deviation (root of the largest eigenvalue) of a spot's 3D position,
            median over the spots; world units.
        spot_sigma_p95: the same, 95th percentile.
        repeat_centre_spread: largest distance between camera centres of runs with other seeds; world units; NaN when
            not repeated.
        repeat_focal_spread_px: largest difference of focal lengths between them.
    """

    n_points: int
    n_observations: int
    n_inliers: int
    fitted: ErrorSummary
    holdout: ErrorSummary
    chi2_per_dof: float
    spot_sigma_median: float
    spot_sigma_p95: float
    repeat_centre_spread: float
    repeat_focal_spread_px: float


@dataclass(frozen=True, slots=True)
class WorldFrame:
    """What the world frame is and where its scale comes from.

    Attributes:
        name: for example "C0" (the first camera's frame), "floor", "given centres".
        unit: "m", or "unit" when no metric information was given.
        scale_source: words for a person: "baseline C0-C1 = 0.35 m", "none: |C0 C1| = 1".
        scale_sigma: relative standard deviation of the scale; not part of the covariances, but where LRFs were solved
            along: then it is within them.
    """

    name: str
    unit: str
    scale_source: str
    scale_sigma: float


@dataclass(frozen=True, slots=True)
class Provenance:
    """Where a result comes from.

    Attributes:
        program_version: of spotcal.
        created_utc: ISO 8601; the only field that differs between two identical runs.
        input_name: what the observations were read from.
        input_sha256: digest of the observations.
        seed: of the random numbers.
        start_method: "factorisation" or "anchor".
        options_json: all options, as canonical JSON text.
    """

    program_version: str
    created_utc: str
    input_name: str
    input_sha256: str
    seed: int
    start_method: str
    options_json: str


# Order of the parameters in the covariance of an LRF: pose at the reference tilt (rotation about its origin, from
# the left, and origin), the tilt axis (two turns and two shifts across it), what the instrument may be wrong by.
LRF_PARAMETER_NAMES = (
    *("rotation_x_rad", "rotation_y_rad", "rotation_z_rad", "origin_x", "origin_y", "origin_z"),
    *("axis_turn_1_rad", "axis_turn_2_rad", "axis_shift_1", "axis_shift_2"),
    *("tilt_gain", "range_bias_m", "range_scale", "bearing_zero_rad", "clock_offset_s"),
)


@dataclass(frozen=True, slots=True)
class CalibratedLrf:
    """One tilting laser range finder: where it is at any tilt, and how certain that is.

    Attributes:
        name: LRF name.
        world_from_lrf: pose at the reference tilt.
        reference_tilt_rad: the tilt of that pose.
        axis_direction_in_world: (3,) unit vector of the tilt axis; a growing tilt turns right-handed about it.
        axis_point_in_world: (3,) its point nearest to the world's origin.
        instrument: (5,) tilt gain, range bias (m), range scale, bearing zero (rad), clock offset (s): what the LRF's
            stamps lack to the cameras'.
        covariance: (15, 15) in the order of LRF_PARAMETER_NAMES; rows of what was held are zero.
        dx_m: the paper's offset of the mirror from the axis, forward.
        dz_m: the same, up.
        mount_roll_rad: how the LRF sits askew on the axis.
        mount_yaw_rad: see `mount_roll_rad`.
        paper_sigma: (4,) standard deviations of dx, dz, roll, yaw.
        tilt_rad: (T,) solved angles of its tilt settings.
        tilt_sigma_rad: (T,) their standard deviations; zero for the reference and for trusted angles.
        n_sightings: spots seen in its plane that the cameras located too.
        n_inliers: of them, used.
        range_rms_m: of the inliers' residuals.
        bearing_rms_rad: the same.
        out_of_plane_rms_m: the same.
        held: names of the parameters that were held, not estimated.
    """

    name: str
    world_from_lrf: RigidTransform
    reference_tilt_rad: float
    axis_direction_in_world: FloatArray
    axis_point_in_world: FloatArray
    instrument: FloatArray
    covariance: FloatArray
    dx_m: float
    dz_m: float
    mount_roll_rad: float
    mount_yaw_rad: float
    paper_sigma: FloatArray
    tilt_rad: FloatArray
    tilt_sigma_rad: FloatArray
    n_sightings: int
    n_inliers: int
    range_rms_m: float
    bearing_rms_rad: float
    out_of_plane_rms_m: float
    held: tuple[str, ...]

    @property
    def sigma(self) -> FloatArray:
        """(15,) standard deviations in the order of LRF_PARAMETER_NAMES."""
        return np.sqrt(np.maximum(np.diag(self.covariance), 0.0))


@dataclass(frozen=True, slots=True)
class Calibration:
    """A calibrated camera network, with the laser range finders that were calibrated with it."""

    cameras: tuple[CalibratedCamera, ...]
    world: WorldFrame
    quality: NetworkQuality
    warnings: tuple[Doubt, ...]
    provenance: Provenance
    lrfs: tuple[CalibratedLrf, ...] = ()

    def as_cameras(self) -> Cameras:
        """The cameras as one batch, for projection."""
        return Cameras(
            names=tuple(c.name for c in self.cameras),
            size_px=np.array([c.size_px for c in self.cameras], dtype=np.int64),
            lenses=tuple(c.lens for c in self.cameras),
            intrinsics=np.stack([c.intrinsics for c in self.cameras]),
            cam_from_world=RigidTransform.concatenate([c.cam_from_world for c in self.cameras]),
        )
