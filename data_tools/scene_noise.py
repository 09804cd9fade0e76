"""How uncertain the points of a scene are: the noise of dots, the errors of poses, and what they make of it.

Base g (:mod:`scene_rows`) knows A_g = Σ JᵀJ/σ² of a point, and errors of its pose move what it sees of the
point by a random vector with covariance M_g. The point's information is then

    Λ = Σ_g (I + κ A_g M_g)⁻¹ A_g

(Woodbury's identity on σ²I + κ J_g M_g J_gᵀ); for one rig alone Λ⁻¹ = A⁻¹ + M. κ says how much the poses err
against what is said of them. Cameras of one body that are not treated as a rig bob together between their key
frames, which no residual shows: where κ < 1 for such cameras, Λ⁻¹ grows by (1 − κ) M̄.

σ and κ come from the residuals. At the least-squares point the expected sum of squares is

    σ² ν + κ tr(P_⊥ Σ_g J_g M_g J_gᵀ),   P_⊥ = I − J (JᵀJ)⁻¹ Jᵀ,

with ν degrees of freedom; the points differ in both terms, as poses are surer in key frames than between.
Where they hardly differ, broad laws decide: log κ is about 0, and σ about what the tracks' third differences
have (20 σ² for white noise). Shapes: P dots, T points, B bases.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from acino_fte.data_tools.scene_rows import SceneRows, Views, pose_shift

NOISE_FLOOR = 0.02
"""Standard deviation of a dot, px; no detector is better."""
_BINS, _FEWEST = 10, 20  # groups of points with like errors from poses, and points in one
_OWN = np.geomspace(0.01, 25.0, 241)  # κ; poses off by more than five times what is said are no poses
_LEVEL = 0.4  # relative error of how much more poses err in long gaps than elsewhere
_BROAD_OWN, _BROAD_PX = 0.5, 0.35  # standard deviations of log κ and log σ before any residual
_MODEL = 0.1  # relative error of a group's level


@dataclass(frozen=True)
class SceneNoise:
    """Noise of a scene.

    Attributes
    ----------
    px : float
        Standard deviation of a dot's coordinate.
    own : float
        κ, variance of the poses over what is said of it.
    common : float
        Share of the stated variance that all bases have in common.
    """

    px: float
    own: float = 1.0
    common: float = 0.0


class PointInformation:
    """What dots and poses know of each point, around given positions.

    Parameters
    ----------
    rows : SceneRows
        The dots.
    views : Views
        Their cameras.
    position : (T, 3)
        Least-squares points; NaN where there is none.
    used : (P,) bool
        Dots that count.
    """

    def __init__(self, rows: SceneRows, views: Views, position: np.ndarray, used: np.ndarray) -> None:
        self._there = np.flatnonzero(np.isfinite(position[:, 0]))
        self._attached = views.attached
        self._roughness = roughness(rows)
        self._position, n = position, rows.n_points
        place = np.full(n, -1)
        place[self._there] = np.arange(len(self._there))
        residual, slope = rows.measured.linearise(position)
        good = used & np.isfinite(residual).all(1) & (place[rows.point] >= 0)
        point, j, r = place[rows.point[good]], slope[good], residual[good]
        base, n_bases, n_there = views.base[rows.camera[good]], len(views.bases), len(self._there)
        squares = np.concatenate([j, r[..., None]], axis=2)
        joint = sum_of_each(j.transpose(0, 2, 1) @ squares, base * n_there + point, n_bases * n_there)
        joint = joint.reshape(n_bases, n_there, 3, 4)
        self._information, self._gradient = joint[..., :3], joint[..., 3]  # for σ = 1 px
        self._squared = np.bincount(point, (r**2).sum(1), n_there)
        self._freedom = 2 * np.bincount(point, minlength=n_there) - 3
        where, frames = position[self._there], rows.frame[self._there]
        self._moves = np.stack([pose_shift(path, frames, where) for path in views.bases])

    def estimate_noise(self, px: float | None = None) -> SceneNoise:
        """σ and κ from the residuals; σ may be given."""
        free = self._freedom > 0
        if not free.any():
            return SceneNoise(px or 1.0)
        ratio = self._squared[free] / (self._freedom[free] * median_of_chi2(self._freedom[free]))
        if len(self._moves) == 1:
            return SceneNoise(px or max(float(np.sqrt(np.median(ratio))), NOISE_FLOOR))
        level, typical, count = _in_groups(self._from_poses()[free] / self._freedom[free], ratio)
        relative = np.hypot(_MODEL, 1.5 * np.sqrt(2.0 / (float(np.median(self._freedom[free])) * count)))
        variance, own = _best_line(level, typical, relative, px, self._roughness)
        common = max(1.0 - own, 0.0) if self._attached else 0.0
        return SceneNoise(float(np.sqrt(variance)), own, common)

    def expected_variance(self, noise: SceneNoise) -> np.ndarray:
        """Expected square of a residual per degree of freedom of each point, (T,), px²; NaN without any."""
        out = np.full(len(self._position), np.nan)
        free = self._freedom > 0
        from_poses = self._from_poses()[free] / self._freedom[free]
        out[self._there[free]] = noise.px**2 + noise.own * from_poses
        return out

    def _from_poses(self) -> np.ndarray:
        """tr(P_⊥ Σ_g J_g M_g J_gᵀ) of points, px²."""
        whole = self._information.sum(0)
        moved = self._information @ self._moves
        inside = np.linalg.solve(whole, (moved @ self._information).sum(0))
        out = np.trace(moved.sum(0), axis1=1, axis2=2) - np.trace(inside, axis1=1, axis2=2)
        return np.maximum(out, 0.0)

    def solve(self, noise: SceneNoise) -> tuple[np.ndarray, np.ndarray]:
        """Positions (T, 3) and covariances (T, 3, 3) after a step with all errors weighed."""
        information, gradient = self._information / noise.px**2, self._gradient / noise.px**2
        if len(self._moves) == 1:
            inverse = inverse_3x3(information[0])
            step, spread = (inverse @ gradient[0][..., None])[..., 0], self._moves[0]
        else:
            share = inverse_3x3(np.eye(3) + noise.own * information @ self._moves)
            inverse = inverse_3x3((share @ information).sum(0))
            step = (inverse @ (share @ gradient[..., None]).sum(0))[..., 0]
            spread = noise.common * self.mean_shift()
        position = np.full_like(self._position, np.nan)
        covariance = np.full((*position.shape, 3), np.nan)
        position[self._there] = self._position[self._there] + step
        total = inverse + spread
        covariance[self._there] = 0.5 * (total + total.transpose(0, 2, 1))
        return position, covariance

    def mean_shift(self) -> np.ndarray:
        """M̄, mean over the bases that see each point."""
        seen = np.trace(self._information, axis1=2, axis2=3) > 0
        total = np.where(seen[..., None, None], self._moves, 0.0).sum(0)
        return total / np.maximum(seen.sum(0), 1)[:, None, None]


def determinant_3x3(matrices: np.ndarray) -> np.ndarray:
    """Determinants of matrices (…, 3, 3)."""
    a, b, c = np.moveaxis(matrices, -2, 0)
    return (a * _cross(b, c)).sum(-1)


def inverse_3x3(matrices: np.ndarray) -> np.ndarray:
    """Inverses of matrices (…, 3, 3), by cofactors: many times as fast as LAPACK for many small matrices."""
    a, b, c = np.moveaxis(matrices, -2, 0)
    columns = np.stack([_cross(b, c), _cross(c, a), _cross(a, b)], axis=-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        return columns / (a * columns[..., 0]).sum(-1)[..., None, None]


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    out = np.empty(np.broadcast_shapes(a.shape, b.shape))
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        out[..., i] = a[..., j] * b[..., k] - a[..., k] * b[..., j]
    return out


def sum_of_each(values: np.ndarray, index: np.ndarray, n: int) -> np.ndarray:
    """Sum (n, …) of the values (P, …) of each index (P,)."""
    flat = values.reshape(len(values), int(np.prod(values.shape[1:])))
    out = np.empty((n, flat.shape[1]))
    for column in range(flat.shape[1]):
        out[:, column] = np.bincount(index, flat[:, column], n)
    return out.reshape(n, *values.shape[1:])


def median_of_chi2(freedom: np.ndarray) -> np.ndarray:
    """Median of χ² over its degrees of freedom (Wilson and Hilferty 1931; exact for one)."""
    return np.where(freedom == 1, 0.45494, (1.0 - 2.0 / (9.0 * freedom)) ** 3)


def _in_groups(from_poses: np.ndarray, ratio: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Groups of points with like errors from poses: medians of these and of the ratios, and their numbers."""
    n = max(1, min(_BINS, len(ratio) // _FEWEST))
    groups = np.array_split(np.argsort(from_poses, kind="stable"), n)
    level = np.array([np.median(from_poses[group]) for group in groups])
    typical = np.array([np.median(ratio[group]) for group in groups])
    return level, typical, np.array([len(group) for group in groups])


def _best_line(
    level: np.ndarray, typical: np.ndarray, relative: np.ndarray, px: float | None, usual_px: float
) -> tuple[float, float]:
    """σ² and κ of typical = σ² + κ level, with relative errors of the typical values (G,).

    The errors are relative to what is expected: found values that are small by chance are not surer.
    """
    expected = np.full(len(level), max(float(np.mean(typical)), NOISE_FLOOR**2))
    beside, best = np.abs(level - np.median(level)), int(np.argmin(np.abs(np.log(_OWN))))
    for _ in range(4):
        weight = 1.0 / np.hypot(relative * expected, _LEVEL * _OWN[best] * beside)
        rest = typical - _OWN[:, None] * level  # what is left for σ², (κ, G)
        variance = np.maximum((rest * weight**2).sum(1) / (weight**2).sum(), NOISE_FLOOR**2)
        if px is not None:
            variance = np.full(len(_OWN), px**2)
        cost = (((rest - variance[:, None]) * weight) ** 2).sum(1) + (np.log(_OWN) / _BROAD_OWN) ** 2
        if np.isfinite(usual_px) and px is None:
            cost += (0.5 * np.log(variance / max(usual_px, NOISE_FLOOR) ** 2) / _BROAD_PX) ** 2
        best = int(np.argmin(cost))
        expected = variance[best] + _OWN[best] * level
    return float(variance[best]), float(_OWN[best])


def roughness(rows: SceneRows) -> float:
    """Standard deviation of a dot's coordinate from the tracks' third differences, px; NaN without any."""
    frame, individual = rows.frame[rows.point], rows.individual[rows.point]
    order = np.lexsort((frame, individual, rows.camera))
    frame, xy = frame[order], rows.measured.xy[order]
    track = (individual * (rows.camera.max(initial=0) + 1) + rows.camera)[order]
    whole = (track[3:] == track[:-3]) & (frame[3:] - frame[:-3] == 3)
    if not whole.any():
        return float("nan")
    third = np.diff(xy, n=3, axis=0)[whole]
    return 1.4826 * float(np.median(np.abs(third))) / np.sqrt(20.0)
