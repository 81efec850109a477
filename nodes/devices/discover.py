"""Which cameras there are: those of this machine, and those of the network that answer to ONVIF's discovery."""

from __future__ import annotations

import os
import re
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

from nodes.devices.cameras import v4l2_ioctl
from nodes.devices.cameras.onvif_probe import probe_onvif
from nodes.devices.permission import permission_advice

_SYSFS, _DEVICES = Path("/sys/class/video4linux"), Path("/dev")


class CameraKind(StrEnum):
    """How a camera is reached."""

    V4L2 = "v4l2"
    ONVIF = "onvif"


@dataclass(frozen=True, slots=True)
class CameraMode:
    """One way in which a camera of this machine can send its pictures.

    Attributes:
        coding: four-character code, such as YUYV or MJPG.
        size_px: width and height.
        rates_hz: frames a second; empty where the driver does not list them.
    """

    coding: str
    size_px: tuple[int, int]
    rates_hz: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class FoundCamera:
    """A camera that is connected.

    Attributes:
        kind: how it is reached.
        address: what `open_live` takes; of an ONVIF camera the host alone, for the path is told only after a login.
        name: as the camera calls itself.
        modes: V4L2: what it can do.
        problem: why it cannot be used or asked; empty if it can.
    """

    kind: CameraKind
    address: str
    name: str
    modes: tuple[CameraMode, ...] = ()
    problem: str = ""


def find_cameras(*, network_wait_s: float | None = None) -> list[FoundCamera]:
    """All cameras of this machine; with `network_wait_s` those too that answer on the network within that time.

    Raises:
        DeviceError: the network does not take the question.
    """
    found = find_v4l2()
    if network_wait_s is not None:
        answered = probe_onvif(wait_s=network_wait_s)
        found += [FoundCamera(CameraKind.ONVIF, camera.host, camera.name) for camera in answered]
    return found


def find_v4l2(
    *, sysfs: Path = _SYSFS, devices: Path = _DEVICES, ioctl: v4l2_ioctl.Ioctl = v4l2_ioctl.kernel_ioctl
) -> list[FoundCamera]:
    """The video devices that capture, by number; a device that may not be asked is listed with the reason."""
    nodes = [path for path in sysfs.glob("video*") if re.fullmatch(r"video\d+", path.name)]
    found = [_asked(path, devices / path.name, ioctl) for path in sorted(nodes, key=lambda path: int(path.name[5:]))]
    return [camera for camera in found if camera is not None]


def _asked(node: Path, device: Path, ioctl: v4l2_ioctl.Ioctl) -> FoundCamera | None:
    """None for what is no camera: second nodes of a camera for its metadata, encoders, outputs."""
    try:
        handle = os.open(device, os.O_RDWR | os.O_NONBLOCK)
    except OSError as error:
        return FoundCamera(CameraKind.V4L2, str(device), _name_of(node), problem=_problem(error, device))
    try:
        capability = v4l2_ioctl.capability(handle, ioctl)
        if not capability.can_capture:
            return None
        modes = tuple(
            CameraMode(coding, size_px, tuple(v4l2_ioctl.rates_hz(handle, coding, size_px, ioctl)))
            for coding in v4l2_ioctl.codings(handle, ioctl)
            for size_px in v4l2_ioctl.sizes_px(handle, coding, ioctl)
        )
        return FoundCamera(CameraKind.V4L2, str(device), capability.card or _name_of(node), modes)
    except OSError as error:
        return FoundCamera(CameraKind.V4L2, str(device), _name_of(node), problem=_problem(error, device))
    finally:
        os.close(handle)


def _problem(error: OSError, device: Path) -> str:
    if isinstance(error, PermissionError):
        return f"no permission to open it. {permission_advice(device)}"
    return error.strerror or type(error).__name__


def _name_of(node: Path) -> str:
    try:
        return (node / "name").read_text(encoding="utf-8", errors="replace").strip()
    except OSError:
        return ""
