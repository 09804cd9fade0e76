"""Which markers the animal's own body hides from which camera."""

from __future__ import annotations

import numpy as np

from acino_fte.cameras import CameraArray
from acino_fte.skeleton import Skeleton

_EPS = 1e-12


def hidden_by_body(skeleton: Skeleton, positions: np.ndarray, cameras: CameraArray) -> np.ndarray:
    """Markers whose line of sight passes through a capsule of the body.

    A capsule does not hide the markers that lie inside it or span it: they stand for points on its surface
    that may be seen from any side.

    Parameters
    ----------
    skeleton : Skeleton
        Its ``capsules`` are the solid body; a species without any hides nothing.
    positions : (N, M, 3)
        m, world frame.
    cameras : CameraArray
        Fixed or moving.

    Returns
    -------
    (N, C, M) bool
    """
    n_frames, n_markers = positions.shape[:2]
    hidden = np.zeros((n_frames, len(cameras), n_markers), dtype=bool)
    for a, b, radius in skeleton.capsules:
        start, end = positions[:, a, None], positions[:, b, None]
        outside = segment_distance_squared(positions, positions, start, end) > radius**2
        for c, camera in enumerate(cameras):
            eye = np.broadcast_to(camera.centre, (n_frames, 3))[:, None]
            hidden[:, c] |= outside & (segment_distance_squared(eye, positions, start, end) < radius**2)
    return hidden


def segment_distance_squared(p0: np.ndarray, p1: np.ndarray, q0: np.ndarray, q1: np.ndarray) -> np.ndarray:
    """Squared distance between the segments p0–p1 and q0–q1, in m².

    Shapes (…, 3), broadcast against each other; segments may be points. (Ericson 2005, Real-Time Collision
    Detection, section 5.1.9: closest points on the two lines, clamped to the segments in turn.)
    """
    d1, d2, r = p1 - p0, q1 - q0, p0 - q0
    a, e, f = _dot(d1, d1), _dot(d2, d2), _dot(d2, r)
    b, c = _dot(d1, d2), _dot(d1, r)
    determinant = a * e - b * b
    s = np.where(determinant > _EPS * a * e, (b * f - c * e) / np.maximum(determinant, _EPS), 0.0)
    s = np.clip(s, 0.0, 1.0)
    t = np.clip((b * s + f) / np.maximum(e, _EPS), 0.0, 1.0)
    s = np.clip((b * t - c) / np.maximum(a, _EPS), 0.0, 1.0)
    gap = r + s[..., None] * d1 - t[..., None] * d2
    return _dot(gap, gap)


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.einsum("...i,...i->...", a, b)
