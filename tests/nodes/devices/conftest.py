"""What tests of devices share."""

import contextlib
import os

import pytest

NOBODY = 65534


@pytest.fixture
def as_nobody():
    """A context in which the file system treats this process as a user without rights, also where root runs it."""

    @contextlib.contextmanager
    def switched():
        user = os.geteuid()
        if user == 0:
            os.seteuid(NOBODY)
        try:
            yield
        finally:
            os.seteuid(user)

    return switched
