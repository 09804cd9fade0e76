"""From a folder to a :class:`~acino_fte.sequence.Sequence`: the one door for recordings."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from acino_fte.cameras import CameraArray
from acino_fte.data_tools import checks
from acino_fte.data_tools.acinoset import is_acinoset, understand_acinoset
from acino_fte.data_tools.calibration import read_cameras
from acino_fte.data_tools.deeplabcut import read_deeplabcut
from acino_fte.data_tools.keypoints import Keypoints
from acino_fte.data_tools.matching import match_markers, match_warnings
from acino_fte.data_tools.pairing import check_pairing
from acino_fte.data_tools.sequence_file import FILE_NAME, SequenceFile, read_sequence_file
from acino_fte.data_tools.truth import read_truth
from acino_fte.data_tools.truth_parameters import read_truth_parameters
from acino_fte.errors import InputError, did_you_mean
from acino_fte.models import species_names
from acino_fte.sequence import Sequence
from acino_fte.skeleton import Skeleton, load_skeleton, species_file_path

if TYPE_CHECKING:
    import xarray as xr


def load_sequence(
    path: Path | str,
    *,
    species: str | Path | None = None,
    fps: float | None = None,
    frames: tuple[int | None, int | None] | None = None,
    likelihood: float = 0.5,
) -> Sequence:
    """Read a recording.

    Parameters
    ----------
    path : Path
        A folder with a ``sequence.yaml``, such a file, or a folder of AcinoSet.
    species : str or Path, optional
        Name or file of the species; overrides the sequence file.
    fps : float, optional
        Frames per second; overrides the sequence file. It is never guessed.
    frames : (start, stop), optional
        Half-open, counted from 0 at the start of the recording; None for an open end. Overrides the
        sequence file.
    likelihood : float
        Which detections the checks (resolution, pairing) trust. It removes nothing from the result.

    Returns
    -------
    Sequence
        Detections of the species' markers, in the species' order. Cameras whose keypoints end up to 5 %
        early are filled up with NaN, with a warning.

    Raises
    ------
    InputError
        Anything that keeps the recording from being used; the message names file, key and remedy.
    """
    file, source = understand(Path(path))
    file = _override(file, source, species, fps)
    skeleton = load_skeleton(str(file.species))
    cameras = _cameras(file, source)
    keypoints = {name: read_deeplabcut(table) for name, table in file.keypoints.items()}
    detections, warnings = _detections(keypoints, skeleton)
    n_frames = detections.sizes["frame"]
    checks.check_poses(cameras, n_frames, file.cameras)
    paths = list(file.keypoints.values())
    warnings += checks.check_detections(detections, cameras, paths, likelihood)
    warnings += checks.same_pose_warnings(cameras)
    warnings += check_pairing(detections, cameras, likelihood)
    truth = read_truth(file.truth, skeleton, n_frames) if file.truth else None
    parameters = {}
    if file.truth_parameters:
        parameters = read_truth_parameters(file.truth_parameters, skeleton, cameras.names, n_frames)
    lidar = None
    if file.lidar is not None:
        from acino_fte.data_tools.sequence_lidar import read_lidar

        lidar, said = read_lidar(file.lidar, cameras, source)
        warnings += said
    folder = source.parent if source.is_file() else source
    name = file.name or folder.resolve().name
    sequence = Sequence(
        name=name,
        species=str(file.species),
        fps=float(file.fps or 0.0),
        detections=detections,
        cameras=cameras,
        truth=truth,
        ground=file.ground.plane if file.ground else None,
        truth_parameters=parameters,
        lidar=lidar,
        provenance={**file.to_dict(), "name": name},
        warnings=tuple(warnings),
    )
    chosen = frames if frames is not None else file.frames
    if chosen is None:
        return sequence
    return _cut(sequence, chosen, source)


def understand(path: Path) -> tuple[SequenceFile, Path]:
    """The sequence file that a path means, with absolute paths, and where it was found.

    Raises
    ------
    InputError
        The path does not exist or is no recording.
    """
    path = path.expanduser()
    if not path.exists():
        raise InputError("The recording does not exist.", file=path, remedy="check the path")
    if path.is_file():
        if path.suffix.lower() not in (".yaml", ".yml"):
            raise InputError(
                "A recording is a folder or a sequence file.",
                file=path,
                expected=f"a folder, or a {FILE_NAME}",
                found=path.name,
                remedy=f"give the folder, or write a {FILE_NAME} that names this file",
            )
        return read_sequence_file(path), path
    if (path / FILE_NAME).is_file():
        return read_sequence_file(path / FILE_NAME), path / FILE_NAME
    if is_acinoset(path):
        return understand_acinoset(path), path
    entries = sorted(p.name for p in path.iterdir())
    raise InputError(
        "The folder is no recording.",
        file=path,
        expected=f"a {FILE_NAME}, or AcinoSet's layout: keypoints in dlc/cam1….h5 (or .csv), … and a "
        "calibration in extrinsic_calib here or above",
        found=", ".join(entries[:8]) + (", …" if len(entries) > 8 else "") or "nothing",
        remedy=f"check the path, or write a {FILE_NAME}",
    )


def _override(
    file: SequenceFile, source: Path, species: str | Path | None, fps: float | None
) -> SequenceFile:
    """The sequence file with the arguments in place of its values; species and frame rate are then known."""
    update: dict[str, object] = {}
    if species is not None:
        bundled = str(species) in species_names()
        update["species"] = str(species) if bundled else str(species_file_path(species).resolve())
    if fps is not None:
        if not (np.isfinite(fps) and fps > 0):
            raise InputError(
                "The frame rate is impossible.",
                key="fps",
                expected="frames per second, more than 0",
                found=f"{fps:g}",
                remedy="give the frame rate that the cameras recorded at, as --fps 120",
            )
        update["fps"] = float(fps)
    file = file.model_copy(update=update)
    if file.species is None:
        raise InputError(
            "The species is not known.",
            file=source,
            key="species",
            expected="a species in sequence.yaml or as an argument",
            found="neither",
            remedy="give --species cheetah; 'acino-fte skeleton list' shows the species",
        )
    if file.fps is None:
        raise InputError(
            "The frame rate is not known, and it is never guessed.",
            file=source,
            key="fps",
            expected="fps in sequence.yaml or as an argument",
            found="neither",
            remedy="give --fps; AcinoSet recorded at 90 (2017) and 120 (2019)",
        )
    return file


def _cameras(file: SequenceFile, source: Path) -> CameraArray:
    """The cameras that have keypoints, in the order of the sequence file."""
    cameras = read_cameras(file.cameras, unit=file.camera_unit)
    for name in file.keypoints:
        if name not in cameras.names:
            raise InputError(
                f"The camera file has no camera '{name}'{did_you_mean(name, cameras.names)}",
                file=source,
                key=f"keypoints.{name}",
                expected=f"one of {', '.join(cameras.names)} (from {file.cameras})",
                found=name,
                remedy="use the names of the camera file under 'keypoints'",
            )
    return CameraArray(tuple(cameras[name] for name in file.keypoints))


def _detections(keypoints: dict[str, Keypoints], skeleton: Skeleton) -> tuple[xr.Dataset, list[str]]:
    """Detections of the markers that at least one file has, in the order of the species."""
    import xarray as xr

    matches = {c: match_markers(k.names, skeleton, k.path) for c, k in keypoints.items()}
    warnings = match_warnings({c: k.names for c, k in keypoints.items()}, matches, skeleton)
    found = {marker for match in matches.values() for marker in match.values()}
    markers = [m for m in skeleton.marker_names if m in found]
    warnings += checks.check_lengths(keypoints)
    n_frames = max(k.n_frames for k in keypoints.values())
    depth = max(k.depth for k in keypoints.values())
    position = np.full((n_frames, len(keypoints), len(markers), depth, 2), np.nan)
    likelihood = np.zeros(position.shape[:4])
    for c, (camera, table) in enumerate(keypoints.items()):
        columns = [table.names.index(name) for name in matches[camera]]
        places = [markers.index(marker) for marker in matches[camera].values()]
        points, chances = table.candidates
        position[: table.n_frames, c, places, : table.depth] = points[:, columns]
        likelihood[: table.n_frames, c, places, : table.depth] = chances[:, columns]
    dims = ("frame", "camera", "marker")
    units = {"units": "px"}
    variables: dict[str, Any] = {
        "position": ((*dims, "space"), position[:, :, :, 0].copy(), units),
        "likelihood": (dims, likelihood[:, :, :, 0].copy()),
    }
    if depth > 1:
        variables["candidate_position"] = ((*dims, "candidate", "space"), position, units)
        variables["candidate_likelihood"] = ((*dims, "candidate"), likelihood)
    return xr.Dataset(
        variables,
        coords={
            "frame": np.arange(n_frames),
            "camera": list(keypoints),
            "marker": markers,
            "space": ["u", "v"],
        },
    ), warnings


def _cut(sequence: Sequence, frames: tuple[int | None, int | None], source: Path) -> Sequence:
    """The chosen frames, in which something must have been detected."""
    part = sequence.select_frames(*frames)
    if not np.isfinite(part.detections.position.values).any():
        raise InputError(
            "Nothing was detected in the chosen frames.",
            file=source,
            key="frames",
            found=f"{part.frames[0]}:{part.frames[-1] + 1}",
            remedy="choose frames in which the animal is in view",
        )
    return part
