"""`spotcal cameras`: what is connected, and what each camera can do."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby

from rich.console import Group
from rich.text import Text

from nodes.devices.discover import CameraKind, CameraMode, FoundCamera, find_cameras
from nodes.report.tables import plain_table

# Cameras answer ONVIF's question within half a second, unless the network is wireless.
NETWORK_WAIT_S = 3.0


def connected_cameras(*, is_network_asked: bool) -> list[FoundCamera]:
    """Cameras of this machine, and on request those of the network.

    Raises:
        DeviceError: the network does not take the question.
    """
    return find_cameras(network_wait_s=NETWORK_WAIT_S if is_network_asked else None)


def cameras_view(found: Sequence[FoundCamera], *, is_network_asked: bool) -> Group:
    """One table of cameras and their modes, and below it what is at fault; a friendly word where there is none."""
    if not found:
        return Group(Text(_none_found(is_network_asked=is_network_asked)))
    table = plain_table("Cameras", "address")
    table.add_column("name", overflow="fold")
    table.add_column("can do", overflow="fold")
    for camera in found:
        lines = ["cannot be used, see below"] if camera.problem else _modes(camera)
        table.add_row(Text(camera.address), Text(camera.name), Text("\n".join(lines)))
    problems = [Text(f"{camera.address}: {camera.problem}") for camera in found if camera.problem]
    usable = [camera for camera in found if not camera.problem and camera.kind is CameraKind.V4L2]
    hint = [Text(f"Look through one: spotcal spot {usable[0].address}")] if usable else []
    return Group(table, *problems, *hint)


def _modes(camera: FoundCamera) -> list[str]:
    """A line for each coding: sizes with their highest rate, the largest first."""
    if camera.kind is CameraKind.ONVIF:
        return [f"spotcal spot rtsp://USER:PASSWORD@{camera.address}/PATH, the path as in its manual"]
    lines = []
    for coding, modes in groupby(camera.modes, key=lambda mode: mode.coding):
        ordered = sorted(modes, key=lambda mode: mode.size_px, reverse=True)
        lines.append(f"{coding.strip()}: " + ", ".join(map(_mode, ordered)))
    return lines or ["does not say"]


def _mode(mode: CameraMode) -> str:
    width, height = mode.size_px
    rate = f" at {max(mode.rates_hz):.4g} Hz" if mode.rates_hz else ""
    return f"{width} x {height}{rate}"


def _none_found(*, is_network_asked: bool) -> str:
    if is_network_asked:
        return (
            "No camera is connected to this machine, and none on the network answers. Network cameras answer only "
            "where ONVIF is switched on; one of known address works all the same: spotcal spot rtsp://HOST/PATH"
        )
    return (
        "No camera is connected to this machine. Plug one in, ask the network with spotcal cameras --network, or start "
        "from recordings: spotcal detect"
    )
