"""What there is to say of a scene's rigs, poses, scale, axes and clocks, as numbers for ``metrics.json``."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from acino_fte.data_tools.camera_paths import PoseNoise
from acino_fte.data_tools.scene_paths import ScenePaths

if TYPE_CHECKING:
    from acino_fte.data_tools.scene import Scene
    from acino_fte.data_tools.scene_axes import AxesEstimate
    from acino_fte.data_tools.scene_scale import ScaleEstimate
    from acino_fte.data_tools.time_offsets import TimeOffsets


def scene_record(scene: Scene, paths: ScenePaths) -> dict[str, Any]:
    """Noise of the poses, rigs, scale, axes and clocks; None for what was not asked for.

    Parameters
    ----------
    scene : Scene
        In its world.
    paths : ScenePaths
        Of its cameras.
    """
    return {
        "pose_noise": {name: _noise(one) for name, one in paths.noise.items()},
        "rigs": [
            {
                "cameras": list(one.names),
                "key_frames": len(one.count),
                "whiteness": one.whiteness,
                "drift_deg": float(np.degrees(one.drift_turn)),
                "drift_m": one.drift_shift,
                **_noise(one.noise),
            }
            for one in paths.rigs
        ],
        "scale": None if scene.scale is None else _scale(scene.scale),
        "axes": None if scene.axes is None else _axes(scene.axes),
        "time_offsets": None if scene.clocks is None else _clocks(scene.clocks),
    }


def _noise(noise: PoseNoise) -> dict[str, float]:
    return {"turn_sd_deg": float(np.degrees(np.max(noise.turn))), "shift_sd_m": float(np.max(noise.shift))}


def _axes(axes: AxesEstimate) -> dict[str, Any]:
    return {"how": axes.how, "tilt_sd_deg": float(np.degrees(axes.tilt_sd))}


def _clocks(clocks: TimeOffsets) -> dict[str, Any]:
    return {
        "reference": clocks.reference,
        "cameras": {
            name: {
                "offset_frames": float(clocks.offset[c]),
                "offset_sd": float(clocks.offset_sd[c]),
                "drift_ppm": 1e6 * float(clocks.drift[c]),
                "drift_ppm_sd": 1e6 * float(clocks.drift_sd[c]),
            }
            for c, name in enumerate(clocks.names)
        },
    }


def _scale(scale: ScaleEstimate) -> dict[str, Any]:
    pairs = zip(scale.distances, scale.measured, scale.residual, scale.normalised, strict=True)
    return {
        "factor": scale.factor,
        "sd": scale.sd,
        "chi2": scale.chi2,
        "distances": [
            {
                "between": [known.first, known.second],
                "kind": known.kind,
                "length_m": known.length,
                "measured_m": scale.factor * found.length,
                "residual_m": float(residual),
                "normalised": float(normalised),
            }
            for known, found, residual, normalised in pairs
        ],
    }
