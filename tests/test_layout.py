"""The repository itself: its layout, what its files may not name, its scripts, and what an import may load."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

FOLDERS = {
    ".ci", "benchmarks", "deploy", "docs", "lrf_stereo", "network_calib", "nodes", "scripts", "tests",
}  # fmt: skip
SCRIPTS = [".ci/run", *(f"scripts/{name}" for name in ("bench", "check", "demo", "lock", "protoc", "setup", "test"))]
# Written in two parts, so that this file passes its own test.
REGISTRY_HOSTS = [
    "pypi." + "org", "python" + "hosted.org", "npmjs." + "org", "deb." + "debian.org", "crates." + "io",
]  # fmt: skip
HEAVY_MODULES = {"av", "cv2", "matplotlib", "pycolmap", "pydantic", "rich", "serial", "typer", "zenoh"}


@pytest.fixture(scope="module")
def project_files(root: Path) -> list[Path]:
    """Every file that is committed or would be, as git sees it, relative to the root."""
    command = ["git", "ls-files", "--cached", "--others", "--exclude-standard", "-z"]
    listing = subprocess.run(command, cwd=root, capture_output=True, text=True, check=False)
    if listing.returncode != 0:
        pytest.skip("not a git clone: no list of the project's files")
    return [Path(name) for name in listing.stdout.split("\0") if name and (root / name).is_file()]


def test_top_level_folders_are_those_of_the_design(project_files):
    assert {path.parts[0] for path in project_files if len(path.parts) > 1} <= FOLDERS


def test_no_file_names_a_registry_host_or_a_path_of_this_machine(root, project_files):
    forbidden = [*REGISTRY_HOSTS, f"{root}/", f"{Path.home()}/"]
    pattern = re.compile("|".join(map(re.escape, forbidden)).encode())
    found = {str(path): match[0] for path in project_files if (match := pattern.search((root / path).read_bytes()))}
    assert not found


def test_lock_holds_names_versions_and_hashes_only(root):
    lines = [line for line in (root / "requirements.lock").read_text().splitlines() if not line.startswith("#")]
    requirement = re.compile(r"[a-z0-9][a-z0-9-]*==[0-9a-z.]+( ; [a-z0-9_.'!=<> ]+)? \\")
    hashes = re.compile(r"    --hash=sha256:[0-9a-f]{64}( \\)?")
    assert lines
    assert [line for line in lines if not (requirement.fullmatch(line) or hashes.fullmatch(line))] == []


@pytest.mark.parametrize("name", SCRIPTS)
def test_script_is_executable_strict_bash(root, name):
    script = root / name
    assert script.stat().st_mode & 0o111 == 0o111
    assert script.read_text().startswith("#!/usr/bin/env bash\n# ")
    assert "\nset -euo pipefail\n" in script.read_text()
    assert subprocess.run(["bash", "-n", script], check=False).returncode == 0


def test_setup_does_nothing_twice(root):
    if not (root / ".venv" / ".setup-stamp").is_file():
        pytest.skip("this environment was not made by scripts/setup")
    again = subprocess.run([root / "scripts" / "setup"], capture_output=True, text=True, check=False)
    assert (again.returncode, again.stdout, again.stderr) == (0, "", "")


@pytest.mark.parametrize("package", ["network_calib", "lrf_stereo", "nodes"])
def test_importing_a_package_loads_nothing_heavy(root, package):
    code = f"import {package}, sys; print('\\n'.join(sys.modules))"
    loaded = subprocess.run([sys.executable, "-c", code], cwd=root, capture_output=True, text=True, check=True).stdout
    assert package in loaded.split()
    assert HEAVY_MODULES & set(loaded.split()) == set()
