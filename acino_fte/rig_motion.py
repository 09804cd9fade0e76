"""How the camera of a simulated rig turns: a smooth function of time that lidar, IMU and pictures share.

The rig stands still, takes a second to swing after the animal, and follows it from just before frame 0. Its
camera stays in one place. Times are seconds since frame 0. World: z up; pan is clockwise from above, 0 looks
along y; tilt is upwards.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from acino_fte.data_tools.rotations import rotation_matrix, rotation_vector
from acino_fte.motions import Motion
from acino_fte.rig_options import RigOptions

SWING = 1.0  # s, from rest to following
START = -0.05  # s, when it follows the animal
_MARGIN = 0.1  # s, after the last frame
_KNOT = 0.5  # s: what is faster than this a hand does not follow
_SLOW, _FAST = (0.2, 0.8), (1.0, 8.0)  # Hz, of a hand's errors and of a shake
_WAVES = 6
_STEP = 1e-3  # s, of difference quotients

Angle = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True, eq=False)
class Wobble:
    """Sums of sines that start softly: small turns (T, 3), rad, about the axes of the camera.

    ``amplitude``, ``frequency`` and ``phase`` are (W, 3): rad, Hz and rad.
    """

    amplitude: np.ndarray
    frequency: np.ndarray
    phase: np.ndarray

    def __call__(self, time: np.ndarray) -> np.ndarray:
        """Rotation vectors (T, 3), rad, at times (T,), s; zero at rest."""
        out = np.zeros((len(time), 3))
        for a, f, p in zip(self.amplitude, self.frequency, self.phase, strict=True):
            out += a * np.sin(2 * np.pi * f * time[:, None] + p)
        return out * _soft_step((time - START) / SWING + 1.0)[:, None]


@dataclass(frozen=True, eq=False)
class CameraPath:
    """The true pose of the camera at any time.

    Attributes
    ----------
    centre : (3,)
        Of the camera, m, world.
    pan, tilt : functions of time (T,) to angles (T,), rad
    wobble : Wobble
    """

    centre: np.ndarray
    pan: Angle
    tilt: Angle
    wobble: Wobble

    def rotation(self, time: np.ndarray) -> np.ndarray:
        """World to camera (T, 3, 3) at times (T,), s."""
        time = np.asarray(time, dtype=float)
        return rotation_matrix(self.wobble(time)) @ looking(self.pan(time), self.tilt(time))

    def rate(self, time: np.ndarray) -> np.ndarray:
        """Angular velocity (T, 3) of the camera in its own frame, rad/s.

        From the turn between t − h and t + h, and that of half the step, extrapolated (Richardson): the
        error is of the fourth order.
        """
        time = np.asarray(time, dtype=float)

        def quotient(step: float) -> np.ndarray:
            before, after = self.rotation(time - step), self.rotation(time + step)
            return rotation_vector(before @ after.swapaxes(-1, -2)) / (2 * step)

        return (4 * quotient(_STEP / 2) - quotient(_STEP)) / 3

    def acceleration(self, time: np.ndarray, arm: np.ndarray) -> np.ndarray:
        """Acceleration (T, 3), world, m/s², of a point that is fixed at `arm` (3,) in the camera's frame."""
        time = np.asarray(time, dtype=float)
        place = [np.einsum("tji,j->ti", self.rotation(time + s), arm) for s in (-_STEP, 0.0, _STEP)]
        return (place[0] - 2 * place[1] + place[2]) / _STEP**2


def looking(pan: np.ndarray, tilt: np.ndarray) -> np.ndarray:
    """World to camera (…, 3, 3) of a level camera: right, down and forward as rows."""
    cp, sp, ct, st = np.cos(pan), np.sin(pan), np.cos(tilt), np.sin(tilt)
    zero = np.zeros_like(cp)
    rows = ((cp, -sp, zero), (sp * st, cp * st, -ct), (sp * ct, cp * ct, st))
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def plan_camera(options: RigOptions, motion: Motion) -> CameraPath:
    """The camera that follows a motion, or looks at the middle of its path."""
    angle = math.radians(options.angle)
    centre = np.array([math.sin(angle), -math.cos(angle), 0.0]) * options.distance
    centre[2] = options.height
    stop = (options.n_frames - 1) / options.fps + _MARGIN
    time = np.linspace(START, stop, max(8, round(60 * (stop - START))))
    animal = motion.kinematics.positions(motion(time), motion.parameters).mean(axis=1) - centre
    if not options.pan:
        animal = np.broadcast_to(0.5 * (animal.min(axis=0) + animal.max(axis=0)), animal.shape)
    pan = np.unwrap(np.arctan2(animal[:, 0], animal[:, 1]))
    tilt = np.arctan2(animal[:, 2], np.hypot(animal[:, 0], animal[:, 1]))
    return CameraPath(centre, _followed(time, pan), _followed(time, tilt), _draw_wobble(options))


def _followed(time: np.ndarray, value: np.ndarray) -> Angle:
    """A smooth function of time near values (T,), that comes from rest during the swing before them."""
    from scipy.interpolate import BPoly, make_lsq_spline

    start, stop = time[0], time[-1]
    inner = np.linspace(start, stop, max(2, round((stop - start) / _KNOT) + 1))[1:-1]
    degree = 5 if len(inner) else 3
    track = make_lsq_spline(time, value, np.r_[[start] * (degree + 1), inner, [stop] * (degree + 1)], degree)
    first, speed, change = (float(track(start, nu)) for nu in range(3))
    rest = first - 0.5 * SWING * speed
    swing = BPoly.from_derivatives([start - SWING, start], [[rest, 0.0, 0.0], [first, speed, change]])

    def angle(t: np.ndarray) -> np.ndarray:
        out = np.full(np.shape(t), rest)
        early, late = (t > start - SWING) & (t < start), t >= start
        out[early], out[late] = swing(t[early]), track(t[late])
        return out

    return angle


def _draw_wobble(options: RigOptions) -> Wobble:
    """Slow errors of pan and tilt, and a shake of all three angles, each kind from its own stream."""
    sizes = (math.radians(options.follow_deg) if options.pan else 0.0, 1e-3 * options.shake_mrad)
    amplitude, frequency, phase = [], [], []
    for purpose, size, (low, high) in zip(("follow", "shake"), sizes, (_SLOW, _FAST), strict=True):
        rng = options.stream(purpose)
        weight = np.abs(rng.standard_normal((_WAVES, 3))) + 0.3
        weight *= size * math.sqrt(2.0) / np.linalg.norm(weight, axis=0)
        if purpose == "follow":
            weight[:, 2] = 0.0  # a head on a tripod does not roll
        amplitude.append(weight)
        frequency.append(rng.uniform(low, high, (_WAVES, 3)))
        phase.append(rng.uniform(0, 2 * np.pi, (_WAVES, 3)))
    return Wobble(np.concatenate(amplitude), np.concatenate(frequency), np.concatenate(phase))


def _soft_step(x: np.ndarray) -> np.ndarray:
    """0 before 0, 1 after 1, and between them with two continuous derivatives."""
    x = np.clip(x, 0.0, 1.0)
    return x**3 * (10 - 15 * x + 6 * x**2)
