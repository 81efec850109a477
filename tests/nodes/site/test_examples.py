"""`spotcal init` writes files that the programs take as they are, and in which every comment is true."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from typer.testing import CliRunner

from network_calib.errors import InputError
from nodes.cli import app
from nodes.site.examples import Example, example
from nodes.site.load import load_camera_node, load_lrf_node, load_site
from nodes.site.model import NodeConfig, SiteConfig

LOADERS = {Example.SITE: load_site, Example.CAMERA: load_camera_node, Example.LRF: load_lrf_node}
# A setting, or the head of a table, that is commented out; prose begins otherwise.
OPTIONAL = re.compile(r"^# (?=[a-z_]+ = |\[)", re.MULTILINE)


def _loaded(which: Example, text: str, folder: Path) -> SiteConfig | NodeConfig:
    path = folder / f"{which}.toml"
    path.write_text(text, encoding="utf-8")
    return LOADERS[which](path)


@pytest.mark.parametrize("which", list(Example))
def test_what_init_writes_is_taken(which: Example, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    result = CliRunner().invoke(app, ["init", which])
    assert result.exit_code == 0, result.output
    LOADERS[which](tmp_path / f"{which}.toml")


@pytest.mark.parametrize("which", list(Example))
def test_what_is_commented_out_is_taken_too(which: Example, tmp_path: Path) -> None:
    text = example(which)
    # Only one of the two camera kinds may be given options of the other.
    whole = OPTIONAL.sub("", text)
    assert whole.count("\n") == text.count("\n")
    assert len(OPTIONAL.findall(text)) > 5
    _loaded(which, whole, tmp_path)


@pytest.mark.parametrize("which", [Example.CAMERA, Example.LRF])
def test_commented_defaults_are_the_defaults(which: Example, tmp_path: Path) -> None:
    with_defaults = OPTIONAL.sub("", example(which))
    plain = _loaded(which, example(which), tmp_path).model_dump()
    whole = _loaded(which, with_defaults, tmp_path).model_dump()
    section = "lrf" if which is Example.LRF else "cameras"
    one, other = plain[section], whole[section]
    one, other = (one[0], other[0]) if isinstance(one, list) else (one, other)
    # These have no default that could be shown.
    examples = {"mask", "exposure_ms", "size", "rate_hz"}
    assert {key: value for key, value in other.items() if key not in examples} == {
        key: value for key, value in one.items() if key not in examples
    }


def test_a_file_that_is_there_is_left_alone(tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_text("precious", encoding="utf-8")
    result = CliRunner().invoke(app, ["init", "site", "--out", str(path)])
    assert isinstance(result.exception, InputError)
    assert path.read_text(encoding="utf-8") == "precious"


def test_an_unknown_kind_is_refused() -> None:
    result = CliRunner().invoke(app, ["init", "sitee"])
    assert isinstance(result.exception, InputError)
    assert "site, camera, lrf" in result.exception.message
