"""The study: figures by hand, sessions that repeat, refusals that are counted; and the rendered picture."""

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform

from lrf_stereo.study import (
    N_PROBES,
    PROBE_TILTS_DEG,
    Accuracy,
    Method,
    StudySetup,
    accuracy,
    gathered,
    run_once,
    run_study,
)
from lrf_stereo.synthetic import paper_scene
from lrf_stereo.synthetic_picture import render
from lrf_stereo.synthetic_scans import Capsule
from network_calib.errors import InputError

SHAPE = (len(PROBE_TILTS_DEG), N_PROBES)


def constant(px):
    return Accuracy(np.full(SHAPE, px), np.full(SHAPE, px / 100), np.full(5, px / 1000), np.full(5, px / 100))


def test_figures_are_of_the_median_run():
    spread = constant(2.0)
    spread.px[:, ::2] += 1.0
    errors = gathered(Method.SCREW, 9, [constant(1.0), spread, constant(400.0), None])
    # Means 1, 2.5, 400; deviations 0, 0.5, 0.
    assert (errors.average_px, errors.spread_px, errors.n_refused) == (2.5, 0.0, 1)
    assert errors.px.shape == (3, *SHAPE)
    assert errors.rotation_rad.shape == (3, 5)


def test_runs_that_are_all_refused_leave_no_errors():
    errors = gathered(Method.PAPER, 6, [None, None])
    assert (len(errors.px), errors.n_refused) == (0, 2)


def test_errors_of_the_truth_are_none_and_of_a_shift_are_the_shift():
    scene = paper_scene(rng=np.random.default_rng(1))
    # The products of reading and pose are rounded at 1e-15 of 5 m; 260 px over 1 m.
    assert accuracy(scene.scanner, scene).px.max() < 1e-11
    moved = scene.scanner.moved_by(RigidTransform.from_translation([0.01, 0.0, 0.0]))
    errors = accuracy(moved, scene)
    assert errors.translation_m == pytest.approx(np.full(5, 0.01), abs=1e-12)
    assert errors.space_m == pytest.approx(np.full(SHAPE, 0.01), abs=1e-12)
    # arccos of a number that is one but for rounding.
    assert errors.rotation_rad == pytest.approx(np.zeros(5), abs=1e-7)
    # Along x of the left camera: 2.6 px m over depths of 0.6 to 3.6 m.
    assert 2.6 / 3.6 < errors.px.min() < errors.px.max() < 2.6 / 0.6


def test_a_point_behind_the_camera_counts_as_the_diagonal():
    scene = paper_scene(rng=np.random.default_rng(1))
    errors = accuracy(scene.scanner.moved_by(RigidTransform.from_translation([0.0, 0.0, -20.0])), scene)
    assert (errors.px == 400.0).all()


def test_the_same_seed_gives_the_same_study_and_progress_is_told():
    told = []
    one, other = (
        run_study((Method.SCREW,), n_runs=2, seed=3, n_spots=(6, 9), progress=lambda *at: told.append(at))
        for _ in range(2)
    )
    assert told == 2 * [(1, 4), (2, 4), (3, 4), (4, 4)]
    for a, b in zip(one.errors, other.errors, strict=True):
        assert (a.px == b.px).all()
    assert not (one.of(Method.SCREW, 6).px[0] == one.of(Method.SCREW, 6).px[1]).any()


def test_methods_share_their_sessions():
    (alone,) = run_once((Method.SCREW,), StudySetup(), n_spots=9, run=0, seed=1)
    paper, screw = run_once((Method.PAPER, Method.SCREW), StudySetup(), n_spots=9, run=0, seed=1)
    assert alone is not None
    assert screw is not None
    assert paper is not None
    assert (alone.px == screw.px).all()
    assert not (paper.px == screw.px).all()


def test_rendered_ball_stands_where_the_camera_projects_it():
    scene = paper_scene(rng=np.random.default_rng(1))
    centre = np.array([0.3, -0.2, 2.5])
    empty, with_ball = render(scene), render(scene, [Capsule.ball(centre, diameter_m=0.4)])
    rows, columns = np.nonzero(empty != with_ball)
    px, _ = scene.cameras.img_from_world(np.array([0]), centre[None])
    x, y = px[0]
    # Half the angle of a 0.2 m ball at 2.53 m is 4.5°, 20.6 px across the view; 10° off the axis it is stretched by 3 %
    # and its middle lies a tenth of a pixel outwards. A pixel of rim on each side.
    assert (columns.min() + columns.max()) / 2 == pytest.approx(x, abs=1.0)
    assert (rows.min() + rows.max()) / 2 == pytest.approx(y, abs=1.0)
    assert columns.max() - columns.min() == pytest.approx(2 * 20.8, abs=2.0)
    assert empty.shape == (240, 320)
    assert 0 <= with_ball.min() < with_ball.max() <= 1


def test_a_camera_in_a_body_is_refused():
    scene = paper_scene(rng=np.random.default_rng(1))
    with pytest.raises(InputError, match="camera C0 stands outside the room or in a body"):
        render(scene, [Capsule.ball(np.zeros(3))])
