"""What a recording does not tell: clocks that differ, cameras that moved, an animal of its own proportions.

:func:`draw_imperfections` draws them, each kind from a random stream of its own; they are the truth of what
``acino-fte run --fit scale,offsets,delay,extrinsics`` estimates. The first camera is the reference: its clock
is right and it has not moved.

Shapes: C cameras, G segment groups, M markers.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from acino_fte.cameras import Camera, CameraArray
from acino_fte.kinematics import Kinematics, load_kinematics
from acino_fte.skeleton import Skeleton

if TYPE_CHECKING:
    from acino_fte.simulation_options import SimulationOptions


@dataclass(frozen=True, eq=False)
class Imperfections:
    """One draw.

    Attributes
    ----------
    delay : (C,)
        Camera c in its frame n sees the animal at t_n + delay_c, s.
    turn, shift : (C, 3), (C, 3)
        What corrects the given calibration R, t of a camera (rotation vector, rad, and m):
        x_camera = Exp(turn) · (R x + t) + shift.
    log_scale : (G,)
        Logarithm of the factor on the lengths of a segment group.
    offset : (M, 3)
        From where a marker is said to be to the point that the detector finds, link's frame, m.
    """

    delay: np.ndarray
    turn: np.ndarray
    shift: np.ndarray
    log_scale: np.ndarray
    offset: np.ndarray

    def animal(self, skeleton: Skeleton) -> tuple[Kinematics, np.ndarray | None]:
        """Kinematics of the animal as the detector finds it, and their parameters k (K,); None for none."""
        families = ["scale"] * bool(np.any(self.log_scale)) + ["offsets"] * bool(np.any(self.offset))
        kinematics = load_kinematics(skeleton, families)
        values = {"scale": self.log_scale, "offsets": self.offset.ravel()}
        chosen = [values[family] for family in kinematics.families]
        return kinematics, np.concatenate(chosen) if chosen else None

    def body(self, skeleton: Skeleton) -> tuple[Kinematics, np.ndarray | None]:
        """The same without the displacements of the markers, which do not touch the ground."""
        return replace(self, offset=np.zeros_like(self.offset)).animal(skeleton)

    def given_cameras(self, true: CameraArray) -> CameraArray:
        """The calibration from before the true cameras moved."""
        return CameraArray(
            tuple(_corrected(camera, *_inverse(self.turn[c], self.shift[c])) for c, camera in enumerate(true))
        )

    def parameters(self, skeleton: Skeleton, cameras: list[str]) -> dict[str, Any]:
        """The draw by name, as plain numbers; complete, with zeros and ones for what is as it should be."""
        return {
            "time_offset_s": dict(zip(cameras, self.delay.tolist(), strict=True)),
            "extrinsics": {
                camera: {"rotation_rad": turn, "translation_m": shift}
                for camera, turn, shift in zip(cameras, self.turn.tolist(), self.shift.tolist(), strict=True)
            },
            "segment_scale": dict(zip(skeleton.groups, np.exp(self.log_scale).tolist(), strict=True)),
            "marker_offset_m": dict(zip(skeleton.marker_names, self.offset.tolist(), strict=True)),
        }


def draw_imperfections(skeleton: Skeleton, options: SimulationOptions) -> Imperfections:
    """Draw what the options ask for. Twice the size of an option is twice the same imperfection."""
    streams = np.random.SeedSequence([options.seed, 0x1F]).spawn(5)
    delay, turn, shift, scale, offset = (np.random.default_rng(s) for s in streams)
    n = options.n_cameras
    later = np.arange(n) > 0
    return Imperfections(
        1e-3 * options.delay_ms * np.where(later, delay.uniform(-1.0, 1.0, n), 0.0),
        np.radians(options.moved_deg) * np.where(later[:, None], turn.standard_normal((n, 3)), 0.0),
        1e-3 * options.moved_mm * np.where(later[:, None], shift.standard_normal((n, 3)), 0.0),
        options.proportions * scale.standard_normal(len(skeleton.groups)),
        1e-3 * options.offsets_mm * offset.standard_normal((len(skeleton.markers), 3)),
    )


def corrected_cameras(cameras: CameraArray, extrinsics: dict[str, Any]) -> CameraArray:
    """Cameras x = Exp(ρ)·(R x_world + t) + d, from a calibration R, t and corrections by camera name.

    ``extrinsics`` is that of :meth:`Imperfections.parameters`: ``rotation_rad`` ρ, ``translation_m`` d, m.
    Cameras that it does not name stay as they are.
    """
    return CameraArray(
        tuple(
            _corrected(c, *(np.array(extrinsics[c.name][k]) for k in ("rotation_rad", "translation_m")))
            if c.name in extrinsics
            else c
            for c in cameras
        )
    )


def _corrected(camera: Camera, turn: np.ndarray, shift: np.ndarray) -> Camera:
    from scipy.spatial.transform import Rotation

    if not (np.any(turn) or np.any(shift)):
        return camera
    return camera.displaced(Rotation.from_rotvec(turn).as_matrix(), shift)


def _inverse(turn: np.ndarray, shift: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The correction that undoes a correction."""
    from scipy.spatial.transform import Rotation

    return -turn, -Rotation.from_rotvec(-turn).apply(shift)
