"""Commands to a node: checked, run once, answered whatever happens."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from contextlib import suppress

from network_calib.errors import SpotcalError
from nodes.bus import spotcal_pb2 as pb
from nodes.bus.check_calls import parse_command
from nodes.bus.checks import MAX_TEXT, MessageError
from nodes.bus.keys import Verb
from nodes.devices.errors import DeviceError
from nodes.journal import Journal

# Answers kept for askers whose answer got lost and who ask again.
N_REMEMBERED = 64
Handler = Callable[[Verb, pb.Command], pb.Reply]


class CommandDesk:
    """Runs commands one after the other; one thread calls it.

    Attributes:
        handler: what the node does; whatever it raises becomes a reply FAILED.
    """

    def __init__(self, journal: Journal, handler: Handler | None) -> None:
        self.handler = handler
        self._journal = journal
        self._remembered: OrderedDict[bytes, pb.Reply] = OrderedDict()

    def answer(self, verb: Verb | None, payload: bytes, *, call: bytes, now_ns: int) -> pb.Reply:
        """The reply, its header still empty.

        Args:
            verb: as the key says; None for none that is known.
            payload: a Command.
            call: the asker's id of this request; one that was answered is not run again. Empty: none.
            now_ns: this machine's clock.
        """
        if call and call in self._remembered:
            return self._remembered[call]
        reply = self._checked(verb, payload, now_ns)
        if call:
            self._remembered[call] = reply
            while len(self._remembered) > N_REMEMBERED:
                self._remembered.popitem(last=False)
        return reply

    def _checked(self, verb: Verb | None, payload: bytes, now_ns: int) -> pb.Reply:
        if verb is None:
            return pb.Reply(code="UNKNOWN", message=f"expected one of {', '.join(Verb)}")
        try:
            command = parse_command(payload, now_ns=now_ns)
        except MessageError as error:
            return pb.Reply(code="FAILED", message=f"the command is refused: {error.reason}")
        match verb:
            case Verb.START:
                return self._start(command)
            case Verb.STOP:
                return self._stop(command)
            case _:
                return self._run(verb, command)

    def _start(self, command: pb.Command) -> pb.Reply:
        session, before = command.header.session, self._journal.session
        if not session:
            return pb.Reply(code="FAILED", message="start: the command's header names no session")
        if session == before:
            return pb.Reply(code="OK", message=f"session {session} is running")
        self._enter(session)
        reply = self._run(Verb.START, command)
        if reply.code != "OK":
            # Otherwise the next try would find the session running, and nothing would run.
            self._enter(before)
        return reply

    def _stop(self, command: pb.Command) -> pb.Reply:
        session, running = command.header.session, self._journal.session
        if session and running and session != running:
            return pb.Reply(code="OK", message=f"session {session} is over; {running} is running")
        self._enter("")
        return self._run(Verb.STOP, command)

    def _enter(self, session: str) -> None:
        # It counts for this process; the next row that cannot be written tells the fault in the status.
        with suppress(DeviceError):
            self._journal.session = session

    def _run(self, verb: Verb, command: pb.Command) -> pb.Reply:
        if self.handler is None:
            return pb.Reply(code="UNSUPPORTED", message=f"this node knows no {verb}")
        try:
            return self.handler(verb, command)
        except SpotcalError as error:
            return pb.Reply(code="FAILED", message=str(error)[:MAX_TEXT])
        except Exception as error:  # whatever a device or its driver raises: the asker is told, the node goes on
            return pb.Reply(code="FAILED", message=f"{type(error).__name__}: {error}"[:MAX_TEXT])
