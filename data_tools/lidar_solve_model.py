"""What a pair of picks says of camera and lidar: residuals, derivatives, weights, and what is known before.

Parameters, by name: a turn ω (rad, in the camera's frame: R' = exp(ω×) R), the translation t (m), log f with
f = √(fx fy), log a with a = fx/fy, the principal point cx, cy (px), and k1, k2 of OpenCV's pinhole lens.
P pairs, D parameters.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from acino_fte.cameras import Camera
from acino_fte.data_tools.rotations import cross_matrix, rotation_matrix

POSE = ("rotation_x", "rotation_y", "rotation_z", "translation_x", "translation_y", "translation_z")
_BOUNDLESS = 1e12  # px²
LENS = ("log_f", "log_aspect", "cx", "cy", "k1", "k2")


@dataclass(frozen=True)
class PickNoise:
    """How far picks are off: standard deviations.

    Attributes
    ----------
    pixel : float
        Each coordinate of a pick in the image, px.
    range : float
        Of a return along its ray, m.
    lateral : float
        Across the ray, rad: the resolution of the scan, where corners lie between its returns. With one zoom
        it acts like more px in the image, which the scale that is found from the pairs takes up.
    """

    pixel: float = 1.0
    range: float = 0.02
    lateral: float = 0.0


@dataclass(frozen=True, eq=False)
class Priors:
    """What is known before: value and standard deviation of some parameters.

    Attributes
    ----------
    value, sd : dict of str to float
        By name; of a turn nothing is ever known.
    """

    value: dict[str, float]
    sd: dict[str, float]

    def terms(self, camera: Camera, names: tuple[str, ...]) -> tuple[np.ndarray, np.ndarray]:
        """(estimate − value) / sd and 1 / sd of each parameter (D,), 0 where nothing is known."""
        now = values(camera)
        off, weight = np.zeros(len(names)), np.zeros(len(names))
        for i, name in enumerate(names):
            if name in self.sd:
                weight[i] = 1.0 / self.sd[name]
                off[i] = (now[name] - self.value.get(name, 0.0)) * weight[i]
        return off, weight


def values(camera: Camera) -> dict[str, float]:
    """The parameters of a camera by name, but for its turn."""
    k = np.append(camera.distortion, np.zeros(2))
    fx, fy = camera.matrix[0, 0], camera.matrix[1, 1]
    found = dict(zip(POSE[3:], camera.translation.tolist(), strict=True))
    lens = (0.5 * np.log(fx * fy), np.log(fx / fy), camera.matrix[0, 2], camera.matrix[1, 2], k[0], k[1])
    return found | dict(zip(LENS, map(float, lens), strict=True))


def moved(camera: Camera, names: tuple[str, ...], step: np.ndarray) -> Camera:
    """The camera after a step (D,) of its parameters."""
    by_name = dict(zip(names, step.tolist(), strict=True))
    turn = np.array([by_name.get(name, 0.0) for name in POSE[:3]])
    shift = np.array([by_name.get(name, 0.0) for name in POSE[3:]])
    f, aspect = np.exp(by_name.get("log_f", 0.0)), np.exp(0.5 * by_name.get("log_aspect", 0.0))
    matrix = camera.matrix.copy()
    matrix[0, 0] *= f * aspect
    matrix[1, 1] *= f / aspect
    matrix[0, 2] += by_name.get("cx", 0.0)
    matrix[1, 2] += by_name.get("cy", 0.0)
    distortion = camera.distortion
    if "k1" in by_name or "k2" in by_name:
        distortion = np.zeros(5)
        distortion[: len(camera.distortion)] = camera.distortion
        distortion[:2] += by_name.get("k1", 0.0), by_name.get("k2", 0.0)
    return replace(
        camera,
        matrix=matrix,
        distortion=distortion,
        rotation=rotation_matrix(turn) @ camera.rotation,
        translation=camera.translation + shift,
    )


def projection(
    camera: Camera, xyz: np.ndarray, names: tuple[str, ...]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pixels (P, 2) of points (P, 3), with derivatives for parameters (P, 2, D) and points (P, 2, 3).

    The derivative for the point in the camera's frame is the generated one of :mod:`acino_fte.projection`;
    the rest is the chain rule. NaN behind the camera.
    """
    pixels, for_point = camera.project_with_jacobian(xyz)
    for_local = for_point @ camera.rotation.T
    turned = xyz @ camera.rotation.T
    columns = dict(zip(POSE[:3], np.moveaxis(-for_local @ cross_matrix(turned), -1, 0), strict=True))
    columns |= dict(zip(POSE[3:], np.moveaxis(for_local, -1, 0), strict=True))
    off = pixels - camera.matrix[:2, 2]
    columns["log_f"] = off
    columns["log_aspect"] = off * [0.5, -0.5]
    columns["cx"] = np.broadcast_to([1.0, 0.0], off.shape)
    columns["cy"] = np.broadcast_to([0.0, 1.0], off.shape)
    local = turned + camera.translation
    ideal = local[:, :2] / local[:, 2:]
    squared = (ideal**2).sum(axis=1, keepdims=True)
    bent = ideal * squared * np.diag(camera.matrix)[:2]
    columns["k1"], columns["k2"] = bent, bent * squared
    return pixels, np.stack([columns[name] for name in names], axis=-1), for_point


def point_covariance(xyz: np.ndarray, noise: PickNoise) -> np.ndarray:
    """Covariance (P, 3, 3) of picked returns, m²: along the ray and across it."""
    distance = np.linalg.norm(xyz, axis=1)[:, None, None]
    ray = xyz[:, :, None] / distance
    along = ray @ ray.transpose(0, 2, 1)
    return noise.range**2 * along + (noise.lateral * distance) ** 2 * (np.eye(3) - along)


def pick_covariance(for_point: np.ndarray, xyz: np.ndarray, noise: PickNoise) -> np.ndarray:
    """Covariance (P, 2, 2) of pick minus projection, px²: both picks, to first order.

    Errors in both of what is compared are as one error in the image (Sampson 1982; Hartley and Zisserman
    2004, section 4.2.6): S = σ² 1 + J Σ Jᵀ.
    """
    spread = for_point @ point_covariance(xyz, noise) @ for_point.transpose(0, 2, 1)
    return noise.pixel**2 * np.eye(2) + spread


def whitening(covariance: np.ndarray) -> np.ndarray:
    """W (P, 2, 2) with Wᵀ W the inverse of covariances (P, 2, 2); 0 where they are no numbers, or as good as.

    Of a point beside the camera, nearly 90° from its axis, the covariance is so large that it has no inverse.
    """
    known = np.isfinite(covariance).all(axis=(1, 2)) & (np.abs(covariance) < _BOUNDLESS).all(axis=(1, 2))
    out = np.zeros_like(covariance)
    out[known] = np.linalg.inv(np.linalg.cholesky(covariance[known]))
    return out
