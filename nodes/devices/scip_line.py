"""Questions and answers on a scanner's line; scans of a stream that is still running are passed over."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

from nodes.devices.errors import DeviceError
from nodes.devices.scip_frames import Reply, ReplyParser
from nodes.devices.scip_status import STATUS_DATA
from nodes.devices.transport import Transport

# A command waits for the scan tick, and may find one scan more in the way.
REPLY_TIMEOUT_S = 1.0
ATTEMPTS = 3
SETTLE_S = 0.15


@dataclass(frozen=True, slots=True)
class Answer:
    """An answer and when it was asked for.

    Attributes:
        reply: the answer.
        before_s: this machine's clock before the command was given to the line.
        after_s: when the line had taken it.
        heard_s: when the answer had come.
    """

    reply: Reply
    before_s: float
    after_s: float
    heard_s: float


class ScipLine:
    """The line to a scanner.

    Args:
        transport: an open line.
        clock: this machine's clock, s.
    """

    def __init__(self, transport: Transport, clock: Callable[[], float]) -> None:
        self.transport, self._clock = transport, clock
        self._parser = ReplyParser()
        self._replies: list[Reply] = []

    @property
    def name(self) -> str:
        """Its address."""
        return self.transport.name

    @property
    def n_bad(self) -> int:
        """Replies that were refused."""
        return self._parser.n_bad

    def read(self, timeout_s: float) -> list[Reply]:
        """Replies that have come; waits for bytes at most so long.

        Raises:
            LineLostError: the scanner is gone.
        """
        replies, self._replies = self._replies, []
        return replies + self._parser.feed(self.transport.read(timeout_s))

    def wait_until(self, time_s: float) -> None:
        """Let time pass; what comes meanwhile is thrown away."""
        while (left_s := time_s - self._clock()) > 0:
            self.read(left_s)

    def quiet(self) -> None:
        """Stop whatever it does, and throw away what is still on the way."""
        # LF ends a half command that somebody left, and TM2 the asking for its clock, in which it refuses all else.
        self.transport.write(b"\nQT\nTM2\n")
        end_s = self._clock() + REPLY_TIMEOUT_S
        while self.transport.read(SETTLE_S) and self._clock() < end_s:
            pass
        self._parser.reset()
        self._replies.clear()

    def to_scip2(self) -> None:
        """An URG-04LX wakes up in SCIP 1; one that is in SCIP 2 refuses this, which does no harm."""
        self._ask_once("SCIP2.0")
        self._replies.clear()

    def parameters(self, name: str) -> dict[str, str]:
        """The lines `KEY:value;` of VV, PP or II."""
        pairs = (line.rstrip(";").partition(":") for line in self.command(name).lines)
        return {key: value for key, _, value in pairs}

    def command(self, command: str) -> Reply:
        """The reply to a command.

        Raises:
            DeviceError: none comes.
        """
        return self.ask(command).reply

    def ask(self, command: str) -> Answer:
        """As `command`, with its times."""
        begin_s = self._clock()
        for _ in range(ATTEMPTS):
            if (answer := self._ask_once(command)) is not None:
                # What answers a second attempt may be a late answer to the first.
                return replace(answer, before_s=min(begin_s, answer.before_s))
        raise DeviceError(
            f"{self.name}: no answer from the scanner to {command}",
            advice="Is this the scanner's port? On RS-232 its speed must be set first; USB and TCP have none.",
        )

    def _ask_once(self, command: str) -> Answer | None:
        before_s = self._clock()
        self.transport.write(f"{command}\n".encode("ascii"))
        after_s = self._clock()
        end_s = after_s + REPLY_TIMEOUT_S
        while (left_s := end_s - self._clock()) > 0:
            replies = self._parser.feed(self.transport.read(left_s))
            heard_s = self._clock()
            for k, reply in enumerate(replies):
                if reply.echo == command and reply.status != STATUS_DATA:
                    self._replies = replies[k + 1 :]
                    return Answer(reply, before_s, after_s, heard_s)
        return None
