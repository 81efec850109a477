"""A site whose nodes are threads here: real Zenoh, real journals, spots of a synthetic room."""

from __future__ import annotations

import threading
import time
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

import tomli_w

from nodes.bus import spotcal_pb2 as pb
from nodes.bus.keys import Keys, Kind, Role, Verb
from nodes.bus.node import BusNode
from nodes.bus.session import BusOptions
from nodes.journal import Journal
from tests.nodes.coordinator.waved_room import FRAMES_PER_BATCH, WavedRoom, waved_room

SITE = "acted"
KEYS = Keys(SITE)
BATCH_S = 0.01
BEAT_S = 0.2


class ActedNode:
    """Does what a node does when it is told, from a thread; `with`."""

    def __init__(self, name, role, endpoint, folder, batches=()):
        self.name, self.role, self.batches = name, role, batches
        self.journal = Journal(folder / f"{name}.sqlite")
        self.bus = BusNode(name, role, BusOptions(SITE, (endpoint,)), self.journal)
        self.bus.status = lambda: pb.NodeStatus(state=self.state, n_settings=2 if role is Role.LRF else 0)
        self.bus.on_command = self.obey
        self.state = "waiting"
        self.told = []
        self._is_waving = threading.Event()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name=name)

    def obey(self, verb, command):
        self.told.append(verb)
        match verb:
            case Verb.START:
                self.state = "watching"
                self._is_waving.set()
            case Verb.STOP:
                self.state = "waiting"
                self._is_waving.clear()
            case Verb.TILTS:
                assert len(command.tilts_rad) == 2
                tilts = pb.TiltSettings(lrf="L0", angle_rad=command.tilts_rad, covariance_rad2=[1e-6, 0, 0, 1e-6])
                self.bus.observe(Kind.TILTS, tilts, stamp_ns=time.time_ns())
        return pb.Reply(code="OK")

    def rows(self, session):
        """(boot, sequence, payload) of everything in the journal."""
        spans = self.journal.spans(session)
        return [
            (span.boot, sequence, payload)
            for span in spans
            for sequence, _, payload in self.journal.rows(session, span.boot, span.first, span.last, max_bytes=2**30)
        ]

    def _run(self):
        batches = iter(self.batches)
        last_beat_s = 0.0
        while not self._stop.wait(BATCH_S):
            if time.monotonic() - last_beat_s > BEAT_S:
                last_beat_s = time.monotonic()
                self.bus.beat()
            batch = next(batches, None) if self._is_waving.is_set() else None
            if batch is not None:
                self.bus.observe(Kind.SPOTS, batch, stamp_ns=batch.frame_stamp_ns[0])

    def __enter__(self):
        self.bus.__enter__()
        self._thread.start()
        return self

    def __exit__(self, *error):
        self._stop.set()
        self._thread.join()
        self.bus.__exit__(None, None, None)
        self.journal.close()


@dataclass
class ActedSite:
    waved: WavedRoom
    nodes: list
    config: Path
    data: Path

    def rows(self, session):
        return sorted(row for node in self.nodes for row in node.rows(session))


@contextmanager
def acted_site(folder, endpoint, *, seconds, has_lrf=False, expected=(), **session):
    """A camera node for each camera of a room, with so many seconds of frames, sent at several times their speed."""
    n_frames = round(seconds / BATCH_S) * FRAMES_PER_BATCH
    # Stamps end before now, so that none comes from the future.
    waved = waved_room(n_frames=n_frames, begin_ns=time.time_ns() - 60 * 10**9 - n_frames * 40_000_000)
    nodes = [ActedNode(f"node-{name}", Role.CAMERA, endpoint, folder, waved.batches[name]) for name in waved.names]
    if has_lrf:
        nodes.append(ActedNode("node-L0", Role.LRF, endpoint, folder))
    config = {
        "name": SITE,
        "router": [endpoint],
        "data": "sessions",
        "nodes": [
            *({"name": node.name, "role": str(node.role)} for node in nodes),
            *({"name": name, "role": "camera"} for name in expected),
        ],
        "session": {
            "background_s": 0.2,
            "min_waving_s": 1.0,
            "target_sigma_mm": 5.0,
            "tilts_deg": [2.0, 12.0],
            **session,
        },
        **waved.config.model_dump(exclude_none=True, exclude_defaults=True),
    }
    path = folder / "site.toml"
    path.write_text(tomli_w.dumps(config))
    with ExitStack() as stack:
        for node in nodes:
            stack.enter_context(node)
        yield ActedSite(waved, nodes, path, folder / "sessions")
