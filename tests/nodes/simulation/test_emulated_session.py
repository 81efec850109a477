"""What cameras of an emulated platform's room saw, as a session folder."""

import numpy as np
import pytest
from rich.console import Console

from network_calib.errors import InputError
from network_calib.formats.table import read_npz
from nodes.config import load_room
from nodes.emulate import emulated_devices, run_emulators
from nodes.simulation.emulated_session import SIGMA_PX, write_camera_session

WALL_ZERO_S = 1_700_000_000.0


def test_cameras_see_the_spot_where_it_is_at_the_stamps_of_their_frames(tmp_path):
    devices = emulated_devices(seed=3)
    unit = devices.by_name["ptu"]
    unit.connect(0.0)
    unit.receive(b"TP-400 ", 0.0)
    write_camera_session(devices.platform, tmp_path / "session", end_s=12.0, wall_zero_s=WALL_ZERO_S)
    seen, cameras = read_npz(tmp_path / "session" / "table.npz").observations, devices.platform.scene.cameras
    assert seen.camera_names == cameras.names
    # The person comes five seconds after the unit rests.
    assert 5 * 25 < seen.frame.min() < 7 * 25
    assert seen.frame.max() == 12 * 25 - 1
    assert seen.stamp_ns is not None
    time_s = 1e-9 * (seen.stamp_ns - int(WALL_ZERO_S * 1e9))
    np.testing.assert_allclose(time_s, seen.frame / 25, atol=1e-6)
    spots = np.array([devices.platform.spot_in_world(float(frame) / 25) for frame in seen.frame])
    px, _ = cameras.img_from_world(seen.camera, spots)
    # Some 2000 residuals: their standard deviation is known to 2 %.
    assert (seen.px - px).std() == pytest.approx(SIGMA_PX, rel=0.08)
    room = load_room(tmp_path / "session" / "room.toml")
    assert [camera.name for camera in room.cameras] == list(cameras.names)


def test_the_session_is_written_when_the_emulators_stop(tmp_path):
    console = Console(quiet=True)
    session = tmp_path / "session"

    def interrupted(_server):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_emulators(
            "platform",
            tmp_path / "ports",
            is_tcp=False,
            is_newer=False,
            seed=0,
            console=console,
            session=session,
            wait=interrupted,
        )
    assert (session / "table.npz").is_file()


def test_one_instrument_alone_has_no_session(tmp_path):
    with pytest.raises(InputError, match="only where platform is emulated"):
        run_emulators(
            "urg",
            tmp_path,
            is_tcp=True,
            is_newer=False,
            seed=0,
            console=Console(quiet=True),
            session=tmp_path,
        )
