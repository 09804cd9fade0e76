"""Which dots of two views may be one animal in a frame: possible pairs, as points in space with covariances.

How far animals move in a frame needs no link: around a pair, the next frame has one pair more than its own
frame has (as in :mod:`dot_candidates`, in space).
Shapes: K pairs sorted by frame.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
from scipy.spatial import cKDTree

from acino_fte.cameras import Camera, CameraArray
from acino_fte.data_tools.epipolar_angles import plane_angles, rays_of
from acino_fte.data_tools.track_dots import Dots
from acino_fte.data_tools.track_evidence import near_dots

_REACH = 3.5  # standard deviations of d
_NEIGHBOURS = 6
_FEWEST = 10
_PARALLEL = 1e-5  # least determinant of the sum of two projectors: 2 sin² of the angle of the rays


@dataclass(frozen=True, eq=False)
class Pairs:
    """Possible pairs of dots, sorted by frame.

    Attributes
    ----------
    frame : (K,) int
    dots : (K, 2) int
        Row of each view.
    surplus : (K,)
        N(d; 0, σ²) over the density of d by chance.
    point : (K, 3)
        m, world.
    covariance : (K, 3, 3)
        m².
    density : (K,)
        Pairs per m³ around each in its frame.
    """

    frame: np.ndarray
    dots: np.ndarray
    surplus: np.ndarray
    point: np.ndarray
    covariance: np.ndarray
    density: np.ndarray

    def __len__(self) -> int:
        return len(self.frame)

    def only(self, which: np.ndarray | slice) -> Pairs:
        """Some of the pairs."""
        return Pairs(*(getattr(self, f.name)[which] for f in fields(self)))


def find_pairs(
    cameras: CameraArray,
    which: tuple[int, int],
    frames: tuple[np.ndarray, np.ndarray],
    xys: tuple[np.ndarray, np.ndarray],
    noise_px: float,
) -> Pairs | None:
    """Possible pairs of two views; None when there are hardly any."""
    both = [cameras[k] for k in which]
    a, b = (rays_of(c, f, x) for c, f, x in zip(both, frames, xys, strict=True))
    angles = plane_angles(cameras, *which, frames, (a, b))
    if angles is None:
        return None
    dots = [Dots(f, np.zeros(len(f), dtype=np.int64), 1, g) for f, g in zip(frames, angles, strict=True)]
    near = list(near_dots(*dots, _REACH * noise_px))
    if not near:
        return None
    i, j, d = (np.concatenate([found[k] for found in near]) for k in (2, 3, 4))
    frame = frames[0][i]
    directions = a.direction[i], b.direction[j]
    point, covariance = _meet(both, frame, (xys[0][i], xys[1][j]), directions, noise_px)
    good = np.flatnonzero(np.isfinite(point).all(1) & np.isfinite(covariance).all((1, 2)))
    order = good[np.argsort(frame[good], kind="stable")]
    if len(order) < _FEWEST:
        return None
    surplus = np.exp(-0.5 * (d[order] / noise_px) ** 2) * (2 * _REACH) / np.sqrt(2 * np.pi)
    frame, point = frame[order], point[order]
    ij = np.column_stack([i, j])[order]
    return Pairs(frame, ij, surplus, point, covariance[order], _local_density(frame, point))


def _meet(
    cameras: Sequence[Camera],
    frame: np.ndarray,
    xys: tuple[np.ndarray, np.ndarray],
    directions: tuple[np.ndarray, np.ndarray],
    noise_px: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Points (K, 3) and covariances (K, 3, 3): where rays meet, and one Gauss–Newton step from there."""
    posed = [c.at_frames(frame) if c.moves else c for c in cameras]
    centre = [np.broadcast_to(c.centre, (len(frame), 3)) for c in posed]
    across = [np.eye(3) - d[:, :, None] * d[:, None] for d in directions]
    total = across[0] + across[1]
    right = sum(m @ c[..., None] for m, c in zip(across, centre, strict=True))
    meet = np.linalg.det(total) > _PARALLEL
    total[~meet] = np.eye(3)
    point = np.linalg.solve(total, right)[..., 0]
    information, gradient = np.zeros((len(frame), 3, 3)), np.zeros((len(frame), 3))
    for camera, c, xy in zip(posed, cameras, xys, strict=True):
        at = point[:, None] if c.moves else point
        pixel, jacobian = camera.project_with_jacobian(at)
        pixel, jacobian = pixel.reshape(-1, 2), jacobian.reshape(-1, 2, 3)
        information += jacobian.swapaxes(1, 2) @ jacobian / noise_px**2
        gradient += (jacobian.swapaxes(1, 2) @ (xy - pixel)[..., None])[..., 0] / noise_px**2
    meet &= np.isfinite(information).all((1, 2)) & np.isfinite(gradient).all(1)
    information[~meet] = np.eye(3)
    covariance = np.linalg.inv(information)
    point = point + (covariance @ gradient[..., None])[..., 0]
    return np.where(meet[:, None], point, np.nan), covariance


def _local_density(frame: np.ndarray, point: np.ndarray) -> np.ndarray:
    """Pairs per m³ around each in its own frame, mixed half and half with the mean, (K,)."""
    low, high = np.percentile(point, [2, 98], axis=0)
    size = high - low + 1e-9
    mean = len(frame) / len(np.unique(frame)) / float(np.prod(size))
    apart = float(np.linalg.norm(size)) * 2.0
    rows = np.column_stack([frame * apart, point])
    distance, _ = cKDTree(rows).query(rows, k=_NEIGHBOURS + 1, distance_upper_bound=apart * 0.49)
    near = np.isfinite(distance).sum(1) - 1
    furthest = np.where(np.isfinite(distance), distance, 0.0).max(1)
    around = np.where(near > 0, near / (4.2 * np.maximum(furthest, 1e-6) ** 3), mean)
    return 0.5 * (mean + np.minimum(around, 30 * mean))


def pair_displacement(pairs: Pairs) -> tuple[float, float] | None:
    """Short and long displacement in a frame, m: the excess of pairs of pairs of consecutive frames."""
    size = float(np.linalg.norm(np.subtract(*np.percentile(pairs.point, [98, 2], axis=0)))) + 1e-6
    radius = np.geomspace(1e-3 * size, size, 120)
    frames, start = np.unique(pairs.frame, return_index=True)
    stop = np.r_[start[1:], len(pairs)]
    following = np.flatnonzero(np.diff(frames) == 1)
    later, same, n = np.zeros(len(radius)), np.zeros(len(radius)), 0
    for f in following[:: max(1, len(following) // 200)]:
        here, there = pairs.point[start[f] : stop[f]], pairs.point[start[f + 1] : stop[f + 1]]
        tree = cKDTree(here)
        later += tree.count_neighbors(cKDTree(there), radius)
        same += (tree.count_neighbors(tree, radius) - len(here)) * len(there) / max(len(here), 1)
        n += len(here)
    excess, error = (later - same) / max(n, 1), np.sqrt(later + same) / max(n, 1)
    sure = np.flatnonzero(excess > np.maximum(4 * error, 0.02))
    if not len(sure):
        return None
    top = float((excess - 3 * error)[sure].max())
    share = np.maximum.accumulate(excess)
    return float(radius[np.argmax(share >= 0.25 * top)]), float(radius[np.argmax(share >= 0.95 * top)])
