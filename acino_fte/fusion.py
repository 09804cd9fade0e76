"""Camera and lidar together: associate, fit, associate again, with what each fit has found.

The first association allows for a start that is decimetres wrong along the line of sight, the later ones for
centimetres. The scale of the depths' noise is found from the residuals, as that of the detections is
(:mod:`acino_fte.noise`): the table of a lidar does not know how hairy an animal is.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from acino_fte.association import associate
from acino_fte.cameras import Camera
from acino_fte.depth import BodyReturns, DepthData, MarkerDepths, expected_surface
from acino_fte.noise import PRIOR_COUNT, robust_scale
from acino_fte.parameters import Parameters
from acino_fte.posterior import MOST_LEVERAGE, Posterior
from acino_fte.prediction import corrected_cameras, positions_at, time_offsets
from acino_fte.sequence import Sequence
from acino_fte.skeleton import Skeleton

_FRONT = (0.3, 0.15, 0.1)  # m: how wrong the depth of the skeleton may be at the first, second, later looks
_FACTORS = (0.5, 5.0)  # of the depths' standard deviations


@dataclass(frozen=True, eq=False)
class DepthResiduals:
    """Measured and predicted depths of markers, as a result carries them. K rows.

    Attributes
    ----------
    camera, association : str
    frame, marker : (K,) int
        Indices.
    measured, predicted : (K,)
        z of the surface in the camera's frame, m.
    sd : (K,)
        m, as estimated.
    count : (K,) int
        Returns behind each.
    """

    camera: str
    association: str
    frame: np.ndarray
    marker: np.ndarray
    measured: np.ndarray
    predicted: np.ndarray
    sd: np.ndarray
    count: np.ndarray

    @property
    def residual(self) -> np.ndarray:
        """Predicted − measured (K,), m."""
        return self.predicted - self.measured

    def metrics(self) -> dict[str, Any]:
        """``depth_m`` of metrics.json."""
        d = self.residual
        if not len(d):
            return {"n": 0, "median": None, "rmse": None, "std": None, "p90": None, "outlier_ratio": None}
        return {
            "n": len(d),
            "n_returns": int(self.count.sum()),
            "association": self.association,
            "median": float(np.median(np.abs(d))),
            "bias": float(d.mean()),
            "rmse": float(np.sqrt(np.mean(d**2))),
            "std": float(d.std()),
            "p90": float(np.quantile(np.abs(d), 0.9)),
            "outlier_ratio": float(np.mean(np.abs(d) > OUTLIER_SD * self.sd)),
        }


OUTLIER_SD = 3.0
"""A depth is an outlier beyond this many of its standard deviations."""


class Fusion:
    """What the lidar of a sequence says, look by look.

    Attributes
    ----------
    data : DepthData, optional
        For the next fit; None without a lidar.
    factor : float
        On the standard deviations of the depths.
    """

    def __init__(self, sequence: Sequence, skeleton: Skeleton, how: str, pixels: np.ndarray) -> None:
        self.sequence, self.skeleton, self.how = sequence, skeleton, how
        self.used = sequence.lidar is not None and how != "none"
        self.surface = expected_surface(skeleton)
        self.data: DepthData | None = None
        self.factor = 1.0
        self._looks = 0
        self._pixels: np.ndarray | None = None
        if sequence.lidar is not None:
            self._pixels = pixels[:, sequence.cameras.names.index(sequence.lidar.camera)]

    def look(
        self,
        positions: np.ndarray,
        found: tuple[Parameters, np.ndarray] | None,
        spread: Posterior | None = None,
    ) -> None:
        """Associate again.

        Markers are at `positions` (N, M, 3), m; θ of a fit is `found`, and its posterior `spread`.
        """
        if not self.used:
            return
        if found is not None:
            self._learn(*found)
        front = _FRONT[min(self._looks, len(_FRONT) - 1)]
        self._looks += 1
        camera, late = self._camera(found)
        data = associate(
            self.sequence,
            self.skeleton,
            positions,
            self.surface,
            how=self.how,
            front_sd=front,
            pixels=self._pixels,
            camera=camera,
            late=late,
        )
        if data is not None and found is not None and self.how == "marker":
            self.factor = self._scale(data, positions, found, spread)
            data = replace(data, measured=replace(data.measured, sd=self.factor * data.measured.sd))
        self.data = data

    def _learn(self, parameters: Parameters, theta: np.ndarray) -> None:
        places = parameters.of_family("surface")
        if len(places):
            origin = np.array([parameters.entries[i].origin for i in places])
            self.surface = origin + theta[places]

    def _camera(self, found: tuple[Parameters, np.ndarray] | None) -> tuple[Camera, float]:
        """The lidar's camera as a fit has corrected it, and how late it is, s."""
        assert self.sequence.lidar is not None
        cameras, name = self.sequence.cameras, self.sequence.lidar.camera
        if found is None:
            return cameras[name], 0.0
        return corrected_cameras(cameras, *found)[name], time_offsets(cameras, *found)[name]

    def _scale(
        self,
        data: DepthData,
        positions: np.ndarray,
        found: tuple[Parameters, np.ndarray],
        spread: Posterior | None,
    ) -> float:
        """Scale of the residuals in units of their standard deviations; the table counts like 20 depths.

        A fit takes its share of the noise: a residual has (1 − h) σ² of it, with the leverage h.
        """
        residuals = self._residuals(data, positions, found)
        free = 1.0
        if spread is not None:
            variance = self._predicted_variance(residuals, found, spread)
            free = np.sqrt(1.0 - np.clip(variance / residuals.sd**2, 0.0, MOST_LEVERAGE))
        scale = robust_scale(residuals.residual / (residuals.sd * free))
        if not scale > 0:
            return self.factor
        count = len(residuals.sd)
        return float(np.clip(math.exp(count * math.log(scale) / (count + PRIOR_COUNT)), *_FACTORS))

    def _predicted_variance(
        self, residuals: DepthResiduals, found: tuple[Parameters, np.ndarray], spread: Posterior
    ) -> np.ndarray:
        """Variance (K,), m², of the predicted depths: zᵀ cov(p) z + var(o) − 2 zᵀ cov(p, o)."""
        frame, marker = residuals.frame, residuals.marker
        rotation = self._camera(found)[0].rotation
        axis = np.broadcast_to(rotation, (len(spread.positions), 3, 3))[frame, 2]
        variance = np.einsum("ka,kab,kb->k", axis, spread.positions[frame, marker], axis)
        places = found[0].of_family("surface")
        if len(places):
            place = places[marker]
            first = len(spread.theta) - spread.with_cameras.shape[-1]
            mixed = spread.with_cameras[frame, marker, :, place - first]
            variance += spread.theta[place, place] - 2.0 * np.einsum("ka,ka->k", axis, mixed)
        return variance

    def _residuals(
        self, data: DepthData, positions: np.ndarray, fit: tuple[Parameters, np.ndarray]
    ) -> DepthResiduals:
        camera, late = self._camera(fit)
        surface = self.surface if data.surface else np.zeros_like(self.surface)
        found = data.measured
        if isinstance(found, MarkerDepths):
            positions = positions_at(positions, late, 1 / self.sequence.fps)
        local = camera.to_camera(positions)
        if isinstance(found, MarkerDepths):
            predicted = local[found.frame, found.marker, 2] - surface[found.marker]
            return DepthResiduals(
                data.camera,
                self.how,
                found.frame,
                found.marker,
                found.depth,
                predicted,
                found.sd,
                found.count,
            )
        return _body_residuals(data.camera, self.how, found, local, surface)

    def residuals(self, positions: np.ndarray, found: tuple[Parameters, np.ndarray]) -> DepthResiduals | None:
        """Depth residuals at the end of the estimate; None without a lidar."""
        if self.data is None:
            return None
        self._learn(*found)
        return self._residuals(self.data, positions, found)

    def findings(self) -> list[str]:
        """What the user should know of size and depth, one sentence each."""
        if self.used:
            count = 0 if self.data is None else len(self.data.measured)
            if count:
                return []
            said = "no return of the lidar is on the animal: check its calibration and synchronisation"
        else:
            said = "one camera and no lidar" if self.sequence.lidar is None else "the lidar is not used"
        if len(self.sequence.cameras) == 1:
            said += "; the animal's size, and with it every distance, is that of the species' segment lengths"
        elif not self.used and self.sequence.lidar is None:
            return []
        return [said]


def _body_residuals(
    camera: str, how: str, found: BodyReturns, local: np.ndarray, surface: np.ndarray
) -> DepthResiduals:
    """Returns on the body against the surface of their capsules; listed at the nearer marker."""
    u, z = found.along, local[..., 2]
    axis = (1 - u) * z[found.frame, found.start] + u * z[found.frame, found.end]
    before = found.bulge * ((1 - u) * surface[found.start] + u * surface[found.end])
    nearer = np.where(u < 0.5, found.start, found.end)
    count = np.ones(len(u), dtype=int)
    return DepthResiduals(camera, how, found.frame, nearer, found.depth, axis - before, found.sd, count)
