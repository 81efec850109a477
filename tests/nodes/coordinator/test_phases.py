from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from nodes.bus.keys import Role, Verb
from nodes.coordinator.orders import NodeNow, Order, Orders, due
from nodes.coordinator.phases import (
    LATE_BACKGROUND_S,
    Action,
    Facts,
    Phase,
    Press,
    Rules,
    State,
    advance,
    resumed,
)
from nodes.coordinator.session_message import message_of
from nodes.devices.errors import DeviceError

RULES = Rules(background_s=4.0, min_waving_s=20.0, max_waving_s=600.0)
AUTO = replace(RULES, is_auto=True)
ALL_THERE = Facts(now_s=1000.0, n_cameras=5)


def at(phase, since_s=1000.0):
    return State(phase, since_s)


def go(state, facts, rules=RULES, press=None):
    step = advance(state, facts, rules, press)
    return step.state.phase, step.actions


class TestIdle:
    def test_waits_for_a_key_however_many_are_there(self):
        assert go(at(Phase.IDLE), ALL_THERE) == (Phase.IDLE, ())
        assert go(at(Phase.IDLE), ALL_THERE, press=Press.ON) == (Phase.BACKGROUND, ())

    def test_auto_begins_when_all_expected_nodes_are_there(self):
        assert go(at(Phase.IDLE), replace(ALL_THERE, missing=("C3",)), AUTO)[0] is Phase.IDLE
        assert go(at(Phase.IDLE), replace(ALL_THERE, n_cameras=0), AUTO)[0] is Phase.IDLE
        assert go(at(Phase.IDLE), ALL_THERE, AUTO)[0] is Phase.BACKGROUND

    def test_a_key_begins_without_the_missing_and_says_so(self):
        step = advance(at(Phase.IDLE), replace(ALL_THERE, missing=("C3",)), RULES, Press.ON)
        assert step.state == State(Phase.BACKGROUND, 1000.0, "begun without C3")


class TestBackground:
    @pytest.mark.parametrize(("spent_s", "expected"), [(3.9, Phase.BACKGROUND), (4.0, Phase.WAVING)])
    def test_takes_its_time(self, spent_s, expected):
        assert go(at(Phase.BACKGROUND), replace(ALL_THERE, now_s=1000 + spent_s))[0] is expected

    def test_waits_for_those_who_learn_but_not_for_ever(self):
        learning = replace(ALL_THERE, learning=("C2",), now_s=1010.0)
        assert go(at(Phase.BACKGROUND), learning)[0] is Phase.BACKGROUND
        late = replace(learning, now_s=1000.0 + RULES.background_s + LATE_BACKGROUND_S)
        step = advance(at(Phase.BACKGROUND), late, RULES)
        assert step.state.phase is Phase.WAVING
        assert "C2" in step.state.warning

    def test_relearn_begins_again_also_while_waving(self):
        for phase in (Phase.BACKGROUND, Phase.WAVING):
            step = advance(at(phase), replace(ALL_THERE, now_s=1003.0), RULES, Press.RELEARN)
            assert step.state == State(Phase.BACKGROUND, 1003.0)
            assert step.actions == (Action.RELEARN,)


class TestWaving:
    def test_ends_when_it_is_enough_and_not_before_its_time(self):
        lacking = replace(ALL_THERE, now_s=1100.0, waving_lacks=("C1 has seen nothing",))
        assert go(at(Phase.WAVING), lacking)[0] is Phase.WAVING
        assert go(at(Phase.WAVING), replace(ALL_THERE, now_s=1019.0))[0] is Phase.WAVING
        assert go(at(Phase.WAVING), replace(ALL_THERE, now_s=1020.0)) == (Phase.SOLVING, (Action.SOLVE,))

    def test_lrfs_have_their_turn_before_the_solve(self):
        facts = replace(ALL_THERE, now_s=1020.0, n_lrfs=1, tilting=("L0",))
        assert go(at(Phase.WAVING), facts) == (Phase.TILTS, ())

    def test_ends_in_any_case_with_a_warning(self):
        lacking = replace(ALL_THERE, now_s=1600.0, waving_lacks=("C1 has seen nothing",))
        step = advance(at(Phase.WAVING), lacking, RULES)
        assert step.state.phase is Phase.SOLVING
        assert "C1 has seen nothing" in step.state.warning

    def test_solve_now(self):
        for phase in (Phase.BACKGROUND, Phase.WAVING, Phase.TILTS):
            assert go(at(phase), ALL_THERE, press=Press.SOLVE) == (Phase.SOLVING, (Action.SOLVE,))
        for phase in (Phase.IDLE, Phase.SOLVING, Phase.DONE):
            assert go(at(phase), ALL_THERE, press=Press.SOLVE) == (phase, ())


class TestTilts:
    def test_end_when_every_lrf_is_through(self):
        tilting = replace(ALL_THERE, n_lrfs=2, tilting=("L1",))
        assert go(at(Phase.TILTS), tilting) == (Phase.TILTS, ())
        assert go(at(Phase.TILTS), replace(tilting, tilting=())) == (Phase.SOLVING, (Action.SOLVE,))

    def test_a_dead_lrf_holds_nobody_up_for_ever(self):
        step = advance(at(Phase.TILTS), replace(ALL_THERE, n_lrfs=1, tilting=("L0",), now_s=1600.0), RULES)
        assert step.state.phase is Phase.SOLVING
        assert "L0" in step.state.warning

    def test_next_tilt_is_told_to_the_lrfs(self):
        assert go(at(Phase.TILTS), replace(ALL_THERE, n_lrfs=1, tilting=("L0",)), press=Press.TILT) == (
            Phase.TILTS,
            (Action.NEXT_TILT,),
        )


class TestEnd:
    def test_done_or_failed_by_the_solve(self):
        assert go(at(Phase.SOLVING), ALL_THERE) == (Phase.SOLVING, ())
        assert go(at(Phase.SOLVING), replace(ALL_THERE, solved="")) == (Phase.DONE, ())
        step = advance(at(Phase.SOLVING), replace(ALL_THERE, solved="too few spots"), RULES)
        assert step.state == State(Phase.FAILED, 1000.0, "too few spots")

    @given(phase=st.sampled_from(Phase))
    def test_quit_changes_no_phase(self, phase):
        assert go(at(phase), ALL_THERE, press=Press.QUIT) == (phase, (Action.QUIT,))

    @given(
        phase=st.sampled_from([Phase.DONE, Phase.FAILED]),
        press=st.sampled_from([None, *(press for press in Press if press is not Press.QUIT)]),
        solved=st.sampled_from([None, "", "why"]),
    )
    def test_what_is_over_stays_over(self, phase, press, solved):
        assert go(at(phase), replace(ALL_THERE, solved=solved), AUTO, press) == (phase, ())


@given(
    presses=st.lists(st.sampled_from([None, None, None, *(p for p in Press if p is not Press.QUIT)]), max_size=40),
    lacks=st.booleans(),
    n_lrfs=st.integers(0, 2),
)
def test_solve_is_begun_once_on_every_way_there(presses, lacks, n_lrfs):
    state, n_solves = at(Phase.IDLE, 0.0), 0
    for i, press in enumerate([*presses, Press.ON, Press.SOLVE]):
        facts = Facts(10.0 * i, n_cameras=2, waving_lacks=("more",) if lacks else (), n_lrfs=n_lrfs)
        step = advance(state, facts, RULES, press)
        state = step.state
        n_solves += Action.SOLVE in step.actions
    assert (state.phase, n_solves) == (Phase.SOLVING, 1)


class TestResumed:
    def test_goes_on_where_it_was(self):
        for phase in (Phase.IDLE, Phase.WAVING, Phase.TILTS):
            assert resumed(at(phase), RULES, now_s=1030.0, was_stopped=False).state == at(phase)

    def test_solves_again(self):
        assert resumed(at(Phase.SOLVING), RULES, now_s=1e6, was_stopped=False).actions == (Action.SOLVE,)

    def test_begins_with_the_background_where_nodes_were_stopped_or_the_solve_failed(self):
        fresh = State(Phase.BACKGROUND, 1030.0)
        assert resumed(at(Phase.WAVING), RULES, now_s=1030.0, was_stopped=True).state == fresh
        assert resumed(at(Phase.FAILED), RULES, now_s=1030.0, was_stopped=False).state == fresh

    def test_a_night_in_between_is_no_waving(self):
        step = resumed(at(Phase.WAVING), RULES, now_s=1000.0 + 40_000, was_stopped=False)
        assert step.state == State(Phase.WAVING, 41_000.0)


class TestMessage:
    def test_says_what_to_do(self):
        missing = replace(ALL_THERE, missing=("C3", "L0"))
        assert message_of(at(Phase.IDLE), missing, AUTO) == "waiting for C3, L0"
        assert "Enter" in message_of(at(Phase.IDLE), ALL_THERE, RULES)
        assert message_of(at(Phase.WAVING), ALL_THERE, RULES, guidance=("wave here", "or there")) == "wave here"
        assert message_of(State(Phase.FAILED, 0, "flat"), ALL_THERE, RULES) == "flat"


CAMERA = NodeNow("n1", Role.CAMERA, b"boot", "", "waiting")
LRF = NodeNow("n2", Role.LRF, b"boot", "", "waiting")
STARTED = frozenset({Order("n1", b"boot", Verb.START), Order("n2", b"boot", Verb.START)})


class TestOrders:
    def test_everybody_is_started_and_lrfs_tilted(self):
        assert due(Phase.IDLE, "s", [CAMERA, LRF], frozenset()) == ()
        assert [order.verb for order in due(Phase.WAVING, "s", [CAMERA, LRF], frozenset())] == [Verb.START] * 2
        assert due(Phase.WAVING, "s", [CAMERA, LRF], STARTED) == ()
        assert due(Phase.TILTS, "s", [CAMERA, LRF], STARTED) == (Order("n2", b"boot", Verb.TILTS),)

    def test_a_node_that_comes_back_is_told_again(self):
        back = replace(CAMERA, boot=b"other")
        assert due(Phase.WAVING, "s", [back], STARTED) == (Order("n1", b"other", Verb.START),)

    def test_an_lrf_that_is_at_its_tilts_or_through_is_left_alone(self):
        for lrf in (replace(LRF, state="collecting"), replace(LRF, is_through=True)):
            assert due(Phase.TILTS, "s", [lrf], STARTED) == ()

    def test_those_in_the_session_are_stopped_at_its_end(self):
        nodes = [replace(CAMERA, session="s"), replace(LRF, session="other")]
        for phase in (Phase.SOLVING, Phase.DONE, Phase.FAILED):
            assert due(phase, "s", nodes, STARTED) == (Order("n1", b"boot", Verb.STOP),)

    def test_an_lrf_whose_tilts_failed_is_asked_again_but_not_at_once(self):
        now_s, sent = [0.0], []
        lrf = replace(LRF, session="s", state="watching")
        with Orders(lambda node, verb: sent.append((node, verb)), clock_s=lambda: now_s[0]) as orders:
            for now_s[0] in (0.0, 1.0, 2.0, 10.0, 11.0):
                _settle(orders, Phase.TILTS, lrf)
        assert sent == [("n2", Verb.START), ("n2", Verb.TILTS), ("n2", Verb.TILTS)]

    def test_an_order_is_given_until_it_is_taken(self):
        now_s, sent, fails = [0.0], [], [True]

        def send(node, verb):
            sent.append((node, verb))
            if fails[0]:
                raise DeviceError("BUSY")

        with Orders(send, clock_s=lambda: now_s[0]) as orders:
            _settle(orders, Phase.WAVING)
            assert orders.refusals == ("n1: start: BUSY",)
            _settle(orders, Phase.WAVING)  # too early for another try
            assert len(sent) == 1
            fails[0], now_s[0] = False, 10.0
            _settle(orders, Phase.WAVING)
            now_s[0] = 20.0
            _settle(orders, Phase.WAVING)
        assert sent == [("n1", Verb.START)] * 2
        assert orders.refusals == ()


def _settle(orders, phase, node=CAMERA):
    """One step, and until its orders were given."""
    orders.step(phase, "s", [node])
    while any(at_s == float("inf") for at_s in orders._not_before_s.values()):
        pass
