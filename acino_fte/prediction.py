"""What the cameras should see: the given calibration with its estimated corrections, and late cameras.

Shapes: N frames, C cameras, M markers.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from acino_fte import delay
from acino_fte.cameras import Camera, CameraArray
from acino_fte.parameters import POSE, Parameters, cayley_matrix


def corrected(camera: Camera, correction: np.ndarray) -> Camera:
    """The camera after a correction (ρ, d) (6,): x_camera = C(ρ)(R x + t) + d, by Cayley's rotation C."""
    return camera.displaced(cayley_matrix(correction[:3]), correction[3:])


def corrected_cameras(cameras: CameraArray, parameters: Parameters, theta: np.ndarray) -> CameraArray:
    """All cameras with the corrections that θ (P,) holds; those without any stay as they are."""
    result = []
    for camera in cameras:
        places = [parameters.place("extrinsics", camera.name, c) for c in POSE]
        known = [p for p in places if p is not None]
        result.append(corrected(camera, theta[known]) if known else camera)
    return CameraArray(tuple(result))


def time_offsets(cameras: CameraArray, parameters: Parameters, theta: np.ndarray) -> dict[str, float]:
    """τ of every camera, s; zero where it is no parameter."""
    places = {camera.name: parameters.place("delay", camera.name) for camera in cameras}
    return {name: 0.0 if place is None else float(theta[place]) for name, place in places.items()}


def positions_at(positions: np.ndarray, late: float, dt: float) -> np.ndarray:
    """Marker positions (N, M, 3) at t + τ, by the stencils of :mod:`acino_fte.delay`."""
    n = len(positions)
    if late == 0.0 or n < delay.NODES:
        return positions
    frames = np.arange(n)
    newest = delay.stencil(frames, n)
    weights = delay.weights(late / dt - (newest - frames))[0]
    nodes = positions[newest - np.arange(delay.NODES)[:, None]]  # (nodes, N, M, 3)
    return np.einsum("kn,knma->nma", weights, nodes)


def predict(
    cameras: CameraArray, positions: np.ndarray, offsets: Mapping[str, float], dt: float
) -> np.ndarray:
    """Pixels (N, C, M, 2) of marker positions (N, M, 3) in cameras that are late by ``offsets`` (s)."""
    views = [camera.project(positions_at(positions, offsets.get(camera.name, 0.0), dt)) for camera in cameras]
    return np.stack(views, axis=1)
