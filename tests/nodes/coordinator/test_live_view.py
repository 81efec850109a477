import io
import os
import pty
import sys

import numpy as np
import pytest
from rich.console import Console

from nodes.bus import spotcal_pb2 as pb
from nodes.bus.keys import Role
from nodes.coordinator.coverage import CameraSeen, LrfSeen
from nodes.coordinator.keyboard import Keyboard, presses_of
from nodes.coordinator.live_result import LiveResult
from nodes.coordinator.live_view import CameraRow, LrfRow, PlainLines, View, render
from nodes.coordinator.phases import Phase, Press
from nodes.coordinator.presence import NodeSeen
from nodes.coordinator.view_rows import Rates, camera_rows, crossings_told, lrf_rows, warnings_of
from nodes.frames import StampOrigin
from nodes.site.model import NodeEntry

CAMERAS = (
    CameraRow("C0", True, "watching", 29.9, 300, 200, 0.5, 3, "PTP 0.01 ms"),
    CameraRow("C1", False, "", 0.0, 120, 80, 0.25, 0, "–"),
)
VIEW = View(
    site="lab",
    session="one",
    phase=Phase.WAVING,
    phase_s=12.0,
    message="wave in front of C1",
    cameras=CAMERAS,
    lrfs=(LrfRow("L0", True, "collecting", 1, 3, 0.2, 7, 0.004),),
    names=("C0", "C1"),
    shared=np.array([[200, 44], [44, 80]]),
    islands=(("C0",), ("C1",)),
    live=LiveResult(sigma=3e-3, worst="C1", n_instants=400),
    lacks=("C1 shares 44 of 100 instants with another camera",),
    guidance=("wave in front of C1", "then there"),
    warnings=("C1: too dark",),
    keys="Enter: go on",
)


def shown(view, width=100):
    out = io.StringIO()
    Console(file=out, width=width).print(render(view))
    return out.getvalue()


def test_everything_that_a_person_needs_is_shown():
    text = shown(VIEW)
    for expected in (
        *("lab, session one", "waving", "wave in front of C1", "29.9", "50%", "PTP 0.01 ms", "missing", "44"),
        *("2 of 3", "11.5°", "4 mm", "C0 | C1", "3 mm", "C1 shares 44 of 100", "then there", "too dark", "Enter"),
    ):
        assert expected in text


def test_a_hundred_cameras_make_no_matrix():
    names = tuple(f"C{c}" for c in range(100))
    view = View("lab", "one", Phase.WAVING, 0.0, "", names=names, shared=np.ones((100, 100), dtype=np.int64))
    assert "Common instants" not in shown(view)


def test_names_from_the_bus_are_no_markup():
    assert "[red]" in shown(View("[red]", "one", Phase.IDLE, 0.0, "[/]"))


class TestPlainLines:
    def test_tells_what_is_new_once(self):
        plain = PlainLines()
        first = plain.lines(VIEW, now_s=0.0)
        assert first == ["warning: C1: too dark", "waving: wave in front of C1"]
        assert plain.lines(VIEW, now_s=1.0) == []

    def test_tells_now_and_then_where_it_stands(self):
        plain = PlainLines()
        plain.lines(VIEW, now_s=0.0)
        lines = plain.lines(VIEW, now_s=11.0)
        assert lines[0] == "waving, 12 s: wave in front of C1"
        assert "  spots: C0 200 (50%), C1 80 (25%)" in lines
        assert plain.lines(VIEW, now_s=12.0) == []

    def test_tells_each_phase(self):
        plain = PlainLines()
        told = [plain.lines(View("lab", "one", phase, 0.0, "go"), now_s=0.0)[-1] for phase in Phase]
        assert told == [f"{phase.value}: go" for phase in Phase]


class TestRows:
    def seen(self, **status):
        header = pb.Header(clock=pb.ClockQuality(source=pb.CLOCK_SOURCE_NTP, sigma_s=2e-3))
        return (NodeSeen("n", Role.CAMERA, True, pb.NodeStatus(header=header, **status), 1.0),)

    def test_camera(self):
        camera = CameraSeen("C0", "n", (800, 600), 30.0, StampOrigin.CAMERA, n_frames=90)
        rates = Rates()
        rates.look({"C0": 30}, now_s=1.0)
        rates.look({"C0": 90}, now_s=3.0)
        (row,) = camera_rows([camera], self.seen(state="watching"), rates)
        assert (row.rate_hz, row.state, row.is_there, row.clock) == (30.0, "watching", True, "NTP 2 ms")

    def test_a_camera_of_a_node_that_was_never_heard(self):
        camera = CameraSeen("C0", "other", (800, 600), None, StampOrigin.CAMERA)
        rows = camera_rows([camera], self.seen(state="learning"), Rates())
        assert [(row.name, row.is_there, row.state) for row in rows] == [("C0", False, ""), ("n", True, "learning")]

    def test_nodes_that_are_expected_are_shown_before_they_come(self):
        entries = [NodeEntry(name="n"), NodeEntry(name="late"), NodeEntry(name="lrf", role="lrf")]
        rows = camera_rows([], self.seen(), Rates(), expected=entries)
        assert [(row.name, row.is_there) for row in rows] == [("late", False), ("n", True)]

    def test_lrf(self):
        lrf = LrfSeen("L0", "n", crossings={0: 12, 1: 3}, tilt_rad={0: 0.0, 1: 0.2})
        (row,) = lrf_rows([lrf], self.seen(setting=1, n_settings=3, n_crossings=5, plane_sigma_m=0.01))
        assert (row.setting, row.tilt_rad, row.n_crossings, row.plane_sigma_m) == (1, 0.2, 5, 0.01)
        assert crossings_told([row]) == ("L0 has 5 crossings at tilt 2 of 3",)

    def test_warnings(self):
        told = warnings_of(self.seen(message="lost", advice=["darker"], journal_dropped=7))
        assert told[:2] == ("n: lost", "n: darker")
        assert "7 rows" in told[2]


class TestKeyboard:
    @pytest.mark.parametrize(
        ("typed", "expected"),
        [
            ("\n", (Press.ON,)),
            (" ", (Press.ON,)),
            ("x1", ()),
            ("Sq", (Press.SOLVE, Press.QUIT)),
            ("rn", (Press.RELEARN, Press.TILT)),
        ],
    )
    def test_keys(self, typed, expected):
        assert presses_of(typed) == expected

    def test_no_terminal_no_keys(self, monkeypatch):
        monkeypatch.setattr(sys, "stdin", io.StringIO("s"))
        with Keyboard() as keyboard:
            assert not keyboard.is_there
            assert keyboard.presses() == ()

    def test_a_key_comes_at_once_and_the_terminal_is_put_back(self, monkeypatch):
        import termios

        ours, theirs = pty.openpty()
        try:
            monkeypatch.setattr(sys, "stdin", os.fdopen(os.dup(theirs)))
            # A pseudo-terminal controls no session here; that it is this job's own is taken for granted.
            monkeypatch.setattr(os, "tcgetpgrp", lambda _fd: os.getpgrp())
            before = termios.tcgetattr(theirs)
            with Keyboard() as keyboard, sys.stdin:
                os.write(ours, b"s")
                assert keyboard.presses() == (Press.SOLVE,)
                assert keyboard.presses() == ()
                keyboard.__exit__(None, None, None)
            assert termios.tcgetattr(theirs) == before
        finally:
            os.close(ours)
            os.close(theirs)
