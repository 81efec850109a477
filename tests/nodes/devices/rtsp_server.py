"""A real RTSP server as a test camera: GStreamer's, run by the system's Python in a process of its own."""

from __future__ import annotations

import functools
import os
import select
import signal
import subprocess
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np

from nodes.frames import Frame, PixelFormat

PROGRAM = Path(__file__).with_name("gst_rtsp_main.py")
SYSTEM_PYTHON = "/usr/bin/python3"
PACKAGES = (
    "python3-gi gir1.2-gst-rtsp-server-1.0 gstreamer1.0-rtsp gstreamer1.0-plugins-base gstreamer1.0-plugins-good "
    "gstreamer1.0-plugins-bad gstreamer1.0-plugins-ugly"
)
_ELEMENTS = "x264enc x265enc jpegenc rtph264pay rtph265pay rtpjpegpay appsrc matroskademux h264parse"
_PROBE = f"""
import gi
gi.require_version("Gst", "1.0"); gi.require_version("GstRtspServer", "1.0")
from gi.repository import Gst, GstRtspServer
Gst.init(None)
print(" ".join(name for name in "{_ELEMENTS}".split() if Gst.ElementFactory.find(name) is None))
"""
# Starting GStreamer takes a second on a quiet machine, much more when its plugins are scanned for the first time.
_START_S = 60.0
_SQUARE_PX = 16


@functools.cache
def why_not() -> str:
    """Why there is no RTSP server on this machine; empty when there is one."""
    advice = f"the RTSP tests need Debian's {PACKAGES}"
    try:
        probe = subprocess.run(
            [SYSTEM_PYTHON, "-c", _PROBE], capture_output=True, text=True, timeout=_START_S, check=False
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        return f"{SYSTEM_PYTHON} does not run ({type(error).__name__}); {advice}"
    if probe.returncode != 0:
        return f"{(probe.stderr.strip().splitlines() or ['?'])[-1]}; {advice}"
    return f"GStreamer has no {probe.stdout.strip()}; {advice}" if probe.stdout.strip() else ""


class RtspServer:
    """Serves /h264, /h265 and /mjpeg on the loopback until it is closed.

    Args:
        port: 0 for a free one.
        rate_hz: frames a second.
        gop: frames from one key frame to the next.
        login: user and password that it asks for.
        file: Matroska with H.264, served as /file.
    """

    def __init__(
        self,
        *,
        port: int = 0,
        rate_hz: int = 25,
        gop: int = 25,
        login: tuple[str, str] | None = None,
        file: Path | None = None,
    ) -> None:
        command = [SYSTEM_PYTHON, str(PROGRAM), "--port", str(port), "--rate", str(rate_hz), "--gop", str(gop)]
        command += ["--user", login[0], "--password", login[1]] if login else []
        command += ["--file", str(file)] if file else []
        # With its standard input this process dies too, whatever becomes of the tests.
        self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
        self.port = self._read_port()

    def url(self, path: str, *, login: str = "") -> str:
        """Of one stream; `login` as `user:password`."""
        return f"rtsp://{login}{'@' if login else ''}127.0.0.1:{self.port}/{path}"

    def freeze(self) -> None:
        """Stop the process: it answers nothing more, but its connections stay."""
        os.kill(self._process.pid, signal.SIGSTOP)

    def thaw(self) -> None:
        """Let it go on."""
        os.kill(self._process.pid, signal.SIGCONT)

    def close(self) -> None:
        """End the process at once."""
        self._process.kill()
        self._process.wait()
        for pipe in (self._process.stdin, self._process.stdout):
            if pipe is not None:
                pipe.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _read_port(self) -> int:
        assert self._process.stdout is not None
        is_ready, _, _ = select.select([self._process.stdout], [], [], _START_S)
        line = self._process.stdout.readline() if is_ready else b""
        if not line:
            self.close()
            raise RuntimeError("the RTSP server did not start")
        return int(line)


def drawn_ns(frame: Frame) -> int:
    """The wall clock that the server drew into the picture."""
    assert frame.pixel_format is PixelFormat.YUV420
    centres = np.arange(8) * _SQUARE_PX + _SQUARE_PX // 2
    bits = frame.image[np.ix_(centres, centres)] > 128
    return int.from_bytes(np.packbits(bits).tobytes(), "big")
