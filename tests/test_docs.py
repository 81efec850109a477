"""README and docs: commands run, links lead somewhere, examples load, options and numbers are those of the program."""

import importlib
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
import typer
from pydantic import BaseModel

from network_calib.formats.table import read_csv
from nodes.cli import app
from nodes.config import load_room
from nodes.config_model import RoomConfig

ROOT = Path(__file__).resolve().parents[1]
DOCS = ("README.md", *sorted(f"docs/{path.name}" for path in (ROOT / "docs").glob("*.md")))
LINK = re.compile(r"\]\(([^)\s]+)\)")
BLOCK = re.compile(r"^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
CODE_SPAN = re.compile(r"`([^`\n]+)`")
OPTION = re.compile(r"(?<![\w-])--[a-z][a-z-]*")
CONSTANT = re.compile(r"`(\w+)\.(_?[A-Z][A-Z_]+)`\s=\s(-?\d[\d.]*\d|\d)")
COMMANDS = typer.main.get_group(app).commands


def text_of(name):
    return (ROOT / name).read_text(encoding="utf-8")


def blocks_of(name, language):
    return [body for kind, body in BLOCK.findall(text_of(name)) if kind == language]


def prose_of(name):
    return BLOCK.sub("", text_of(name))


def heading_anchors(name):
    """The anchors that a forge makes of headings: lower case, spaces to hyphens, punctuation gone."""
    headings = re.findall(r"^#+ (.+)$", prose_of(name), re.MULTILINE)
    return {re.sub(r"[^\w -]", "", heading.lower()).replace(" ", "-") for heading in headings}


def options_of(command):
    """Of a command, and of all commands of a group."""
    own = {option for parameter in command.params for option in parameter.opts if option.startswith("--")}
    return own.union({"--help"}, *map(options_of, getattr(command, "commands", {}).values()))


@pytest.mark.parametrize("name", [name for name in DOCS if blocks_of(name, "sh")])
def test_every_shell_command_runs(name, tmp_path):
    script = "".join(blocks_of(name, "sh"))
    path = f"{Path(sys.executable).parent}{os.pathsep}{ROOT / 'scripts'}{os.pathsep}{os.environ['PATH']}"
    # -e: the first command that fails ends the script; -u: so does a variable that nobody set.
    done = subprocess.run(
        ["bash", "-euo", "pipefail", "-c", script],
        cwd=tmp_path,
        env={**os.environ, "PATH": path},
        capture_output=True,
        text=True,
        check=False,
        timeout=240,
    )
    assert done.returncode == 0, done.stderr


def test_there_is_a_walk_through_from_recordings():
    # Otherwise the test above could pass with nothing to run.
    script = "".join(blocks_of("docs/recordings.md", "sh"))
    assert {"calibrate", "show", "evaluate", "export"} <= set(re.findall(r"^spotcal (\w+)", script, re.MULTILINE))


@pytest.mark.parametrize("name", DOCS)
def test_every_relative_link_resolves(name):
    for link in (link for link in LINK.findall(prose_of(name)) if "://" not in link):
        path, _, anchor = link.partition("#")
        target = (ROOT / name).parent / path if path else ROOT / name
        assert target.is_file(), link
        if anchor:
            assert anchor in heading_anchors(target.resolve().relative_to(ROOT)), link


def test_pictures_are_small():
    for picture in (ROOT / "docs").glob("*.png"):
        assert picture.stat().st_size < 200_000, picture.name


@pytest.mark.parametrize("name", DOCS)
def test_every_script_named_exists(name):
    for script in re.findall(r"scripts/\w+", text_of(name)):
        assert os.access(ROOT / script, os.X_OK), script


def config_examples():
    return [(name, number) for name in DOCS for number in range(len(blocks_of(name, "toml")))]


@pytest.mark.parametrize(("name", "number"), config_examples())
def test_every_room_toml_loads(name, number, tmp_path):
    path = tmp_path / "room.toml"
    path.write_text(blocks_of(name, "toml")[number], encoding="utf-8")
    assert load_room(path).model_fields_set


def test_configuration_shows_every_field_of_room_toml():
    example = "".join(blocks_of("docs/configuration.md", "toml"))
    keys = set(re.findall(r"(\w+) = ", example)) | set(re.findall(r"^\[+(\w+)\]", example, re.MULTILINE))
    assert {field for model in models_below(RoomConfig) for field in model.model_fields} <= keys


def models_below(model):
    """The model and all models that its fields are made of."""
    parts = [field.annotation for field in model.model_fields.values()]
    found = {model}
    while parts:
        part = parts.pop()
        parts.extend(getattr(part, "__args__", ()))
        if isinstance(part, type) and issubclass(part, BaseModel):
            found |= models_below(part)
    return found


def test_every_table_of_spots_reads(tmp_path):
    tables = [body for name in DOCS for body in blocks_of(name, "csv")]
    assert tables
    for number, body in enumerate(tables):
        path = tmp_path / f"{number}.csv"
        path.write_text(body, encoding="utf-8")
        # The header is one line, every other a detection.
        assert len(read_csv(path).observations) == len(body.splitlines()) - 1


@pytest.mark.parametrize("name", DOCS)
def test_every_option_exists(name):
    pieces = [
        *CODE_SPAN.findall(prose_of(name)),
        *(line for _, body in BLOCK.findall(text_of(name)) for line in body.splitlines()),
    ]
    known = set().union(*map(options_of, COMMANDS.values()))
    for piece in pieces:
        command = re.match(r"(?:\S*/)?spotcal ([a-z]\w*)", piece)
        if command:
            assert command[1] in COMMANDS, piece
        allowed = options_of(COMMANDS[command[1]]) if command else known
        assert set(OPTION.findall(piece)) <= allowed, piece


def test_every_command_is_listed_with_every_option():
    table = text_of("docs/commands.md")
    rows = {row[1]: row[2] for row in re.finditer(r"^\| `spotcal (\w+)[^`]*` \|(.*)\|$", table, re.MULTILINE)}
    assert set(rows) == set(COMMANDS)
    for name, row in rows.items():
        assert set(OPTION.findall(row)) == options_of(COMMANDS[name]) - {"--help"}, name


def test_every_warning_is_explained_and_no_other():
    code = re.compile(r'Doubt\(\s*"(\w+)"')
    raised = {
        match for path in (ROOT / "network_calib").glob("*.py") for match in code.findall(path.read_text("utf-8"))
    }
    section = text_of("docs/warnings.md")
    assert set(re.findall(r"^\| `(\w+)` \|", section, re.MULTILINE)) == raised


def test_conventions_name_every_field_of_the_result():
    golden = json.loads(text_of("tests/network_calib/formats/three_cameras.json"))
    words = set(CODE_SPAN.findall(text_of("docs/conventions.md")))
    assert field_names(golden) - words == set()


def field_names(value):
    if isinstance(value, list):
        return set().union(*map(field_names, value))
    if isinstance(value, dict):
        return set(value).union(*map(field_names, value.values()))
    return set()


def test_every_constant_has_the_value_that_is_written():
    written = CONSTANT.findall(text_of("docs/algorithm.md"))
    assert len(written) > 20
    wrong = []
    for module, name, value in written:
        actual = getattr(importlib.import_module(f"network_calib.{module}"), name)
        if actual != float(value):
            wrong.append(f"{module}.{name} is {actual}, written {value}")
    assert not wrong


def test_every_file_named_in_the_algorithm_exists():
    files = set(re.findall(r"`(\w+\.py)`", text_of("docs/algorithm.md")))
    assert files
    assert {file for file in files if not (ROOT / "network_calib" / file).is_file()} == set()
