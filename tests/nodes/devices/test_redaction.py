import pytest
from hypothesis import given
from hypothesis import strategies as st

from network_calib.errors import InputError
from nodes.devices.redaction import redact, shown_address

# Characters that people put into passwords; a blank cannot stand in an address at all.
PASSWORDS = st.text(st.characters(min_codepoint=33, max_codepoint=126), min_size=4)


@given(PASSWORDS)
def test_no_password_survives_in_a_text(password):
    text = f"Server returned 401: 'rtsp://someone:{password}@10.0.0.7/live', giving up"
    shown = redact(text)
    assert shown == "Server returned 401: 'rtsp://***@10.0.0.7/live', giving up"


@pytest.mark.parametrize("key", ["password", "PASSWD", "pwd", "pass", "token"])
def test_no_password_in_path_or_query_survives(key):
    shown = redact(f"rtsp://10.0.0.7/user=admin&{key}=hunter2&channel=1")
    assert shown == f"rtsp://10.0.0.7/user=admin&{key}=***&channel=1"


@pytest.mark.parametrize(
    ("address", "shown"),
    [
        ("rtsp://admin:hunter2@cam.local:8554/a/b?c=1", "rtsp://cam.local:8554/a/b?c=1"),
        ("rtsp://admin:hun%40ter2@10.0.0.7/live", "rtsp://10.0.0.7/live"),
        ("rtsp://admin:hun@ter2@10.0.0.7/live", "rtsp://10.0.0.7/live"),
        ("rtsps://u:hunter2@[fe80::1]:322/x?password=hunter2", "rtsps://[fe80::1]:322/x?password=***"),
        ("rtsp://10.0.0.7", "rtsp://10.0.0.7"),
    ],
)
def test_an_address_is_shown_without_its_login(address, shown):
    assert shown_address(address) == shown


@pytest.mark.parametrize(
    "address",
    [
        "rtsp://",
        "rtsp:///live",
        "rtsp://admin:hunter2@",
        "rtsp://admin:hun/ter2@10.0.0.7/live",
        "rtsp://admin:hunter2@10.0.0.7:port/live",
        "rtsp://admin:hunter2@10.0.0.7:0/live",
        "rtsp://admin:hunter2@10.0.0.7/a b",
        "rtsp://admin:hunter2@[fe80::1/live",
    ],
)
def test_a_broken_address_is_refused_without_showing_its_password(address):
    with pytest.raises(InputError, match="expected rtsp://user:password@host:554/path") as caught:
        shown_address(address)
    assert "ter2" not in str(caught.value)
