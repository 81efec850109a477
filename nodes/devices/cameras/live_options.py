"""How a live camera is to be opened and kept."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from network_calib.errors import InputError


class Transport(StrEnum):
    """How an RTSP camera sends its packets."""

    TCP = "tcp"  # whole or not at all: a lost packet is sent again
    UDP = "udp"  # for multicast-minded networks; a lost packet costs every picture up to the next key frame


@dataclass(frozen=True, slots=True)
class LiveOptions:
    """Options of `nodes.devices.cameras.live_video.open_live`.

    Attributes:
        transport: RTSP only.
        timeout_s: without an answer or data for so long, the camera is taken for gone.
        clock_wait_s: RTSP: wait so long for the camera's first sender report before its frames get arrival stamps.
            By RFC 3550 (6.2, 6.3.1, A.7) a sender reports 0.5 to 1.5 times 5 s / 1.21828 after the last one, so within
            6.2 s even if the first report, due after half of that, was lost.
        max_away_s: a camera that stays away longer ends the source with an error.
        n_queued: frames that wait for the consumer; when one more comes, the oldest is dropped and counted.
        n_decoder_threads: 0 leaves it to the decoder.
        size_px: V4L2: width and height to ask for; None for the driver's present choice.
        rate_hz: V4L2: frames a second to ask for; None for the driver's present choice.
        coding: V4L2: how the camera is to code its pictures, a value of `v4l2.CODINGS`; None for the driver's choice.
    """

    transport: Transport = Transport.TCP
    timeout_s: float = 5.0
    clock_wait_s: float = 6.5
    max_away_s: float = 600.0
    n_queued: int = 4
    n_decoder_threads: int = 0
    size_px: tuple[int, int] | None = None
    rate_hz: float | None = None
    coding: str | None = None

    def __post_init__(self) -> None:
        """Refuse what cannot work.

        Raises:
            InputError: names the option, its value and what was expected.
        """
        positive = {"timeout_s": self.timeout_s, "n_queued": self.n_queued, "rate_hz": self.rate_hz or 1.0}
        if self.size_px is not None:
            positive |= {"size_px width": self.size_px[0], "size_px height": self.size_px[1]}
        for name, value in positive.items():
            if not value > 0:
                raise InputError(f"live camera: {name} = {value}; expected a number > 0")
        for name, value in (
            ("clock_wait_s", self.clock_wait_s),
            ("max_away_s", self.max_away_s),
            ("n_decoder_threads", self.n_decoder_threads),
        ):
            if not value >= 0:
                raise InputError(f"live camera: {name} = {value}; expected 0 or more")
