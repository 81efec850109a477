"""The spot in compressed video: H.264 of a few Mbit/s, and what a fit, centroids and OpenCV's blob detector make of it.

A room of soft shapes and fine texture under sensor noise, empty at first; then spots wander through it. What is empty
teaches the background, as it does the detector.
"""

from __future__ import annotations

import io
from dataclasses import dataclass

import numpy as np

from benchmarks.spot_pictures import Picture
from network_calib.observations import FloatArray
from nodes.detection.noise_model import PROCESSED_CORRELATION_PX2, NoiseModel
from nodes.detection.profile import localise

WIDTH, HEIGHT, RATE_HZ, BIT_RATE = 1920, 1080, 25, 4_000_000
N_SPOTS, STEP_PX, N_EMPTY, N_SETTLING = 8, 4.0, 20, 5
NOISE_SIGMA = 2.0
REACH_PX = 12  # of a window, to each side
FULL_SCALE = 235  # of luma in video


@dataclass(frozen=True, slots=True)
class Errors:
    """M spots, errors in px.

    Attributes:
        fit_px: (M, 2).
        stated_px2: (M, 2) variances that the fit stated.
        centroid_px: (M, 2) of what exceeds four standard deviations of the sensor, weighted by brightness.
        thresholded_px: (M, 2) of the pixels above half of the peak, all alike.
        blob_px: (K, 2) of `cv2.SimpleBlobDetector` in the picture, where it found something: of several the nearest.
        light_blob_px: (L, 2) the same in the picture less its background.
        mbit_s: as encoded.
    """

    fit_px: FloatArray
    stated_px2: FloatArray
    centroid_px: FloatArray
    thresholded_px: FloatArray
    blob_px: FloatArray
    light_blob_px: FloatArray
    mbit_s: float


def compressed(*, width: float, peak: float, n_frames: int, rng: np.random.Generator) -> Errors:
    """Render, encode, decode, locate."""
    paths = _paths(n_frames, rng)
    frames = _frames(paths, width, peak, rng)
    decoded, n_bytes = _decoded(frames)
    empty = np.array(decoded[N_SETTLING:N_EMPTY], dtype=np.float32)
    background = empty.mean(axis=0)
    # A codec repeats what does not change: its noise near a moving spot is not that of the empty scene. Even weights
    # are then right, and the residuals say how large the noise is.
    noise = NoiseModel(float(np.median(empty.var(axis=0))), 0.0, PROCESSED_CORRELATION_PX2)
    columns: list[list[FloatArray]] = [[], [], [], [], [], []]
    detector = _blob_detector()
    for positions, image in zip(paths, decoded[N_EMPTY:], strict=True):
        for px in positions:
            corner = px.astype(int) - REACH_PX
            part = np.s_[corner[1] : corner[1] + 2 * REACH_PX + 1, corner[0] : corner[0] + 2 * REACH_PX + 1]
            light = image[part] - background[part]
            found = localise(image[part], background[part].astype(float), noise=noise, full_scale=FULL_SCALE)
            if found is not None:
                columns[0].append(found.px + corner - px)
                columns[1].append(found.covariance_px2.diagonal())
            columns[2].append(_centroid(np.where(light > 4 * NOISE_SIGMA, light, 0.0)) + corner - px)
            columns[3].append(_centroid((light > light.max() / 2).astype(float)) + corner - px)
            for column, seen in ((columns[4], image[part]), (columns[5], np.clip(np.round(light), 0, 255))):
                column.extend(_nearest_blob(detector, seen.astype(np.uint8), px - corner))
    return Errors(*(np.array(column) for column in columns), mbit_s=n_bytes * 8e-6 * RATE_HZ / len(frames))


def _paths(n_frames: int, rng: np.random.Generator) -> FloatArray:
    """(n, spots, 2) straight ways that stay in the picture."""
    start = np.stack([np.linspace(300, WIDTH - 300, N_SPOTS), rng.uniform(300, HEIGHT - 300, N_SPOTS)], axis=1)
    angle = rng.uniform(0, 2 * np.pi, N_SPOTS)
    step = STEP_PX * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return start + step * np.arange(n_frames)[:, None, None]


def _frames(paths: FloatArray, width: float, peak: float, rng: np.random.Generator) -> list[np.ndarray]:
    """Luma of the empty room, then of the room with the spots."""
    import cv2

    room = cv2.resize(rng.uniform(30, 90, (34, 60)), (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC)
    room = room + cv2.GaussianBlur(rng.normal(0, 20, (HEIGHT, WIDTH)), (0, 0), 1.5)
    frames = []
    for positions in [np.empty((0, 2))] * N_EMPTY + list(paths):
        frame = room + rng.normal(0, NOISE_SIGMA, room.shape)
        for x, y in positions.tolist():
            left, top = int(x) - 20, int(y) - 20
            frame[top : top + 41, left : left + 41] += Picture((41, 41), x - left, y - top, width, peak).light()
        frames.append(np.clip(np.round(frame), 16, FULL_SCALE).astype(np.uint8))
    return frames


def _decoded(frames: list[np.ndarray]) -> tuple[list[np.ndarray], int]:
    """Luma after H.264, and the number of bytes."""
    import av

    buffer = io.BytesIO()
    with av.open(buffer, "w", format="mp4") as container:
        stream = container.add_stream("libx264", rate=RATE_HZ)
        stream.width, stream.height, stream.pix_fmt, stream.bit_rate = WIDTH, HEIGHT, "yuv420p", BIT_RATE
        rate = f"{BIT_RATE // 1000}k"
        stream.options = {"preset": "veryfast", "tune": "zerolatency", "maxrate": rate, "bufsize": rate}
        picture = np.full((HEIGHT * 3 // 2, WIDTH), 128, dtype=np.uint8)
        for luma in frames:
            picture[:HEIGHT] = luma
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="yuv420p")))
        container.mux(stream.encode(None))
    n_bytes = buffer.tell()
    buffer.seek(0)
    with av.open(buffer, "r") as recording:
        return [frame.to_ndarray()[:HEIGHT].copy() for frame in recording.decode(video=0)], n_bytes


def _blob_detector():  # noqa: ANN202 - OpenCV's class has no public type
    import cv2

    parameters = cv2.SimpleBlobDetector.Params()
    parameters.blobColor, parameters.minArea, parameters.maxArea = 255, 3, 2000
    parameters.filterByCircularity = parameters.filterByConvexity = parameters.filterByInertia = False
    parameters.minThreshold, parameters.maxThreshold, parameters.thresholdStep = 20, FULL_SCALE, 10
    return cv2.SimpleBlobDetector.create(parameters)


def _nearest_blob(detector, image: np.ndarray, px: FloatArray) -> list[FloatArray]:  # noqa: ANN001 - as above
    """(2,) error of the blob that is nearest to the truth; none where no blob is seen."""
    errors = [np.array(blob.pt) - px for blob in detector.detect(np.ascontiguousarray(image))]
    return sorted(errors, key=lambda error: float(np.hypot(*error)))[:1]


def _centroid(weight: FloatArray) -> FloatArray:
    y, x = np.indices(weight.shape)
    return np.array([(weight * x).sum(), (weight * y).sum()]) / weight.sum()
