"""How well pieces of 2D tracks in two views agree, as log-odds of being one animal.

In a frame that two pieces share, one animal gives plane angles that differ by noise, d ~ N(0, σ²) px; two
animals give any difference, with the density of the dots of the recording. But two animals that stay where
they are, or keep to one plane for long, are near each other in many frames by one chance: their frames are
not independent looks. A piece's *memory* L is how long it takes to move away from a plane by two standard
deviations, and n shared frames hold n/L looks of n_b = L frames each. Inside a look the mean of d is one draw
of a coincidence, and the scatter about it tells nothing. With a slow part σ_s of the noise (calibration, a
dot that is not the same spot of the body in both views), the log of the Bayes factor of a look is

    log N(d̄; 0, v) − log p(d̄ | others) = chance + ½ log((σ² + σ_s²)/v) − ½ d̄²/v,     v = σ²/n_b + σ_s²

where chance = −log(√(2π) √(σ² + σ_s²) · density of another animal's dots along d). The sum over the looks is
the weight W. The sum of d̄²/v is taken over blocks no longer than a look (frames, chunks of 64 frames, or
all), which has the same mean, with as much added as the additional blocks take away; scatter inside a block
counts only where it is clearly too large. A frame in which the dots are beyond reach costs ½ reach²; one in
fifty is free, for the dots of real detectors that are somewhere else.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
from itertools import groupby

import numpy as np

from acino_fte.data_tools.track_dots import Dots, Noise, runs, usable_rows
from acino_fte.data_tools.track_memory import memories

REACH = 4.0
"""Dots further apart than this, in standard deviations, are as good as unrelated; the floor of a frame."""
_CHUNK = 64
_SELDOM = 0.25
_STRAY = 0.02
_BINS = 256
_SPAN = 8.0 * np.pi  # from one frame to the next in keys of frame and angle
_BATCH = 1_000_000
_HOPELESS = -40.0  # pairs of pieces below count as never near each other


@dataclass(frozen=True, eq=False)
class Evidence:
    """Pairs of pieces that were near each other, E of them.

    Attributes
    ----------
    a, b : (E,) int
        Pieces of the first and of the second view.
    near, shared : (E,) int
        Frames in which their dots were within reach, and frames that both have.
    squares, sums : (E,)
        Sums of d² and of d over the near frames, px², px.
    between : (E,)
        Sum over chunks of frames of (mean d)²/(σ²/n + σ_s²).
    squared_means : (E,)
        Sum over chunks of n (mean d)², px².
    chunks : (E,)
        Number of chunks.
    weight : (E,)
        W, log Bayes factor (natural).
    """

    a: np.ndarray
    b: np.ndarray
    near: np.ndarray
    shared: np.ndarray
    squares: np.ndarray
    sums: np.ndarray
    between: np.ndarray
    squared_means: np.ndarray
    chunks: np.ndarray
    weight: np.ndarray

    def take(self, which: np.ndarray) -> Evidence:
        """Some of the pairs."""
        return Evidence(**{field.name: getattr(self, field.name)[which] for field in fields(self)})


def near_dots(
    a: Dots, b: Dots, reach: float
) -> Iterator[tuple[int, int, np.ndarray, np.ndarray, np.ndarray]]:
    """Dots of two views in one frame that lie within `reach` px of one plane, chunk by chunk of frames.

    Yields
    ------
    first, stop : int
        The frames of the chunk. One with many dots comes in several parts.
    i, j : (K,) int
        Rows of a and of b.
    d : (K,)
        Signed distance, px.
    """
    use_a, use_b = usable_rows(a), usable_rows(b)
    if not len(use_a) or not len(use_b):
        return
    first = int(min(a.frame[use_a[0]], b.frame[use_b[0]]))
    stop = int(min(a.frame[use_a[-1]], b.frame[use_b[-1]])) + 1
    for start in range(first, stop, _CHUNK):
        end = start + _CHUNK
        rows_a = use_a[slice(*np.searchsorted(a.frame[use_a], (start, end)))]
        rows_b = use_b[slice(*np.searchsorted(b.frame[use_b], (start, end)))]
        if len(rows_a) and len(rows_b):
            for found in _near_in_chunk(a, b, rows_a, rows_b, reach):
                yield (start, end, *found)


def _near_in_chunk(
    a: Dots, b: Dots, rows_a: np.ndarray, rows_b: np.ndarray, reach: float
) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Sort the second view's dots by frame and angle; look up the first view's, once a turn of the pencil."""
    slope_a, slope_b = a.angles.slope[rows_a], b.angles.slope[rows_b]
    angle_a, angle_b = a.angles.angle[rows_a], b.angles.angle[rows_b]
    key_b = b.frame[rows_b] * _SPAN + angle_b
    order = np.argsort(key_b)
    half = np.minimum(reach * np.hypot(slope_a, slope_b.max()), np.pi)
    crossing = np.flatnonzero(np.abs(angle_a) + half > np.pi)
    for turn, who in ((0.0, np.arange(len(rows_a))), (2 * np.pi, crossing), (-2 * np.pi, crossing)):
        key_a = a.frame[rows_a[who]] * _SPAN + angle_a[who] + turn
        low = np.searchsorted(key_b[order], key_a - half[who])
        count = np.searchsorted(key_b[order], key_a + half[who], side="right") - low
        for part in _batches(count):
            i = np.repeat(who[part], count[part])
            j = order[runs(low[part], count[part])]
            d = (angle_a[i] + turn - angle_b[j]) / np.hypot(slope_a[i], slope_b[j])
            meet = b.angles.along[rows_b[j]] - a.angles.along[rows_a[i]] > -reach * (slope_a[i] + slope_b[j])
            keep = (np.abs(d) < reach) & meet
            yield rows_a[i[keep]], rows_b[j[keep]], d[keep]


def _batches(count: np.ndarray) -> Iterator[slice]:
    """Slices of the entries with about a million pairs each."""
    if not len(count):
        return
    batch = np.cumsum(count) // _BATCH
    edges = np.flatnonzero(np.r_[True, batch[1:] != batch[:-1], True])
    for first, stop in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True):
        yield slice(first, stop)


def gather_evidence(a: Dots, b: Dots, noise: Noise, weigh: bool = True) -> Evidence:
    """Weights of all pairs of pieces that are near each other in at least one frame in four.

    Parameters
    ----------
    a, b : Dots
        Of the two views of a pair, with the plane angles of this pair.
    noise : Noise
        Of a dot's coordinate.
    weigh : bool
        Whether to give weights, and to leave out hopeless pairs.
    """
    chunks_of = groupby(near_dots(a, b, REACH * noise.total), key=lambda found: found[:2])
    parts = [_chunk_evidence(a, b, chunk, [f[2:] for f in found], noise) for chunk, found in chunks_of]
    key = np.concatenate([part[0] for part in parts]) if parts else np.empty(0, dtype=np.int64)
    order = np.argsort(key, kind="stable")
    key = key[order]
    heads = np.flatnonzero(np.r_[True, key[1:] != key[:-1]]) if len(key) else np.empty(0, dtype=int)

    def total(k: int) -> np.ndarray:
        values = np.concatenate([part[k] for part in parts])[order] if parts else np.empty(0)
        return np.add.reduceat(values, heads) if len(heads) else np.empty(0)

    pairs = key[heads]
    piece_a, piece_b = pairs // max(b.n_pieces, 1), pairs % max(b.n_pieces, 1)
    near, squares, sums, between, means, chunks = (total(k) for k in range(1, 7))
    shared = shared_frames(a, b, piece_a, piece_b)
    found = Evidence(
        piece_a, piece_b, near, shared, squares, sums, between, means, chunks, np.zeros(len(pairs))
    )
    if not weigh:
        return found
    found = replace(found, weight=_weights(a, b, noise, found))
    return found.take(found.weight > _HOPELESS)


def _chunk_evidence(
    a: Dots,
    b: Dots,
    chunk: tuple[int, int],
    found: list[tuple[np.ndarray, np.ndarray, np.ndarray]],
    noise: Noise,
) -> tuple[np.ndarray, ...]:
    """Keys and sums of one chunk, as in :class:`Evidence`; pairs that are seldom near are left out."""
    start, end = chunk
    active_a, local_a = _active(a, start, end)
    active_b, local_b = _active(b, start, end)
    n_a, n_b = len(active_a), len(active_b)
    near, squares, sums = np.zeros(n_a * n_b), np.zeros(n_a * n_b), np.zeros(n_a * n_b)
    for i, j, d in found:
        index = local_a[a.piece[i]] * n_b + local_b[b.piece[j]]
        near += np.bincount(index, minlength=n_a * n_b)
        squares += np.bincount(index, weights=d**2, minlength=n_a * n_b)
        sums += np.bincount(index, weights=d, minlength=n_a * n_b)
    shared = _presence(a, start, end, local_a, n_a) @ _presence(b, start, end, local_b, n_b).T
    keep = np.flatnonzero((near > 0) & (near >= _SELDOM * shared.ravel()))
    key = active_a[keep // n_b].astype(np.int64) * b.n_pieces + active_b[keep % n_b]
    count, squares, sums = near[keep], squares[keep], sums[keep]
    means = sums**2 / count
    between = means / (noise.white**2 + count * noise.slow**2)
    return key, count, squares, sums, between, means, np.ones(len(keep))


def _active(dots: Dots, start: int, end: int) -> tuple[np.ndarray, np.ndarray]:
    """Pieces with a dot in some frames, and the index of each piece among them."""
    low, high = np.searchsorted(dots.frame, (start, end))
    pieces = np.unique(dots.piece[low:high])
    pieces = pieces[pieces >= 0]
    local = np.zeros(dots.n_pieces + 1, dtype=np.int64)
    local[pieces] = np.arange(len(pieces))
    return pieces, local


def _presence(dots: Dots, start: int, end: int, local: np.ndarray, n: int) -> np.ndarray:
    """(n, frames) 1 where a piece has a dot."""
    low, high = np.searchsorted(dots.frame, (start, end))
    rows = low + np.flatnonzero((dots.piece[low:high] >= 0) & np.isfinite(dots.angles.angle[low:high]))
    present = np.zeros((n, end - start), dtype=np.float32)
    present[local[dots.piece[rows]], dots.frame[rows] - start] = 1.0
    return present


_ONES = np.array([bin(value).count("1") for value in range(256)], dtype=np.uint8)


def shared_frames(a: Dots, b: Dots, piece_a: np.ndarray, piece_b: np.ndarray) -> np.ndarray:
    """Number of frames in which both pieces of each pair have a usable dot, (E,)."""
    n_frames = int(max(a.frame.max(initial=0), b.frame.max(initial=0))) + 1
    bits_a, bits_b = _bits(a, n_frames), _bits(b, n_frames)
    shared = np.empty(len(piece_a))
    step = max(1, 20_000_000 // max(bits_a.shape[1], 1))
    for start in range(0, len(piece_a), step):
        part = slice(start, start + step)
        both = bits_a[piece_a[part]] & bits_b[piece_b[part]]
        shared[part] = _ONES[both].sum(1, dtype=np.int64)
    return shared


def _bits(dots: Dots, n_frames: int) -> np.ndarray:
    rows = usable_rows(dots)
    present = np.zeros((dots.n_pieces, n_frames), dtype=bool)
    present[dots.piece[rows], dots.frame[rows]] = True
    return np.packbits(present, axis=1)


def _weights(a: Dots, b: Dots, noise: Noise, e: Evidence) -> np.ndarray:
    """W of the module's docstring, (E,)."""
    chance = 0.5 * (log_chance(a, b, noise.total)[e.a] + log_chance(b, a, noise.total)[e.b])
    memory = np.maximum(memories(a, noise.total)[e.a], memories(b, noise.total)[e.b])
    shared, near = np.maximum(e.shared, 1.0), np.maximum(e.near, 1.0)
    looks = np.maximum(shared / memory, 1.0)
    frames_a_look = shared / looks
    spread = noise.white**2 / frames_a_look + noise.slow**2
    whole = e.sums**2 / near / (noise.white**2 + near * noise.slow**2)
    frames, chunks = e.squares / noise.total**2 - e.near, e.between - e.chunks
    fine, coarse = _clearly_too_large(frames, e.near), _clearly_too_large(chunks, e.chunks)
    misfit = np.select(
        [memory < _CHUNK / 4, memory < shared / 4],
        [frames, chunks + fine],
        whole - 1.0 + np.maximum(fine, coarse),
    )
    per_look = chance + 0.5 * np.log(noise.total**2 / spread) - 0.5
    far = np.maximum(e.shared - e.near - _STRAY * e.shared, 0.0)
    return looks * per_look - 0.5 * misfit - 0.5 * REACH**2 * far


def _clearly_too_large(excess: np.ndarray, freedom: np.ndarray) -> np.ndarray:
    """What a χ² exceeds its degrees of freedom by, beyond three standard deviations and a tenth, or 0."""
    return np.maximum(excess - 3.0 * np.sqrt(2.0 * freedom) - 0.1 * freedom, 0.0)


def animals_in_view(dots: Dots) -> float:
    """Mean number of dots in the frames that have any."""
    rows = usable_rows(dots)
    return max(len(rows) / max(len(np.unique(dots.frame[rows])), 1), 1.0)


def log_chance(a: Dots, b: Dots, noise: float) -> np.ndarray:
    """Mean log of 1/(√(2π) σ · density) along the dots of each piece of a, (pieces,).

    The density is that of the dots of b over the angle, from all frames.
    """
    rows_a, rows_b = usable_rows(a), usable_rows(b)
    chance = np.zeros(a.n_pieces)
    if not len(rows_a) or not len(rows_b):
        return chance
    angle = b.angles.angle[rows_b]
    low, high = angle.min(), angle.max() + 1e-12
    counts, edges = np.histogram(angle, bins=_BINS, range=(low, high))
    width = edges[1] - edges[0]
    smooth = np.convolve(counts, np.full(9, 1 / 9), mode="same") + 0.5
    density = smooth / smooth.sum() / width  # 1/rad
    where = np.clip(((a.angles.angle[rows_a] - low) / width).astype(int), 0, _BINS - 1)
    per_px = density[where] * a.angles.slope[rows_a] * np.sqrt(2.0)
    value = -np.log(np.sqrt(2 * np.pi) * noise * per_px)
    piece = a.piece[rows_a]
    count = np.bincount(piece, minlength=a.n_pieces)
    return np.bincount(piece, weights=value, minlength=a.n_pieces) / np.maximum(count, 1)
