"""The observations of a recording, every one checked again: a recording may be foreign.

Their order is that of the nodes: by node, by the first stamp of a boot, by sequence. So the order of arrival, and how
often a row arrived, make no difference.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable
from dataclasses import dataclass
from hashlib import blake2b

from nodes.bus import spotcal_pb2 as pb
from nodes.bus.checks import MessageError, Observation, parse_observation
from nodes.bus.keys import Kind
from nodes.bus.ledger import Ledger
from nodes.recording.reader import Row
from nodes.recording.schemas import address_of, message_type_of

# Of these nothing but their headers is asked for afterwards, and they are most of a recording's bytes.
_BULK = (Kind.LRF_SCAN, Kind.IMU)


@dataclass(frozen=True, slots=True)
class MissingRows:
    """Observations that a node numbered and the recording does not hold, or holds and had to refuse."""

    node: str
    boot: bytes
    first: int
    last: int

    @property
    def n_rows(self) -> int:
        return self.last - self.first + 1


@dataclass(frozen=True, slots=True)
class Checked:
    """One observation.

    Attributes:
        kind: of it.
        header: of it.
        message: None for scans and IMU samples, whose contents were checked and let go.
    """

    kind: Kind
    header: pb.Header
    message: Observation | None


@dataclass(frozen=True, slots=True)
class CheckedRows:
    """The good observations of a session.

    Attributes:
        session: id.
        observations: in the order of the module.
        n_rows: of the recording, of all keys.
        refused: rows that were left out, by reason.
        missing: by node and boot, in order.
    """

    session: str
    observations: tuple[Checked, ...]
    n_rows: int
    refused: Counter[str]
    missing: tuple[MissingRows, ...]


def check_rows(rows: Iterable[Row], *, session: str, refused: Counter[str]) -> CheckedRows:
    """Check, order and number the observations of a recording.

    Args:
        rows: of the recording.
        session: id; empty: the one that most observations belong to.
        refused: what reading has left out already; is added to.
    """
    unique = _Unique(refused)
    n_rows = 0
    for row in rows:
        n_rows += 1
        unique.add(row)
    ordered = unique.ordered()
    told = session or _commonest(ordered)
    kept = tuple(one for one in ordered if one.header.session == told)
    if len(kept) < len(ordered):
        refused["header.session: another session"] += len(ordered) - len(kept)
    return CheckedRows(told, kept, n_rows, refused, _missing(ordered))


# Node, boot, sequence.
_Identity = tuple[str, bytes, int]


class _Unique:
    """Observations by identity; of two that differ the one of the lesser digest, whichever came first."""

    def __init__(self, refused: Counter[str]) -> None:
        self._refused = refused
        self._held: dict[_Identity, tuple[Checked, bytes]] = {}
        self._rivals: defaultdict[_Identity, set[bytes]] = defaultdict(set)

    def add(self, row: Row) -> None:
        key = address_of(row.key)
        if key is None:
            if message_type_of(row.key) is None:
                self._refused["key: of no observation"] += 1
            return
        try:
            message = parse_observation(key.kind, row.payload, node=key.node, now_ns=row.log_ns)
        except MessageError as error:
            self._refused[f"{key.kind}: {error.reason}"] += 1
            return
        header = pb.Header()
        header.CopyFrom(message.header)
        checked = Checked(key.kind, header, None if key.kind in _BULK else message)
        self._hold((header.node, header.boot, header.sequence), checked, row.payload)

    def _hold(self, identity: _Identity, checked: Checked, payload: bytes) -> None:
        digest = _digest(checked.kind, payload)
        held = self._held.get(identity)
        if held is not None and held[1] != digest:
            self._rivals[identity] |= {held[1], digest}
        if held is None or digest < held[1]:
            self._held[identity] = checked, digest

    def ordered(self) -> list[Checked]:
        n_rivals = sum(len(digests) - 1 for digests in self._rivals.values())
        if n_rivals:
            self._refused["header.sequence: told twice, differently"] += n_rivals
        first_ns: dict[tuple[str, bytes], int] = {}
        for (node, boot, _), (checked, _) in self._held.items():
            stamp_ns = checked.header.stamp_ns
            first_ns[node, boot] = min(stamp_ns, first_ns.get((node, boot), stamp_ns))
        keys = sorted(self._held, key=lambda key: (key[0], first_ns[key[:2]], key[1], key[2]))
        return [self._held[key][0] for key in keys]


def _digest(kind: Kind, payload: bytes) -> bytes:
    return blake2b(payload, digest_size=16, person=kind.encode()).digest()


def _commonest(observations: Iterable[Checked]) -> str:
    counts = Counter(one.header.session for one in observations)
    return min(counts, key=lambda session: (-counts[session], session), default="")


def _missing(observations: Iterable[Checked]) -> tuple[MissingRows, ...]:
    """Numbers run over all sessions of a boot, so all rows of a boot are looked at."""
    ledger = Ledger()
    for one in observations:
        ledger.insert(one.header.node, one.header.boot, one.header.sequence)
    return tuple(MissingRows(node, gap.boot, gap.first, gap.last) for node in ledger.nodes for gap in ledger.gaps(node))
