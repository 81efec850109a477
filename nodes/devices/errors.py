"""Errors of devices and sources, all part of the project's one tree (`network_calib.errors`)."""

from __future__ import annotations

from network_calib.errors import SpotcalError


class DeviceError(SpotcalError):
    """A device cannot be opened, does not answer, or answers what it must not."""


class LineLostError(DeviceError):
    """The line to a device is gone: unplugged, switched off, connection ended. Opening it again may help."""


class SourceError(DeviceError):
    """A camera, video or folder of images cannot be opened, or failed for good. Never holds a password."""
