"""Lost pictures of an H.264 stream, told from the numbers that the stream itself carries.

When a picture that others refer to is lost, the decoder goes on with the picture before it and says nothing: measured
here, a spot moving by 8 px a frame stood up to 150 px from its place until the next key frame, every picture marked as
good. Each slice carries `frame_num` (ITU-T H.264, 7.4.3), which rises by one after every reference picture; a gap is
found by reading a few bits of the first slice. H.265 needs no such watch: its decoder refuses missing references.
"""

from __future__ import annotations

from dataclasses import dataclass

_SLICE, _KEY_SLICE, _PARAMETERS = 1, 5, 7
# Profiles whose parameter sets say more about the samples (7.3.2.1.1).
_HIGH_PROFILES = frozenset({44, 83, 86, 100, 110, 118, 122, 128, 134, 135, 138, 139, 244})
# Parameter sets and supplemental data before the first slice fit into this many bytes, or the packet is not judged.
_HEAD_BYTES = 8192
_MAX_HEADER_BYTES = 400


class FrameNumbers:
    """Watches the packets of one stream, in decoding order."""

    def __init__(self, extradata: bytes | None = None) -> None:
        self._parameters: _Parameters | None = None
        self._last_reference: int | None = None
        self.is_gap_before(extradata or b"")

    def is_gap_before(self, packet: bytes) -> bool:
        """Whether a reference picture is missing between this packet (Annex B) and the one before it."""
        for unit in _units(packet[:_HEAD_BYTES]):
            kind, is_reference = unit[0] & 0x1F, bool(unit[0] & 0x60)
            if kind == _PARAMETERS:
                self._parameters = _read_parameters(_Bits(unit))
            elif kind in (_SLICE, _KEY_SLICE):
                return self._judge(_Bits(unit), is_key=kind == _KEY_SLICE, is_reference=is_reference)
        return False

    def _judge(self, bits: _Bits, *, is_key: bool, is_reference: bool) -> bool:
        parameters = self._parameters
        if parameters is None or parameters.is_gap_allowed:
            return False
        bits.skip(8)
        for _ in range(3):  # first macroblock, slice type, picture parameter set
            bits.unsigned()
        number = bits.read(parameters.n_number_bits)
        last, modulus = self._last_reference, 1 << parameters.n_number_bits
        is_gap = not is_key and last is not None and number not in (last, (last + 1) % modulus)
        if is_reference:
            self._last_reference = number
        elif is_gap:
            self._last_reference = (number - 1) % modulus  # that of the lost picture: the gap is told once
        return is_gap


@dataclass(frozen=True, slots=True)
class _Parameters:
    """What a sequence parameter set says of `frame_num`."""

    n_number_bits: int
    is_gap_allowed: bool


def _read_parameters(bits: _Bits) -> _Parameters:
    """ITU-T H.264, 7.3.2.1.1, as far as `gaps_in_frame_num_value_allowed_flag`."""
    bits.skip(8)
    profile = bits.read(8)
    bits.skip(16)
    bits.unsigned()
    has_separate_planes = profile in _HIGH_PROFILES and _skip_samples(bits)
    n_number_bits = bits.unsigned() + 4
    order_type = bits.unsigned()
    if order_type == 0:
        bits.unsigned()
    elif order_type == 1:
        bits.skip(1)
        bits.unsigned()
        bits.unsigned()
        for _ in range(min(bits.unsigned(), 255)):
            bits.unsigned()
    bits.unsigned()
    # Planes that are coded apart shift the slice header; no camera does that, and its gaps are then not looked for.
    return _Parameters(min(n_number_bits, 16), bool(bits.read(1)) or has_separate_planes)


def _skip_samples(bits: _Bits) -> bool:
    """Chroma, depth and scaling lists; whether the three planes are coded apart."""
    chroma = bits.unsigned()
    has_separate_planes = chroma == 3 and bool(bits.read(1))
    bits.unsigned()
    bits.unsigned()
    bits.skip(1)
    if bits.read(1):
        for index in range(12 if chroma == 3 else 8):
            if bits.read(1):
                _skip_scaling_list(bits, 16 if index < 6 else 64)
    return has_separate_planes


def _skip_scaling_list(bits: _Bits, n_entries: int) -> None:
    """7.3.2.1.1.1: a list ends early where the next scale comes to 0."""
    scale = 8
    for _ in range(n_entries):
        code = bits.unsigned()
        scale = (scale + (code + 1 if code & 1 else -code) // 2) % 256
        if scale == 0:
            return


def _units(packet: bytes) -> list[bytes]:
    """The units between start codes, without their emulation prevention (7.3.1)."""
    parts = packet.split(b"\x00\x00\x01")[1:]
    return [part[:_MAX_HEADER_BYTES].replace(b"\x00\x00\x03", b"\x00\x00") for part in parts if part]


class _Bits:
    """Reads bits from the front; zeros follow the end, so that damaged data ends every loop."""

    def __init__(self, data: bytes) -> None:
        self._value = int.from_bytes(data, "big")
        self._n_left = 8 * len(data)

    def read(self, n_bits: int) -> int:
        self._n_left -= n_bits
        shifted = self._value >> self._n_left if self._n_left >= 0 else self._value << -self._n_left
        return shifted & ((1 << n_bits) - 1)

    def skip(self, n_bits: int) -> None:
        self._n_left -= n_bits

    def unsigned(self) -> int:
        """An Exp-Golomb code (9.1)."""
        n_zeros = 0
        while n_zeros < 32 and not self.read(1):
            n_zeros += 1
        return (1 << n_zeros) - 1 + self.read(n_zeros)
