"""Runs for the tests of evaluation and adjustments: a recording on disk and a result, without a solver."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
from data_tools_synthetic import cloud, ring, write_recording

from acino_fte.cameras import CameraArray
from acino_fte.data_tools.calibration import write_cameras
from acino_fte.data_tools.load import load_sequence
from acino_fte.data_tools.rotations import rotation_matrix
from acino_fte.prediction import predict
from acino_fte.result import FTEResult, Status
from acino_fte.result_files import write_tables
from acino_fte.skeleton import load_skeleton

START, STOP = 10, 22
CORRECTION = {"rotation_rad": [0.002, -0.001, 0.0015], "translation_m": [0.02, -0.01, 0.03]}


def make_run(
    folder: Path,
    name: str = "run",
    n_cameras: int = 3,
    *,
    seed: int = 0,
    status: Status = Status.CONVERGED,
    parameters: dict | None = None,
    moving: bool = False,
    unplaced: tuple[int, int] | None = None,
) -> Path:
    """A recording in ``folder/recording`` (unless it is there) and a run of its frames 10 to 21.

    The positions are :func:`data_tools_synthetic.cloud`'s. ``unplaced`` (row, marker) has no position.
    """
    recording = folder / "recording"
    if not recording.exists():
        write_recording(recording, n_cameras)
        if moving:
            _let_first_move(recording, n_cameras)
    sequence = load_sequence(recording, frames=(START, STOP))
    skeleton = load_skeleton("cheetah")
    positions = cloud()[START:STOP].copy()
    if unplaced is not None:
        positions[unplaced] = np.nan
    parameters = parameters or {}
    corrections = parameters.get("extrinsics", {})
    cameras = CameraArray(
        tuple(
            c.displaced(
                rotation_matrix(np.array(corrections[c.name]["rotation_rad"])),
                np.array(corrections[c.name]["translation_m"]),
            )
            if c.name in corrections
            else c
            for c in sequence.cameras
        )
    )
    offsets = parameters.get("time_offset_s", {})
    reprojected = predict(cameras, positions, offsets, 1 / sequence.fps)
    observed = sequence.pixels(skeleton.marker_names, 0.5)
    observed = observed + np.random.default_rng(seed).normal(0, 1.0, observed.shape)
    observed[:, :, 3] = np.nan  # a marker that nothing detected
    result = FTEResult(
        status=status,
        sequence=replace(sequence, name="cheetahs"),
        skeleton=skeleton,
        q=np.zeros((len(positions), 0)),
        dq=np.zeros((len(positions), 0)),
        ddq=np.zeros((len(positions), 0)),
        positions=positions,
        observed=observed,
        reprojected=reprojected,
        objective=1.0,
        iterations=3,
        method="tri",
        parameters=parameters,
    )
    out = folder / name
    out.mkdir()
    write_tables(result, out)
    return out


def _let_first_move(recording: Path, n_cameras: int) -> None:
    cameras = list(ring(n_cameras))
    n = len(cloud())
    shift = np.linspace(0, 0.3, n)[:, None] * [1.0, 0.2, -0.1]
    cameras[0] = replace(
        cameras[0],
        rotation=np.broadcast_to(cameras[0].rotation, (n, 3, 3)),
        translation=cameras[0].translation + shift,
    )
    write_cameras(recording / "cameras.json", CameraArray(tuple(cameras)))


def with_depth(run: Path, values: np.ndarray) -> Path:
    """The run as one with a lidar leaves it: depth residuals (N, M) m, about a depth of 50 m."""
    names = load_skeleton("cheetah").marker_names
    rows = [
        f"{START + n},{(START + n) / 120},{names[m]},50.000000,{50 + values[n, m]:.6f},0.02,1"
        for n, m in np.argwhere(np.isfinite(values))
    ]
    head = "frame,time_s,marker,measured,predicted,sd,returns"
    (run / "depth.csv").write_text("\n".join([head, *rows]) + "\n", encoding="utf-8")
    return run


def edited(path: Path, **changes) -> Path:
    """A JSON file with other values."""
    data = json.loads(path.read_text(encoding="utf-8"))
    path.write_text(json.dumps({**data, **changes}), encoding="utf-8")
    return path
