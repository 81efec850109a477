"""A small RTSP camera, run by the system's Python, which has GStreamer: see `rtsp_server.py`.

Each picture carries, as a block of 8 x 8 dark and bright squares, the wall clock at which it was drawn, in ns. The
program prints its port when it listens, and ends when its standard input is closed.
"""

import argparse
import sys
import threading
import time

import gi  # pyright: ignore[reportMissingImports]

gi.require_version("Gst", "1.0")
gi.require_version("GstRtspServer", "1.0")
from gi.repository import GLib, Gst, GstRtspServer  # noqa: E402  # pyright: ignore[reportMissingImports]

Gst.init(None)  # before any class is derived from one of its own

WIDTH, HEIGHT, SQUARE = 320, 240, 16
ENCODERS = {
    "h264": "x264enc tune=zerolatency speed-preset=ultrafast key-int-max={gop} ! rtph264pay name=pay0",
    "h265": "x265enc tune=zerolatency speed-preset=ultrafast key-int-max={gop} log-level=0 ! rtph265pay name=pay0",
    "mjpeg": "jpegenc ! rtpjpegpay name=pay0",
}


class CaptureTimeMedia(GstRtspServer.RTSPMedia):
    """Reports the time of capture, as cameras do; GStreamer's default is that of sending, later by its latency."""

    def do_setup_rtpbin(self, rtpbin) -> bool:
        """Set up the part that writes sender reports."""
        rtpbin.set_property("rtcp-sync-send-time", False)
        return True


def picture(stamp_ns: int) -> bytes:
    """Planar YUV420 with the stamp in its corner, most significant bit first."""
    side = b"\x80" * (WIDTH - 8 * SQUARE)
    rows = []
    for byte in stamp_ns.to_bytes(8, "big"):
        squares = b"".join((b"\xe0" if byte >> bit & 1 else b"\x20") * SQUARE for bit in range(7, -1, -1))
        rows.append((squares + side) * SQUARE)
    luma = b"".join(rows) + b"\x80" * (WIDTH * (HEIGHT - 8 * SQUARE))
    return luma + b"\x80" * (WIDTH * HEIGHT // 2)


def feed(source, is_over: threading.Event, rate_hz: float) -> None:
    """Push pictures at an even pace until the media is over."""
    begin_s = time.monotonic()
    number = 0
    while not is_over.is_set():
        flow = source.emit("push-buffer", Gst.Buffer.new_wrapped(picture(time.time_ns())))
        if flow != Gst.FlowReturn.OK:
            return
        number += 1
        is_over.wait(max(0.0, begin_s + number / rate_hz - time.monotonic()))


def drawn(codec: str, rate_hz: int, gop: int):
    """A factory of live pictures."""
    factory = GstRtspServer.RTSPMediaFactory()
    caps = f"video/x-raw,format=I420,width={WIDTH},height={HEIGHT},framerate={rate_hz}/1"
    source = f"appsrc name=source is-live=true do-timestamp=true format=time caps={caps}"
    factory.set_launch(f"( {source} ! {ENCODERS[codec].format(gop=gop)} )")
    factory.set_shared(True)
    factory.set_media_gtype(CaptureTimeMedia.__gtype__)

    def configure(_factory, media):
        is_over = threading.Event()
        media.connect("unprepared", lambda _media: is_over.set())
        source = media.get_element().get_by_name("source")
        threading.Thread(target=feed, args=(source, is_over, rate_hz), daemon=True).start()

    factory.connect("media-configure", configure)
    return factory


def played(file: str):
    """A factory that plays a Matroska file with H.264, without decoding, at its own pace."""
    factory = GstRtspServer.RTSPMediaFactory()
    factory.set_launch(f'( filesrc location="{file}" ! matroskademux ! h264parse ! rtph264pay name=pay0 )')
    factory.set_shared(True)
    return factory


def protect(server, factories, user: str, password: str) -> None:
    """Let only this user play."""
    auth = GstRtspServer.RTSPAuth()
    token = GstRtspServer.RTSPToken()
    token.set_string("media.factory.role", "viewer")
    auth.add_basic(GstRtspServer.RTSPAuth.make_basic(user, password), token)
    server.set_auth(auth)
    for factory in factories:
        permissions = GstRtspServer.RTSPPermissions()
        permissions.add_permission_for_role("viewer", "media.factory.access", True)
        permissions.add_permission_for_role("viewer", "media.factory.construct", True)
        factory.set_permissions(permissions)


def main() -> None:
    """Serve until standard input is closed."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--port", default="0")
    parser.add_argument("--rate", type=int, default=25)
    parser.add_argument("--gop", type=int, default=25)
    parser.add_argument("--user")
    parser.add_argument("--password")
    parser.add_argument("--file", help="Matroska with H.264, served as /file")
    arguments = parser.parse_args()
    factories = {codec: drawn(codec, arguments.rate, arguments.gop) for codec in ENCODERS}
    if arguments.file:
        factories["file"] = played(arguments.file)
    server = GstRtspServer.RTSPServer()
    server.set_address("127.0.0.1")
    server.set_service(arguments.port)
    for path, factory in factories.items():
        server.get_mount_points().add_factory(f"/{path}", factory)
    if arguments.user:
        protect(server, factories.values(), arguments.user, arguments.password)
    if server.attach(None) == 0:
        sys.exit(f"cannot listen on port {arguments.port}")
    print(server.get_bound_port(), flush=True)
    loop = GLib.MainLoop()
    threading.Thread(target=lambda: (sys.stdin.read(), loop.quit()), daemon=True).start()
    loop.run()


main()
