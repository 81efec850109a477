"""Every error that spotcal raises on purpose.

    SpotcalError                  what went wrong, and what to do next
    ├── InputError                a file, table or configuration cannot be used as it is
    ├── DegenerateError           the geometry does not determine the answer; says where to wave next
    │   └── FlatError             the spot moved in a plane or along a line
    ├── ConvergenceError          the solve did not reach an optimum worth reporting
    ├── ProjectionError           a question that a calibration cannot answer (`nodes.projection.errors`)
    └── DeviceError               a device cannot be opened, or answers what it must not (`nodes.devices.errors`)
        └── SourceError           a camera, video or folder of images

The command line prints `message` and `advice` and exits with status 2; anything else that escapes is a defect.
"""


class SpotcalError(Exception):
    """A failure that the user can act on.

    Attributes:
        message: what is wrong, with the numbers, the file, the field and the value.
        advice: what to do next; empty when the message says it already.
    """

    def __init__(self, message: str, *, advice: str = "") -> None:
        super().__init__(message if not advice else f"{message}\n{advice}")
        self.message = message
        self.advice = advice


class InputError(SpotcalError):
    """A file, table or configuration that cannot be used: says which, where, and what was expected."""


class DegenerateError(SpotcalError):
    """Observations that do not determine the calibration: says why, and where to wave next."""


class FlatError(DegenerateError):
    """Spots that lie in a plane or on a line: wrong worlds fit them."""


class ConvergenceError(SpotcalError):
    """A solve that ended without an optimum that may be reported."""
