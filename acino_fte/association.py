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

from dataclasses import fields, replace

import numpy as np

from acino_fte.attaching import Attached, attach
from acino_fte.cameras import Camera
from acino_fte.depth import BodyReturns, DepthData, MarkerDepths
from acino_fte.depth_sigma import group_variance, return_variance
from acino_fte.errors import InputError
from acino_fte.lidar import Lidar
from acino_fte.prediction import positions_at
from acino_fte.sequence import Sequence
from acino_fte.skeleton import Skeleton

ASSOCIATIONS = ("marker", "body", "nearest", "none")
_MOST = 8  # returns of one link and frame that count as distances: more say the same again
_SCAN = 0.1  # s: what the thesis takes for one frame of the lidar
_NEAREST_SD = 0.05  # m, of the thesis's way
_MARGIN = 0.1  # of the picture's size: how far outside it returns still count


def associate(
    sequence: Sequence,
    skeleton: Skeleton,
    positions: np.ndarray,
    surface: np.ndarray,
    *,
    how: str = "marker",
    front_sd: float = 0.1,
    pixels: np.ndarray | None = None,
    camera: Camera | None = None,
    late: float = 0.0,
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
    camera : Camera, optional
        The lidar's camera where a fit has corrected it.
    late : float
        How late that camera is, s, by a fit.

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
    lidar = sequence.lidar
    camera = sequence.cameras[lidar.camera] if camera is None else camera
    local = camera.to_camera(positions_at(positions, late, 1 / sequence.fps))
    if how == "nearest":
        seen = camera.project(positions) if pixels is None else pixels
        return DepthData(camera.name, nearest_depths(sequence, camera, seen), surface=False)
    target = camera.to_camera(positions) if how == "body" else None  # whose residual knows no delay
    found = attach(lidar, sequence.frames, sequence.fps, local, skeleton, surface, front_sd, target)
    if how == "body":
        found = _thinned(found)
        _, way, _ = _to_marker(found, local)
        variance = return_variance(lidar, found, local, surface, sequence.fps, way, carried=False)
        places = (found.frame, found.start, found.end, found.along, found.bulge)
        return DepthData(camera.name, BodyReturns(*places, found.depth, np.sqrt(variance.total)))
    return DepthData(camera.name, marker_depths(lidar, found, local, surface, sequence.fps))


def in_view(sequence: Sequence) -> Sequence:
    """The same sequence with only the returns that its camera's picture shows, with a margin."""
    lidar = sequence.lidar
    if lidar is None or not len(lidar):
        return sequence
    camera = sequence.cameras[lidar.camera]
    size = np.array(camera.resolution)
    seen = _at_rest(camera).project(lidar.to_camera())
    with np.errstate(invalid="ignore"):
        keep = ((seen >= -_MARGIN * size) & (seen <= (1 + _MARGIN) * size)).all(axis=-1)
    return replace(sequence, lidar=lidar.select(np.asarray(keep)))


def _at_rest(camera: Camera) -> Camera:
    """The camera in its own frame."""
    return replace(camera, rotation=np.eye(3), translation=np.zeros(3))


def _thinned(found: Attached) -> Attached:
    """At most :data:`_MOST` returns of one link and frame, spread evenly along it."""
    order = np.lexsort((found.along, found.end, found.start, found.frame))
    key = np.stack([found.frame, found.start, found.end])[:, order]
    first = np.flatnonzero(np.r_[True, (np.diff(key) != 0).any(axis=0)]) if len(order) else order
    count = np.diff(np.r_[first, len(order)])
    rank = np.arange(len(order)) - np.repeat(first, count)
    many = np.maximum(np.repeat(count, count), _MOST)
    kept = order[(rank * _MOST) // many != ((rank - 1) * _MOST) // many]
    return Attached(*(getattr(found, f.name)[kept] for f in fields(Attached)))


def marker_depths(
    lidar: Lidar, found: Attached, local: np.ndarray, surface: np.ndarray, fps: float
) -> MarkerDepths:
    """One depth for every marker and frame: of the returns nearest to it, carried along the link.

    A return before the point u of a link is carried to the link's nearer end by what the pose has between
    them. How well each tells the depth there, and what they share, is in :mod:`acino_fte.depth_sigma`.
    """
    nearer, way, farther = _to_marker(found, local)
    u = found.along
    thicker = surface[nearer] - found.bulge * ((1 - u) * surface[found.start] + u * surface[found.end])
    depth = found.depth + farther - thicker
    variance = return_variance(lidar, found, local, surface, fps, way)
    weight = 1.0 / variance.total
    key = found.frame * len(surface) + nearer
    groups, place, count = np.unique(key, return_inverse=True, return_counts=True)
    mean = np.bincount(place, weight * depth, len(groups)) / np.bincount(place, weight, len(groups))
    link = found.start * len(surface) + found.end
    sd = np.sqrt(group_variance(variance, weight, place, link, len(groups)))
    return MarkerDepths(groups // len(surface), groups % len(surface), mean, sd, count)


def _to_marker(found: Attached, local: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The nearer marker of every return (K,), how far along the link it is, and how much deeper, m."""
    nearer = np.where(found.along < 0.5, found.start, found.end)
    share = np.where(found.along < 0.5, found.along, 1.0 - found.along)
    link = local[found.frame, found.start + found.end - nearer] - local[found.frame, nearer]
    return nearer, share * np.linalg.norm(link, axis=1), -share * link[:, 2]


def nearest_depths(sequence: Sequence, camera: Camera, pixels: np.ndarray) -> MarkerDepths:
    """The thesis's pseudo-depth: that of the return nearest in the image, in the scan about the frame.

    Whatever its depth, and however far away: of every detection (N, M, 2) px.
    """
    lidar = sequence.lidar
    assert lidar is not None
    local = lidar.to_camera()
    at_rest = _at_rest(camera)
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
