"""From the attitude of an inertial sensor to the poses of the camera that it is fixed to."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from acino_fte.data_tools.camera_motion import CameraMotion, bridged
from acino_fte.data_tools.imu import Attitude
from acino_fte.data_tools.rotations import cross_matrix, rotation_vector
from acino_fte.errors import InputError

_LEAST = 6  # pairs of frames
_STRIDE = 0.3  # s between the two frames of a pair
_UNSURE = np.radians(5.0)


@dataclass(frozen=True, eq=False)
class Mounting:
    """How a sensor sits on a camera, and how their clocks differ.

    Attributes
    ----------
    imu_to_camera : (3, 3)
        x_camera = imu_to_camera @ x_sensor; the turn only, the lever between them does not matter to
        attitudes.
    covariance : (3, 3)
        Of a small turn in the camera's frame, rad².
    offset : float
        What to add to a frame's stamp to have it on the sensor's clock, s.
    offset_sd : float
        s.
    residual : float
        Root mean square of what is left of a turn between frames, rad.
    notes : tuple of str
    """

    imu_to_camera: np.ndarray
    covariance: np.ndarray
    offset: float = 0.0
    offset_sd: float = 0.0
    residual: float = 0.0
    notes: tuple[str, ...] = ()


def motion_from_attitude(
    attitude: Attitude, frame_ns: np.ndarray, mounting: Mounting, *, levelled: bool = True
) -> CameraMotion:
    """Poses of a camera from the attitude of its sensor: R_n = imu_to_camera · R(t_n)ᵀ.

    Parameters
    ----------
    attitude : Attitude
        Sensor to world.
    frame_ns : (N,) int64
        Stamps of the frames by the sensor's clock, but for the mounting's offset.
    mounting : Mounting
        Of the sensor on the camera.
    levelled : bool
        Whether the attitude's world has z up.

    Returns
    -------
    CameraMotion
        Centres are zeros: a sensor's attitude says nothing of where the camera is. Frames outside the samples
        are not known.

    Raises
    ------
    InputError
        No frame lies within the samples.
    """
    frame_ns = np.asarray(frame_ns)
    time = (frame_ns - attitude.first_ns) * 1e-9 + mounting.offset
    known = (time >= attitude.time[0]) & (time <= attitude.time[-1])
    if not known.any():
        raise InputError(
            "No frame was taken while the inertial sensor ran.",
            expected=f"frames between 0 and {attitude.time[-1]:.3f} s of the samples",
            found=f"{time.min():.3f} to {time.max():.3f} s",
            remedy="check the time of the first frame on the sensor's clock, and the offset",
        )
    inside = np.clip(time, attitude.time[0], attitude.time[-1])
    turned = mounting.imu_to_camera @ np.swapaxes(_at(attitude, inside), 1, 2)
    k = np.clip(np.searchsorted(attitude.time, inside) - 1, 0, len(attitude.time) - 2)
    share = ((inside - attitude.time[k]) / (attitude.time[k + 1] - attitude.time[k]))[:, None, None]
    covariance = (1 - share) * attitude.covariance[k] + share * attitude.covariance[k + 1]
    rate = (
        rotation_vector(np.swapaxes(_at(attitude, inside - 5e-3), 1, 2) @ _at(attitude, inside + 5e-3)) / 1e-2
    )
    late = mounting.offset_sd**2 * (rate**2).sum(1) / 3.0
    variance = np.trace(covariance, axis1=1, axis2=2) / 3.0 + np.trace(mounting.covariance) / 3.0 + late
    centre = np.zeros((len(time), 3))
    rotation, centre = bridged(turned, centre, known)
    notes = attitude.notes + mounting.notes
    if not known.all():
        notes += (f"{int((~known).sum())} of {len(known)} frames lie outside the inertial samples.",)
    return CameraMotion(
        np.arange(len(time)),
        rotation,
        centre,
        known,
        True,
        np.where(known, np.sqrt(variance), np.nan),
        "imu",
        levelled,
        notes,
        {
            "bias_rad_s": attitude.bias.tolist(),
            "offset_s": mounting.offset,
            "offset_sd_s": mounting.offset_sd,
        },
    )


def _at(attitude: Attitude, time: np.ndarray) -> np.ndarray:
    """Attitudes (N, 3, 3) at times in s, by the shortest turn between samples."""
    from scipy.spatial.transform import Rotation, Slerp

    slerp = Slerp(attitude.time, Rotation.from_matrix(attitude.rotation))
    return slerp(np.clip(time, attitude.time[0], attitude.time[-1])).as_matrix()


def find_mounting(
    attitude: Attitude, motion: CameraMotion, frame_ns: np.ndarray, *, max_offset: float = 0.5
) -> Mounting:
    """How the sensor sits on the camera, and their clocks' offset, from turns that both have seen.

    Between two frames the camera turned by v (by its pictures) and the sensor by u; v = M u for the rotation
    M from sensor to camera. M solves Wahba's problem (Markley 1988, by SVD), for every offset of a search;
    the offset with the least robust sum is refined, and the covariance is that of M and the offset together.

    Parameters
    ----------
    attitude : Attitude
        From the gyroscope, in any world.
    motion : CameraMotion
        From the pictures; only its turns are used.
    frame_ns : (N,) int64
        Stamps of the frames, within `max_offset` of the sensor's clock.
    max_offset : float
        s.

    Raises
    ------
    InputError
        There are too few turns, or all about one axis, so that the mounting cannot be found.
    """
    from scipy.optimize import minimize_scalar

    time = (np.asarray(frame_ns) - attitude.first_ns) * 1e-9
    first, second, stride = _pairs(motion, time, attitude, max_offset)
    seen = rotation_vector(motion.rotation[second] @ np.swapaxes(motion.rotation[first], 1, 2))

    def felt(offset: float) -> np.ndarray:
        rotation = _at(attitude, time + offset)
        return rotation_vector(np.swapaxes(rotation[second], 1, 2) @ rotation[first])

    def misfit(offset: float) -> float:
        turn = felt(offset)
        left = seen - turn @ _wahba(seen, turn).T
        return float(np.abs(left).sum())

    step = 0.5 * float(np.median(np.diff(time)))
    grid = np.arange(-max_offset, max_offset + step, step)
    best = float(grid[np.argmin([misfit(offset) for offset in grid])])
    offset = float(minimize_scalar(misfit, bounds=(best - step, best + step), method="bounded").x)
    turn = felt(offset)
    matrix, weight = _robust_wahba(seen, turn)
    slope = (felt(offset + 0.25 * step) - felt(offset - 0.25 * step)) / (0.5 * step)
    shared = stride if motion.numbers.get("model") == "full" else 2  # errors of chained turns add up
    covariance, variance = _mounting_covariance(seen, turn, slope, matrix, weight, shared)
    notes: tuple[str, ...] = (
        f"Mounting found from {int((weight > 0).sum())} turns, offset {1e3 * offset:+.1f} ms ± "
        f"{1e3 * np.sqrt(covariance[3, 3]):.1f} ms.",
    )
    if abs(offset) > max_offset - 2 * step:
        notes += ("The offset lies at the end of what was searched; it may be longer.",)
    return Mounting(
        matrix, covariance[:3, :3], offset, float(np.sqrt(covariance[3, 3])), float(np.sqrt(variance)), notes
    )


def _mounting_covariance(
    seen: np.ndarray, turn: np.ndarray, slope: np.ndarray, matrix: np.ndarray, weight: np.ndarray, shared: int
) -> tuple[np.ndarray, float]:
    """Covariance (4, 4) of a small turn of the mounting (rad) and the offset (s), and the variance of a turn.

    Of turns `seen` in the pictures, felt by the sensor (`turn`, with its `slope` by the offset), (P, 3); that
    many (`shared`) have errors in common.

    Raises
    ------
    InputError
        The turns leave the mounting open.
    """
    jacobian = np.concatenate([cross_matrix(turn @ matrix.T), -(slope @ matrix.T)[:, :, None]], axis=2)
    left = seen - turn @ matrix.T
    variance = float((weight[:, None] * left**2).sum() / max(3 * weight.sum() - 4, 1.0))
    information = np.einsum("k,kij,kil->jl", weight, jacobian, jacobian)
    covariance = shared * variance * np.linalg.pinv(information, rcond=1e-12)
    worst = float(np.sqrt(np.linalg.eigvalsh(covariance[:3, :3])[-1]))
    if worst > _UNSURE or np.linalg.eigvalsh(information[:3, :3])[0] < 1e-9:
        left_open = (
            f"it unsure by {np.degrees(worst):.1f}°" if worst < np.pi else "a turn about their axis open"
        )
        raise InputError(
            "How the sensor sits on the camera cannot be found from this recording.",
            expected="turns about two axes at least (pan and tilt)",
            found=f"turns of {np.degrees(np.abs(seen).max()):.2f}° at most, which leave {left_open}",
            remedy="state the mounting (--imu-to-camera), or record one pan and one tilt by hand",
        )
    return covariance, variance


def _pairs(
    motion: CameraMotion, time: np.ndarray, attitude: Attitude, margin: float
) -> tuple[np.ndarray, np.ndarray, int]:
    """Rows of the two frames of each pair, and how many frames they are apart."""
    stride = max(1, int(round(_STRIDE / float(np.median(np.diff(time))))))
    first = np.arange(len(time) - stride)
    second = first + stride
    inside = (time > attitude.time[0] + margin) & (time < attitude.time[-1] - margin) & motion.known
    keep = inside[first] & inside[second]
    if keep.sum() < _LEAST:
        inside = (time > attitude.time[0]) & (time < attitude.time[-1]) & motion.known
        keep = inside[first] & inside[second]
    if keep.sum() < _LEAST:
        raise InputError(
            "Too few frames have both pictures and inertial samples.",
            expected=f"{_LEAST} pairs of frames",
            found=str(int(keep.sum())),
        )
    return first[keep], second[keep], stride


def _wahba(seen: np.ndarray, felt: np.ndarray, weight: np.ndarray | None = None) -> np.ndarray:
    """The rotation M (3, 3) with the least Σ w |seen − M felt|² (Markley 1988)."""
    if weight is not None:
        felt = felt * weight[:, None]
    u, _, vt = np.linalg.svd(seen.T @ felt)
    return u @ np.diag([1.0, 1.0, np.linalg.det(u) * np.linalg.det(vt)]) @ vt


def _robust_wahba(seen: np.ndarray, felt: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The rotation and the weights (K,) of Tukey's biweight."""
    weight = np.ones(len(seen))
    for _ in range(10):
        matrix = _wahba(seen, felt, weight)
        left = np.linalg.norm(seen - felt @ matrix.T, axis=1)
        scale = 4.685 * max(float(np.median(left)) / 1.538, 1e-12)  # the median of |e| of three Gaussians
        weight = np.where(left < scale, (1.0 - (left / scale) ** 2) ** 2, 0.0)
    return matrix, weight
