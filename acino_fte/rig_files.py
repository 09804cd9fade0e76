"""Writes a simulated recording of a rig as a sequence folder, with its truth, and as raw recordings."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from acino_fte.cameras import CameraArray
from acino_fte.data_tools.recording import ImuSamples
from acino_fte.errors import InputError
from acino_fte.lidar import Lidar
from acino_fte.rig_clocks import CAMERA_START, LIDAR_START, UNIX_START, FrameStamps
from acino_fte.rig_recording import Recording, VideoFormat, write_recording
from acino_fte.simulate import is_bundled
from acino_fte.simulate_rig import CAMERA, RigSimulation
from acino_fte.simulation_files import PROVENANCE, check_target, whole_folder

FORMAT = "acino-fte/rig-simulation/1"
FOLDER = "recording"

_README = """# {name}

A simulated recording of a rig: {species}, motion '{motion}', {n_frames} frames at {fps:g} Hz, {distance:g} m
away, one camera and one lidar. Made by

    {command}

which makes it again, number for number. All options are in `simulation.json`.

| file | what |
| --- | --- |
| `sequence.yaml` | what belongs together |
| `cameras.json` | the camera, a pose a frame: x_camera = rotation * x_world + translation, m |
| `dlc/cam1.csv` | detections as DeepLabCut writes them, px; an empty cell is a missing detection |
| `frames.csv` | of every frame: true time (s), stamps of camera and computer (ns), number, whether dropped |
| `imu.csv` | angular velocity and specific force, in the frame of the lidar; s since frame 0 |
| `truth.csv`, `truth_states.csv` | true marker positions (m, world) and degrees of freedom (rad, m) |
| `truth_rig.json` | true lidar_to_camera and poses of the camera, biases of the IMU, clocks |
"""
_README_LIDAR = """| `lidar.npz` | returns: time (s since frame 0), xyz (m, frame of the lidar), intensity |
| `lidar_camera.json` | where the lidar is from the camera |
| `truth_lidar.npz` | what each return hit: on_body, link, marker, misled, true time and distance |
"""
_README_RECORDING = """
`recording` holds the same as the rig would record it, in the clocks of the sensors, and `keypoints.csv`, the
detections of the frames that were recorded.
"""


def write_rig_simulation(
    simulation: RigSimulation,
    folder: Path | str,
    *,
    recording: Recording | None = None,
    video: VideoFormat | None = None,
    picture_width: int = 512,
    overwrite: bool = False,
    command: str | None = None,
) -> Path:
    """Write a sequence folder, and the recording in real formats; it appears whole or not at all.

    Parameters
    ----------
    simulation : RigSimulation
        From :func:`acino_fte.simulate_rig.simulate_rig`.
    folder : Path
        Where; its name becomes the name of the sequence.
    recording : {"lvx", "bag1", "bag2"}, optional
        Lidar and IMU as Livox Viewer writes them, or these and pictures as a bag of ROS 1 or ROS 2.
    video : {"mp4", "mkv"}, optional
        Pictures as a video.
    picture_width : int
        Of the pictures, px, from 16 to 8192.
    overwrite : bool
        Replace an earlier simulation there. Nothing else is ever replaced.
    command : str, optional
        The command that made it, for the note in the folder.

    Raises
    ------
    InputError
        The folder exists and is not to be replaced, cannot be made, or a library is missing.
    """
    if not 16 <= picture_width <= 8192:
        raise InputError(
            "The width of the pictures is wrong.",
            key="picture_width",
            expected="px, from 16 to 8192",
            found=str(picture_width),
        )
    folder = check_target(folder, overwrite=overwrite)
    command = command or "acino_fte.simulate_rig.simulate_rig (from Python)"
    with whole_folder(folder) as work:
        _write_sequence(simulation, work, folder.name)
        _write_truth(simulation, work)
        _write_imu(work / "imu.csv", simulation.imu)
        _write_frames(work / "frames.csv", simulation.stamps)
        if recording or video:
            (work / FOLDER).mkdir()
            write_recording(simulation, work / FOLDER, recording, video, picture_width)
        _write_notes(simulation, work, folder.name, command, bool(recording or video))
    return folder


def _write_sequence(simulation: RigSimulation, folder: Path, name: str) -> None:
    from acino_fte.data_tools.calibration import write_cameras
    from acino_fte.data_tools.deeplabcut import write_deeplabcut_csv
    from acino_fte.data_tools.sequence_file import write_sequence_file
    from acino_fte.data_tools.truth_parameters import FILE_NAME, write_truth_parameters

    detections = simulation.detections
    write_cameras(folder / "cameras.json", CameraArray((simulation.camera,)))
    (folder / "dlc").mkdir()
    write_deeplabcut_csv(
        folder / "dlc" / f"{CAMERA}.csv",
        simulation.skeleton.marker_names,
        detections.position[:, 0],
        detections.likelihood[:, 0],
        scorer="acino_fte_simulation",
    )
    content: dict[str, Any] = {
        "format": "acino-fte/sequence/1",
        "name": name,
        "species": _species(simulation, folder),
        "fps": float(simulation.options.fps),
        "cameras": "cameras.json",
        "keypoints": {CAMERA: f"dlc/{CAMERA}.csv"},
        "truth": "truth.csv",
    }
    if simulation.lidar is not None:
        content["lidar"] = _write_lidar(simulation, simulation.lidar, folder)
    options = simulation.options
    if options.proportions or options.offsets_mm or options.swaps:
        write_truth_parameters(folder / FILE_NAME, simulation.truth_parameters)
        content["truth_parameters"] = FILE_NAME
    write_sequence_file(folder / "sequence.yaml", content)


def _species(simulation: RigSimulation, folder: Path) -> str:
    """The species as the sequence file names it; a user's own file is copied into the folder."""
    skeleton = simulation.skeleton
    if skeleton.path is None or is_bundled(skeleton):
        return skeleton.name
    (folder / "species.yaml").write_bytes(skeleton.path.read_bytes())
    return "species.yaml"


def _write_lidar(simulation: RigSimulation, lidar: Lidar, folder: Path) -> dict[str, Any]:
    """Write returns and calibration; the lidar of the sequence file."""
    from dataclasses import replace

    from acino_fte.data_tools.lidar_camera import LidarCamera, write_lidar_camera

    np.savez_compressed(folder / "lidar.npz", time=lidar.time, xyz=lidar.xyz, intensity=lidar.intensity)
    camera = replace(simulation.camera, rotation=lidar.rotation, translation=lidar.translation)
    write_lidar_camera(folder / "lidar_camera.json", LidarCamera(camera, note="simulated"))
    return {
        "camera": CAMERA,
        "returns": "lidar.npz",
        "calibration": "lidar_camera.json",
        "range_sd": float(lidar.range_sd),
        "range_sd_per_m": float(lidar.range_sd_per_m),
        "beam_deg": [round(float(width), 6) for width in np.degrees(lidar.beam)],
        "time_sd_ms": 1e3 * float(lidar.time_sd),
    }


def _write_truth(simulation: RigSimulation, folder: Path) -> None:
    import pandas as pd

    from acino_fte.data_tools.truth import write_truth

    write_truth(folder / "truth.csv", simulation.skeleton.marker_names, simulation.positions)
    states = pd.DataFrame(simulation.q, columns=simulation.skeleton.dof_names)
    states.insert(0, "frame", np.arange(len(states)))
    states.to_csv(folder / "truth_states.csv", index=False, lineterminator="\n", float_format="%.6f")
    returns, options = simulation.returns, simulation.options
    if returns is not None:
        np.savez_compressed(
            folder / "truth_lidar.npz",
            on_body=returns.on_body,
            link=returns.link,
            marker=returns.marker,
            misled=returns.misled,
            time=returns.time,
            distance=returns.distance,
        )
    camera = simulation.true_camera
    rig = {
        "lidar_to_camera": {
            "rotation": simulation.lidar_to_camera[0].tolist(),
            "translation": simulation.lidar_to_camera[1].tolist(),
        },
        "links": [[simulation.skeleton.marker_names[m] for m in edge] for edge in simulation.skeleton.edges],
        "imu_bias": simulation.imu_bias,
        "clocks": {
            "camera": {"start_s": CAMERA_START, "drift_ppm": options.camera_drift_ppm},
            "lidar": {"start_s": LIDAR_START + options.rest_s, "drift_ppm": options.lidar_drift_ppm},
            "computer": {"frame_0_ns": UNIX_START},
        },
        "camera": {
            "matrix": camera.matrix.tolist(),
            "rotation": camera.rotation.tolist(),
            "translation": camera.translation.tolist(),
        },
    }
    (folder / "truth_rig.json").write_text(json.dumps(rig, indent=1) + "\n", encoding="utf-8")


def _write_imu(path: Path, imu: ImuSamples) -> None:
    import pandas as pd

    table = pd.DataFrame({"time (s)": [f"{t * 1e-9:.9f}" for t in imu.time_ns.tolist()]})
    for i, axis in enumerate("xyz"):
        table[f"gyr_{axis} (rad/s)"] = imu.rate[:, i]
    for i, axis in enumerate("xyz"):
        table[f"acc_{axis} (m/s2)"] = imu.force[:, i]
    table.to_csv(path, index=False, lineterminator="\n", float_format="%.9g")


def _write_frames(path: Path, stamps: FrameStamps) -> None:
    import pandas as pd

    columns = {
        "frame": np.arange(len(stamps.time)),
        "time_s": stamps.time,
        "camera_ns": stamps.camera_ns,
        "received_ns": stamps.received_ns,
        "number": stamps.number,
        "dropped": stamps.dropped.astype(int),
    }
    pd.DataFrame(columns).to_csv(path, index=False, lineterminator="\n", float_format="%.9f")


def _write_notes(simulation: RigSimulation, folder: Path, name: str, command: str, recorded: bool) -> None:
    from acino_fte import __version__

    options = asdict(simulation.options) | {"species": simulation.skeleton.name}
    text = _README.format(name=name, command=command, **options)
    text += _README_LIDAR if simulation.lidar is not None else ""
    text += _README_RECORDING if recorded else ""
    (folder / "README.md").write_text(text, encoding="utf-8")
    content = {"format": FORMAT, "version": __version__, "command": command, "options": options}
    (folder / PROVENANCE).write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
