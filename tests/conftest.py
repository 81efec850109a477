"""What all tests share: the real recordings, one BLAS thread, and property tests that repeat exactly."""

import os
from pathlib import Path

# Before NumPy is loaded: threads are slower on small matrices, and their order of summation changes the last digits.
os.environ["OMP_NUM_THREADS"] = os.environ["OPENBLAS_NUM_THREADS"] = "1"

import pytest
from hypothesis import HealthCheck, settings

ROOT = Path(__file__).resolve().parents[1]
RECORDINGS = ("DATA20090709_111010", "DATA20100906_134124", "caldata20130726_122220")

# Same examples in every run, so that a red test stays red. A busy machine draws slowly: no reason to fail.
settings.register_profile(
    "spotcal", derandomize=True, deadline=None, database=None, suppress_health_check=[HealthCheck.too_slow]
)
settings.load_profile("spotcal")


@pytest.fixture(scope="session")
def root() -> Path:
    """The root of the repository."""
    return ROOT


@pytest.fixture(scope="session")
def recordings_dir() -> Path:
    """The folder of real bright-spot recordings; the test is skipped where it is absent."""
    path = ROOT.parent / "shared" / "data"
    if not path.is_dir():
        pytest.skip("real recordings are absent: no folder ../shared/data beside the repository")
    return path


@pytest.fixture(params=RECORDINGS)
def recording(recordings_dir: Path, request: pytest.FixtureRequest) -> Path:
    """The folder of one real recording; the test runs once for each."""
    path = recordings_dir / request.param
    if not path.is_dir():
        pytest.skip(f"real recording {request.param} is absent from ../shared/data")
    return path
