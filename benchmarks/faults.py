"""Programs of a whole session are killed in random order and repeatedly: is anything lost, doubled, or different?"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

from benchmarks.report import Row, Run
from tests.nodes.fault_runs import Killer, Kills, run_disturbed, run_undisturbed
from tests.nodes.fault_site import FaultSite, Size, journalled, numbers_of, recorded

FULL, FULL_KILLS = Size(n_cameras=5, rate_hz=5.0, wave_s=30.0), Kills(n_waving=16, n_solving=6, pause_s=1.5)
QUICK, QUICK_KILLS = Size(n_cameras=3, rate_hz=10.0, wave_s=8.0), Kills(n_waving=5, n_solving=1, pause_s=1.5)

# Tilts take their time, so kills are further apart. No two runs of instruments are the same to the bit.
LRF_SIZE = Size(n_cameras=3, rate_hz=10.0, wave_s=10.0, tilts_deg=(2.0, 12.0, 23.0))
LRF_KILLS = Kills(n_waving=6, n_solving=3, pause_s=2.0, n_tilts=7)


def measure(run: Run) -> Iterator[Row]:
    """Sessions of real processes with kills, each beside the undisturbed one with the same frames."""
    size, kills = (QUICK, QUICK_KILLS) if run.is_quick else (FULL, FULL_KILLS)
    for seed in range(run.pick(3, 1)):
        with TemporaryDirectory(prefix="spotcal-faults-") as folder:
            site, killer = run_disturbed(Path(folder) / "disturbed", size, kills, seed=seed)
            yield _rows(site, killer, f"{size.n_cameras} cameras, seed {seed}")
            undisturbed = run_undisturbed(Path(folder) / "undisturbed", site)
            yield _calibrations(site, undisturbed, f"{size.n_cameras} cameras, seed {seed}")
    for seed in range(run.pick(2, 0)):
        with TemporaryDirectory(prefix="spotcal-faults-") as folder:
            site, killer = run_disturbed(Path(folder), LRF_SIZE, LRF_KILLS, seed=seed)
            yield _rows(site, killer, f"{LRF_SIZE.n_cameras} cameras and an LRF, seed {seed}")


def _rows(site: FaultSite, killer: Killer, of: str) -> Row:
    """What the journals hold, beside what was recorded."""
    written, found = journalled(site), recorded(site)
    counts = {name: sum(killed == name for _, killed in killer.done) for name in site.programs}
    told = ", ".join(f"{name} {n}×" for name, n in counts.items())
    n_missing, n_doubled = (written - found).total(), sum(found.values()) - len(found)
    n_strange = (found - written).total() - n_doubled
    return Row(
        f"rows of the journals in the recording; {of}, {len(killer.done)} SIGKILLs ({told})",
        f"{n_missing} missing, {n_doubled} doubled, {n_strange} in no journal, of {written.total()}",
        "0, 0, 0",
        n_missing == n_doubled == n_strange == 0,
    )


def _calibrations(site: FaultSite, undisturbed: FaultSite, of: str) -> Row:
    is_equal = numbers_of(site.session.calibration) == numbers_of(undisturbed.session.calibration)
    told = "equal to the bit" if is_equal else "different"
    return Row(f"calibration beside the undisturbed session's; {of}", told, "equal to the bit", is_equal)
