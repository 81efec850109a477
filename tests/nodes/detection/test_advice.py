import numpy as np
import pytest

from nodes.detection.advice import ExposureWatch, FrameFacts
from nodes.detection.spots import AdviceKind, DetectorState, Spot


def spot(*, peak=0.5, smear_px=0.0, is_saturated=False, score=0.8):
    return Spot(np.zeros(2), 0.01 * np.eye(2), score, peak, 1.5, smear_px, is_saturated)


def advised(*spots, brightness=0.3, n=1, **facts):
    """Advice after frames with these spots, all of them `n` times."""
    watch = ExposureWatch()
    for _ in range(n):
        for one in spots:
            watch.note(
                FrameFacts(
                    state=facts.get("state", DetectorState.WATCHING),
                    spot=one,
                    brightness=brightness,
                    blind_share=facts.get("blind_share", 0.0),
                    exposure_s=facts.get("exposure_s"),
                )
            )
    return watch.advice()


def kinds(advice):
    return [one.kind for one in advice]


def test_a_good_picture_needs_no_advice():
    assert advised(spot(), n=100) == ()


def test_too_few_frames_give_no_advice():
    assert advised(spot(is_saturated=True, peak=3.0), n=5) == ()


@pytest.mark.parametrize(("peak", "words"), [(1.1, "about a half"), (1.9, "about a third"), (3.0, "about a fifth")])
def test_a_saturated_spot_tells_by_how_much(peak, words):
    (advice,) = advised(spot(is_saturated=True, peak=peak), spot(), spot(is_saturated=True, peak=peak), n=40)
    assert advice.kind is AdviceKind.SATURATED
    assert "67%" in advice.message
    assert advice.message.endswith(words)


def test_a_few_saturated_frames_are_no_matter():
    assert advised(spot(is_saturated=True, peak=2.0), *[spot()] * 9, n=10) == ()


def test_a_dim_spot_tells_its_height_and_the_factor():
    (advice,) = advised(spot(peak=0.06), n=60)
    assert advice.kind is AdviceKind.TOO_DIM
    assert "6%" in advice.message
    assert "10 times" in advice.message


def test_a_smeared_spot_tells_length_and_exposure():
    (advice,) = advised(spot(smear_px=18.0), n=60, exposure_s=0.02)
    assert advice.kind is AdviceKind.SMEARED
    assert "18 px" in advice.message
    assert "about a third (now 20 ms)" in advice.message
    assert advised(spot(smear_px=5.0), n=60, exposure_s=0.02) == ()


def test_glare_is_told_with_its_share():
    (advice,) = advised(spot(), n=60, blind_share=0.23)
    assert advice.kind is AdviceKind.BACKGROUND_TOO_BRIGHT
    assert "23%" in advice.message


def test_flicker_is_told_and_one_switched_lamp_is_not():
    watch = ExposureWatch()
    for k in range(100):
        watch.note(FrameFacts(DetectorState.WATCHING, spot(), 0.3 if k < 50 else 0.4, 0.0))
    assert watch.advice() == ()
    for k in range(250):
        watch.note(FrameFacts(DetectorState.WATCHING, spot(), 0.3 + 0.01 * (k % 2), 0.0))
    (advice,) = watch.advice()
    assert advice.kind is AdviceKind.UNSTEADY_LIGHT
    # 0.01 from frame to frame in a mean of 0.305.
    assert "3.3%" in advice.message


def test_light_that_changes_again_and_again_is_told():
    watch = ExposureWatch()
    for _ in range(4):
        for state, n in ((DetectorState.WATCHING, 20), (DetectorState.RELEARNING, 12)):
            for _ in range(n):
                watch.note(FrameFacts(state, spot() if state is DetectorState.WATCHING else None, 0.3, 0.0))
    (advice,) = watch.advice()
    assert advice.kind is AdviceKind.UNSTEADY_LIGHT
    assert "4 times" in advice.message


def test_nothing_seen_counts_the_frames_and_ends_with_a_spot():
    assert advised(None, n=100) == ()
    (advice,) = advised(None, n=150)
    assert advice.kind is AdviceKind.NOTHING_SEEN
    assert "150 frames" in advice.message
    assert kinds(advised(*[None] * 150, spot())) == []


def test_what_is_hardly_a_spot_is_no_spot():
    assert kinds(advised(spot(score=0.1, is_saturated=True, peak=2.0), n=150)) == [AdviceKind.NOTHING_SEEN]


def test_the_past_is_forgotten():
    watch = ExposureWatch()
    for one in [spot(is_saturated=True, peak=2.0)] * 300 + [spot()] * 250:
        watch.note(FrameFacts(DetectorState.WATCHING, one, 0.3, 0.0))
    assert watch.advice() == ()
