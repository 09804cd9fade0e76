"""Which lidar return belongs to what: returns attached to the skeleton, robustly, given where it is about.

A return of time t is compared to the skeleton at time t, in the camera's frame: positions between frames are
interpolated, so that neither a lidar that scans for a tenth of a second nor a camera that pans smears the
animal. On the link from a to b, the point that is nearest in the image to the return x̃ is

    v = clip( (x̃/z̃ − a/z_a)·(b/z_b − a/z_a) / |b/z_b − a/z_a|², 0, 1 ),   u = v z_a / ((1 − v) z_b + v z_a)

(v along the link's image, u along the link), at a lateral distance g (m, at the depth of the return), and the
return lies f = z(u) − z̃ before it. It is attached to the link with the least (g/σ_g)² + ((f − c s)/σ_f)²,
where s is the surface of that link and c = √(1 − (g/s)²) how much of it a round body has there, and to none
when that is large: grass, bushes and a neighbour fail along the ray although they are near in the image. What
is attached is moved to the time of its frame with the link. A link that lies behind another one on the same
ray, such as the far shoulder behind the near one, is hidden by it and costs more.

The thesis's way stays for comparison: the nearest return in the image of a whole scan, whatever its depth.
Shapes: K returns, N frames, M markers, E links to draw.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from acino_fte.cameras import Camera
from acino_fte.depth import BodyReturns, DepthData, MarkerDepths
from acino_fte.errors import InputError
from acino_fte.lidar import Lidar
from acino_fte.sequence import Sequence
from acino_fte.skeleton import Skeleton

ASSOCIATIONS = ("marker", "body", "nearest", "none")
_REACH = 0.25  # m: returns farther to the side of every link are not looked at
_SIDE = 0.05  # m, σ_g: how far to the side of a link its surface reaches
_GATE = 9.0  # of the squared distance above: three standard deviations
_SIDE_SD = 0.01  # m: how well the side is known at which a ray passes a link
_SHAPE = 0.015  # m, standard deviation of the surface about a capsule
_LEAST_BULGE = 0.3
_SLOPE = 0.15  # of the way from a return to its marker along the link, as depth that the pose may be wrong by
_SCAN = 0.1  # s: what the thesis takes for one frame of the lidar
_NEAREST_SD = 0.05  # m, of the thesis's way
_HIDDEN_SD, _HIDDEN = 0.04, 4.0  # m: how well it is known what hides what; the most that being hidden costs
_MARGIN = 0.1  # of the picture's size: how far outside it returns still count
_WIDEST = 0.5  # m: σ_f is never more


@dataclass(frozen=True, eq=False)
class Attached:
    """Returns attached to links. K of them.

    ``row`` (K,) is the return's place in the lidar's arrays, ``frame`` (K,) the nearest frame's index,
    ``start``, ``end`` (K,) the markers of its link, ``along`` (K,) is u, ``side`` and ``front`` (K,) are g
    and f, m; ``bulge`` (K,) is c; ``depth`` (K,) is z in the camera's frame at the time of the frame, m.
    """

    row: np.ndarray
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


def associate(
    sequence: Sequence,
    skeleton: Skeleton,
    positions: np.ndarray,
    surface: np.ndarray,
    *,
    how: str = "marker",
    front_sd: float = 0.1,
    pixels: np.ndarray | None = None,
) -> DepthData | None:
    """What the lidar of a sequence says of the skeleton.

    Parameters
    ----------
    sequence : Sequence
        With a lidar.
    skeleton : Skeleton
        The species.
    positions : (N, M, 3)
        Where the markers are, as far as is known, m.
    surface : (M,)
        How far the surface lies before every marker, as far as is known, m.
    how : str
        ``"marker"``: one depth for every marker and frame with returns about it; ``"body"``: every return on
        the body; ``"nearest"``: the thesis's nearest neighbour in the image; ``"none"``.
    front_sd : float
        σ_f: how far `positions` may be wrong along the line of sight, m.
    pixels : (N, M, 2), optional
        Detections in the lidar's camera, px, for ``"nearest"``.

    Returns
    -------
    DepthData or None
        None without a lidar, or with ``"none"``.
    """
    if how not in ASSOCIATIONS:
        raise InputError(
            f"There is no way '{how}' to associate returns.",
            key="association",
            expected=", ".join(ASSOCIATIONS),
        )
    if sequence.lidar is None or how == "none":
        return None
    lidar, camera = sequence.lidar, sequence.cameras[sequence.lidar.camera]
    local = camera.to_camera(positions)
    if how == "nearest":
        seen = camera.project(positions) if pixels is None else pixels
        return DepthData(camera.name, nearest_depths(sequence, camera, seen), surface=False)
    found = attach(lidar, sequence.frames, sequence.fps, local, skeleton, surface, front_sd)
    rate = _depth_rate(local, sequence.fps)
    if how == "body":
        sd = np.sqrt(_own_variance(lidar, found, rate))
        places = (found.frame, found.start, found.end, found.along, found.bulge)
        return DepthData(camera.name, BodyReturns(*places, found.depth, sd))
    return DepthData(camera.name, marker_depths(lidar, found, local, surface, rate))


def in_view(sequence: Sequence) -> Sequence:
    """The same sequence with only the returns before its camera's picture, with a margin."""
    lidar = sequence.lidar
    if lidar is None or not len(lidar):
        return sequence
    camera = sequence.cameras[lidar.camera]
    width, height = camera.resolution
    edge = np.linspace(0.0, 1.0, 9)
    border = np.concatenate([np.stack([edge, np.full(9, v)], 1) for v in (0.0, 1.0)])
    border = np.concatenate([border, border[:, ::-1]]) * [width, height]
    flat = camera.undistort(border)
    margin = _MARGIN * np.ptp(flat, axis=0)
    local = lidar.to_camera()
    ahead = local[:, 2] > 0
    with np.errstate(divide="ignore", invalid="ignore"):
        seen = local[:, :2] / local[:, 2:]
    keep = ahead & ((seen >= flat.min(0) - margin) & (seen <= flat.max(0) + margin)).all(-1)
    return replace(sequence, lidar=lidar.select(keep))


def attach(
    lidar: Lidar,
    frames: np.ndarray,
    fps: float,
    local: np.ndarray,
    skeleton: Skeleton,
    surface: np.ndarray,
    front_sd: float,
) -> Attached:
    """Attach returns to links; `local` (N, M, 3) are markers in the camera's frame, m."""
    row, frame, before, share = _in_time(lidar, frames, fps)
    xyz = lidar.to_camera()[row]
    near = _near_body(xyz, local, before, front_sd)
    row, frame, before, share, xyz = (v[near] for v in (row, frame, before, share, xyz))
    links = _links(skeleton)
    then = local[before] + share[:, None, None] * (
        local[np.minimum(before + 1, len(local) - 1)] - local[before]
    )
    along, side, front = _against_links(xyz, then, links)
    radius = (1 - along) * surface[links[:, 0]] + along * surface[links[:, 1]]  # (K, E)
    bulge = _bulge(side, radius)
    width = min(front_sd, _WIDEST)
    reach = np.maximum(_SIDE, radius)
    cost = (side / reach) ** 2 + ((front - bulge * radius) / width) ** 2
    hidden = _behind(xyz[:, 2:] + front - bulge * radius, side < radius)
    cost += np.minimum((hidden / _HIDDEN_SD) ** 2, _HIDDEN)
    best = np.argmin(np.where(np.isfinite(cost), cost, np.inf), axis=1) if len(xyz) else np.zeros(0, int)
    every = np.arange(len(xyz))
    good = cost[every, best] < _GATE
    every, best = every[good], best[good]
    start, end, u = links[best, 0], links[best, 1], along[every, best]
    moved = _on_link(local[frame[every]], start, end, u) - _on_link(then[every], start, end, u)
    return Attached(
        row[every],
        frame[every],
        start,
        end,
        u,
        side[every, best],
        front[every, best],
        bulge[every, best],
        (xyz[every] + moved)[:, 2],
    )


def _behind(surface: np.ndarray, hit: np.ndarray) -> np.ndarray:
    """How far surfaces (K, E), m, lie behind the nearest one that the ray hits; 0 where it hits none."""
    nearest = np.where(hit, surface, np.inf).min(axis=1, keepdims=True, initial=np.inf)
    return np.where(np.isfinite(nearest), np.maximum(surface - nearest, 0.0), 0.0)


def _bulge(side: np.ndarray, radius: np.ndarray) -> np.ndarray:
    """c = √(1 − (g/r)²), not less than :data:`_LEAST_BULGE`: shapes are not that round."""
    return np.sqrt(np.maximum(1.0 - (side / np.maximum(radius, 1e-9)) ** 2, _LEAST_BULGE**2))


def marker_depths(
    lidar: Lidar, found: Attached, local: np.ndarray, surface: np.ndarray, rate: np.ndarray
) -> MarkerDepths:
    """One depth for every marker and frame: of the returns nearest to it, carried along the link.

    A return before the point u of a link is carried to the link's nearer end by what the pose has between
    them. Its variance is that of the range, of the body's shape, of the time, and of a share of the way.
    Returns of one marker and frame have one surface and one shape: only their ranges average out.
    """
    nearer = np.where(found.along < 0.5, found.start, found.end)
    on_link = _on_link(local[found.frame], found.start, found.end, found.along)
    marker = local[found.frame, nearer]
    u = found.along
    thicker = surface[nearer] - found.bulge * ((1 - u) * surface[found.start] + u * surface[found.end])
    depth = found.depth + marker[:, 2] - on_link[:, 2] - thicker
    way = np.linalg.norm(marker - on_link, axis=1)
    own = _own_variance(lidar, found, rate)
    carried = own + (_SLOPE * way) ** 2
    key = found.frame * len(surface) + nearer
    groups, place, count = np.unique(key, return_inverse=True, return_counts=True)
    weight = 1.0 / carried
    total = np.bincount(place, weight, len(groups))
    mean = np.bincount(place, weight * depth, len(groups)) / np.maximum(total, 1e-300)
    floor = np.bincount(place, weight * (carried - lidar.range_sd**2), len(groups)) / np.maximum(
        total, 1e-300
    )
    sd = np.sqrt(floor + lidar.range_sd**2 / count)
    return MarkerDepths(groups // len(surface), groups % len(surface), mean, sd, count)


def nearest_depths(sequence: Sequence, camera: Camera, pixels: np.ndarray) -> MarkerDepths:
    """The thesis's pseudo-depth: that of the return nearest in the image, in the scan about the frame.

    Whatever its depth, and however far away: of every detection (N, M, 2) px.
    """
    lidar = sequence.lidar
    assert lidar is not None
    local = lidar.to_camera()
    at_rest = replace(camera, rotation=np.eye(3), translation=np.zeros(3))
    seen = at_rest.project(local)
    inside = np.isfinite(seen).all(-1) & at_rest.inside(seen)
    time, z, seen = lidar.time[inside], local[inside, 2], seen[inside]
    rows: list[tuple[int, int, float]] = []
    for n, frame in enumerate(sequence.frames):
        first, last = np.searchsorted(time, frame / sequence.fps + np.array([-0.5, 0.5]) * _SCAN)
        if first == last:
            continue
        for m in np.flatnonzero(np.isfinite(pixels[n]).all(-1)):
            k = first + int(np.argmin(((seen[first:last] - pixels[n, m]) ** 2).sum(-1)))
            rows.append((n, int(m), float(z[k])))
    table = np.array(rows).reshape(-1, 3)
    count = np.ones(len(table), dtype=int)
    sd = np.full(len(table), _NEAREST_SD)
    return MarkerDepths(table[:, 0].astype(int), table[:, 1].astype(int), table[:, 2], sd, count)


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
    """Marker pairs (E, 2) that have the body about them: what is drawn, and the solid body."""
    pairs = {tuple(sorted(e)) for e in skeleton.edges} | {
        tuple(sorted((a, b))) for a, b, _ in skeleton.capsules
    }
    return np.array(sorted(pairs), dtype=int).reshape(-1, 2)


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


def _on_link(points: np.ndarray, start: np.ndarray, end: np.ndarray, u: np.ndarray) -> np.ndarray:
    """(1 − u) a + u b of points (K, M, 3) with the markers of every row."""
    every = np.arange(len(start))
    return (1 - u)[:, None] * points[every, start] + u[:, None] * points[every, end]


def _depth_rate(local: np.ndarray, fps: float) -> np.ndarray:
    """How fast the animal's depth changes in every frame (N,), m/s."""
    middle = local[..., 2].mean(axis=1)
    return np.gradient(middle) * fps if len(middle) > 1 else np.zeros(len(middle))


def _own_variance(lidar: Lidar, found: Attached, rate: np.ndarray) -> np.ndarray:
    """Variance of every return, m²: its range, the body's shape, and the synchronisation."""
    steep = _SIDE_SD * np.sqrt(1.0 - found.bulge**2) / found.bulge  # of a round body, where the ray passes
    return lidar.range_sd**2 + _SHAPE**2 + steep**2 + (lidar.time_sd * rate[found.frame]) ** 2
