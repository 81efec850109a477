"""An emulator that is heard late."""

import numpy as np

from nodes.simulated.late_line import LateEmulator
from tests.nodes.simulated.echo import Echo


def test_messages_come_in_order_and_late():
    rng = np.random.default_rng(0)
    late = LateEmulator(Echo(0.01), lambda: rng.uniform(0, 0.1))
    late.connect(0.0)
    heard: list[tuple[float, bytes]] = []
    for k in range(200):
        now_s = 0.005 * k
        if k < 100:
            late.receive(bytes([k]), now_s)
        if data := late.send(now_s):
            heard.append((now_s, data))
    assert b"".join(data for _, data in heard) == bytes(range(100))
    waits = np.concatenate([[now_s - 0.005 * number for number in data] for now_s, data in heard])
    # 10 ms of the echo, at most 100 ms of lateness, 5 ms until it is looked for.
    assert 0.01 <= waits.min() <= waits.max() <= 0.115 + 1e-9
    assert waits.max() > 0.05


def test_nothing_is_kept_over_an_unplugging():
    late = LateEmulator(Echo(0.0), lambda: 0.5)
    late.connect(0.0)
    late.receive(b"gone", 0.0)
    late.send(0.1)
    late.disconnect(0.2)
    late.connect(0.3)
    assert late.send(5.0) == b""
