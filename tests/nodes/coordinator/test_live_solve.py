import numpy as np
import pytest

from network_calib.cameras import Cameras
from network_calib.synthetic import compare
from nodes.camera.matching_frames import candidates_of, match_frames
from nodes.config_model import NoAnchor
from nodes.coordinator.coverage import Coverage
from nodes.coordinator.live_solve import (
    MAX_INSTANTS,
    MIN_INSTANTS,
    LiveInput,
    _calibrated,
    predicted_sigma,
    solve_live,
    thinned,
)
from nodes.coordinator.room_cells import emptiest_place
from tests.nodes.coordinator.waved_room import waved_room


@pytest.fixture(scope="module")
def waved():
    return waved_room(n_frames=900)


def recordings_of(waved, *, n_batches=None, names=None):
    coverage = Coverage()
    for name in names or waved.names:
        for batch in waved.batches[name][:n_batches]:
            coverage.add(batch, node=name)
    return coverage.detections()


def test_a_first_calibration_and_its_predicted_accuracy(waved):
    result = solve_live(LiveInput(recordings_of(waved), waved.config))
    assert result.not_yet == ""
    assert result.unit == "m"
    assert result.n_used == MAX_INSTANTS < result.n_instants <= 900
    assert result.worst in waved.names
    # 0.1 px at 3 m with a focal length of some 1000 px is 0.3 mm of one view; hundreds of instants and a baseline of
    # 0.35 m in a room of 6 m leave something between a tenth and ten times of it.
    assert 3e-5 < result.sigma < 3e-3
    assert any(name in result.emptiest for name in waved.names)


def test_the_prediction_is_what_all_instants_give(waved):
    given = LiveInput(recordings_of(waved), waved.config)
    matched = match_frames(given.recordings)
    every, n_instants = thinned(candidates_of(given.recordings, matched), most=10**9)
    few, _ = thinned(candidates_of(given.recordings, matched), most=200)
    whole, _ = _calibrated(every, given)
    part, observations = _calibrated(few, given)
    n_used = len(np.unique(observations.frame))
    predicted, _ = predicted_sigma(part, n_used=n_used, n_instants=n_instants)
    reached, _ = predicted_sigma(whole, n_used=n_instants, n_instants=n_instants)
    # Which 200 instants were drawn changes the geometry's strength by several percent; the noise is estimated from
    # some thousand residuals, so to 2 %. Without the root of 900/200 it would be off by a factor of 2.1.
    assert predicted == pytest.approx(reached, rel=0.25)
    # And what is predicted holds: of five centres hardly one is beyond 4 sigma.
    errors = compare(whole.as_cameras(), waved.truth.cameras, align="rigid")
    assert errors.centre_m.max() < 4 * reached


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ({"names": ["C0"]}, "C0 saw the spot, a network needs two"),
        ({"n_batches": 5}, f"{MIN_INSTANTS} are needed"),
    ],
)
def test_what_cannot_be_solved_yet_is_told(waved, options, told):
    result = solve_live(LiveInput(recordings_of(waved, **options), waved.config))
    assert told in result.not_yet
    assert result.advice != ""


def test_a_refusal_of_the_solve_is_told(waved):
    """A baseline between cameras of which one saw nothing."""
    result = solve_live(LiveInput(recordings_of(waved, names=["C1", "C2", "C3"]), waved.config))
    assert "C0" in result.not_yet


def test_cameras_that_saw_nothing_hinder_nobody(waved):
    result = solve_live(LiveInput(recordings_of(waved, names=["C0", "C1", "C2"]), waved.config))
    assert result.not_yet == ""


def test_without_an_anchor_there_are_no_metres(waved):
    room = waved.config.model_copy(update={"anchor": NoAnchor(kind="none")})
    assert solve_live(LiveInput(recordings_of(waved), room)).unit == "unit"


def test_thinning_keeps_whole_instants(waved):
    recordings = recordings_of(waved)
    candidates = candidates_of(recordings, match_frames(recordings))
    few, n_common = thinned(candidates, most=50)
    frames, n_rows = np.unique(few.frame, return_counts=True)
    assert len(frames) == 50
    assert (n_rows == np.array([(candidates.frame == frame).sum() for frame in frames])).all()
    assert n_rows.min() >= 2
    # Evenly spread: no gap of twice the mean.
    assert np.diff(frames).max() < 2.5 * n_common / 50


class TestEmptiestPlace:
    def test_is_the_corner_that_was_left_out(self, waved):
        """Spots everywhere in a box but in one of its corners."""
        rng = np.random.default_rng(0)
        low, high = np.array([1.5, 1.5, 0.5]), np.array([4.5, 3.5, 2.0])
        spots = rng.uniform(low, high, (4000, 3))
        hole = np.array([4.2, 3.2, 1.25])
        is_far = np.abs(spots[:, :2] - hole[:2]).max(axis=1) > 0.7
        told = emptiest_place(spots[is_far], waved.truth.cameras, unit="m")
        assert np.linalg.norm(_place(told, waved.truth.cameras) - hole) < 1.2

    def test_says_nothing_of_nothing(self, waved):
        assert emptiest_place(np.zeros((0, 3)), waved.truth.cameras, unit="m") == ""


def _place(told: str, cameras: Cameras):
    """The words read backwards."""
    words = told.replace(",", "").split()
    camera = cameras.names.index(words[5])
    front, across, along = float(words[0]), float(words[6]), float(words[12])
    across = across if words[10] == "right" else -across
    along = along if words[14] == "below" else -along
    return cameras.rotations[camera].T @ np.array([across, along, front]) + cameras.centres_in_world[camera]
