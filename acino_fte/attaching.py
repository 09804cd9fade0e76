"""Lidar returns attached to links: the geometry of :mod:`acino_fte.association`.

Shapes: K returns, N frames, M markers, E links to draw.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from acino_fte.lidar import Lidar
from acino_fte.skeleton import Skeleton

_REACH = 0.25  # m: returns farther to the side of every link are not looked at
_SIDE = 0.05  # m, σ_g: how far to the side of a link its surface reaches
_GATE = 9.0  # of the squared distance: three standard deviations
_LEAST_BULGE = 0.3
_HIDDEN_SD, _HIDDEN = 0.04, 4.0  # m: how well it is known what hides what; the most that being hidden costs
_WIDEST = 0.5  # m: σ_f is never more
_CHUNK = 50_000  # returns at once: every one is compared to every link


@dataclass(frozen=True, eq=False)
class Attached:
    """Returns attached to links. K of them.

    ``frame`` (K,) is the nearest frame's index, ``start``, ``end`` (K,) are the markers of its link,
    ``along`` (K,) is u, ``side`` and ``front`` (K,) are g and f, m; ``bulge`` (K,) is c; ``depth``
    (K,) is z in the camera's frame at the time of the frame, m.
    """

    frame: np.ndarray
    start: np.ndarray
    end: np.ndarray
    along: np.ndarray
    side: np.ndarray
    front: np.ndarray
    bulge: np.ndarray
    depth: np.ndarray

    def __len__(self) -> int:
        return len(self.frame)


def attach(
    lidar: Lidar,
    frames: np.ndarray,
    fps: float,
    local: np.ndarray,
    skeleton: Skeleton,
    surface: np.ndarray,
    front_sd: float,
    target: np.ndarray | None = None,
) -> Attached:
    """Attach returns to links.

    Parameters
    ----------
    lidar : Lidar
        Its returns, in the clock of the frames.
    frames : (N,)
        Frame numbers of the sequence.
    fps : float
        Frames per second.
    local : (N, M, 3)
        Markers in the camera's frame when the camera saw them, m.
    skeleton : Skeleton
        The species.
    surface : (M,)
        How far the surface lies before every marker, m.
    front_sd : float
        σ_f, m.
    target : (N, M, 3), optional
        Where attached returns are moved to; `local` unless given.

    Returns
    -------
    Attached
        In the order of time.
    """
    row, frame, before, share = _in_time(lidar, frames, fps)
    xyz = lidar.to_camera()[row]
    near = _near_body(xyz, local, before, front_sd)
    given = _Near(frame, before, share, xyz)
    width, target = min(front_sd, _WIDEST), local if target is None else target
    chunks = np.array_split(near, max(1, -(-len(near) // _CHUNK)))
    parts = [_attach_some(given.at(rows), local, target, skeleton, surface, width) for rows in chunks]
    return Attached(*(np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(Attached)))


@dataclass(frozen=True, eq=False)
class _Near:
    """Returns to be attached: nearest frame, frame before, share of the way on, place (K, 3)."""

    frame: np.ndarray
    before: np.ndarray
    share: np.ndarray
    xyz: np.ndarray

    def at(self, rows: np.ndarray) -> _Near:
        """Some of them."""
        return _Near(*(getattr(self, f.name)[rows] for f in fields(_Near)))


def _attach_some(
    near: _Near,
    local: np.ndarray,
    target: np.ndarray,
    skeleton: Skeleton,
    surface: np.ndarray,
    width: float,
) -> Attached:
    links = _links(skeleton)
    after, xyz, frame = np.minimum(near.before + 1, len(local) - 1), near.xyz, near.frame
    then = local[near.before] + near.share[:, None, None] * (local[after] - local[near.before])
    along, side, front = _against_links(xyz, then, links)
    radius = (1 - along) * surface[links[:, 0]] + along * surface[links[:, 1]]  # (K, E)
    bulge = _bulge(side, radius)
    cost = (side / np.maximum(_SIDE, radius)) ** 2 + ((front - bulge * radius) / width) ** 2
    hidden = _behind(xyz[:, 2:] + front - bulge * radius, side < radius)
    cost += np.minimum((hidden / _HIDDEN_SD) ** 2, _HIDDEN)
    best = np.where(np.isfinite(cost), cost, np.inf).argmin(axis=1)
    every = np.flatnonzero(cost[np.arange(len(xyz)), best] < _GATE)
    best = best[every]
    start, end, u = links[best, 0], links[best, 1], along[every, best]
    moved = on_link(target[frame[every]], start, end, u) - on_link(then[every], start, end, u)
    chosen = (every, best)
    depth = (xyz[every] + moved)[:, 2]
    return Attached(frame[every], start, end, u, side[chosen], front[chosen], bulge[chosen], depth)


def _in_time(lidar: Lidar, frames: np.ndarray, fps: float) -> tuple[np.ndarray, ...]:
    """Returns within the sequence: rows, the nearest frame, the one before, share of the way to the next."""
    place = lidar.time * fps - frames[0]
    row = np.flatnonzero((place >= -0.5) & (place < len(frames) - 0.5))
    place = place[row]
    frame = np.clip(np.rint(place).astype(int), 0, len(frames) - 1)
    before = np.clip(np.floor(place).astype(int), 0, max(len(frames) - 2, 0))
    return row, frame, before, place - before


def _near_body(xyz: np.ndarray, local: np.ndarray, before: np.ndarray, front_sd: float) -> np.ndarray:
    """Rows of returns within reach of the box about the markers of the frames before and after them."""
    reach = np.array([_REACH, _REACH, _REACH + 3 * front_sd])
    lower, upper = local.min(axis=1) - reach, local.max(axis=1) + reach
    lower[:-1], upper[:-1] = np.minimum(lower[:-1], lower[1:]), np.maximum(upper[:-1], upper[1:])
    return np.flatnonzero(((xyz >= lower[before]) & (xyz <= upper[before])).all(-1))


def _links(skeleton: Skeleton) -> np.ndarray:
    """Marker pairs (E, 2) that have the body about them: what is drawn, and the solid body.

    Of a species that draws nothing, every marker with itself.
    """
    drawn = {(min(e), max(e)) for e in (*skeleton.edges, *((a, b) for a, b, _ in skeleton.capsules))}
    pairs = sorted(drawn) or [(m, m) for m in range(len(skeleton.markers))]
    return np.array(pairs, dtype=int)


def _against_links(
    xyz: np.ndarray, then: np.ndarray, links: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """u, g and f (K, E) of returns (K, 3) and every link of the skeleton (K, M, 3) at their times."""
    flat = then[..., :2] / then[..., 2:]
    a, b = flat[:, links[:, 0]], flat[:, links[:, 1]]
    seen = (xyz[:, :2] / xyz[:, 2:])[:, None]
    way = b - a
    length = np.maximum((way**2).sum(-1), 1e-18)
    inside = np.clip(((seen - a) * way).sum(-1) / length, 0.0, 1.0)
    side = np.linalg.norm(seen - a - inside[..., None] * way, axis=-1) * xyz[:, None, 2]
    z = then[..., 2]
    start, end = z[:, links[:, 0]], z[:, links[:, 1]]
    along = inside * start / ((1 - inside) * end + inside * start)
    front = (1 - along) * z[:, links[:, 0]] + along * z[:, links[:, 1]] - xyz[:, None, 2]
    return along, side, front


def on_link(points: np.ndarray, start: np.ndarray, end: np.ndarray, u: np.ndarray) -> np.ndarray:
    """(1 − u) a + u b of points (K, M, 3) with the markers of every row."""
    every = np.arange(len(start))
    return (1 - u)[:, None] * points[every, start] + u[:, None] * points[every, end]


def _behind(surface: np.ndarray, hit: np.ndarray) -> np.ndarray:
    """How far surfaces (K, E), m, lie behind the nearest one that the ray hits; 0 where it hits none."""
    nearest = np.where(hit, surface, np.inf).min(axis=1, keepdims=True, initial=np.inf)
    return np.where(np.isfinite(nearest), np.maximum(surface - nearest, 0.0), 0.0)


def _bulge(side: np.ndarray, radius: np.ndarray) -> np.ndarray:
    """c = √(1 − (g/r)²), not less than :data:`_LEAST_BULGE`: shapes are not that round."""
    return np.sqrt(np.maximum(1.0 - (side / np.maximum(radius, 1e-9)) ** 2, _LEAST_BULGE**2))
