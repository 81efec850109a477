"""The LRF block: its residual is what `scanner.py` measures, its Jacobians are its derivatives; so are the priors'."""

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from lrf_stereo.lrf_block import N_COLUMNS, SCANNERS, TILTS, LrfBlock
from lrf_stereo.lrf_priors import DistancePrior, InstrumentPrior, InstrumentSigma, TiltPrior
from lrf_stereo.samples import TiltSettings
from lrf_stereo.scanner import TiltingScanner
from lrf_stereo.scanner_part import N_GEOMETRY, N_SCANNER, SCANNER_TANGENT, ScannerPart, TiltPart
from network_calib.camera_block import PART
from network_calib.camera_parameters import CameraParameters
from network_calib.cameras import Cameras, LensModel, poses_from_centres

N_SCANNERS, TILTS_RAD = 2, np.radians([2.0, 25.0, 50.0, -10.0, 30.0])
SCANNER_OF = np.array([0, 0, 0, 1, 1])
# Central differences of 1e-5 rad, m or 1: truncation h^2 / 6 times third derivatives, below (4 m / 1 m^3), 1e-10;
# rounding 1e-15 * 4 m / 1e-5 = 4e-10; over sigmas of 0.1 or more, so ten times that, and ten for sums of such terms.
STEP, TOLERANCE = 1e-5, 1e-7


def a_scanner(rng):
    """A scanner with everything at work: oblique axis, gain, bias, scale, bearing zero."""
    return TiltingScanner(
        world_from_lrf=RigidTransform.from_components(rng.uniform(-1, 1, 3), Rotation.random(rng=rng)),
        axis_direction_in_world=rng.standard_normal(3),
        axis_point_in_world=rng.uniform(-1, 1, 3),
        reference_tilt_rad=rng.uniform(-0.2, 0.5),
        tilt_gain=rng.uniform(0.95, 1.05),
        range_bias_m=rng.uniform(-0.02, 0.02),
        range_scale=rng.uniform(0.98, 1.02),
        bearing_zero_rad=rng.uniform(-0.02, 0.02),
        clock_offset_s=rng.uniform(-0.1, 0.1),
    )


def whitening_of(rng, n):
    """(3, 3, n) lower triangles with 0.5 to 10 on the diagonal, as of a Cholesky factor."""
    below = np.tril(np.ones((3, 3)), -1)[:, :, None] * rng.uniform(-2, 2, (3, 3, n))
    return below + np.eye(3)[:, :, None] * rng.uniform(0.5, 10, (3, n))


def everything_free():
    """Columns of two scanners and five angles."""
    scanners = np.arange(N_SCANNERS * N_SCANNER).reshape(N_SCANNERS, N_SCANNER)
    return scanners, np.arange(len(TILTS_RAD))


@pytest.fixture(params=range(4))
def case(request):
    """Scanners, spots (3, 20) a metre to three from the LRF of their setting, the block, and its parts."""
    rng = np.random.default_rng(request.param)
    scanners = tuple(a_scanner(rng) for _ in range(N_SCANNERS))
    setting = np.repeat(np.arange(len(TILTS_RAD)), 4)
    in_lrf = np.column_stack([rng.uniform(1, 3, 20), rng.uniform(-2, 2, 20), rng.uniform(-0.3, 0.3, 20)])
    points = np.stack(
        [scanners[SCANNER_OF[t]].world_from_lrf_at(TILTS_RAD[t]).apply(x) for t, x in zip(setting, in_lrf, strict=True)]
    )
    of_scanner, of_tilt = everything_free()
    block = LrfBlock(
        group=setting,
        point=np.arange(20),
        measured=rng.uniform(-1, 1, (3, 20)),
        whitening=whitening_of(rng, 20),
        velocity=rng.uniform(-1, 1, (3, 20)),
        delay_s=rng.uniform(-0.1, 0.1, 20),
        scanner_of_setting=SCANNER_OF,
        reference_rad=np.array([scanner.reference_tilt_rad for scanner in scanners]),
        columns=np.column_stack([of_scanner[SCANNER_OF], of_tilt + of_scanner.size]),
    )
    parts = {SCANNERS: ScannerPart.from_scanners(scanners, of_scanner), TILTS: TiltPart(TILTS_RAD, of_tilt)}
    return scanners, np.ascontiguousarray(points.T), block, parts


def moved(parts, column, step):
    """The parts after a step along one global column."""
    change = np.zeros(parts[SCANNERS].size + parts[TILTS].size)
    change[column] = step
    first = parts[SCANNERS].size
    return {SCANNERS: parts[SCANNERS].retract(change[:first]), TILTS: parts[TILTS].retract(change[first:])}


ALL = slice(0, 20)


def raw(block, parts, points):
    """(3, 20) residuals before they were whitened."""
    return np.linalg.solve(block.whitening.transpose(2, 0, 1), block.residual(parts, points, ALL).T[:, :, None])[
        :, :, 0
    ].T


def test_residual_is_what_the_scanner_measures(case):
    scanners, points, block, parts = case
    residual = raw(block, parts, points) + block.measured
    for k, t in enumerate(block.group.tolist()):
        scanner = scanners[SCANNER_OF[t]]
        late_s = block.delay_s[k] + scanner.clock_offset_s
        velocity = scanner.world_from_lrf_at(TILTS_RAD[t]).rotation.apply(block.velocity[:, k])
        at_beam = points[:, k] + velocity * late_s
        range_m, bearing, height = scanner.measure(at_beam[None], TILTS_RAD[t])
        # Two orders of the same twenty products of numbers below 10: 20 * 10 * 2e-16, and some for arctan2; then
        # whitened and back, by triangles whose inverses have entries below 2 + 4 * 2 * 2 + 8 * 4.
        assert residual[0, k] == pytest.approx(range_m[0], abs=1e-11)
        assert np.sin(residual[1, k] - bearing[0]) == pytest.approx(0, abs=1e-11)
        assert residual[2, k] == pytest.approx(height[0], abs=1e-11)


def test_bearing_residual_is_wrapped(case):
    _, points, block, parts = case
    before = raw(block, parts, points)[1]
    block.measured[1] += 2 * np.pi
    after = raw(block, parts, points)[1]
    assert np.abs(after).max() <= np.pi + 1e-11
    assert np.abs(np.sin(after - before)).max() < 1e-11


@pytest.mark.parametrize("column", range(N_COLUMNS))
def test_jacobian_by_shared_columns(case, column):
    _, points, block, parts = case
    residual, by_shared, _ = block.linearise(parts, points, ALL)
    assert residual == pytest.approx(block.residual(parts, points, ALL), abs=1e-12)
    for t in range(len(TILTS_RAD)):
        rows = np.flatnonzero(block.group == t)
        ahead, behind = (
            block.residual(moved(parts, block.columns[t, column], step), points, ALL) for step in (STEP, -STEP)
        )
        numeric = (ahead - behind)[:, rows] / (2 * STEP)
        assert by_shared[column][:, rows] == pytest.approx(numeric, abs=TOLERANCE)
        # A column moves nothing of the other scanner.
        others = np.flatnonzero(SCANNER_OF[block.group] != SCANNER_OF[t])
        assert (ahead == behind)[:, others].all()


def test_every_column_moves_something(case):
    _, points, block, parts = case
    _, by_shared, _ = block.linearise(parts, points, ALL)
    names = (*SCANNER_TANGENT, "tilt")
    assert [name for name, slope in zip(names, by_shared, strict=True) if np.abs(slope).max() < 1e-3] == []


@pytest.mark.parametrize("axis", range(3))
def test_jacobian_by_the_spot(case, axis):
    _, points, block, parts = case
    _, _, by_point = block.linearise(parts, points, ALL)
    shift = STEP * np.eye(3)[:, [axis]]
    numeric = block.residual(parts, points + shift, ALL) - block.residual(parts, points - shift, ALL)
    assert by_point[axis] == pytest.approx(numeric / (2 * STEP), abs=TOLERANCE)


def test_rows_and_take_agree(case):
    _, points, block, parts = case
    order = np.random.default_rng(9).permutation(20)
    whole = block.residual(parts, points, ALL)
    assert block.residual(parts, points[:, 5:9], slice(5, 9)) == pytest.approx(whole[:, 5:9], abs=0)
    taken = block.take(order)
    assert taken.residual(parts, points[:, order], ALL) == pytest.approx(whole[:, order], abs=0)


def test_world_directions_leave_the_residual_when_the_spots_move_along(case):
    _, points, block, parts = case
    directions = parts[SCANNERS].rigid_directions()
    _, by_shared, by_point = block.linearise(parts, points, ALL)
    for k in range(6):
        unit = np.eye(3)[k % 3]
        spots = np.tile(unit, (20, 1)) if k < 3 else np.cross(unit, points.T)
        along = np.einsum("imn,ni->mn", by_point, spots)
        padded = np.append(directions[:, k], np.zeros(len(TILTS_RAD)))
        along += np.einsum("imn,ni->mn", by_shared, padded[block.columns][block.group])
        # Sums of some twenty products, at most 3 m / 0.1 each.
        assert np.abs(along).max() < 1e-11


def test_retract_keeps_the_axis_a_line_and_rotations_rotations(case):
    *_, parts = case
    part = parts[SCANNERS].retract(np.random.default_rng(1).uniform(-0.5, 0.5, parts[SCANNERS].size))
    assert np.linalg.norm(part.directions, axis=1) == pytest.approx(1, abs=1e-14)
    assert (part.directions * part.foot_points).sum(axis=1) == pytest.approx(0, abs=1e-14)
    assert part.rotations @ part.rotations.transpose(0, 2, 1) == pytest.approx(np.tile(np.eye(3), (2, 1, 1)), abs=1e-14)


def test_scanner_part_gives_back_the_scanners(case):
    scanners, *_, parts = case
    for before, after in zip(scanners, parts[SCANNERS].apply_to(scanners), strict=True):
        probe = np.random.default_rng(2).uniform(-2, 2, (5, 3))
        expected = np.stack(before.measure(probe, 0.3))
        assert np.stack(after.measure(probe, 0.3)) == pytest.approx(expected, abs=1e-13)


def numeric_jacobian(block, parts, part_name):
    """Central differences of a shared block by one part's tangent."""
    part = parts[part_name]
    columns = []
    for unit in np.eye(part.size):
        ahead, behind = (block.linearise({**parts, part_name: part.retract(s * unit)})[0] for s in (STEP, -STEP))
        columns.append((ahead - behind) / (2 * STEP))
    return np.stack(columns, axis=1)


def test_tilt_prior_is_the_mahalanobis_distance_of_the_differences():
    settings = TiltSettings(SCANNER_OF, TILTS_RAD, np.diag([1.0, 2.0, 3.0, 4.0, 5.0]) * 1e-6)
    free = np.array([1, 2, 4])
    tilts = TiltPart(TILTS_RAD + np.array([0, 1e-3, -2e-3, 0, 3e-3]), np.array([-1, 0, 1, -1, 2]))
    prior = TiltPrior.of(settings, free, np.arange(3))
    residual, jacobian = prior.linearise({TILTS: tilts})
    # By hand: variances add up against the reference (setting 0 and 3), which settings 1 and 2 share.
    spread = np.array([[3.0, 1.0, 0.0], [1.0, 4.0, 0.0], [0.0, 0.0, 9.0]]) * 1e-6
    off = np.array([1e-3, -2e-3, 3e-3])
    assert residual @ residual == pytest.approx(off @ np.linalg.solve(spread, off), rel=1e-12)
    # The prior is linear, so a difference is exact but for rounding: 1e-15 * 0.9 rad / 1e-3 / 1e-5 = 1e-7.
    assert jacobian == pytest.approx(numeric_jacobian(prior, {TILTS: tilts}, TILTS), abs=1e-6)


def test_instrument_prior_is_over_its_sigma(case):
    *_, parts = case
    columns = np.full((2, N_SCANNER), -1)
    columns[:, N_GEOMETRY + 1] = [0, 1]
    part = ScannerPart.from_scanners(case[0], columns)
    prior = InstrumentPrior.of(part, [InstrumentSigma(range_bias_m=0.01), InstrumentSigma(range_bias_m=0.02)], 5)
    residual, jacobian = prior.linearise({**parts, SCANNERS: part})
    assert residual == pytest.approx([case[0][0].range_bias_m / 0.01, case[0][1].range_bias_m / 0.02], rel=1e-12)
    assert prior.columns.ravel().tolist() == [5, 6]
    assert jacobian.ravel() == pytest.approx([100.0, 50.0])


def test_distance_prior_and_its_jacobian():
    centres = np.array([[0.1, 0.2, 0.3], [0.4, -0.2, 0.35]])
    poses = poses_from_centres(np.tile(np.eye(3), (2, 1, 1)), centres)
    intrinsics = np.tile([260.0, 260.0, 159.5, 119.5, 0, 0, 0, 0], (2, 1))
    cameras = Cameras(("C0", "C1"), np.tile([320, 240], (2, 1)), (LensModel.NONE,) * 2, intrinsics, poses)
    columns = np.full((2, 14), -1)
    columns[:, 3:6] = np.arange(6).reshape(2, 3)
    parts = {PART: CameraParameters.from_cameras(cameras, columns)}
    prior = DistancePrior(0, 1, 0.5, 0.001, np.arange(6)[None])
    residual, jacobian = prior.linearise(parts)
    distance = np.sqrt(0.3**2 + 0.4**2 + 0.05**2)
    assert residual[0] == pytest.approx((distance - 0.5) / 0.001, rel=1e-12)
    # Curvature over 0.5 m: h^2 / (6 * 0.5^2) * 1000 = 7e-8.
    assert jacobian == pytest.approx(numeric_jacobian(prior, parts, PART), abs=1e-6)
