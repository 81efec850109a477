import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from nodes.bus import spotcal_pb2 as pb
from nodes.coordinator.coverage import COLUMNS, ROWS, SLOT_NS, Coverage, common_instants, islands_of
from nodes.coordinator.guidance import part_of_picture, where_to_wave
from nodes.coordinator.live_result import LiveResult
from nodes.coordinator.sufficiency import Needs, Overlaps, overlaps_of, waving_lacks
from tests.nodes.coordinator.waved_room import waved_room

NEEDS = Needs(target_sigma_m=2e-3)
GOOD = LiveResult(n_instants=500, n_used=400, sigma=1e-3, worst="A")


@pytest.fixture(scope="module")
def waved():
    return waved_room(n_frames=500)


def counted(waved, **options):
    coverage = Coverage(**options)
    for name, batches in waved.batches.items():
        for batch in batches:
            coverage.add(batch, node=f"node-{name}")
    return coverage


def overlaps(names, shared, cells=None):
    full = np.ones((len(names), ROWS, COLUMNS), dtype=np.int64)
    return Overlaps(tuple(names), full if cells is None else cells, np.array(shared))


class TestCounting:
    def test_every_frame_and_spot_is_counted(self, waved):
        coverage = counted(waved)
        for name in waved.names:
            camera = coverage.cameras[name]
            assert camera.n_frames == 500
            assert camera.n_seen == sum(len(set(b.spot_frame)) for b in waved.batches[name]) == camera.cells.sum()
            assert camera.node == f"node-{name}"

    def test_order_of_arrival_does_not_matter(self, waved):
        there, back = counted(waved), Coverage()
        for name in reversed(waved.names):
            for batch in reversed(waved.batches[name]):
                back.add(batch, node="n")
        assert (overlaps_of(there).shared == overlaps_of(back).shared).all()
        for one, other in zip(there.detections(), back.detections(), strict=True):
            assert (one.stamp_ns == other.stamp_ns).all()
            assert (one.px == other.px).all()

    def test_corners_of_the_picture_have_their_cells(self):
        coverage = Coverage()
        for x, y in [(-0.5, -0.5), (799.5, 599.5), (799.5, -0.5)]:
            coverage.add(one_spot("A", x, y), node="n")
        cells = coverage.cameras["A"].cells
        assert (cells[0, 0], cells[-1, -1], cells[0, -1], cells.sum()) == (1, 1, 1, 3)

    def test_a_budget_keeps_the_same_instants_of_all_cameras(self, waved):
        whole, thin = counted(waved), counted(waved, max_kept_frames=600)
        kept = sum(len(camera.kept) for camera in thin.cameras.values())
        assert 200 < kept <= 600
        assert thin.stride > 1
        for name in waved.names:
            assert all((stamp // SLOT_NS) % thin.stride == 0 for stamp in thin.cameras[name].kept)
            expected = {s for s in whole.cameras[name].kept if (s // SLOT_NS) % thin.stride == 0}
            assert set(thin.cameras[name].kept) == expected
        # Quarters of a second are spread evenly; a tenth of 500 frames of one camera is one or two of them.
        ratio = overlaps_of(thin).shared / overlaps_of(whole).shared
        assert (np.abs(ratio - 1) < 0.5).all()

    def test_a_clock_gone_mad_costs_no_memory_and_comes_to_an_end(self):
        coverage = Coverage(max_kept_frames=10)
        # A number of a quarter second that every stride divides.
        begin_ns = 2**32 * SLOT_NS
        for offset_ns in range(50):
            batch = one_spot("A", 1.0, 1.0)
            batch.frame_stamp_ns[0] = begin_ns + offset_ns
            coverage.add(batch, node="n")
        assert len(coverage.cameras["A"].kept) <= 10 + 1
        assert coverage.cameras["A"].n_seen == 50

    def test_pictures_of_another_size_are_no_pictures_of_this_camera(self):
        coverage = Coverage()
        other = one_spot("A", 1.0, 1.0)
        other.width_px = 400
        for batch in (one_spot("A", 799.0, 1.0), other):
            coverage.add(batch, node="n")
        assert coverage.cameras["A"].n_frames == 1

    def test_lrfs(self):
        coverage = Coverage()
        coverage.add(pb.LrfScan(lrf="L0"), node="n")
        coverage.add(pb.TiltSample(lrf="L0", setting=1, tilt_rad=0.2), node="n")
        for setting in (0, 1, 1):
            coverage.add(pb.LrfSpot(lrf="L0", setting=setting), node="n")
        lrf = coverage.lrfs["L0"]
        assert (lrf.n_scans, lrf.crossings, lrf.tilt_rad, lrf.is_fused) == (1, {0: 1, 1: 2}, {1: 0.2}, False)
        coverage.add(pb.TiltSettings(lrf="L0"), node="n")
        assert lrf.is_fused


class TestCommonInstants:
    @given(
        stamps=st.lists(st.lists(st.integers(0, 400), unique=True, max_size=12), min_size=1, max_size=4),
        half=st.integers(0, 20),
    )
    def test_equals_the_definition(self, stamps, half):
        stamp_ns = np.array([s for own in stamps for s in own], dtype=np.int64)
        camera = np.array([c for c, own in enumerate(stamps) for _ in own], dtype=np.int64)
        table = common_instants(stamp_ns, camera, len(stamps), half_frame_ns=half)
        for a, first in enumerate(stamps):
            for b, second in enumerate(stamps):
                within = sum(abs(s - t) <= half for s in first for t in second)
                assert table[a, b] == (len(first) if a == b else within)

    def test_cameras_without_a_common_trigger_share_what_both_saw(self):
        frame_ns, n = 40_000_000, 100
        late = waved_room(n_frames=n, n_cameras=2, lateness_ns={"C1": frame_ns // 3})
        together = waved_room(n_frames=n, n_cameras=2)
        assert overlaps_of(counted(late)).shared[0, 1] == overlaps_of(counted(together)).shared[0, 1] > 0


class TestSufficiency:
    def test_enough(self):
        assert waving_lacks(overlaps("AB", [[200, 150], [150, 200]]), NEEDS, expected="AB", live=GOOD) == ()

    def test_names_who_saw_nothing_and_who_too_little(self):
        found = overlaps("AB", [[200, 30], [30, 200]])
        lacks = waving_lacks(found, NEEDS, expected="ABC", live=GOOD)
        assert lacks[0] == "C has seen nothing"
        assert "A shares 30 of 100" in lacks[1]
        assert "not tied" in lacks[-1]

    def test_a_corner_is_not_a_picture(self):
        cells = np.zeros((2, ROWS, COLUMNS), dtype=np.int64)
        cells[:, 0, 0] = 100
        lacks = waving_lacks(overlaps("AB", [[200, 150], [150, 200]], cells), NEEDS, expected="AB", live=GOOD)
        assert len(lacks) == 2
        assert "2% of its picture" in lacks[0]

    def test_accuracy(self):
        found = overlaps("AB", [[200, 150], [150, 200]])
        assert waving_lacks(found, NEEDS, expected="AB", live=None) == ("no calibration was tried yet",)
        (refused,) = waving_lacks(found, NEEDS, expected="AB", live=LiveResult(not_yet="flat"))
        assert "flat" in refused
        (coarse,) = waving_lacks(found, NEEDS, expected="AB", live=LiveResult(sigma=5e-3, worst="B"))
        assert coarse == "B is known to 5 mm, 2 mm are wanted"
        assert waving_lacks(found, NEEDS, expected="AB", live=LiveResult(sigma=float("nan"), worst="B")) != ()
        assert waving_lacks(found, NEEDS, expected="AB", live=LiveResult(sigma=9.0, worst="B", unit="unit")) == ()

    def test_islands_are_named_the_largest_first(self):
        shared = [[9, 0, 60, 0], [0, 9, 0, 0], [60, 0, 9, 70], [0, 0, 70, 9]]
        assert overlaps("ABCD", shared).islands(50) == [("A", "C", "D"), ("B",)]
        assert islands_of(np.zeros((2, 2), dtype=np.int64), minimum=1) == [(0,), (1,)]


class TestGuidance:
    def test_the_blind_come_first(self):
        told = where_to_wave(overlaps("AB", [[9, 0], [0, 0]]), NEEDS, expected="ABC", live=None)
        assert told[0] == "wave in front of B, C: no spot seen there yet"

    def test_then_the_weakest_tie_that_is_needed(self):
        shared = [[900, 800, 30], [800, 900, 10], [30, 10, 900]]
        told = where_to_wave(overlaps("ABC", shared), NEEDS, expected="ABC", live=GOOD)
        # B and C share less, but hang together over A.
        assert told[0] == "wave where A and C both see the spot: 30 common instants tie them"

    def test_then_the_emptiest_picture(self):
        cells = np.ones((2, ROWS, COLUMNS), dtype=np.int64)
        cells[1, :, 3:] = 0
        cells[1, 5, 7] = 1
        told = where_to_wave(overlaps("AB", [[900, 800], [800, 900]], cells), NEEDS, expected="AB", live=GOOD)
        assert told == ("wave in the upper centre of the picture of B: spots in 19 of its 48 cells",)

    def test_then_the_emptiest_part_of_the_room(self):
        live = LiveResult(sigma=1e-3, worst="A", emptiest="2.1 m in front of A")
        found = overlaps("AB", [[900, 800], [800, 900]])
        assert "2.1 m in front of A" in where_to_wave(found, NEEDS, expected="AB", live=live)[0]
        assert where_to_wave(found, NEEDS, expected="AB", live=GOOD) != ()

    @pytest.mark.parametrize(("row", "column", "told"), [(0, 0, "upper left"), (2, 4, "centre"), (5, 7, "lower right")])
    def test_part_of_the_picture(self, row, column, told):
        cells = np.ones((ROWS, COLUMNS), dtype=np.int64)
        cells[row, column] = 0
        assert part_of_picture(cells) == told

    def test_nothing_seen_at_all(self):
        nothing = overlaps_of(Coverage())
        assert where_to_wave(nothing, NEEDS, expected="A", live=None) == ("wave in front of A: no spot seen there yet",)
        assert where_to_wave(nothing, NEEDS, expected="", live=None) != ()


def one_spot(camera, x_px, y_px):
    return pb.SpotBatch(
        camera=camera,
        width_px=800,
        height_px=600,
        frame_sequence=[0],
        frame_stamp_ns=[10**18],
        spot_frame=[0],
        x_px=[x_px],
        y_px=[y_px],
        sigma_px=[0.1],
        score=[1.0],
    )
