"""What the projection service refuses, with a code that a program can act on."""

from __future__ import annotations

from enum import StrEnum

from network_calib.errors import SpotcalError


class ErrorCode(StrEnum):
    """Why a request was refused; these words travel on the bus."""

    UNKNOWN_CAMERA = "UNKNOWN_CAMERA"
    UNKNOWN_LRF = "UNKNOWN_LRF"
    NO_TILT = "NO_TILT"
    TOO_LARGE = "TOO_LARGE"
    BAD_REQUEST = "BAD_REQUEST"
    STALE_CALIBRATION = "STALE_CALIBRATION"
    NO_CALIBRATION = "NO_CALIBRATION"
    FAILED = "FAILED"  # a defect of the service; it lives on


class ProjectionError(SpotcalError):
    """A request that cannot be answered.

    Attributes:
        code: for programs.
        message: for persons: what is wrong, with the numbers.
        detail: what would have been right; the advice of every `SpotcalError`.
    """

    def __init__(self, code: ErrorCode, message: str, detail: str = "") -> None:
        super().__init__(message, advice=detail)
        self.code = code
        self.detail = detail
