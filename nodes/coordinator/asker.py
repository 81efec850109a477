"""Questions to the nodes' journals through Zenoh; nobody waits for an answer."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import zenoh
from zenoh.handlers import Callback

from nodes.bus import qos
from nodes.bus.checks import MAX_MESSAGE_BYTES
from nodes.bus.keys import Keys
from nodes.coordinator.books import ALL, Ask

TIMEOUT_S = 5.0
Post = Callable[[Callable[[], None]], None]


class Asker:
    """Sends questions; answers are posted to whoever takes them, in the thread of their choice.

    Args:
        zenoh_session: of the coordinator.
        keys: of the site.
        session: id that the rows belong to.
        post: takes what is to be done about an answer; called from Zenoh's threads, must not wait.
        on_answer: a payload, of one of perhaps many replies.
        on_end: there will be no more replies; there may have been none.
    """

    def __init__(
        self,
        zenoh_session: zenoh.Session,
        keys: Keys,
        session: str,
        *,
        post: Post,
        on_answer: Callable[[Ask, bytes], None],
        on_end: Callable[[Ask], None],
    ) -> None:
        self._zenoh, self._keys, self._session = zenoh_session, keys, session
        self._post, self._on_answer, self._on_end = post, on_answer, on_end

    def ask(self, ask: Ask) -> None:
        """Send a question; `on_end` comes for certain, at the latest after `TIMEOUT_S`."""

        def take(reply: zenoh.Reply) -> None:
            if reply.ok is not None and len(reply.ok.payload) <= MAX_MESSAGE_BYTES:
                self._post(partial(self._on_answer, ask, reply.ok.payload.to_bytes()))

        def end() -> None:
            self._post(partial(self._on_end, ask))

        try:
            # Without NONE, Zenoh keeps one reply of several; ALL reaches the journals of all nodes.
            self._zenoh.get(
                self._selector(ask),
                Callback(take, drop=end),
                target=zenoh.QueryTarget.ALL,
                consolidation=zenoh.ConsolidationMode.NONE,
                timeout=TIMEOUT_S,
                congestion_control=qos.CONGESTION,
                priority=qos.COMMAND.priority,
            )
        except zenoh.ZError:
            end()

    def _selector(self, ask: Ask) -> str:
        gap = ask.gap
        if gap is not None:
            part = f"boot={gap.boot.hex()};from={gap.first};to={gap.last}"
            return f"{self._keys.replay_rows(ask.node)}?session={self._session};{part}"
        key = self._keys.all_summaries if ask.node == ALL else self._keys.replay_summary(ask.node)
        return f"{key}?session={self._session}"
