"""What gives a user the right to open a device."""

from __future__ import annotations

import grp
from pathlib import Path


def permission_advice(device: Path) -> str:
    """Names the group that owns the device."""
    try:
        group = grp.getgrgid(device.stat().st_gid).gr_name
    except (OSError, KeyError):
        group = "video"
    if group == "root":
        return 'Only root may: give the device to a group by a udev rule (GROUP="video", MODE="0660"), and join it.'
    return f"Join the group that may: `sudo usermod -aG {group} $USER`, then log in anew."
