"""A person of capsules who carries the ball on a short stick: where the limbs are, how they look, what they hide."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from nodes.simulated.rendering.camera_view import CameraView
from nodes.simulated.rendering.spot_path import BallPath

FloatArray = npt.NDArray[np.float64]
Float32Array = npt.NDArray[np.float32]
BoolArray = npt.NDArray[np.bool_]
ByteArray = npt.NDArray[np.uint8]
REACH_M = 0.62
STICK_M = 0.13
SHOULDER_M = 1.42
SKIN_BGR = (0.30, 0.42, 0.62)
HAIR_BGR = (0.05, 0.06, 0.08)
TROUSERS_BGR = (0.16, 0.12, 0.10)
STICK_BGR = (0.03, 0.03, 0.03)
# Sub-pixel places for OpenCV's drawing: fixed point with this many bits.
SHIFT = 4
N_ALONG = 4
N_CAP = 6
SHADOW_RADIUS_M = 0.42


@dataclass(frozen=True, slots=True)
class Person:
    """The limbs at one instant.

    Attributes:
        start: (P, 3) one end of each capsule's axis, m.
        end: (P, 3) the other.
        radius_m: (P,).
        bgr: (P, 3) reflectance.
        is_body: (P,) hides the spot's mirror image too; the stick and hand that hold the ball are too near to it.
    """

    start: FloatArray
    end: FloatArray
    radius_m: FloatArray
    bgr: FloatArray
    is_body: BoolArray

    def hides(self, origin: FloatArray, targets: FloatArray, *, body_only: bool = False) -> BoolArray:
        """(N,) whether a limb lies between an origin (3,) and targets (N, 3)."""
        keep = self.is_body if body_only else np.ones(len(self.start), dtype=bool)
        distance_m = _segment_distances(origin, targets, self.start[keep], self.end[keep])
        return np.asarray((distance_m < self.radius_m[keep]).any(axis=1))


@dataclass(frozen=True, slots=True)
class PersonPatch:
    """The person as one camera sees them.

    Attributes:
        x: column of the patch's first pixel.
        y: row of it.
        bgr: (h, w, 3) reflectance 0..255.
        cover: (h, w) 0..255 how much of each pixel the person covers.
        range_m: distance of the person, m.
    """

    x: int
    y: int
    bgr: ByteArray
    cover: ByteArray
    range_m: float


@dataclass(frozen=True, slots=True)
class Shadow:
    """Where the person takes light from the floor: `dark` (h, w) 0..255 from column x, row y."""

    x: int
    y: int
    dark: ByteArray


def person_at(path: BallPath, time_s: float, *, clothes: float, phase_rad: float) -> Person | None:
    """The person who holds the ball at an instant; None while nobody is in the room.

    They turn around the ball slowly, so that now and then they stand between it and a camera.
    """
    ball = path.at(np.array([time_s]))[0]
    if not np.isfinite(ball).all():
        return None
    turn = phase_rad + 2 * np.pi * time_s / 23.0 + 0.8 * np.sin(2 * np.pi * time_s / 7.3)
    outward = np.array([np.cos(turn), np.sin(turn), 0.0])
    aside = np.array([-outward[1], outward[0], 0.0])
    crouch = float(np.clip((ball[2] + 0.55) / SHOULDER_M, 0.62, 1.0))
    up = np.array([0.0, 0.0, crouch])
    foot = np.array([ball[0], ball[1], 0.0]) + REACH_M * outward
    step = 0.16 * np.sin(2 * np.pi * 0.9 * time_s)
    hip, chest, head = foot + 0.9 * up, foot + 1.32 * up, foot + 1.62 * up
    shoulder = foot + SHOULDER_M * up + 0.2 * aside
    hand = ball + STICK_M * _unit(shoulder - ball)
    elbow = (shoulder + hand) / 2 + 0.08 * aside - np.array([0.0, 0.0, 0.06])
    other_hand = hip - 0.30 * aside + 0.1 * outward
    cloth = (clothes * 0.95, clothes, clothes * 0.85)
    limbs = [
        (hip - 0.09 * aside, foot - 0.11 * aside + step * outward, 0.08, TROUSERS_BGR, True),
        (hip + 0.09 * aside, foot + 0.11 * aside - step * outward, 0.08, TROUSERS_BGR, True),
        (hip, chest, 0.17, cloth, True),
        (foot + SHOULDER_M * up - 0.2 * aside, other_hand, 0.055, cloth, True),
        (head - 0.02 * up, head + 0.05 * up, 0.1, SKIN_BGR, True),
        (head + 0.05 * up + 0.02 * outward, head + 0.09 * up + 0.02 * outward, 0.1, HAIR_BGR, True),
        (shoulder, elbow, 0.055, cloth, True),
        (elbow, hand, 0.045, SKIN_BGR, True),
        (hand, hand, 0.05, SKIN_BGR, False),
        (hand, hand + 0.9 * (ball - hand), 0.006, STICK_BGR, False),
    ]
    start, end, radius_m, bgr, is_body = zip(*limbs, strict=True)
    return Person(np.array(start), np.array(end), np.array(radius_m), np.array(bgr), np.array(is_body))


def draw_person(view: CameraView, person: Person, *, blur_px: float) -> PersonPatch | None:
    """Draw the limbs from far to near; None where none is in the image."""
    outlines = _outlines(view, person)
    if not outlines:
        return None
    corners = np.concatenate([outline for _, outline, _ in outlines])
    low = np.clip(np.floor(corners.min(axis=0) - 3 * blur_px).astype(int), 0, view.size_px)
    high = np.clip(np.ceil(corners.max(axis=0) + 3 * blur_px).astype(int) + 1, 0, view.size_px)
    if (high <= low).any():
        return None
    bgr = np.zeros((high[1] - low[1], high[0] - low[0], 3), dtype=np.uint8)
    cover = np.zeros(bgr.shape[:2], dtype=np.uint8)
    for limb, outline, _ in sorted(outlines, key=lambda drawn: -drawn[2]):
        # Where OpenCV puts pixel centres: at whole numbers, as here.
        polygon = np.rint((outline - low) * (1 << SHIFT)).astype(np.int32)
        colour = [float(c) for c in np.rint(255 * person.bgr[limb])]
        cv2.fillPoly(bgr, [polygon], colour, cv2.LINE_AA, SHIFT)
        cv2.fillPoly(cover, [polygon], [255.0], cv2.LINE_AA, SHIFT)
    # Colours are spread under the soft rim first, so that it does not darken: they were drawn on black.
    bgr = np.where(cover[..., None] > 0, bgr, cv2.dilate(bgr, np.ones((7, 7), dtype=np.uint8)))
    bgr, cover = cv2.GaussianBlur(bgr, (0, 0), blur_px), cv2.GaussianBlur(cover, (0, 0), blur_px)
    range_m = float(np.median([drawn[2] for drawn in outlines]))
    return PersonPatch(int(low[0]), int(low[1]), bgr.astype(np.uint8), cover.astype(np.uint8), range_m)


def draw_shadow(view: CameraView, person: Person) -> Shadow | None:
    """The soft dark place around the feet; None where it is not in the image."""
    foot = (person.end[0] + person.end[1]) / 2
    turn = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    rim = foot + SHADOW_RADIUS_M * np.stack([np.cos(turn), np.sin(turn), 0 * turn], axis=1)
    if ((rim - view.centre_in_world) @ view.rotation[2] < 0.15).any():
        return None
    rim_px = view.project_clamped(rim)
    blur_px = float(np.ptp(rim_px, axis=0).min()) / 8 + 0.5
    low = np.clip(np.floor(rim_px.min(axis=0) - 2 * blur_px).astype(int), 0, view.size_px)
    high = np.clip(np.ceil(rim_px.max(axis=0) + 2 * blur_px).astype(int) + 1, 0, view.size_px)
    if (high <= low).any():
        return None
    dark = np.zeros((high[1] - low[1], high[0] - low[0]), dtype=np.uint8)
    cv2.fillPoly(dark, [np.rint((rim_px - low) * (1 << SHIFT)).astype(np.int32)], [255.0], cv2.LINE_AA, SHIFT)
    size = 2 * int(blur_px) + 1
    for _ in range(2):
        dark = cv2.blur(dark, (size, size))
    return Shadow(int(low[0]), int(low[1]), dark.astype(np.uint8))


def _outlines(view: CameraView, person: Person) -> list[tuple[int, FloatArray, float]]:
    """For each limb in view: its index, its outline in the image (n, 2), its distance."""
    part, cap = np.linspace(0, 1, N_ALONG)[:, None], np.linspace(0, np.pi, N_CAP + 2)[1:-1, None]
    span = (person.end - person.start)[:, None]
    axis = person.start[:, None] + part * span
    middle = axis.mean(axis=1, keepdims=True) - view.centre_in_world
    sight = _units(middle)
    along = _units(span + np.array([0.0, 0.0, 1e-9]))
    side = _units(np.cross(along, sight))
    ahead = np.cross(sight, side)
    ahead = np.where((ahead * along).sum(axis=-1, keepdims=True) < 0, -ahead, ahead)
    radius = person.radius_m[:, None, None]
    cap_end = axis[:, -1:] + radius * (np.cos(cap) * side + np.sin(cap) * ahead)
    cap_start = axis[:, :1] - radius * (np.cos(cap) * side + np.sin(cap) * ahead)
    edge = np.concatenate([axis + radius * side, cap_end, axis[:, ::-1] - radius * side, cap_start], axis=1)
    px = view.project_clamped(edge)
    is_ahead = ((axis - view.centre_in_world) @ view.rotation[2] > 0.15).any(axis=1)
    least, most = px.min(axis=1), px.max(axis=1)
    is_outside = ((most < -0.5) | (least > np.array(view.size_px) - 0.5)).any(axis=1)
    distance_m = np.linalg.norm(middle[:, 0], axis=1)
    return [(int(limb), px[limb], float(distance_m[limb])) for limb in np.flatnonzero(is_ahead & ~is_outside)]


def _segment_distances(origin: FloatArray, targets: FloatArray, start: FloatArray, end: FloatArray) -> FloatArray:
    """(N, P) smallest distances between the segments origin -> targets (N, 3) and start -> end (P, 3)."""
    sight = (targets - origin)[:, None, :]
    limb = (end - start)[None]
    offset = (origin - start)[None]
    sight2, limb2 = (sight * sight).sum(-1), (limb * limb).sum(-1)
    cross = (sight * limb).sum(-1)
    on_sight, on_limb = (sight * offset).sum(-1), (limb * offset).sum(-1)
    determinant = sight2 * limb2 - cross * cross
    s = np.clip((cross * on_limb - on_sight * limb2) / np.maximum(determinant, 1e-12), 0, 1)
    t = np.clip((cross * s + on_limb) / np.maximum(limb2, 1e-12), 0, 1)
    s = np.clip((cross * t - on_sight) / np.maximum(sight2, 1e-12), 0, 1)
    gap = offset + s[..., None] * sight - t[..., None] * limb
    return np.sqrt((gap * gap).sum(-1))


def _unit(vector: FloatArray) -> FloatArray:
    return vector / max(float(np.linalg.norm(vector)), 1e-12)


def _units(vectors: FloatArray) -> FloatArray:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-12)
