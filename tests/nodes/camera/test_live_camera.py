"""Sessions of one camera: what is learnt, what is published, and what a killed node does when it comes back."""

from dataclasses import replace

import pytest

from nodes.camera.live_camera import IDLE, LiveCamera, Resumed
from nodes.camera.session_marks import SessionMark, SessionMarks
from nodes.camera.spot_batches import BatchOptions
from nodes.detection.spots import DetectorOptions
from tests.nodes.detection.small_scene import Scene, light

N_LEARNING = 15
T0_NS = 1_700_000_000 * 10**9


@pytest.fixture(scope="module")
def frames():
    """25 frames a second: the empty room, then the spot on its way."""
    scene = Scene()
    out = [scene.frame() for _ in range(N_LEARNING)]
    out += [scene.frame(light(40 + 5 * k, 60 + 3 * k)) for k in range(45)]
    return [replace(frame, stamp_ns=T0_NS + frame.stamp_ns) for frame in out]


def camera(marks=None):
    return LiveCamera(DetectorOptions(n_learning_frames=N_LEARNING), BatchOptions("C0", 25.0, 80_000_000), marks)


def fed(live, frames):
    return [batch for frame in frames for batch in live.take(frame, n_dropped=0, began_ns=7)]


def rows(batches):
    """What stands in messages: by frame, its spots."""
    out = []
    for batch in batches:
        spots = list(zip(batch.spot_frame, batch.x_px, batch.y_px, batch.sigma_px, batch.score, strict=True))
        for k, sequence in enumerate(batch.frame_sequence):
            out.append((sequence, [spot[1:] for spot in spots if spot[0] == k]))
    return out


@pytest.fixture(scope="module")
def whole(frames):
    """An undisturbed session."""
    live = camera()
    live.begin("s")
    return rows(fed(live, frames) + live.flush())


def test_before_a_session_nothing_is_published(frames):
    live = camera()
    assert fed(live, frames) == []
    assert live.flush() == []
    assert (live.state, live.counts.n_frames) == (IDLE, len(frames))


def test_all_watched_frames_are_published_with_or_without_a_spot(frames, whole):
    assert [sequence for sequence, _ in whole] == [frame.sequence for frame in frames[N_LEARNING:]]
    assert sum(bool(spots) for _, spots in whole) > 40
    x_px = whole[10][1][0][0]
    assert x_px == pytest.approx(90, abs=0.5)


def test_states_follow_the_frames(frames):
    live = camera()
    live.begin("s")
    assert live.state == "learning"
    fed(live, frames[:N_LEARNING])
    fed(live, frames[N_LEARNING : N_LEARNING + 1])
    assert live.state == "watching"
    live.relearn()
    fed(live, frames[N_LEARNING + 1 : N_LEARNING + 2])
    assert live.state == "learning"
    live.end()
    assert (live.state, live.session, live.flush()) == (IDLE, "", [])


@pytest.mark.parametrize("n_before", [N_LEARNING + 1, N_LEARNING + 20])
def test_a_killed_node_goes_on_as_if_nothing_had_been(frames, whole, tmp_path, n_before):
    journal = tmp_path / "node.journal"
    first = camera(SessionMarks(journal))
    first.begin("s")
    journalled = rows(fed(first, frames[:n_before]))
    # Killed: what was gathered and not handed on is gone. The next process knows the files only.
    second = camera(SessionMarks(journal))
    mark = second.mark_of("s")
    assert mark is not None
    last = journalled[-1][0] if journalled else -1
    second.begin("s", Resumed(mark, last))
    again = [frame for frame in frames if frame.sequence >= mark.first_sequence]
    assert journalled + rows(fed(second, again) + second.flush()) == whole


def test_a_background_learnt_anew_is_learnt_anew_again(frames, tmp_path):
    first = camera(SessionMarks(tmp_path / "j"))
    first.begin("s")
    batches = fed(first, frames[:30])
    first.relearn()
    batches += fed(first, frames[30:]) + first.flush()
    second = camera(SessionMarks(tmp_path / "j"))
    second.begin("s", Resumed(second.mark_of("s")))
    assert rows(fed(second, frames) + second.flush()) == rows(batches)


def test_a_spot_in_the_frames_that_a_late_camera_learns_from_leaves_no_trail(frames):
    moving = frames[N_LEARNING:]
    live = camera()
    live.begin("s", Resumed(None))
    # Learnt from frames with the spot on its way; where it had been it must be found again.
    fed(live, moving[: N_LEARNING + 1])
    back = [replace(frame, sequence=1000 + k) for k, frame in enumerate(moving[:N_LEARNING])]
    found = rows(fed(live, back) + live.flush())
    assert sum(bool(spots) for _, spots in found) >= 12


def test_marks_outlive_the_process_and_damage(tmp_path):
    journal = tmp_path / "j"
    marks = SessionMarks(journal)
    marks.begin("C0", SessionMark("s", 5, 9))
    marks.relearn("C0", 8)
    marks.relearn("C1", 8)
    assert SessionMarks(journal).of("C0", "s") == SessionMark("s", 5, 9, (8,))
    assert SessionMarks(journal).of("C0", "other") is None
    assert SessionMarks(journal).of("C1", "s") is None
    for damage in ("", "[]", '{"C0": {}}', '{"C0": 3}'):
        (tmp_path / "j.marks").write_text(damage)
        assert SessionMarks(journal).of("C0", "s") is None


def test_a_late_camera_that_is_killed_begins_again_as_late(frames, tmp_path):
    moving = frames[N_LEARNING - 2 :]
    first = camera(SessionMarks(tmp_path / "j"))
    first.begin("s", Resumed(None))
    batches = fed(first, moving) + first.flush()
    second = camera(SessionMarks(tmp_path / "j"))
    second.begin("s", Resumed(second.mark_of("s")))
    assert rows(fed(second, moving) + second.flush()) == rows(batches)
