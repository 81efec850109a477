"""The coordinator: wiring of who is there, what came in, the session's state, orders to nodes, and what is shown."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import ExitStack
from dataclasses import replace
from typing import Self

import zenoh

from network_calib.errors import SpotcalError
from nodes.bus import spotcal_pb2 as pb
from nodes.bus.client import send_command
from nodes.bus.keys import Keys, Role, Verb
from nodes.coordinator.announcer import Announcer
from nodes.coordinator.ending import HEARD_S, STOP_TIMEOUT_S, Ending
from nodes.coordinator.facts import facts_of, nodes_now
from nodes.coordinator.finishing import Finished
from nodes.coordinator.ingest import Ingest
from nodes.coordinator.keyboard import HELP
from nodes.coordinator.live_view import View
from nodes.coordinator.orders import NodeNow, Orders
from nodes.coordinator.phases import Action, Facts, Phase, Press, State, Step, advance, resumed
from nodes.coordinator.plan import Plan
from nodes.coordinator.presence import NodeSeen, Presence
from nodes.coordinator.progress import Progress
from nodes.coordinator.session_folder import Saved
from nodes.coordinator.session_message import message_of
from nodes.coordinator.session_store import SessionStore
from nodes.coordinator.sufficiency import Needs
from nodes.coordinator.view_rows import Rates, camera_rows, crossings_told, lrf_rows, warnings_of
from nodes.coordinator.worker_process import WorkerProcess
from nodes.devices.errors import DeviceError
from nodes.recording.writer import RecordingWriter

STATE_EVERY_S = 1.0
ORDER_TIMEOUT_S = 5.0


class Coordinator:
    """One session; `with`, then `step` until `is_over`.

    Args:
        bus: an open session.
        plan: what is to be run.
        has_keys: somebody can press keys.
        clock_s: seconds since the epoch.
    """

    def __init__(
        self, bus: zenoh.Session, plan: Plan, *, has_keys: bool = False, clock_s: Callable[[], float] = time.time
    ) -> None:
        self._bus, self._plan, self._clock_s, self._has_keys = bus, plan, clock_s, has_keys
        self._keys = Keys(plan.site.name)
        self._session = plan.saved.session
        self.state: State = plan.saved.state
        self.finished: Finished | None = None
        self.is_quit = False
        self.notes: list[str] = []
        self._finishing: Future[Finished] | None = None
        self._next_state_s = 0.0
        self._begin_s = time.monotonic()
        self._rates = Rates()
        self._seen: tuple[NodeSeen, ...] = ()
        self._now: tuple[NodeNow, ...] = ()
        self._facts = Facts(clock_s())
        self._stack = ExitStack()

    def __enter__(self) -> Self:
        plan, folder = self._plan, self._plan.folder.path
        with ExitStack() as stack:
            # The thread that finishes is waited for last, when all that it may wait for has ended.
            self._pool = stack.enter_context(ThreadPoolExecutor(1, thread_name_prefix="finish"))
            writer = RecordingWriter(folder, session=self._session)
            stack.callback(writer.abandon)
            writer.write_site(plan.site_text)
            self._store = SessionStore(writer)
            ledger = self._store.restore(folder) if plan.is_resumed else None
            self._worker = stack.enter_context(WorkerProcess())
            self._ingest = stack.enter_context(
                Ingest(self._bus, self._keys, self._session, self._store.take, ledger=ledger)
            )
            self._presence = stack.enter_context(Presence(self._bus, self._keys, on_node=self._ingest.expect))
            self._announcer = stack.enter_context(Announcer(self._bus, self._keys, self._session))
            self._orders = stack.enter_context(Orders(self._send, clock_s=time.monotonic))
            self._ending = Ending(
                self._ingest, self._store, self._worker, folder, is_stopped=lambda: self.is_everybody_stopped
            )
            stack.callback(self._ending.leave)
            needs = Needs(plan.site.session.target_sigma_mm * 1e-3)
            names = [camera.name for camera in plan.site.cameras]
            self._progress = Progress(self._store, self._worker, plan.site, needs, expected=names)
            self._enter(resumed(self.state, plan.rules, now_s=self._clock_s(), was_stopped=plan.saved.was_stopped))
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *error: object) -> None:
        self._stack.close()

    @property
    def is_over(self) -> bool:
        """Nothing is left to be done: stopped by a person, failed, or done."""
        return self.is_quit or self.state.phase.is_over

    @property
    def is_everybody_stopped(self) -> bool:
        """No node that is there is in this session."""
        return not any(node.session == self._session for node in self._now)

    def step(self, press: Press | None = None) -> None:
        """Look at everything once, a few times a second.

        Raises:
            DeviceError: the recording cannot be written.
        """
        if self._ingest.failure is not None:
            raise self._ingest.failure
        self._seen = self._presence.nodes()
        self._now = nodes_now(self._seen, self._store.lrfs())
        if self._progress.step(is_solving=self.state.phase in (Phase.WAVING, Phase.TILTS)):
            self._rates.look({camera.name: camera.n_frames for camera in self._store.cameras()}, now_s=time.monotonic())
        self._facts = self._facts_now()
        self._enter(advance(self.state, self._facts, self._plan.rules, press))
        self._orders.step(self.state.phase, self._session, self._now)
        if time.monotonic() >= self._next_state_s:
            self._tell_state()

    def view(self) -> View:
        """What is shown now."""
        progress = self._progress
        own = (self.state.warning,) if self.state.warning and self.state.phase is not Phase.FAILED else ()
        is_heard = time.monotonic() - self._begin_s > HEARD_S
        is_late = self._facts.missing and is_heard and self.state.phase.is_observing
        late = [f"expected, and not there: {', '.join(self._facts.missing)}"] if is_late else []
        return View(
            site=self._plan.site.name,
            session=self._session,
            phase=self.state.phase,
            phase_s=max(self._clock_s() - self.state.since_s, 0.0),
            message=self._message(),
            cameras=camera_rows(self._store.cameras(), self._seen, self._rates, expected=self._plan.site.nodes),
            lrfs=lrf_rows(self._store.lrfs(), self._seen),
            names=progress.overlaps.names,
            shared=progress.overlaps.shared,
            islands=progress.islands,
            live=progress.live,
            lacks=progress.lacks,
            guidance=progress.guidance,
            warnings=(*own, *late, *self._orders.refusals, *warnings_of(self._seen), *self.notes, *self._ending.notes),
            keys=HELP if self._has_keys and not self.is_over else "",
        )

    def _facts_now(self) -> Facts:
        facts = facts_of(
            self._plan.site.nodes,
            self._now,
            session=self._session,
            now_s=self._clock_s(),
            waving_lacks=self._progress.lacks,
        )
        if self._finishing is None or not self._finishing.done():
            return facts
        return replace(facts, solved=self._collect())

    def _collect(self) -> str:
        """The reason why there is no calibration; empty where there is one, which is told then."""
        assert self._finishing is not None
        try:
            self.finished = self._finishing.result()
        except SpotcalError as error:
            return str(error)
        except Exception as error:  # whatever it was, the recording is whole, and the reason is told
            return f"{type(error).__name__}: {error}"
        self.notes += self.finished.notes
        self._announcer.tell_calibration(self.finished.calibration_id, self._plan.folder.calibration.read_bytes())
        return ""

    def _enter(self, step: Step) -> None:
        is_new = step.state != self.state or self._next_state_s == 0.0
        self.state = step.state
        if is_new:
            self._save(was_stopped=False)
            self._tell_state()
        for action in step.actions:
            self._act(action)

    def _act(self, action: Action) -> None:
        match action:
            case Action.RELEARN:
                self._orders.once(Verb.RELEARN, [node.node for node in self._now if node.role is Role.CAMERA])
            case Action.NEXT_TILT:
                self._orders.once(Verb.NEXT, [node.node for node in self._now if node.role is Role.LRF])
            case Action.SOLVE:
                self._finishing = self._pool.submit(self._ending.finish)
            case Action.QUIT:
                ours = [node.node for node in self._now if node.session == self._session]
                wait(self._orders.once(Verb.STOP, ours), STOP_TIMEOUT_S)
                self._save(was_stopped=True)
                self.is_quit = True

    def _send(self, node: str, verb: Verb) -> None:
        """In a thread of the orders."""
        command = pb.Command(header=self._announcer.header())
        # Whoever joins when the room is no longer empty must not take what is in it for its background.
        command.is_late = verb is Verb.START and self.state.phase is not Phase.BACKGROUND
        if verb is Verb.TILTS:
            command.tilts_rad.extend(math.radians(angle) for angle in self._plan.site.session.tilts_deg)
            command.n_crossings = self._plan.site.session.crossings
        try:
            reply = send_command(self._bus, self._keys, node, verb, command, timeout_s=ORDER_TIMEOUT_S)
        except zenoh.ZError as error:
            raise DeviceError(f"the bus does not take the command: {error}") from None
        if reply.code != "OK":
            raise DeviceError(f"{reply.code}: {reply.message}")

    def _message(self) -> str:
        lrfs = lrf_rows(self._store.lrfs(), self._seen)
        return message_of(
            self.state,
            self._facts,
            self._plan.rules,
            guidance=self._progress.guidance,
            crossings=crossings_told(lrfs),
            summary="" if self.finished is None else self.finished.summary,
        )

    def _tell_state(self) -> None:
        payload = self._announcer.tell_state(self.state.phase, self._message())
        self._next_state_s = time.monotonic() + STATE_EVERY_S
        self._store.note(self._keys.session_state, payload, stamp_ns=time.time_ns())

    def _save(self, *, was_stopped: bool) -> None:
        saved = self._plan.saved
        self._plan.folder.save(
            Saved(saved.session, saved.begun_s, self.state.phase, self.state.since_s, self.state.warning, was_stopped)
        )
