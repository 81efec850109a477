"""Observations of a recording, with the names and image sizes of a calibration."""

from __future__ import annotations

from dataclasses import replace

from network_calib.errors import InputError
from network_calib.formats.recording import Recording
from network_calib.observations import Observations
from network_calib.result import Calibration


def observations_of(calibration: Calibration, recording: Recording) -> tuple[Observations, tuple[str, ...]]:
    """Match cameras by name, or by order where the recording names none.

    Returns:
        The observations with camera names of the calibration, and notes.

    Raises:
        InputError: the recording has a camera that the calibration lacks, or one of another image size.
    """
    known = tuple(camera.name for camera in calibration.cameras)
    names = recording.observations.camera_names
    notes: tuple[str, ...] = ()
    if not recording.is_named and len(names) == len(known) and not set(names) & set(known):
        names, notes = known, ("the recording names no cameras; they are taken in the order of the calibration",)
    unknown = [name for name in names if name not in known]
    if unknown:
        raise InputError(
            f"{recording.name}: cameras {', '.join(unknown)} are not in the calibration, which has {', '.join(known)}"
        )
    sizes = {camera.name: tuple(camera.size_px) for camera in calibration.cameras}
    for name, setup in zip(names, recording.setups, strict=False):
        if tuple(setup.size_px) != sizes[name]:
            raise InputError(
                f"{recording.name}: camera {name!r} has images of {setup.size_px[0]} x {setup.size_px[1]}, but was "
                f"calibrated with {sizes[name][0]} x {sizes[name][1]}"
            )
    return replace(recording.observations, camera_names=names), notes
