"""Equation 14 for trackers: ask with laser points, get pixels in every camera; and back.

`Calibration.load(path).project(...)` answers in the same process; `ProjectionClient` asks the service on the bus, and
gets the same numbers.

points.py       what is asked, and what is answered
calibration.py  a calibration that answers; errors.py why it refuses
requests.py     its questions as values; wire.py and wire_requests.py these as bytes and back, wire_answers.py answers
desk.py         answers bytes by bytes; current.py the calibration in force; service.py both on the bus
client.py       asks the service; async_client.py the same without holding an event loop
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from nodes.projection.async_client import AsyncProjectionClient
    from nodes.projection.calibration import Calibration
    from nodes.projection.client import ProjectionClient
    from nodes.projection.errors import ErrorCode, ProjectionError
    from nodes.projection.points import (
        Beams,
        Bearings,
        CovarianceOf,
        Located,
        LrfPoints,
        Projected,
        Rays,
        WorldPoints,
    )

# Loaded when first asked for: the command line imports this package, and must answer at once.
_MODULE_OF = {
    "Calibration": "calibration",
    "AsyncProjectionClient": "async_client",
    "ProjectionClient": "client",
    "ErrorCode": "errors",
    "ProjectionError": "errors",
    **dict.fromkeys(
        ("Beams", "Bearings", "CovarianceOf", "Located", "LrfPoints", "Projected", "Rays", "WorldPoints"), "points"
    ),
}

__all__ = [
    "AsyncProjectionClient",
    "Beams",
    "Bearings",
    "Calibration",
    "CovarianceOf",
    "ErrorCode",
    "Located",
    "LrfPoints",
    "Projected",
    "ProjectionClient",
    "ProjectionError",
    "Rays",
    "WorldPoints",
]


def __getattr__(name: str) -> object:
    if name not in _MODULE_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_MODULE_OF[name]}"), name)
