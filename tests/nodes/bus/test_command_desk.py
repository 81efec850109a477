import pytest

from network_calib.errors import InputError
from nodes.bus import spotcal_pb2 as pb
from nodes.bus.command_desk import N_REMEMBERED, CommandDesk
from nodes.bus.keys import Verb
from nodes.devices.errors import DeviceError
from nodes.journal import Journal
from tests.nodes.bus.good_messages import NOW_NS, header


class Handler:
    """Remembers what it was asked, and in which session."""

    def __init__(self, journal, answer=None):
        self.journal, self.answer, self.asked = journal, answer, []

    def __call__(self, verb, command):
        self.asked.append((verb, self.journal.session, command.number))
        if isinstance(self.answer, Exception):
            raise self.answer
        return self.answer or pb.Reply(code="OK")


@pytest.fixture
def journal(tmp_path):
    with Journal(tmp_path / "j") as opened:
        yield opened


@pytest.fixture
def handler(journal):
    return Handler(journal)


@pytest.fixture
def desk(journal, handler):
    return CommandDesk(journal, handler)


def ask(desk, verb, session="", *, number=0.0, call=b""):
    command = pb.Command(header=header(), number=number)
    command.header.session = session
    return desk.answer(verb, command.SerializeToString(), call=call, now_ns=NOW_NS)


def test_start_enters_the_session_before_the_handler_and_stop_leaves_it(desk, handler, journal):
    assert ask(desk, Verb.START, "S1").code == "OK"
    assert journal.session == "S1"
    assert ask(desk, Verb.STOP, "S1").code == "OK"
    assert journal.session == ""
    assert [(verb, session) for verb, session, _ in handler.asked] == [(Verb.START, "S1"), (Verb.STOP, "")]


def test_the_same_session_started_twice_is_started_once(desk, handler):
    assert [ask(desk, Verb.START, "S1").code for _ in range(2)] == ["OK", "OK"]
    assert len(handler.asked) == 1


def test_a_node_that_was_started_again_within_a_session_is_not_started_twice(journal, handler):
    journal.session = "S1"
    assert ask(CommandDesk(journal, handler), Verb.START, "S1").code == "OK"
    assert handler.asked == []


@pytest.mark.parametrize("answer", [pb.Reply(code="BUSY"), DeviceError("no camera")])
def test_a_start_that_failed_leaves_the_session_so_that_the_next_try_runs(journal, answer):
    handler = Handler(journal, answer)
    desk = CommandDesk(journal, handler)
    assert ask(desk, Verb.START, "S1").code in {"BUSY", "FAILED"}
    assert journal.session == ""
    ask(desk, Verb.START, "S1")
    assert len(handler.asked) == 2


def test_a_start_without_a_session_is_refused(desk, handler):
    assert ask(desk, Verb.START).code == "FAILED"
    assert handler.asked == []


def test_a_stop_of_another_session_does_not_end_the_running_one(desk, journal, handler):
    ask(desk, Verb.START, "S2")
    assert ask(desk, Verb.STOP, "S1").code == "OK"
    assert journal.session == "S2"
    assert [verb for verb, _, _ in handler.asked] == [Verb.START]


@pytest.mark.parametrize(
    ("error", "message"),
    [
        (InputError("exposure 9 s", advice="At most 1 s."), "exposure 9 s\nAt most 1 s."),
        (ZeroDivisionError("by zero"), "ZeroDivisionError: by zero"),
        (RuntimeError("x" * 9000), "RuntimeError: " + "x" * (4096 - len("RuntimeError: "))),
    ],
)
def test_whatever_a_handler_raises_becomes_a_reply(journal, error, message):
    reply = ask(CommandDesk(journal, Handler(journal, error)), Verb.EXPOSURE)
    assert (reply.code, reply.message) == ("FAILED", message)


def test_unknown_verbs_bad_messages_and_no_handler_are_answered(desk, journal, handler):
    assert ask(desk, None).code == "UNKNOWN"
    bad = desk.answer(Verb.NEXT, b"\xff", call=b"", now_ns=NOW_NS)
    assert (bad.code, bad.message) == ("FAILED", "the command is refused: message: no protobuf of its type")
    assert ask(desk, Verb.EXPOSURE, number=float("nan")).code == "FAILED"
    assert ask(CommandDesk(journal, None), Verb.NEXT).code == "UNSUPPORTED"
    assert handler.asked == []


def test_a_call_is_run_once_as_long_as_it_is_remembered(desk, handler):
    for _ in range(2):
        assert ask(desk, Verb.NEXT, call=b"first").code == "OK"
    assert len(handler.asked) == 1
    for i in range(N_REMEMBERED):
        ask(desk, Verb.NEXT, call=b"%d" % i)
    ask(desk, Verb.NEXT, call=b"first")
    assert len(handler.asked) == N_REMEMBERED + 2
