"""The bookkeeping of decoding, on a decoder that does as it is told."""

from types import SimpleNamespace
from typing import Any

import pytest
from av.error import InvalidDataError

from nodes.devices.cameras.video_decode import PicturePass
from nodes.devices.cameras.video_open import OpenVideo

FAIL = "fail"


def packet(pts, *, key=False, corrupt=False, discard=False):
    return SimpleNamespace(pts=pts, dts=0, size=1, duration=1, is_keyframe=key, is_corrupt=corrupt, is_discard=discard)


def picture(pts, *, key=False, corrupt=False):
    return SimpleNamespace(pts=pts, dts=None, key_frame=key, is_corrupt=corrupt)


def run(script: list[tuple[Any, Any]], *, keep_damaged=False, is_timed=True):
    """What is delivered as (number, time) when each packet makes the decoder give these pictures, or fail."""
    answers = iter([given for _, given in script])

    def decode(_packet):
        given = next(answers)
        if given == FAIL:
            raise InvalidDataError(0, "")
        return given

    def demux(_stream):
        yield from (sent for sent, _ in script if sent is not None)

    codec = SimpleNamespace(canonical_name="any")
    stream: Any = SimpleNamespace(codec_context=SimpleNamespace(codec=codec, extradata=None, decode=decode))
    container: Any = SimpleNamespace(demux=demux)
    done = PicturePass(OpenVideo(container, stream, is_timed=is_timed, is_strict=True), keep_damaged=keep_damaged)
    return [(number, shown.pts) for number, shown in done], done


def test_every_frame_has_its_number():
    script = [(packet(k, key=k == 0), [picture(k, key=k == 0)]) for k in range(4)] + [(None, [])]
    delivered, done = run(script)
    assert delivered == [(0, 0), (1, 1), (2, 2), (3, 3)]
    assert (done.n_packets, done.n_lost, done.n_doubtful, done.n_backward, done.end_pts) == (4, 0, 0, 0, 4)


def test_what_is_decoded_before_a_loss_is_whole_though_shown_after():
    script = [
        (packet(0, key=True), []),
        (packet(2), [picture(0, key=True)]),
        (packet(1), [picture(1)]),
        (packet(4), FAIL),  # and swallows the picture of 2
        (packet(3), []),
        (packet(5, key=True), [picture(3)]),
        (None, [picture(5, key=True)]),
    ]
    delivered, done = run(script)
    assert delivered == [(0, 0), (1, 1), (5, 5)]
    assert (done.n_lost, done.n_doubtful) == (2, 1)


def test_a_picture_marked_as_faulty_is_left_out_with_those_built_on_it():
    script = [
        (packet(0, key=True), [picture(0, key=True)]),
        (packet(1), [picture(1, corrupt=True)]),
        (packet(2), [picture(2)]),
        (packet(3, key=True), [picture(3, key=True)]),
        (None, []),
    ]
    assert run(script)[0] == [(0, 0), (3, 3)]
    assert run(script, keep_damaged=True)[0] == [(k, k) for k in range(4)]


def test_a_loss_before_a_key_frame_is_no_leading_frame_though_the_key_frame_is_there_already():
    script = [
        (packet(0, key=True), [picture(0, key=True)]),
        (packet(1), []),  # lost in silence
        (packet(2), []),
        (packet(3, key=True), [picture(2)]),
        (None, [picture(3, key=True)]),
    ]
    delivered, done = run(script)
    assert delivered == [(0, 0), (3, 3)]
    assert (done.n_lost, done.n_doubtful) == (1, 1)


@pytest.mark.parametrize("given", [FAIL, []])
def test_a_lost_leading_frame_spoils_nothing(given):
    script = [
        (packet(0, key=True), [picture(0, key=True)]),
        (packet(3, key=True), []),
        (packet(2), given),
        (packet(4), [picture(3, key=True)]),
        (None, [picture(4)]),
    ]
    delivered, done = run(script)
    assert delivered == [(0, 0), (2, 3), (3, 4)]
    assert (done.n_lost, done.n_doubtful) == (1, 0)


def test_a_corrupt_packet_spoils_itself_and_the_next():
    script = [
        (packet(0, key=True), [picture(0, key=True)]),
        (packet(1, key=True, corrupt=True), [picture(1, key=True)]),
        (packet(2, key=True), [picture(2, key=True)]),
        (packet(3, key=True), [picture(3, key=True)]),
        (None, []),
    ]
    assert run(script)[0] == [(0, 0), (3, 3)]


def test_frames_that_are_to_be_left_out_by_the_file_are_no_loss():
    script = [
        (packet(0, key=True, discard=True), []),
        (packet(1, key=True), [picture(1, key=True)]),
        (None, []),
    ]
    delivered, done = run(script)
    assert (delivered, done.n_lost, done.n_packets) == ([(0, 1)], 0, 1)


def test_without_times_failures_are_counted_as_they_come():
    script = [
        (packet(7, key=True), [picture(9, key=True)]),
        (packet(7), FAIL),
        (packet(7, key=True), [picture(1, key=True)]),
        (None, []),
    ]
    delivered, done = run(script, is_timed=False)
    assert delivered == [(0, 9), (2, 1)]
    assert (done.n_lost, done.n_backward, done.end_pts) == (1, 0, None)


def test_time_that_stands_still_or_goes_back_is_left_out():
    times = [0, 1, 1, 0, 2]
    script = [(packet(time, key=True), [picture(time, key=True)]) for time in times] + [(None, [])]
    delivered, done = run(script)
    assert [time for _, time in delivered] == [0, 1, 2]
    assert done.n_backward == 2


def test_a_demuxer_that_fails_for_good_ends_the_pass_and_says_why():
    class Failing:
        def __iter__(self):
            return self

        def __next__(self):
            raise InvalidDataError(0, "broken")

    context = SimpleNamespace(codec=SimpleNamespace(canonical_name="any"), extradata=None, decode=lambda _packet: [])
    stream: Any = SimpleNamespace(codec_context=context)
    container: Any = SimpleNamespace(demux=lambda _stream: Failing())
    done = PicturePass(OpenVideo(container, stream, is_timed=True, is_strict=True), keep_damaged=False)
    assert list(done) == []
    assert done.read_error
