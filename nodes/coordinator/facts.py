"""From who is there and what came in to the facts that the session's state rests on."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from nodes.bus.keys import Role
from nodes.coordinator.coverage import LrfSeen
from nodes.coordinator.orders import TILTING, NodeNow
from nodes.coordinator.phases import Facts
from nodes.coordinator.presence import NodeSeen
from nodes.site.model import NodeEntry

# A camera node's state once it has learnt its background.
WATCHING = "watching"


def nodes_now(seen: Iterable[NodeSeen], lrfs: Iterable[LrfSeen]) -> tuple[NodeNow, ...]:
    """The nodes that may be told something: alive, and known by a status.

    Args:
        seen: all that were heard of.
        lrfs: what came in of the LRFs.
    """
    fused = {lrf.node for lrf in lrfs if lrf.is_fused}
    return tuple(
        NodeNow(
            node.node,
            node.role,
            node.status.header.boot,
            node.status.header.session,
            node.status.state,
            is_through=node.node in fused and node.status.state not in TILTING,
        )
        for node in seen
        if node.is_alive and node.status is not None and node.role is not None
    )


def facts_of(
    expected: Sequence[NodeEntry],
    now: Sequence[NodeNow],
    *,
    session: str,
    now_s: float,
    waving_lacks: tuple[str, ...] = (),
    solved: str | None = None,
) -> Facts:
    """What is known at a moment.

    Args:
        expected: nodes of the site.
        now: nodes that are there.
        session: id of the running one.
        now_s: seconds since the epoch.
        waving_lacks: see `Facts`.
        solved: see `Facts`.
    """
    there = {node.node for node in now}
    cameras = [node for node in now if node.role is Role.CAMERA]
    lrfs = {entry.name for entry in expected if entry.role == Role.LRF} | {n.node for n in now if n.role is Role.LRF}
    through = {node.node for node in now if node.is_through}
    return Facts(
        now_s=now_s,
        missing=tuple(entry.name for entry in expected if entry.name not in there),
        n_cameras=len(cameras),
        learning=tuple(n.node for n in cameras if n.session != session or n.state != WATCHING),
        waving_lacks=waving_lacks,
        tilting=tuple(sorted(lrfs - through)),
        n_lrfs=len(lrfs),
        solved=solved,
    )
