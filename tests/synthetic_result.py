"""A small FTEResult without a solver: a cheetah, or another animal, gallops past a row of cameras."""

from dataclasses import replace

import numpy as np
import xarray as xr

from acino_fte.cameras import Camera, CameraArray
from acino_fte.kinematics import load_kinematics
from acino_fte.result import FTEResult, Status
from acino_fte.sequence import Sequence
from acino_fte.skeleton import load_skeleton

FPS = 120.0


def make_cameras(n):
    cameras = []
    for c in range(n):
        x = -1.0 + 14.0 * (c // 2) / max(1, (n - 1) // 2)
        centre = np.array([x, -6.0 if c % 2 == 0 else 6.0, 1.2])
        forward = np.array([5.0, 0.0, 0.6]) - centre
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        rotation = np.stack([right, np.cross(forward, right), forward])
        matrix = np.array([[1200.0, 0, 1352], [0, 1200, 760], [0, 0, 1]])
        cameras.append(
            Camera(f"cam{c + 1}", "fisheye", matrix, np.zeros(4), rotation, -rotation @ centre, (2704, 1520))
        )
    return CameraArray(tuple(cameras))


def gallop(skeleton, n_frames, speed=13.0):
    """Degrees of freedom (N, Q) of something like a gallop, inside every limit."""
    time = np.arange(n_frames) / FPS
    q = np.zeros((n_frames, len(skeleton.dofs)))
    for j, dof in enumerate(skeleton.dofs):
        if np.isfinite(dof.lower):
            swing = min(0.25 * (dof.upper - dof.lower), 0.45)
            centre = np.clip(0.0, dof.lower + 1.2 * swing, dof.upper - 1.2 * swing)
            q[:, j] = centre + swing * np.sin(2 * np.pi * 3.0 * time + 1.3 * j)
    root = skeleton.dofs[0].name.partition(".")[0]
    q[:, skeleton.dof(f"{root}.x")] = speed * time
    q[:, skeleton.dof(f"{root}.z")] = 0.85 + 0.05 * np.sin(2 * np.pi * 3.0 * time)
    q[:, skeleton.dof(f"{root}.yaw")] = 0.15 * np.sin(2 * np.pi * 0.5 * time)
    return q


def make_result(
    n_frames=12,
    n_cameras=3,
    noise=3.0,
    outliers=0.03,
    missing=0.3,
    start=80,
    status=Status.CONVERGED,
    truth=True,
    seed=0,
    warnings=(),
    kinematics=None,
):
    kinematics = kinematics or load_kinematics(load_skeleton("cheetah"))
    skeleton = kinematics.skeleton
    rng = np.random.default_rng(seed)
    q = gallop(skeleton, n_frames)
    positions = kinematics.positions(q)
    cameras = make_cameras(n_cameras)
    reprojected = cameras.project(positions)
    observed = reprojected + rng.normal(0, noise, reprojected.shape)
    wild = rng.random(observed.shape[:3]) < outliers
    observed[wild] += rng.normal(0, 150, (wild.sum(), 2))
    inside = np.stack([camera.inside(observed[:, c]) for c, camera in enumerate(cameras)], axis=1)
    observed[(rng.random(observed.shape[:3]) < missing) | ~inside] = np.nan
    frames = np.arange(start, start + n_frames)
    labels = {"frame": frames, "camera": cameras.names, "marker": skeleton.marker_names}
    likelihood = np.where(np.isfinite(observed).all(-1), 0.9, 0.1)
    detections = xr.Dataset(
        {
            "position": (("frame", "camera", "marker", "space"), observed),
            "likelihood": (("frame", "camera", "marker"), likelihood),
        },
        {**labels, "space": ["u", "v"]},
    )
    true = xr.DataArray(
        positions + rng.normal(0, 0.002, positions.shape),
        dims=("frame", "marker", "space"),
        coords={"frame": frames, "marker": skeleton.marker_names, "space": ["x", "y", "z"]},
    )
    sequence = Sequence(
        name="gallop",
        species=skeleton.name,
        fps=FPS,
        detections=detections,
        cameras=cameras,
        truth=true if truth else None,
        provenance={"species": skeleton.name, "fps": FPS, "frames": [start, start + n_frames]},
        warnings=tuple(warnings),
    )
    dq = np.gradient(q, 1 / FPS, axis=0) if n_frames > 1 else np.zeros_like(q)
    return FTEResult(
        status=status,
        sequence=sequence,
        skeleton=skeleton,
        q=q,
        dq=dq,
        ddq=np.zeros_like(q),
        positions=positions,
        observed=observed,
        reprojected=reprojected,
        objective=123.5,
        iterations=9,
        method="fte-condensed",
        seconds={"load": 0.5, "initialise": 0.02, "build": 0.01, "solve": 0.07},
        options={"likelihood": 0.5, "loss": "redescending", "solve": {"max_iter": 200}},
    )


def with_estimates(result, seed=1):
    """The result as an estimator with parameters and uncertainty leaves it; errors are as claimed."""
    rng = np.random.default_rng(seed)
    n, m = result.positions.shape[:2]
    names = result.sequence.cameras.names
    views = np.isfinite(result.observed).all(-1).sum(axis=1)
    factor = rng.normal(0, 1, (n, m, 3, 3)) * [0.004, 0.006, 0.003] / (0.4 + views)[..., None, None]
    covariance = factor @ factor.swapaxes(-1, -2) + 1e-6 * np.eye(3)
    error = np.einsum("nmij,nmj->nmi", np.linalg.cholesky(covariance), rng.normal(0, 1, (n, m, 3)))
    truth = result.sequence.truth.copy(data=result.positions - error)
    turn = {"rotation_rad": [0.001, -0.002, 0.0005], "translation_m": [0.02, -0.01, 0.005]}
    spread = {"rotation_rad": [4e-4, 5e-4, 3e-4], "translation_m": [0.004, 0.006, 0.003]}
    parameters = {
        "time_offset_s": dict(zip(names, [0.0, 0.0054, -0.0021], strict=False)),
        "time_offset_s_sd": dict(zip(names, [0.0, 0.0004, 0.0006], strict=False)),
        "segment_scale": {g: 1 + 0.04 * np.sin(i) for i, g in enumerate(result.skeleton.groups)},
        "segment_scale_sd": {g: 0.005 + 0.001 * i for i, g in enumerate(result.skeleton.groups)},
        "extrinsics": {name: turn for name in names[1:]},
        "extrinsics_sd": {name: spread for name in names[1:]},
        "marker_offset_m": {
            name: list(0.01 * rng.normal(0, 1, 3))
            for name in ("spine", "nose")
            if name in result.skeleton.marker_names
        },
        "noise_px": {x.name: x.sd_px * rng.uniform(0.7, 2.5) for x in result.skeleton.markers},
    }
    return replace(
        result,
        sequence=replace(result.sequence, truth=truth),
        parameters=parameters,
        q_sd=np.full_like(result.q, 0.04) * rng.uniform(0.5, 2.0, (n, 1)),
        position_covariance=covariance,
        findings=("cam2 is 5.4 ms behind the others.", "l_hip and r_hip are swapped in cam3."),
    )


def with_evaluation(result):
    """The result as ``--holdout-cameras each --ladder`` leaves it; the first camera cannot be predicted."""
    names = result.sequence.cameras.names

    def scores(median):
        return {"median": median, "p90": 3 * median, "within_20px": 0.7, "coverage": 0.95, "n": 1234}

    def left_out(median):
        lost = {"median": None, "p90": None, "within_20px": None, "coverage": 0.0, "n": 56}
        others = {name: scores(median + c) for c, name in enumerate(names[1:], 1)}
        return {**scores(median), "per_camera": {names[0]: lost, **others}}

    def rung(fit, took_part, fitted, nominal):
        error = {"median": took_part, "within_20px": 0.8}
        return {
            "fit": fit,
            "reprojection_px": error,
            "heldout_px": scores(fitted),
            "heldout_nominal_px": scores(nominal),
        }

    ladder = [
        rung([], 11.3, 16.3, 15.8),
        rung(["delay"], 10.1, 14.6, 15.2),
        rung(["delay", "extrinsics"], 8.0, 12.25, 13.75),
    ]
    evaluation = {"heldout_px": left_out(12.25), "heldout_nominal_px": left_out(13.75), "ladder": ladder}
    return replace(result, evaluation=evaluation)


def triangulated(result):
    """The result as a method without a skeleton leaves it: no joints, and no position from a single view."""
    unseen = np.isfinite(result.observed).all(-1).sum(axis=1) < 2
    empty = np.zeros((len(result.q), 0))
    return replace(
        result,
        method="tri",
        q=empty,
        dq=empty,
        ddq=empty,
        positions=np.where(unseen[..., None], np.nan, result.positions),
        reprojected=np.where(unseen[:, None, :, None], np.nan, result.reprojected),
    )
