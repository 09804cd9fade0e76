"""What the 3D viewer of the report shows: positions, edges, cameras and a ground grid, as JSON."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from acino_fte.cameras import Camera
    from acino_fte.result import FTEResult

_MOST_FRAMES = 2000  # beyond, every k-th frame is shown


def scene(result: FTEResult) -> dict[str, Any]:
    """The trajectory for the viewer.

    Returns
    -------
    dict
        ``positions`` (frames · markers · 3), whole mm, world frame, None where missing; ``views``
        (frames · markers), cameras that saw the marker; ``frames`` and ``every`` (the step between them);
        ``fps``; ``markers`` with name and side; ``edges`` [marker, marker, side]; ``cameras`` with poses
        [centre, right, down, forward] in m, one, or one a frame; ``grid``; ``size`` of the animal, m.
    """
    every = -(-len(result.positions) // _MOST_FRAMES)
    positions = result.positions[::every]
    seen = np.isfinite(result.observed).all(-1).sum(axis=1)[::every]
    sides = marker_sides(result)
    names = result.skeleton.marker_names
    return {
        "frames": [int(f) for f in result.sequence.frames[::every]],
        "every": every,
        "fps": float(result.sequence.fps),
        "markers": [{"name": name, "side": side} for name, side in zip(names, sides, strict=True)],
        "edges": [[a, b, sides[b] if sides[a] == "middle" else sides[a]] for a, b in result.skeleton.edges],
        "positions": [int(v) if np.isfinite(v) else None for v in np.round(1000 * positions).ravel()],
        "views": seen.ravel().tolist(),
        "cameras": [_camera(camera, every) for camera in result.sequence.cameras],
        "grid": ground_grid(positions),
        "size": body_size(positions),
    }


def body_size(positions: np.ndarray) -> float:
    """Median over the frames of the greatest extent of the markers (N, M, 3) along an axis, m.

    Frames without two markers do not count; 1 when there are none.
    """
    there = np.isfinite(positions).all(-1)
    seen = there.sum(axis=1) > 1
    frames = np.where(there[seen][..., None], positions[seen], np.nan)
    extent = (np.nanmax(frames, axis=1) - np.nanmin(frames, axis=1)).max(axis=1)
    return round(float(np.median(extent)), 3) if extent.size else 1.0


def marker_sides(result: FTEResult) -> list[str]:
    """``left``, ``right`` or ``middle`` for every marker: from the twins, else from the name."""
    lefts = {left for left, _ in result.skeleton.twins}
    rights = {right for _, right in result.skeleton.twins}
    sides = []
    for name in result.skeleton.marker_names:
        words = name.lower().split("_")
        left = name in lefts or "l" in words or "left" in words
        right = name in rights or "r" in words or "right" in words
        sides.append("left" if left and not right else "right" if right and not left else "middle")
    return sides


def _camera(camera: Camera, every: int) -> dict[str, Any]:
    """Name, height over width of the image, and poses of a camera."""
    rotation, centre = camera.rotation, camera.centre
    if not camera.moves:
        poses = np.concatenate([centre, rotation.ravel()])[None]
    else:
        n = len(rotation) if rotation.ndim == 3 else len(centre)
        axes = np.broadcast_to(rotation, (n, 3, 3)).reshape(n, 9)
        poses = np.concatenate([np.broadcast_to(centre, (n, 3)), axes], axis=1)[::every]
    width, height = camera.resolution
    return {"name": camera.name, "aspect": round(height / width, 4), "poses": np.round(poses, 4).tolist()}


def ground_grid(positions: np.ndarray) -> dict[str, float]:
    """A grid on the ground under positions (N, M, 3): at most 40 lines each way, in steps of 1, 2 or 5, m."""
    points = positions[np.isfinite(positions).all(-1)]
    points = points if len(points) else np.array([[-1.0, -1.0, 0.0], [1.0, 1.0, 0.0]])
    low, high = points.min(axis=0), points.max(axis=0)
    length = float(max(high[:2] - low[:2]))
    steps = [base * 10.0**power for power in range(-2, 5) for base in (1, 2, 5)]
    step = next((s for s in steps if length / s <= 20), length / 20)
    x0, y0 = (np.floor(low[:2] / step) - 1) * step
    x1, y1 = (np.ceil(high[:2] / step) + 1) * step
    z = 0.0 if abs(low[2]) < 0.3 else float(low[2])
    return {
        "x0": round(float(x0), 6),
        "y0": round(float(y0), 6),
        "x1": round(float(x1), 6),
        "y1": round(float(y1), 6),
        "z": round(z, 4),
        "step": round(float(step), 6),
    }
