"""Writes a recording of 2D tracks as a folder: cameras, one table per camera, and the truth beside them.

==================  ========================================================================================
cameras.json        fixed pinhole cameras: a list with id, K, R, t (world to camera, m), dist_opencv,
                    image_size; others: the project's own camera file
camN.csv            frame, track, x, y (px); an empty track is a bare point; N counts the cameras from 0
camN_truth.csv      the true animal of each row of camN.csv, −1 for clutter; for scoring only
truth_3d.csv        frame, animal, x, y, z (m); for scoring only
==================  ========================================================================================
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from acino_fte.cameras import CameraArray
from acino_fte.data_tools.calibration import write_cameras
from acino_fte.data_tools.tracks2d import TrackRecording, Tracks2D
from acino_fte.errors import InputError
from acino_fte.simulation_files import whole_folder


def write_tracks(recording: TrackRecording, folder: Path | str) -> Path:
    """Write a recording; the folder appears whole or not at all.

    Parameters
    ----------
    recording : TrackRecording
        From a simulation or a reader.
    folder : Path
        New, or empty.

    Returns
    -------
    Path
        The folder.

    Raises
    ------
    InputError
        Something is there already, or the folder cannot be made.
    """
    folder = Path(folder).expanduser().resolve()
    if folder.exists() and not (folder.is_dir() and not any(folder.iterdir())):
        raise InputError(
            "The target exists; it is left alone.", file=folder, remedy="choose another folder, or remove it"
        )
    with whole_folder(folder) as work:
        _write_files(recording, work)
    return folder


def _write_files(recording: TrackRecording, folder: Path) -> None:
    import pandas as pd

    _write_cameras(folder / "cameras.json", recording.cameras)
    for n, view in enumerate(recording.views):
        _table(view).to_csv(folder / f"cam{n}.csv", index=False, lineterminator="\n", float_format="%.4f")
        if view.animal is not None:
            truth = pd.DataFrame({"animal": view.animal})
            truth.to_csv(folder / f"cam{n}_truth.csv", index=False, lineterminator="\n")
    if recording.truth_3d is not None:
        recording.truth_3d.to_csv(
            folder / "truth_3d.csv", index=False, lineterminator="\n", float_format="%.6f"
        )


def _table(view: Tracks2D):
    import pandas as pd

    labels = np.array([*view.labels, ""], dtype=object)  # the last for bare points, track −1
    x, y = view.xy.T
    return pd.DataFrame({"frame": view.frame, "track": labels[view.track], "x": x, "y": y})


def _write_cameras(path: Path, cameras: CameraArray) -> None:
    if any(camera.moves or camera.model != "pinhole" for camera in cameras):
        write_cameras(path, cameras)
        return
    entries = [
        {
            "id": str(n),
            "K": camera.matrix.tolist(),
            "R": camera.rotation.tolist(),
            "t": camera.translation.tolist(),
            "dist_opencv": camera.distortion.tolist(),
            "image_size": list(camera.resolution),
            "model": "X_cam = R X_world + t",
        }
        for n, camera in enumerate(cameras)
    ]
    path.write_text(json.dumps(entries, indent=1) + "\n", encoding="utf-8")
