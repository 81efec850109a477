"""Samples of an IMU as they come, with the clock that places them."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from nodes.devices.clock_fit import ClockFit
from nodes.devices.mti import ImuSample
from nodes.lrf.tilt_of_session import ImuSeries


@dataclass(slots=True)
class ImuLog:
    """All samples of an acquisition."""

    fit: ClockFit = field(default_factory=ClockFit)
    samples: list[ImuSample] = field(default_factory=list)

    def add(self, sample: ImuSample) -> None:
        """Keep one."""
        self.fit.add(sample.device_s, sample.arrival_s)
        self.samples.append(sample)

    def series(self) -> ImuSeries | None:
        """On this machine's clock; None where there is no sample."""
        if not self.samples:
            return None
        # One line for all samples: an integral needs times that grow as the device's do.
        line = self.fit.line()
        device_s = np.array([sample.device_s for sample in self.samples])
        return ImuSeries(
            line.offset_s + line.gain * (device_s - line.reference_s),
            np.array([sample.rate_rad_s for sample in self.samples]),
            np.array([sample.acceleration_m_s2 for sample in self.samples]),
        )
