"""What FFmpeg's errors mean for a live camera, in words that hold no password."""

from __future__ import annotations

import av.error

from nodes.devices.cameras.connection import ConnectionLostError
from nodes.devices.errors import SourceError
from nodes.devices.redaction import redact

_PATH_ADVICE = "Look up the stream's path in the camera's manual or its ONVIF settings."
_LOGIN_ADVICE = (
    "Give the camera's RTSP or ONVIF user as rtsp://user:password@host/path, special characters percent-encoded."
)
_NETWORK_ADVICE = "Check the camera's power, network and address."


def timed_out(name: str, timeout_s: float) -> ConnectionLostError:
    """The error of a camera that keeps silent."""
    return ConnectionLostError(f"{name}: no answer or data for {timeout_s:g} s", advice=_NETWORK_ADVICE)


def source_error_of(error: av.error.FFmpegError, name: str) -> SourceError:
    """The error to raise instead: FFmpeg's own text holds the whole address.

    Raise it outside the `except` block: FFmpeg's error must not stand in its context, where a traceback shows it.

    Args:
        error: of opening or reading.
        name: of the source; without password.
    """
    if isinstance(error, av.error.HTTPUnauthorizedError | av.error.HTTPForbiddenError):
        # Final: cameras lock an account after a few wrong passwords.
        return SourceError(f"{name}: the camera refuses user name or password", advice=_LOGIN_ADVICE)
    if isinstance(error, av.error.DecoderNotFoundError | av.error.ProtocolNotFoundError):
        return SourceError(f"{name}: FFmpeg, as installed, cannot read this: {_words(error)}")
    if isinstance(error, av.error.HTTPNotFoundError):
        return ConnectionLostError(f"{name}: the camera has no stream at this path", advice=_PATH_ADVICE)
    if isinstance(error, av.error.ConnectionRefusedError):
        return ConnectionLostError(
            f"{name}: nothing listens there (connection refused)",
            advice="Check the port (554 is usual), and that RTSP is switched on in the camera.",
        )
    if isinstance(error, av.error.InvalidDataError):
        return ConnectionLostError(
            f"{name}: what answers there sends no video that FFmpeg understands", advice=_PATH_ADVICE
        )
    return ConnectionLostError(f"{name}: {_words(error)}", advice=_NETWORK_ADVICE)


def _words(error: av.error.FFmpegError) -> str:
    return redact(str(error.strerror or type(error).__name__))
