"""Messages that nobody should believe, of eleven kinds, made from genuine ones; the seed decides."""

import os
import struct
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
import zenoh

from nodes.bus import spotcal_pb2 as pb
from nodes.bus.keys import Keys, Kind
from nodes.bus.seal import seal
from nodes.bus.session import BusOptions, open_bus

HUGE_BYTES = 5 * 2**20


class Attack(StrEnum):
    """What is wrong with a message."""

    RANDOM = "random bytes"
    MUTATED = "mutated, with the seal of the genuine one"
    NAN = "not a number"
    HUGE = "5 MiB"
    WRONG_KEY = "a key that is none"
    WRONG_NODE = "the header names another node"
    REPLAYED = "replayed"
    FUTURE = "from the future"
    OTHER_SESSION = "of another session"
    JUMP = "sequence 2**50 ahead"
    BOOT = "forged boot"


@dataclass(frozen=True, slots=True)
class Hostile:
    """One message and how it is published."""

    attack: Attack
    key: str
    payload: bytes
    attachment: bytes | None


def hostile_messages(keys: Keys, genuine: bytes, node: str, n: int, rng: np.random.Generator) -> Iterator[Hostile]:
    """`n` of them, all attacks in turn; a huge one each ten thousand.

    Args:
        keys: of the site.
        genuine: an observation of `node` that the coordinator has got already: spots, one frame, one spot.
        node: that the attacker pretends to be.
        n: how many.
        rng: what varies.
    """
    attacks = [attack for attack in Attack if attack is not Attack.HUGE]
    for k in range(n):
        attack = Attack.HUGE if k % 10_000 == 5_000 else attacks[k % len(attacks)]
        yield _made(attack, keys, genuine, node, rng)


def _made(attack: Attack, keys: Keys, genuine: bytes, node: str, rng: np.random.Generator) -> Hostile:
    key = keys.observation(node, Kind.SPOTS)
    match attack:
        case Attack.RANDOM:
            kind = list(Kind)[rng.integers(len(Kind))]
            return Hostile(attack, keys.observation(node, kind), rng.bytes(int(rng.integers(300))), None)
        case Attack.MUTATED:
            return Hostile(attack, key, _mutated(genuine, rng), seal(genuine))
        case Attack.HUGE:
            return Hostile(attack, key, rng.bytes(HUGE_BYTES), None)
        case Attack.WRONG_KEY:
            ending = ("video", "SPOTS", "spots-", "%00", "-")[rng.integers(5)]
            return Hostile(attack, f"{keys.base}/node/{node}{rng.integers(10**9)}/obs/{ending}", genuine, seal(genuine))
        case Attack.REPLAYED:
            return Hostile(attack, key, genuine, seal(genuine))
        case _:
            payload = _forged(attack, genuine, rng)
            return Hostile(attack, key, payload, seal(payload))


def _forged(attack: Attack, genuine: bytes, rng: np.random.Generator) -> bytes:
    """A whole message with a good seal: only what it says is wrong."""
    message = pb.SpotBatch.FromString(genuine)
    match attack:
        case Attack.NAN:
            column = (message.x_px, message.y_px, message.sigma_px, message.score)[rng.integers(4)]
            column[0] = (np.nan, np.inf, -np.inf)[rng.integers(3)]
            message.header.sequence += 1
        case Attack.WRONG_NODE:
            message.header.node = "somebody"
        case Attack.FUTURE:
            message.header.stamp_ns = time.time_ns() + int(rng.integers(3600, 10**7)) * 10**9
        case Attack.OTHER_SESSION:
            message.header.session = f"s{rng.integers(10**6)}-old"
        case Attack.JUMP:
            message.header.sequence = 2**50 + int(rng.integers(2**40))
        case Attack.BOOT:
            message.header.boot = os.urandom(16)
    return message.SerializeToString()


def _mutated(payload: bytes, rng: np.random.Generator) -> bytes:
    """One to four bytes changed, or a piece cut out, doubled or put in; never the payload itself."""
    while True:
        changed = bytearray(payload)
        at = int(rng.integers(len(payload)))
        match rng.integers(5):
            case 0 | 1:
                for place in rng.integers(len(payload), size=rng.integers(1, 5)):
                    changed[place] = rng.integers(256)
            case 2:
                changed = changed[:at]
            case 3:
                changed[at:at] = changed[at : at + 20]
            case _:
                changed[at:at] = struct.pack("<d", rng.normal())
        if changed != payload:
            return bytes(changed)


def flood(endpoints: tuple[str, ...], site: str, genuine: bytes, node: str, n: int, seed: int) -> Counter[Attack]:
    """Publish `n` hostile messages from a session of one's own; what was sent, by attack.

    With BLOCK, so that each arrives and must be counted; but huge ones with DROP: among other traffic, a router that
    must not drop their fragments closes the link to the coordinator after five seconds, and what waits for it is lost.
    """
    sent: Counter[Attack] = Counter()
    with open_bus(BusOptions(site, endpoints)) as session:
        for message in hostile_messages(Keys(site), genuine, node, n, np.random.default_rng(seed)):
            sent[message.attack] += 1
            control = zenoh.CongestionControl
            session.put(
                message.key,
                message.payload,
                attachment=message.attachment,
                congestion_control=control.DROP if message.attack is Attack.HUGE else control.BLOCK,
            )
    return sent
