"""A keypoint detector with the faults of a real one, each of them switchable and with its own random stream.

Applied in this order: left/right swaps, pixel noise, guesses for markers hidden by the body, gross
outliers, dropouts, rounding to the grid of the network; then each detection gets a likelihood that fits
what happened to it.

Shapes: N frames, C cameras, M markers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from acino_fte.skeleton import Skeleton

GRID, GRID_START = 8.0, 4.0  # px: DeepLabCut's stride, and the middle of its first cell
_BOX = 0.25  # of the size of the animal in the image: margin of the box that outliers fall in

# Beta distributions of the likelihood. A threshold of 0.5 keeps 99.8 % of the good detections, 11 % of the
# guesses for hidden markers and 58 % of the gross outliers: it knows itself often, not always.
LIKELIHOOD = {
    "seen": (9.0, 1.0),
    "swapped": (6.0, 1.5),
    "occluded": (1.5, 4.0),
    "outlier": (1.8, 1.5),
    "absent": (1.0, 12.0),
}


@dataclass(frozen=True)
class Faults:
    """What the detector does wrong; see :class:`acino_fte.simulate.SimulationOptions` for the meaning."""

    noise_px: np.ndarray  # (M,)
    missing: float
    outliers: float
    swaps: float
    occlusion_px: float
    quantise: bool
    seed: int


@dataclass(frozen=True, eq=False)
class Detections:
    """Simulated detections and what happened to each.

    Attributes
    ----------
    position : (N, C, M, 2)
        px; NaN where nothing was detected.
    likelihood : (N, C, M)
    in_image : (N, C, M) bool
        The marker is in front of the camera and inside its image.
    missing, outlier, swapped, occluded : (N, C, M) bool
        Lost at random; replaced by a gross error; took the place of its twin; hidden by the body, so that
        its place was guessed. A missing detection carries no other flag but ``occluded``.
    """

    position: np.ndarray
    likelihood: np.ndarray
    in_image: np.ndarray
    missing: np.ndarray
    outlier: np.ndarray
    swapped: np.ndarray
    occluded: np.ndarray


def detect(
    skeleton: Skeleton,
    pixels: np.ndarray,
    in_image: np.ndarray,
    hidden: np.ndarray,
    resolution: np.ndarray,
    faults: Faults,
) -> Detections:
    """Turn true pixels into detections.

    Parameters
    ----------
    skeleton : Skeleton
        For its twins and limbs.
    pixels : (N, C, M, 2)
        True projections, px; NaN behind a camera.
    in_image : (N, C, M) bool
        The projection is inside the image.
    hidden : (N, C, M) bool
        Hidden by the body.
    resolution : (C, 2)
        Width and height, px.
    faults : Faults
        What goes wrong, and how often.
    """
    streams = np.random.SeedSequence([faults.seed, 0xD7]).spawn(6)
    swap, noise, guess, gross, drop, sure = (np.random.default_rng(s) for s in streams)
    shape = in_image.shape
    source = _swap_sources(swap, skeleton, shape, faults.swaps)
    true = np.where(in_image[..., None], pixels, np.nan)
    position = np.take_along_axis(true, source[..., None], axis=2)
    absent = ~np.isfinite(position[..., 0])
    swapped = (source != np.arange(shape[2])) & ~absent
    position += noise.standard_normal(position.shape) * faults.noise_px[:, None]
    occluded = np.take_along_axis(hidden, source, axis=2) & ~absent
    position += np.where(
        occluded[..., None], guess.standard_normal(position.shape) * faults.occlusion_px, 0.0
    )
    missing = (drop.random(shape) < faults.missing) & ~absent
    outlier = (gross.random(shape) < faults.outliers) & ~absent & ~missing
    wrong = _gross_errors(gross, true, resolution, outlier)
    position = np.where(outlier[..., None], wrong, position)
    position = np.where(missing[..., None], np.nan, position)
    if faults.quantise:
        position = GRID * np.floor(position / GRID) + GRID_START
    kinds = (("swapped", swapped), ("occluded", occluded), ("outlier", outlier), ("absent", absent | missing))
    return Detections(
        position,
        _likelihoods(sure, shape, kinds),
        in_image,
        missing,
        outlier,
        swapped & ~outlier & ~missing,
        occluded & ~outlier,
    )


def _likelihoods(
    rng: np.random.Generator, shape: tuple[int, ...], kinds: Sequence[tuple[str, np.ndarray]]
) -> np.ndarray:
    """Likelihoods (N, C, M): drawn as for a good detection, then replaced kind by kind, the last one wins."""
    likelihood = rng.beta(*LIKELIHOOD["seen"], shape)
    for kind, chosen in kinds:
        likelihood = np.where(chosen, rng.beta(*LIKELIHOOD[kind], shape), likelihood)
    return likelihood


def _gross_errors(
    rng: np.random.Generator, true: np.ndarray, resolution: np.ndarray, outlier: np.ndarray
) -> np.ndarray:
    """Wrong places (N, C, M, 2): half of them on another marker, half anywhere in a box about the animal."""
    seen = np.isfinite(true)
    low = np.min(np.where(seen, true, np.inf), axis=2, keepdims=True)
    high = np.max(np.where(seen, true, -np.inf), axis=2, keepdims=True)
    some = np.isfinite(low)
    low, high = np.where(some, low, 0.0), np.where(some, high, 0.0)
    margin = _BOX * np.max(high - low, axis=-1, keepdims=True)
    low = np.maximum(low - margin, 0.0)
    high = np.minimum(high + margin, resolution[None, :, None] - 1.0)
    anywhere = low + rng.random(true.shape) * (high - low)
    n_markers = true.shape[2]
    shift = rng.integers(1, max(n_markers, 2), true.shape[:3])
    other = (np.arange(n_markers) + shift) % n_markers
    jumped = np.take_along_axis(true, other[..., None], axis=2)
    jumps = (rng.random(true.shape[:3]) < 0.5)[..., None] & np.isfinite(jumped) & (n_markers > 1)
    return np.where(outlier[..., None], np.where(jumps, jumped, anywhere), np.nan)


def _swap_sources(
    rng: np.random.Generator, skeleton: Skeleton, shape: tuple[int, ...], rate: float
) -> np.ndarray:
    """Index (N, C, M) of the marker whose place each marker takes: its own, or that of its twin."""
    n_frames, n_cameras, n_markers = shape
    limbs = twin_limbs(skeleton)
    source = np.broadcast_to(np.arange(n_markers), shape).copy()
    event = rng.random((n_frames, n_cameras)) < rate
    whole = rng.random((n_frames, n_cameras)) < 0.5
    which = rng.integers(0, max(len(limbs), 1), (n_frames, n_cameras))
    for i, limb in enumerate(limbs):
        frames, cameras = np.nonzero(event & (whole | (which == i)))
        for left, right in limb:
            source[frames, cameras, left] = right
            source[frames, cameras, right] = left
    return source


def twin_limbs(skeleton: Skeleton) -> list[list[tuple[int, int]]]:
    """Pairs of twins (left, right), grouped into limbs: those joined by drawn edges belong together.

    Twins are those that the species mirrors, and those named alike but for ``l_``/``r_`` or
    ``left``/``right``.
    """
    pairs = _twin_markers(skeleton)
    group = {left: left for left, _ in pairs}

    def top(i: int) -> int:
        while group[i] != i:
            i = group[i]
        return i

    for a, b in skeleton.edges:
        if a in group and b in group:
            group[top(a)] = top(b)
    limbs: dict[int, list[tuple[int, int]]] = {}
    for left, right in pairs:
        limbs.setdefault(top(left), []).append((left, right))
    return list(limbs.values())


def _twin_markers(skeleton: Skeleton) -> list[tuple[int, int]]:
    index = {name: i for i, name in enumerate(skeleton.marker_names)}
    pairs = {index[left]: index[right] for left, right in skeleton.twins}
    for name, i in index.items():
        for left, right in (("l_", "r_"), ("left", "right"), ("L_", "R_"), ("Left", "Right")):
            twin = right + name.removeprefix(left)
            if name.startswith(left) and twin in index and i not in pairs:
                pairs[i] = index[twin]
    return sorted(pairs.items())
