"""The IMU of a simulated rig: it sits in the lidar, has its axes, and turns with the camera."""

from __future__ import annotations

import numpy as np

from acino_fte.data_tools.recording import GRAVITY, ImuSamples
from acino_fte.rig_motion import SWING, CameraPath
from acino_fte.rig_options import RigOptions

_AFTER = 0.05  # s, that it runs on after the last frame


def simulate_imu(
    options: RigOptions, path: CameraPath, lidar_to_camera: tuple[np.ndarray, np.ndarray]
) -> tuple[ImuSamples, dict[str, list[float]]]:
    """Samples from the rest before the recording to its end, and the true biases.

    ``lidar_to_camera`` is a rotation (3, 3) and a translation (3,), m: the IMU's frame is that of the lidar.
    ``time_ns`` of the samples counts from frame 0: it is negative before. Each sample has a constant bias and
    white noise; the biases are ``gyro`` (rad/s) and ``accel`` (m/s²).
    """
    rotation, translation = lidar_to_camera
    start = -(options.rest_s + SWING)
    count = int((options.n_frames / options.fps + _AFTER - start) * options.imu_rate) + 1
    time_ns = np.round(1e9 * (start + np.arange(count) / options.imu_rate)).astype(np.int64)
    time = 1e-9 * time_ns
    rate = path.rate(time) @ rotation
    pull = path.acceleration(time, translation) + np.array([0.0, 0.0, GRAVITY])
    force = np.einsum("tij,tj->ti", path.rotation(time), pull) @ rotation
    gyro, gyro_bias = _flawed(options.stream("gyro"), rate, options.gyro_bias, options.gyro_noise)
    accel, accel_bias = _flawed(options.stream("accel"), force, options.accel_bias, options.accel_noise)
    return ImuSamples(time_ns, gyro, accel), {"gyro": gyro_bias.tolist(), "accel": accel_bias.tolist()}


def _flawed(
    rng: np.random.Generator, true: np.ndarray, bias: float, noise: float
) -> tuple[np.ndarray, np.ndarray]:
    """True values (K, 3) with noise and a bias of a given length in a random direction; and the bias (3,)."""
    direction = rng.standard_normal(3)
    constant = bias * direction / np.linalg.norm(direction)
    return true + constant + noise * rng.standard_normal(true.shape), constant
