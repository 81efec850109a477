"""References to passwords are replaced by what they refer to, percent-encoded."""

from __future__ import annotations

from pathlib import Path
from urllib.parse import unquote, urlsplit

import pytest
from hypothesis import given
from hypothesis import strategies as st

from network_calib.errors import InputError
from nodes.site.passwords import with_passwords

SOURCE = "rtsp://viewer:${DOOR}@host:554/path"


@given(st.text(min_size=1).filter(lambda text: text.isprintable()))
def test_any_password_arrives_whole(password: str) -> None:
    parts = urlsplit(with_passwords(SOURCE, {"DOOR": password}))
    assert unquote(parts.password or "") == password
    assert (parts.hostname, parts.port, parts.path) == ("host", 554, "/path")


def test_a_file_holds_one(tmp_path: Path) -> None:
    path = tmp_path / "door"
    path.write_text("se@cret\n", encoding="utf-8")
    assert with_passwords(f"rtsp://viewer:${{file:{path}}}@host") == "rtsp://viewer:se%40cret@host"


@pytest.mark.parametrize("content", [None, b"", b"\n", b"\xff\xfe"])
def test_a_file_without_one_is_refused(tmp_path: Path, content: bytes | None) -> None:
    path = tmp_path / "door"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(InputError, match="door, which a camera's source asks for"):
        with_passwords(f"rtsp://viewer:${{file:{path}}}@host")


def test_a_variable_that_is_not_set_is_refused() -> None:
    with pytest.raises(InputError, match="the environment has no DOOR"):
        with_passwords(SOURCE, {})
