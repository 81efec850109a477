"""Candidates to observations: the planted spot is found beside brighter reflections, and single detections are kept."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from network_calib.candidates import Candidates
from network_calib.choose import choose
from network_calib.errors import InputError
from network_calib.observations import Observations
from network_calib.synthetic import observe, room


def planted(name, *, seed=1, brighter=0.3, dimmer=0.3, n_frames=800):
    """Candidates of a room, which of them are the spot, and image sizes.

    Of the spots, these shares have a rival at a random pixel that scores higher, or one that scores lower.
    """
    rng = np.random.default_rng(seed)
    scene = room(name, rng=rng, n_frames=n_frames)
    spots = observe(scene, rng=rng, sigma_px=0.2, missing=0.2).observations
    part = rng.random(len(spots))
    beside = np.flatnonzero(part < brighter + dimmer)
    rival_px = rng.uniform(0, scene.cameras.size_px[spots.camera[beside]] - 1)
    score = np.concatenate([rng.uniform(0.6, 0.8, len(spots)), np.where(part[beside] < brighter, 0.9, 0.4)])
    frame, camera = (
        np.concatenate([spots.frame, spots.frame[beside]]),
        np.concatenate([spots.camera, spots.camera[beside]]),
    )
    px = np.concatenate([spots.px, rival_px])
    candidates = Candidates.from_columns(spots.camera_names, camera=camera, frame=frame, px=px, score=score)
    is_spot = (candidates.score >= 0.6) & (candidates.score <= 0.8)
    sizes = {name: (int(w), int(h)) for name, (w, h) in zip(spots.camera_names, scene.cameras.size_px, strict=True)}
    return candidates, is_spot, sizes


def chosen_of(candidates, sizes=None, seed=0):
    return choose(candidates, rng=np.random.default_rng(seed), size_px=sizes)


def assert_same(a, b):
    assert a.camera_names == b.camera_names
    for name in ("camera", "frame", "px", "stamp_ns"):
        assert np.array_equal(getattr(a, name), getattr(b, name)), name
    assert np.array_equal(a.sigma_px, b.sigma_px, equal_nan=True)


@pytest.mark.parametrize("is_size_known", [True, False])
@pytest.mark.parametrize("name", ["smart_room", "ring_room", "corridor_chain", "wide_fisheye", "tele_beside_wide"])
def test_the_spot_is_found_beside_brighter_reflections(name, is_size_known):
    candidates, is_spot, sizes = planted(name, n_frames=2000 if name == "corridor_chain" else 800)
    chosen = chosen_of(candidates, sizes if is_size_known else None)
    n_views = np.bincount(candidates.frame, weights=is_spot)[candidates.frame]
    for views, most_wrong in ((n_views >= 3, 0.01), (n_views == 2, 0.04)):
        # A rival passes for the spot when it lies within some 4 sigma of the epipolar lines of the others' spots: 4 px
        # (0.5 px of detector and lens, twice that where the one bend does not describe the lens) to both sides of 480
        # or more, or 2 % for one line and a twentieth of that for two; and rivals of two cameras may agree with each
        # other as often. Twice that.
        wrong = views & ~is_spot & chosen.is_chosen
        assert wrong.sum() <= most_wrong * (views & is_spot).sum()
        assert (views & is_spot & chosen.is_chosen).sum() >= (1 - most_wrong) * (views & is_spot).sum()
    # The test means something: the score alone takes a rival in three of ten frames.
    assert (is_spot & candidates.is_best).sum() < 0.75 * is_spot.sum()
    assert chosen.n_preferred >= 0.25 * is_spot.sum()


def test_counts_are_those_of_the_choice():
    candidates, _, sizes = planted("smart_room", n_frames=300)
    chosen = chosen_of(candidates, sizes)
    pictures = list(zip(candidates.camera.tolist(), candidates.frame.tolist(), strict=True))
    assert chosen.n_several == len({picture for picture in pictures if pictures.count(picture) > 1})
    assert chosen.n_preferred == int((chosen.is_chosen & ~candidates.is_best).sum())
    assert len(chosen.observations) == int(chosen.is_chosen.sum()) == len(set(pictures)) - chosen.n_refused


@given(st.integers(0, 2**32 - 1))
def test_single_candidates_are_all_kept_and_unchanged(seed):
    rng = np.random.default_rng(seed)
    frame, camera = np.nonzero(rng.random((30, 4)) < rng.uniform(0.1, 1.0))
    names, n = ("A", "B", "C", "D"), len(frame)
    px, sigma, stamp = rng.uniform(0, 600, (n, 2)), rng.uniform(0.1, 1, n), 10**18 + frame * 40_000_000 + camera
    expected = Observations.from_columns(names, camera=camera, frame=frame, px=px, sigma_px=sigma, stamp_ns=stamp)
    score = rng.random(n)
    candidates = Candidates.from_columns(
        names, camera=camera, frame=frame, px=px, sigma_px=sigma, stamp_ns=stamp, score=score
    )
    chosen = chosen_of(candidates)
    assert_same(chosen.observations, expected)
    assert (chosen.n_several, chosen.n_preferred, chosen.n_refused) == (0, 0, 0)


def test_single_candidates_stay_beside_contested_ones():
    # A false detection that is alone in its picture is kept: to reject it is for the calibration.
    candidates, _, sizes = planted("smart_room", n_frames=300)
    is_single = (np.bincount(candidates.group)[candidates.group] == 1) & (candidates.camera == 0)
    px = candidates.px.copy()
    px[is_single] = np.random.default_rng(5).uniform(0, 479, (int(is_single.sum()), 2))
    moved = Candidates(
        candidates.camera_names, candidates.camera, candidates.frame, px, candidates.sigma_px, candidates.score
    )
    assert chosen_of(moved, sizes).is_chosen[is_single].all()


@settings(max_examples=10)
@given(st.integers(0, 2**32 - 1))
def test_the_order_of_the_rows_does_not_matter(seed):
    table, _, sizes = planted("smart_room", n_frames=60)
    order = np.random.default_rng(seed).permutation(len(table))
    shuffled = Candidates.from_columns(
        table.camera_names,
        camera=table.camera[order],
        frame=table.frame[order],
        px=table.px[order],
        score=table.score[order],
    )
    assert_same(chosen_of(shuffled, sizes).observations, chosen_of(table, sizes).observations)


def test_the_same_generator_state_gives_the_same_choice():
    candidates, _, _ = planted("ring_room", n_frames=300)
    assert np.array_equal(chosen_of(candidates, seed=3).is_chosen, chosen_of(candidates, seed=3).is_chosen)


def test_where_all_candidates_contradict_the_others_none_is_taken():
    candidates, is_spot, sizes = planted("ring_room", n_frames=400, brighter=0.0, dimmer=1.0)
    # In every fifth picture of C3 the spot is hidden and two reflections remain.
    px, hidden = candidates.px.copy(), np.flatnonzero(is_spot & (candidates.camera == 3) & (candidates.frame % 5 == 0))
    px[hidden] = np.random.default_rng(2).uniform(0, [639, 479], (len(hidden), 2))
    table = Candidates(
        candidates.camera_names, candidates.camera, candidates.frame, px, candidates.sigma_px, candidates.score
    )
    chosen = chosen_of(table, sizes)
    taken = chosen.is_chosen[(table.camera == 3) & (table.frame % 5 == 0)].sum()
    # One of 14 candidates-times-cameras lies within 2 % of a line, which is not enough against six that say no.
    assert taken <= 0.05 * len(hidden)
    assert chosen.n_refused >= 0.95 * len(hidden)


def test_where_no_other_camera_sees_the_track_goes_on():
    candidates, is_spot, sizes = planted("smart_room", n_frames=400, brighter=0.0, dimmer=0.0)
    # Every fourth frame only C2 sees, with a better-scored rival at the opposite place of the picture.
    is_alone = candidates.frame % 4 == 3
    kept = is_spot & (~is_alone | (candidates.camera == 2))
    rival = np.flatnonzero(kept & is_alone)
    opposite = np.array([639.0, 479.0]) - candidates.px[rival]
    is_far = np.linalg.norm(opposite - candidates.px[rival], axis=1) > 200
    rival, opposite = rival[is_far], opposite[is_far]
    rows = np.concatenate([np.flatnonzero(kept), rival])
    table = Candidates.from_columns(
        candidates.camera_names,
        camera=candidates.camera[rows],
        frame=candidates.frame[rows],
        px=np.concatenate([candidates.px[kept], opposite]),
        score=np.concatenate([np.full(int(kept.sum()), 0.7), np.full(len(rival), 0.9)]),
    )
    chosen = chosen_of(table, sizes)
    n = int((table.score == 0.9).sum())
    assert n > 30
    # A fifth of the detections is missing, so a chance of one in 25 that the frame before and that after are both
    # unknown; their neighbours in turn are two frames off, which the track still reaches. No more than those 4 %.
    assert (chosen.is_chosen & (table.score == 0.9)).sum() <= 0.04 * n


@pytest.mark.parametrize("order", [[0, 1, 2], [2, 1, 0]])
def test_equal_scores_are_told_apart_by_place_not_by_row(order):
    px = np.array([[3.0, 4.0], [1.0, 9.0], [1.0, 2.0]])[order]
    table = Candidates.from_columns(("A",), camera=[0] * 3, frame=[0] * 3, px=px, score=[0.5] * 3)
    assert chosen_of(table).observations.px.tolist() == [[1, 2]]


def test_without_geometry_the_best_score_wins():
    table = Candidates.from_columns(
        ("A",), camera=[0, 0, 0], frame=[0, 0, 1], px=[[1, 2], [3, 4], [5, 6]], score=[0.2, 0.9, 0.5]
    )
    assert chosen_of(table).observations.px.tolist() == [[3, 4], [5, 6]]


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"score": [0.5, 1.1]}, "score of camera 'A' in frame 7 is 1.1, expected 0 to 1"),
        ({"score": [0.5, np.nan]}, "score of camera 'A' in frame 7 is nan"),
        ({"score": [0.5]}, "score has 1 values, expected 2"),
        ({"stamp_ns": [1, 2]}, "camera 'A' has candidates of two stamps in frame 7: 1 and 2 ns"),
        ({"camera": [0, 1]}, r"camera index 0..1 outside 0..0"),
        ({"px": [[1, 2], [np.inf, 2]]}, "is not finite"),
    ],
)
def test_columns_at_fault_are_refused(changed, message):
    good = {"camera": [0, 0], "frame": [7, 7], "px": [[1, 2], [3, 4]], "score": [0.5, 0.4]}
    with pytest.raises(InputError, match=message):
        Candidates.from_columns(("A",), **(good | changed))
