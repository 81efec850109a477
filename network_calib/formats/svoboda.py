"""Recordings in the layout of Svoboda's MultiCamSelfCal, read and written.

    points.dat                3 C rows of F numbers: u, v, w of each camera; the pixel is u/w, v/w
    IdMat.dat                 C rows of F numbers: 1 where the camera saw the spot, else 0
    Res.dat                   C rows: image width, height
    camera_order.txt          optional: C camera names
    <Basename><N>.rad         optional, N = 1..C: given intrinsics and distortion (`rad.py`)
    original_cam_centers.dat  optional: C rows of measured camera centres
    multicamselfcal.cfg       optional: Basename, Num-Cameras and Undo-Radial are used (`svoboda_cfg.py`)

Pixels are taken unshifted: the format does not say whether the centre of the top-left pixel is (0, 0), (1, 1) or
(0.5, 0.5), the tools that wrote such files differ, and the only parameter that feels it is the principal point.
Frame numbers are column numbers from 0.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from network_calib.errors import InputError
from network_calib.formats.matrix_text import read_matrix, write_matrix
from network_calib.formats.rad import read_rad_intrinsics
from network_calib.formats.recording import Recording, digest, natural_key, read_text
from network_calib.formats.svoboda_cfg import NO_CFG, SvobodaCfg, read_cfg
from network_calib.observations import BoolArray, FloatArray, IntArray, Observations
from network_calib.room_setup import CameraSetup, Knowledge, KnownCentres

MAX_IMAGE_SIDE_PX = 100_000
# Two missing-value marks, (0, 0) and (-1, -1), stand in files whose IdMat says "seen". One such pixel may be a spot;
# more than this many, and more than this share of a camera's spots, on exactly one pixel are marks.
MARK_COUNT, MARK_SHARE = 3, 0.01


def read_svoboda(folder: Path) -> Recording:
    """Read a recording folder.

    A spot counts when IdMat says seen and its coordinates are finite. "Seen" spots without coordinates, marks of
    missing points, and pixels further outside than one image size are dropped and counted in the notes.

    Raises:
        InputError: a file is missing, is no table of the expected shape, or contradicts another file.
    """
    cfg = read_cfg(folder / "multicamselfcal.cfg") if (folder / "multicamselfcal.cfg").is_file() else NO_CFG
    points = read_matrix(folder / "points.dat")
    if len(points) % 3:
        raise InputError(f"{folder / 'points.dat'} has {len(points)} rows, expected 3 for each camera")
    n_cameras, n_frames = len(points) // 3, points.shape[1]
    if cfg.n_cameras not in (None, n_cameras):
        raise InputError(
            f"{cfg.path}: Num-Cameras is {cfg.n_cameras}, but {folder / 'points.dat'} holds {n_cameras} cameras"
        )
    is_seen = _read_is_seen(folder / "IdMat.dat", shape=(n_cameras, n_frames))
    size_px = _read_sizes(folder / "Res.dat", n_cameras=n_cameras)
    names = _read_names(folder / "camera_order.txt", n_cameras=n_cameras)
    observations, notes = _observations(names, points=points, is_seen=is_seen, size_px=size_px)
    setups, rad_notes = _setups(folder, cfg, names=names, size_px=size_px)
    return Recording(
        name=folder.resolve().name,
        observations=observations,
        setups=setups,
        known_centres=_read_centres(folder / "original_cam_centers.dat", names=names),
        notes=(*cfg.notes, *notes, *rad_notes),
        sha256=digest(observations),
        is_named=(folder / "camera_order.txt").is_file(),
    )


def write_svoboda_recording(observations: Observations, *, size_px: IntArray, folder: Path) -> None:
    """Write a recording folder that `read_svoboda` reads back exactly; frame f becomes column f.

    Args:
        observations: frames are 0 or more.
        size_px: (C, 2) image width, height.
        folder: made when missing.

    Raises:
        InputError: a frame number is negative.
    """
    n_cameras = observations.n_cameras
    if len(observations) and observations.frame.min() < 0:
        raise InputError(f"frame {observations.frame.min()} has no column, expected 0 or more")
    n_frames = int(observations.frame.max()) + 1 if len(observations) else 0
    points = np.full((n_cameras, 3, n_frames), np.nan)
    points[observations.camera, :2, observations.frame] = observations.px
    points[observations.camera, 2, observations.frame] = 1.0
    is_seen = np.isfinite(points[:, 2])
    folder.mkdir(parents=True, exist_ok=True)
    write_matrix(folder / "points.dat", points.reshape(3 * n_cameras, n_frames))
    write_matrix(folder / "IdMat.dat", is_seen.astype(np.int64))
    write_matrix(folder / "Res.dat", np.asarray(size_px))
    (folder / "camera_order.txt").write_text("\n".join(observations.camera_names) + "\n", encoding="utf-8")


def _read_is_seen(path: Path, *, shape: tuple[int, int]) -> BoolArray:
    matrix = read_matrix(path)
    if matrix.shape != shape:
        raise InputError(
            f"{path} is {matrix.shape[0]} x {matrix.shape[1]}, expected {shape[0]} cameras x {shape[1]} frames "
            "as in points.dat"
        )
    wrong = np.argwhere((matrix != 0) & (matrix != 1))
    if len(wrong):
        row, column = wrong[0]
        raise InputError(f"{path}, row {row + 1}, column {column + 1}: {matrix[row, column]:g}, expected 0 or 1")
    return matrix == 1


def _read_sizes(path: Path, *, n_cameras: int) -> IntArray:
    if not path.is_file():
        raise InputError(f"{path} is missing", advice='Write one row "width height" for each camera.')
    sizes = read_matrix(path)
    if sizes.shape != (n_cameras, 2):
        raise InputError(
            f"{path} is {sizes.shape[0]} x {sizes.shape[1]}, expected {n_cameras} rows of width and height"
        )
    is_wrong = ~((sizes >= 1) & (sizes <= MAX_IMAGE_SIDE_PX) & (sizes == np.round(sizes))).all(axis=1)
    if is_wrong.any():
        row = int(np.flatnonzero(is_wrong)[0])
        raise InputError(
            f"{path}, row {row + 1}: image size {sizes[row, 0]:g} x {sizes[row, 1]:g}, "
            f"expected whole numbers 1..{MAX_IMAGE_SIDE_PX}"
        )
    return sizes.astype(np.int64)


def _read_names(path: Path, *, n_cameras: int) -> tuple[str, ...]:
    if not path.is_file():
        return tuple(f"cam{k + 1}" for k in range(n_cameras))
    names = tuple(line.strip() for line in read_text(path).splitlines() if line.strip())
    if len(names) != n_cameras:
        raise InputError(f"{path} names {len(names)} cameras, expected {n_cameras} as in points.dat")
    if len(set(names)) != len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise InputError(f"{path}: camera name {twice!r} stands there twice")
    return names


def _read_centres(path: Path, *, names: tuple[str, ...]) -> KnownCentres | None:
    if not path.is_file():
        return None
    centres = read_matrix(path)
    if centres.shape != (len(names), 3) or not np.isfinite(centres).all():
        raise InputError(
            f"{path} is {centres.shape[0]} x {centres.shape[1]}, expected {len(names)} rows of x, y, z, all finite"
        )
    return KnownCentres(names, centres)


def _observations(
    names: tuple[str, ...], *, points: FloatArray, is_seen: BoolArray, size_px: IntArray
) -> tuple[Observations, list[str]]:
    """Rows for what was seen and can be used, and a note on each camera's dropped ones."""
    uvw = points.reshape(len(names), 3, -1)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        px = np.moveaxis(uvw[:, :2] / uvw[:, 2:], 1, 2)
    is_finite = np.asarray(np.isfinite(px).all(axis=2))
    is_outside = (px < -size_px[:, None]) | (px > 2 * size_px[:, None])
    is_far = is_finite & np.asarray(np.any(is_outside, axis=2))
    is_mark = _missing_marks(px, is_seen & is_finite)
    notes: list[str] = []
    for k, name in enumerate(names):
        n_seen = int(is_seen[k].sum())
        n_far = int((is_seen[k] & is_far[k]).sum())
        if n_far > 0.05 * n_seen and not is_mark[k].any():
            x, y = px[k, np.flatnonzero(is_seen[k] & is_far[k])[0]]
            raise InputError(
                f"camera {name!r}: {n_far} of {n_seen} spots lie more than one image size outside the image "
                f"{size_px[k, 0]} x {size_px[k, 1]}, the first at ({x:.6g}, {y:.6g})",
                advice="Check Res.dat (width first) and the unit of points.dat (pixels).",
            )
        for n, reason in (
            (int((is_seen[k] & ~is_finite[k]).sum()), "are marked seen but have no finite coordinates"),
            (int(is_mark[k].sum()), "stand on exactly (0, 0) or (-1, -1), the marks of a missing point"),
            (n_far, "lie more than one image size outside the image"),
        ):
            if n:
                notes.append(f"camera {name!r}: {n} of {n_seen} spots {reason}; dropped")
    camera, frame = np.nonzero(is_seen & is_finite & ~is_far & ~is_mark)
    return Observations.from_columns(names, camera=camera, frame=frame, px=px[camera, frame]), notes


def _missing_marks(px: FloatArray, is_used: BoolArray) -> BoolArray:
    """(C, F) spots on a mark's pixel, for the cameras that have too many of them there for chance."""
    is_mark = is_used & (np.all(px == 0, axis=2) | np.all(px == -1, axis=2))
    count = is_mark.sum(axis=1)
    is_bulk = (count >= MARK_COUNT) & (count > MARK_SHARE * is_used.sum(axis=1))
    return is_mark & is_bulk[:, None]


def _setups(
    folder: Path, cfg: SvobodaCfg, *, names: tuple[str, ...], size_px: IntArray
) -> tuple[tuple[CameraSetup, ...], list[str]]:
    """Cameras with the intrinsics of the .rad files, as priors, where there are any."""
    sizes = [(int(width), int(height)) for width, height in size_px]
    paths = _rad_files(folder, cfg, n_cameras=len(names))
    if not paths:
        notes = [f"{cfg.path}: Undo-Radial is 1, but there are no .rad files"] if cfg.undo_radial else []
        return tuple(CameraSetup(name, size) for name, size in zip(names, sizes, strict=True)), notes
    read = [read_rad_intrinsics(path) for path in paths]
    setups = tuple(
        CameraSetup(name, size, knowledge=Knowledge.INITIAL, intrinsics=intrinsics)
        for name, size, (intrinsics, _) in zip(names, sizes, read, strict=True)
    )
    return setups, [note for _, notes in read for note in notes]


def _rad_files(folder: Path, cfg: SvobodaCfg, *, n_cameras: int) -> list[Path]:
    """The .rad files of cameras 1..C, in this order; empty when there are none."""
    by_prefix: dict[str, dict[int, Path]] = {}
    for path in sorted(folder.glob("*.rad"), key=lambda p: natural_key(p.name)):
        prefix = path.stem.rstrip("0123456789")
        digits = path.stem[len(prefix) :]
        if digits:
            by_prefix.setdefault(prefix, {})[int(digits)] = path
    if not by_prefix:
        return []
    prefix = cfg.basename if cfg.basename in by_prefix else None
    if prefix is None and len(by_prefix) == 1:
        prefix = next(iter(by_prefix))
    if prefix is None:
        found = ", ".join(f"{p}*.rad" for p in by_prefix)
        raise InputError(f"{folder} holds several families of .rad files: {found}", advice="Keep one, or set Basename.")
    numbers = sorted(by_prefix[prefix])
    if numbers != list(range(1, n_cameras + 1)):
        raise InputError(
            f"{folder} holds {prefix}N.rad for N = {', '.join(map(str, numbers))}; expected 1..{n_cameras}, one for "
            "each camera"
        )
    return [by_prefix[prefix][k] for k in numbers]
