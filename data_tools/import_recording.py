"""A recording of a rig becomes a sequence folder: keypoints, camera, lidar returns, poses, pictures.

The clock of the sequence is that of its frames: frame n is at n / fps. Dropped frames stay as gaps, so that
time goes on evenly.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from acino_fte.cameras import CameraArray
from acino_fte.data_tools.import_inputs import gather_inputs
from acino_fte.data_tools.import_lidar import write_returns
from acino_fte.data_tools.import_motion import Encoders, Poses, encoder_camera, posed_camera
from acino_fte.data_tools.import_notes import doubts, made_by, next_steps, recording_notes, sequence_notes
from acino_fte.data_tools.import_pictures import VideoPictures, write_pictures
from acino_fte.data_tools.import_pivot import PivotHint
from acino_fte.data_tools.import_scan import Scan, scan_recording
from acino_fte.data_tools.import_strike import Animal
from acino_fte.data_tools.import_sync import Inputs, Timing, per_sample, synchronise
from acino_fte.data_tools.recording import ImuSamples
from acino_fte.data_tools.sync import Synchronisation
from acino_fte.errors import InputError
from acino_fte.metrics import json_safe
from acino_fte.result_files import Contents, check_output_folder, written_whole

PROVENANCE = "import.json"
_AROUND = 2  # frames before the first and after the last of which lidar returns are kept


@dataclass(frozen=True)
class ImportOptions:
    """What an import is told besides the recording.

    Attributes
    ----------
    video, keypoints, calibration : Path, optional
        The calibration must be there to import.
    species : str, optional
    camera_topic, lidar_topic, imu_topic : str, optional
        Where a recording has several.
    frames : (start or None, stop or None)
        Of the video, half-open.
    pivot : PivotHint, optional
    fps : float, optional
        Of the camera.
    expected : int, optional
        Frames that the camera exposed while it took the video.
    margin_px : float, optional
        Keep only lidar returns within the picture and this margin.
    motion : {"imu", "encoders", "none"}, optional
        What tells how the camera turned.
    encoders : Encoders, optional
        What the encoders count.
    range_sd : float
        Of the lidar, m.
    pictures : bool
        Whether the folder gets the pictures.
    """

    video: Path | None = None
    keypoints: Path | None = None
    calibration: Path | None = None
    species: str | None = None
    camera_topic: str | None = None
    lidar_topic: str | None = None
    imu_topic: str | None = None
    frames: tuple[int | None, int | None] = (None, None)
    pivot: PivotHint | None = None
    fps: float | None = None
    expected: int | None = None
    margin_px: float | None = None
    motion: str | None = None
    encoders: Encoders | None = None
    range_sd: float = 0.02
    pictures: bool = True


@dataclass(frozen=True, eq=False)
class Import:
    """What an import found, and where it is.

    Attributes
    ----------
    folder : Path
    provenance : dict
        The content of ``import.json``.
    warnings : tuple of str
    """

    folder: Path
    provenance: dict[str, Any]
    warnings: tuple[str, ...]


def import_contents(name: str = "cam1") -> Contents:
    """What the folder of an import may hold."""
    videos = tuple(f"{name}{suffix}" for suffix in (".mp4", ".mkv", ".avi", ".mov", ".m4v", ".webm"))
    files = (
        "sequence.yaml",
        "species.yaml",
        "cameras.json",
        "dlc",
        "lidar.npz",
        "lidar_camera.json",
        "imu.csv",
        *videos,
    )
    return Contents("import", (*files, PROVENANCE), (PROVENANCE, "sequence.yaml"))


def import_recording(
    recording: Path | str,
    out: Path | str,
    options: ImportOptions,
    *,
    overwrite: bool = False,
    command: str = "",
    tell: Callable[[str], None] = lambda _: None,
) -> Import:
    """Make a sequence folder of a recording; it appears whole or not at all.

    Parameters
    ----------
    recording : Path
        LVX, or a bag of ROS 1 or ROS 2.
    out : Path
        The folder to make.
    options : ImportOptions
        What else there is.
    overwrite : bool
        Replace an earlier import there. Nothing else is ever replaced.
    command : str
        For ``import.json``.
    tell : callable
        Is told what is being done.

    Raises
    ------
    InputError
        A file is missing or does not belong to the others, the recording has no lidar, nothing tells when the
        frames were taken, or there is something at `out` already.
    """
    from acino_fte.data_tools.lidar_camera import read_lidar_camera

    recording = Path(recording)
    if options.calibration is None:
        raise InputError(
            "Without a calibration of camera and lidar the returns cannot be placed in the pictures.",
            key="--calibration",
            expected="lidar_camera.json",
            found="none",
            remedy="make one with scripts/calibrate_lidar.py; --inspect shows what a recording holds without",
        )
    calibration = read_lidar_camera(options.calibration)
    contents = import_contents(calibration.name)
    folder = _target(Path(out), recording, contents, overwrite)
    species = _species_file(options.species)
    keypoints = _keypoints(options.keypoints)
    with ExitStack() as stack:
        if options.video is not None:
            video = VideoPictures(options.video)
            stack.callback(video.close)
        else:
            video = None
        tell("reading")
        scan = scan_recording(recording, tell)
        inputs = gather_inputs(scan, video, keypoints, options)
        animal = Animal(recording, inputs.lidar.name, calibration.camera, keypoints)
        inputs = replace(inputs, imu_to_camera=calibration.camera.rotation, animal=animal)
        tell("synchronising")
        timing = synchronise(inputs)
        work = _Work(scan, inputs, timing, options, calibration, keypoints, species, tell)
        with written_whole(folder, contents) as working:
            provenance, warnings = work.write(working, folder.name, command)
    return Import(folder, provenance, warnings)


def _target(out: Path, recording: Path, contents: Contents, overwrite: bool) -> Path:
    """The checked output folder."""
    folder = check_output_folder(
        out, input_folder=recording if recording.is_dir() else None, contents=contents
    )
    if folder.is_dir() and any(folder.iterdir()) and not overwrite:
        raise InputError(
            "There is an import already.",
            file=folder,
            remedy="choose another folder, or replace it with --overwrite",
        )
    return folder


def _keypoints(path: Path | None) -> Any:
    if path is None:
        return None
    from acino_fte.data_tools.deeplabcut import read_deeplabcut

    return read_deeplabcut(path)


@dataclass(frozen=True, eq=False)
class _Work:
    """One import under way."""

    scan: Scan
    inputs: Inputs
    timing: Timing
    options: ImportOptions
    calibration: Any
    keypoints: Any
    species: Path | None
    tell: Callable[[str], None]

    def write(self, folder: Path, name: str, command: str) -> tuple[dict[str, Any], tuple[str, ...]]:
        """Fill the folder; what goes into ``import.json``, and warnings."""
        from acino_fte.data_tools.calibration import write_cameras
        from acino_fte.data_tools.lidar_camera import write_lidar_camera

        start, stop = self.inputs.frames
        sync = self.timing.sync.select(start, stop)
        camera_name = self.calibration.name
        warnings = list(doubts(sync, self.inputs, self.calibration.camera.resolution))
        imu = self._imu(sync)
        poses = self._poses(sync, imu)
        write_cameras(folder / "cameras.json", CameraArray((poses.camera,)))
        write_lidar_camera(folder / "lidar_camera.json", self.calibration)
        counts = self._lidar(folder, sync)
        if not counts["kept"]:
            warnings.append("no lidar return lies within the frames; check the synchronisation")
        if imu is not None:
            _write_imu(folder / "imu.csv", imu)
        (folder / "dlc").mkdir()
        if self.keypoints is not None:
            self._keypoints(folder / "dlc" / f"{camera_name}.csv", sync)
        video = self._pictures(folder, sync, camera_name)
        self._sequence(folder, name, sync, camera_name)
        warnings += next_steps(self.keypoints is not None, camera_name, video)
        files = {key: getattr(self.options, key) for key in ("video", "keypoints", "calibration")}
        provenance = {
            **made_by(command, {"recording": self.scan.path, **files}),
            **recording_notes(self.scan, self.timing),
            **sequence_notes(self.inputs.frames, sync),
            "motion": {"route": poses.route, "notes": list(poses.notes)},
            "lidar": counts,
            "video_file": video,
            "warnings": warnings,
        }
        text = json.dumps(json_safe(provenance), indent=1, ensure_ascii=False, allow_nan=False)
        (folder / PROVENANCE).write_text(text + "\n", encoding="utf-8")
        return provenance, tuple(warnings)

    def _imu(self, sync: Synchronisation) -> ImuSamples | None:
        """Inertial samples in the clock of the sequence, ns since frame 0, in order."""
        imu = self.inputs.imu
        if imu is None:
            return None
        samples = imu.samples()
        seconds = self.timing.seconds(self.timing.imu, samples.time_ns, per_sample(imu, samples))
        time = np.rint(1e9 * sync.sequence_time(seconds)).astype(np.int64)
        order = np.argsort(time, kind="stable")
        order = order[np.append(True, np.diff(time[order]) > 0)]
        return ImuSamples(time[order], samples.rate[order], samples.force[order], samples.clock)

    def _poses(self, sync: Synchronisation, imu: ImuSamples | None) -> Poses:
        """The camera in every frame of the sequence."""
        lens, motion = self.calibration.camera, self.options.motion
        if motion == "encoders":
            start, stop = self.inputs.frames
            camera, rows = self.inputs.camera, self.timing.rows
            counts = camera.encoders if camera is not None and rows is not None else []
            mine = [counts[i] for i in rows[start:stop]] if counts and rows is not None else []
            return encoder_camera(lens, mine, sync.place, self.options.encoders)
        even = np.arange(int(sync.place[-1]) + 1) / sync.fps
        return posed_camera(lens, imu, even, motion, 1e-3 * sync.sd_ms)

    def _lidar(self, folder: Path, sync: Synchronisation) -> dict[str, int]:
        around = _AROUND / sync.fps
        first, last = sync.frame_time[0] - around, sync.frame_time[-1] + around

        def to_time(stamps: np.ndarray, received: int | None) -> tuple[np.ndarray, np.ndarray]:
            seconds = self.timing.seconds(self.timing.lidar, stamps, received)
            return sync.sequence_time(seconds), (seconds >= first) & (seconds <= last)

        self.tell("lidar")
        return write_returns(
            self.scan.path,
            self.inputs.lidar.name,
            folder / "lidar.npz",
            to_time,
            self.calibration.camera,
            self.options.margin_px,
            self.tell,
        )

    def _keypoints(self, path: Path, sync: Synchronisation) -> None:
        """Detections at the frames' places; dropped frames have none."""
        from acino_fte.data_tools.deeplabcut import write_deeplabcut_csv

        start, stop = self.inputs.frames
        n, k = int(sync.place[-1]) + 1, len(self.keypoints.names)
        position, likelihood = np.full((n, k, 2), np.nan), np.zeros((n, k))
        position[sync.place] = self.keypoints.position[start:stop]
        likelihood[sync.place] = self.keypoints.likelihood[start:stop]
        write_deeplabcut_csv(path, self.keypoints.names, position, likelihood)

    def _pictures(self, folder: Path, sync: Synchronisation, name: str) -> str | None:
        if self.inputs.pictures is None or not self.options.pictures:
            return None
        self.tell("pictures")
        start, stop = self.inputs.frames
        return write_pictures(self.inputs.pictures, start, stop, sync.place, sync.fps, folder, name)

    def _sequence(self, folder: Path, name: str, sync: Synchronisation, camera: str) -> None:
        from acino_fte.data_tools.sequence_file import write_sequence_file

        if self.species is not None:
            shutil.copyfile(self.species, folder / "species.yaml")
        content: dict[str, Any] = {
            "format": "acino-fte/sequence/1",
            "name": name,
            "species": self.options.species if self.species is None else "species.yaml",
            "fps": round(sync.fps, 6),
            "cameras": "cameras.json",
            "keypoints": {camera: f"dlc/{camera}.csv"},
            "lidar": {
                "camera": camera,
                "returns": "lidar.npz",
                "calibration": "lidar_camera.json",
                "range_sd": self.options.range_sd,
                "time_sd_ms": round(sync.sd_ms, 4),
            },
        }
        write_sequence_file(folder / "sequence.yaml", content)


def _species_file(name: str | None) -> Path | None:
    """The file of a user's own species; None for a bundled one, or without any."""
    from acino_fte.models import species_names
    from acino_fte.skeleton import species_file_path

    return None if name is None or name in species_names() else species_file_path(name)


def _write_imu(path: Path, imu: ImuSamples) -> None:
    """Columns time (s since frame 0), gyr_x, gyr_y, gyr_z (rad/s), acc_x, acc_y, acc_z (m/s²)."""
    import pandas as pd

    table = pd.DataFrame({"time (s)": [f"{t * 1e-9:.9f}" for t in imu.time_ns.tolist()]})
    for prefix, unit, values in (("gyr", "rad/s", imu.rate), ("acc", "m/s2", imu.force)):
        for i, axis in enumerate("xyz"):
            table[f"{prefix}_{axis} ({unit})"] = values[:, i]
    table.to_csv(path, index=False, lineterminator="\n", float_format="%.9g")
