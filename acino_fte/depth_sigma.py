"""How well a return tells the depth of what it is attached to: three variances, by what shares them.

*Own* to a return are its range and its place in the beam. The light that comes back from a target wider than
the beam falls with the square of the range r, and what the detector adds to a range goes with the root of the
light (Wehr and Lohr 1999), so

    σ_range(r)² = σ_0² + (k r)².

A beam of the full width γ is r γ wide, and the return comes from anywhere in it: along each of its two axes
with a standard deviation of r γ / 4 (Lichti and Gordon 2004). Across the link, at the side g of a round body
of radius R, c = √(1 − (g/R)²), the surface's depth has the slope τ = √(1 − c²)/c and the curvature 1/(R c³),
so a place that is σ off makes

    min( σ² τ² + ¾ σ⁴ / (R c³)²,  R² (2/3 − π²/16 + (c − π/4)²) ),

whose bound is what a place anywhere on the round would make. Along the link, of slope m in depth and dz from
end to end, it makes min(σ² m², dz²/12).

*Shared* by the returns of a link, marker and frame: the pose is a centimetre off to the side, and the link
turned a little, 0.15 ℓ of the way ℓ to the marker. Between returns the surface may bulge, the more the
farther they are from the marker: σ_b² (1 − exp(−ℓ²/L²)).

*Common* to all returns of a marker and frame: the shape of the body at it, and time. The animal moves at the
velocity v in the camera's frame: σ_t v_z along the ray, and σ_t v to the sides as any other error of place.

Shapes: K returns, N frames, M markers. Camera's frame: x right, y down, z forward, m.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from acino_fte.attaching import Attached
from acino_fte.lidar import Lidar

SHAPE = 0.01
"""Standard deviation of the body's shape at a marker, from frame to frame, m."""
_BETWEEN, _LENGTH = 0.011, 0.05  # m, σ_b and L: how far the surface bulges between returns, and over what
_SIDE_SD = 0.01  # m: how well the side is known at which a ray passes a link
_SLOPE = 0.15  # of the way from a return to its marker along the link, as depth that the pose may be wrong by
_LEAST = 1e-3  # m
_ROUND = 2 / 3 - (np.pi / 4) ** 2  # variance of √(1 − x²), x uniform from −1 to 1


@dataclass(frozen=True, eq=False)
class ReturnVariance:
    """Variances (K,) of returns, m²: of each alone, shared along its link, common to its marker and frame."""

    own: np.ndarray
    shared: np.ndarray
    common: np.ndarray

    @property
    def total(self) -> np.ndarray:
        """Of a return by itself (K,), m²."""
        return self.own + self.shared + self.common


def return_variance(
    lidar: Lidar,
    found: Attached,
    local: np.ndarray,
    surface: np.ndarray,
    fps: float,
    way: np.ndarray,
    *,
    carried: bool = True,
) -> ReturnVariance:
    """Variances of attached returns as depths of what they are attached to.

    Parameters
    ----------
    lidar : Lidar
        With the noise of its range, its beam and its synchronisation.
    found : Attached
        K returns.
    local : (N, M, 3)
        Markers in the camera's frame, m.
    surface : (M,)
        How far the surface lies before every marker, m.
    fps : float
        Frames per second.
    way : (K,)
        ℓ: how far along the link its nearer marker is, m.
    carried : bool
        The depth is that of the surface at the marker, and not at the return.
    """
    u, z = found.along, found.depth
    start, end = local[found.frame, found.start], local[found.frame, found.end]
    along, slope, rise = _in_image(start, end)
    radius = np.maximum((1 - u) * surface[found.start] + u * surface[found.end], _LEAST)
    late = lidar.time_sd * _velocity(found, local, fps)
    beam = 0.25 * lidar.beam[:, None] * lidar.rotation[:2, 1:].T  # of its two axes in the image, at 1 m
    ways = _places(beam, z, along, late), _places(beam, z, along[:, ::-1] * (-1.0, 1.0), late)
    squared = ways[0].sum(axis=0), ways[1].sum(axis=0)
    made = np.minimum(squared[0] * slope**2, rise**2 / 12), _round_variance(squared[1], found.bulge, radius)
    own, shared, common = sum(w * (m / s) for w, m, s in zip(ways, made, squared, strict=True))
    between = _BETWEEN**2 * -np.expm1(-((way / _LENGTH) ** 2))
    return ReturnVariance(
        own + lidar.range_sd**2 + (lidar.range_sd_per_m * z) ** 2,
        shared + between + ((_SLOPE * way) ** 2 if carried else 0.0),
        common + late[:, 2] ** 2 + SHAPE**2,
    )


def group_variance(
    variance: ReturnVariance, weight: np.ndarray, place: np.ndarray, link: np.ndarray, count: int
) -> np.ndarray:
    """Variance (groups,) of weighted means of returns, m².

    ``place`` (K,) is the group of every return, of `count`; ``link`` (K,) any number for its link. What is
    their own averages out; what returns of one link share does not, and what all have in common neither.
    """
    total = np.bincount(place, weight, count)
    own = np.bincount(place, weight**2 * variance.own, count)
    common = np.bincount(place, weight * np.sqrt(variance.common), count) ** 2
    links, first, member = np.unique(link * count + place, return_index=True, return_inverse=True)
    shared = np.bincount(member, weight * np.sqrt(variance.shared), len(links)) ** 2
    return (own + common + np.bincount(place[first], shared, count)) / total**2


def _in_image(start: np.ndarray, end: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Unit direction (K, 2) of links in the image, their slope in depth (K,), and depth from end to end."""
    z = 0.5 * (start[:, 2] + end[:, 2])
    way = (end[:, :2] / end[:, 2:] - start[:, :2] / start[:, 2:]) * z[:, None]
    length = np.maximum(np.linalg.norm(way, axis=1), _LEAST)
    rise = end[:, 2] - start[:, 2]
    return way / length[:, None], rise / length, rise


def _velocity(found: Attached, local: np.ndarray, fps: float) -> np.ndarray:
    """Velocity (K, 3) of the places on links in the camera's frame, m/s."""
    if len(local) < 2:
        return np.zeros((len(found), 3))
    moves = np.gradient(local, axis=0) * fps
    u = found.along[:, None]
    return (1 - u) * moves[found.frame, found.start] + u * moves[found.frame, found.end]


def _places(beam: np.ndarray, z: np.ndarray, direction: np.ndarray, late: np.ndarray) -> np.ndarray:
    """Variances (3, K) of a return's place in directions (K, 2) of the image, m²: beam, pose and time."""
    in_beam = ((direction @ beam.T) ** 2).sum(axis=1) * z**2
    return np.stack([in_beam, np.full(len(z), _SIDE_SD**2), (late[:, :2] * direction).sum(axis=1) ** 2])


def _round_variance(place: np.ndarray, bulge: np.ndarray, radius: np.ndarray) -> np.ndarray:
    """Variance (K,) of the depth of a round body's surface, whose place across has the variance (K,), m²."""
    squared = bulge**2
    near = place * (1 - squared) / squared + 0.75 * place**2 / (radius**2 * squared**3)
    return np.minimum(near, radius**2 * (_ROUND + (bulge - np.pi / 4) ** 2))
