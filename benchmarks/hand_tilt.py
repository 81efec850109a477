"""An LRF that is tilted by hand: what gyroscope and gravity tell of its angles, on an emulated IMU and person."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from benchmarks.report import Row, Run, at_most, within
from lrf_stereo.synthetic import paper_scene
from lrf_stereo.tilt import PAPER_AXIS
from network_calib.observations import FloatArray
from nodes.devices.mti import Mti
from nodes.lrf.hand_tilt import HandTilt
from nodes.lrf.imu_log import ImuLog
from nodes.lrf.tilt_of_session import session_tilts
from nodes.simulated.loopback import LoopbackTransport, VirtualClock
from nodes.simulated.mti_device import MtiDevice
from nodes.simulated.platform import SimulatedPlatform
from nodes.simulated.tilting_person import TiltingPerson

TILTS_DEG = (12.1, 30.0, 48.0)
REST_S, READ_S = 12.0, 0.1


def measure(run: Run) -> Iterator[Row]:
    """Errors of the turns from tilt to tilt, and the stated sigma."""
    turns = [_turns(seed) for seed in range(run.pick(60, 6))]
    error, sigma = np.concatenate(turns, axis=1)
    yield at_most("tilt by hand: RMS error of a turn", float(np.degrees(np.sqrt((error**2).mean()))), 0.3, unit="°")
    ratio = float(np.sqrt(((error / sigma) ** 2).mean()))
    note = f"{len(error)} turns, stated {np.degrees(sigma.mean()):.3f}°"
    yield within("tilt by hand: RMS of error / stated sigma", ratio, 0.8, 1.2, note=note)


def _turns(seed: int) -> FloatArray:
    """(2, T - 1) errors and stated sigmas."""
    clock, hand, log = VirtualClock(), HandTilt(axis_in_imu=PAPER_AXIS), ImuLog()
    person = TiltingPerson(np.random.default_rng([seed, 7]))
    rng = np.random.default_rng(seed)
    platform = SimulatedPlatform(paper_scene(rng=rng, n_spots_per_tilt=1), person, seed=seed)
    imu = Mti(LoopbackTransport(MtiDevice(platform.motion, rng=rng), clock), clock=clock)
    imu.start()

    def read() -> None:
        for sample in imu.read(READ_S):
            hand.add(sample)
            log.add(sample)

    rests: list[tuple[float, float]] = []
    for tilt_rad in np.radians(TILTS_DEG).tolist():
        person.ask(tilt_rad, clock())
        while not hand.has_arrived(tilt_rad, is_first=not rests):
            read()
        begin_s, end_s = hand.still_since_s, clock() + REST_S
        if rests and hand.left_s is not None:
            rests[-1] = (rests[-1][0], hand.left_s)
        hand.begin()
        while clock() < end_s:
            read()
        rests.append((clock() if begin_s is None else begin_s, clock()))
    found = session_tilts(rests, imu=log.series()).tilts
    true = np.array([platform.tilt_rad(sum(rest) / 2) for rest in rests])
    difference = np.diff(np.eye(len(true)), axis=0)
    variance = np.diag(difference @ found.covariance_rad2 @ difference.T)
    return np.stack([difference @ (found.angle_rad - true), np.sqrt(variance)])
