"""A run read back from its folder: trajectory, residuals, and the cameras as the run saw through them.

Shapes: N frames, C cameras, M markers.
"""

from __future__ import annotations

import csv
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from acino_fte.cameras import Camera, CameraArray
from acino_fte.errors import InputError, did_you_mean

if TYPE_CHECKING:
    from acino_fte.skeleton import Skeleton

DATA, METRICS, SEQUENCE, DEPTH = "fte.nc", "metrics.json", "sequence.yaml", "depth.csv"
_NEEDED = ("position", "detection", "residual", "frame", "keypoints", "camera")
_AGREE_PX = 0.5
_AGAIN = "run the trajectory estimation to its end (acino-fte run SEQUENCE -o FOLDER)"


@dataclass(frozen=True, eq=False)
class Run:
    """What a run left behind.

    Attributes
    ----------
    folder : Path
    name : str
        Of the folder; what tables and figures call it.
    identity : str
        SHA-256 of its ``fte.nc``: adjustments belong to these numbers and to no others.
    metrics : dict
        Its ``metrics.json``.
    fps : float
    frames : (N,)
        Frame numbers, counted from the start of the recording.
    markers, camera_names : list of str
    positions : (N, M, 3)
        m, world frame; NaN where the run has none.
    detection : (N, C, M, 2)
        px, NaN where there is none.
    residual : (N, C, M, 2)
        Reprojected − detected, px.
    depth_residual : (N, M), optional
        Depth of the trajectory's surface − depth of the lidar, m; NaN where there is none. None where the
        run has no lidar, or did not write them one by one.
    """

    folder: Path
    name: str
    identity: str
    metrics: dict[str, Any]
    fps: float
    frames: np.ndarray
    markers: list[str]
    camera_names: list[str]
    positions: np.ndarray
    detection: np.ndarray
    residual: np.ndarray
    depth_residual: np.ndarray | None = None

    @property
    def converged(self) -> bool:
        """Whether its trajectory is an optimum."""
        return self.metrics.get("status") in ("converged", "acceptable")

    @property
    def sequence(self) -> str:
        """Name of the recording."""
        return str(self.metrics.get("sequence", ""))

    @property
    def has_depth(self) -> bool:
        """Whether the run has depth residuals, one by one or as numbers in its metrics."""
        return self.depth_residual is not None or bool(self.metrics.get("depth_m"))

    @cached_property
    def skeleton(self) -> Skeleton:
        """The species of the run.

        Raises
        ------
        InputError
            Its file is gone, or has no longer the markers of the run.
        """
        from acino_fte.data_tools.sequence_file import read_sequence_file
        from acino_fte.skeleton import load_skeleton

        skeleton = load_skeleton(str(read_sequence_file(self.folder / SEQUENCE).species))
        lost = [name for name in self.markers if name not in skeleton.marker_names]
        if lost:
            raise InputError(
                "The species of the run has no longer the markers of the run.",
                file=self.folder / SEQUENCE,
                key="species",
                expected=", ".join(self.markers),
                found=f"a species '{skeleton.name}' without {', '.join(lost)}",
                remedy="restore the species file, or run the estimation again",
            )
        return skeleton

    @cached_property
    def cameras(self) -> CameraArray:
        """The cameras as the run saw through them: for its frames, with its corrections of their poses.

        Raises
        ------
        InputError
            The camera file is gone, or is not the one that the run was made with.
        """
        from acino_fte.data_tools.calibration import read_cameras
        from acino_fte.data_tools.sequence_file import read_sequence_file

        file = read_sequence_file(self.folder / SEQUENCE)
        known = read_cameras(file.cameras, unit=file.camera_unit)
        found: list[Camera] = []
        for name in self.camera_names:
            if name not in known.names:
                raise _changed_cameras(file.cameras, f"a camera '{name}'", ", ".join(known.names))
            found.append(_corrected(known[name].at_frames(self.frames), self._extrinsics.get(name)))
        cameras = CameraArray(tuple(found))
        self._check_cameras(cameras, file.cameras)
        return cameras

    @property
    def _extrinsics(self) -> Mapping[str, Any]:
        return (self.metrics.get("parameters") or {}).get("extrinsics") or {}

    @property
    def offsets(self) -> dict[str, float]:
        """How late every camera is, s."""
        found = (self.metrics.get("parameters") or {}).get("time_offset_s") or {}
        return {name: float(found.get(name) or 0.0) for name in self.camera_names}

    def reprojected(self, positions: np.ndarray | None = None) -> np.ndarray:
        """Pixels (N, C, M, 2) of the run's positions, or of others (N, M, 3); late cameras see them late."""
        return self._predict(self.cameras, self.positions if positions is None else positions)

    def _predict(self, cameras: CameraArray, positions: np.ndarray) -> np.ndarray:
        from acino_fte.prediction import predict

        return predict(cameras, positions, self.offsets, 1.0 / self.fps)

    def _check_cameras(self, cameras: CameraArray, path: str) -> None:
        """Through the right cameras the detections have the residuals that the run wrote."""
        again = self._predict(cameras, self.positions) - self.detection - self.residual
        known = np.isfinite(again).all(-1)
        if not known.any():
            return
        worst = float(np.abs(again[known]).max())
        if worst > _AGREE_PX:
            expected = f"reprojections as the run has them, to {_AGREE_PX:g} px"
            raise _changed_cameras(path, expected, f"up to {worst:.1f} px apart")


def _corrected(camera: Camera, correction: Mapping[str, Any] | None) -> Camera:
    """The camera after x' = Exp(ω) x + τ, where the run estimated one."""
    if not correction:
        return camera
    from acino_fte.data_tools.rotations import rotation_matrix

    turn = np.array(correction.get("rotation_rad") or (0.0, 0.0, 0.0), dtype=float)
    shift = np.array(correction.get("translation_m") or (0.0, 0.0, 0.0), dtype=float)
    return camera.displaced(rotation_matrix(turn), shift)


def _changed_cameras(path: str, expected: str, found: str) -> InputError:
    return InputError(
        "The camera file is not the one that the run was made with.",
        file=path,
        expected=expected,
        found=found,
        remedy="restore the camera file, or run the estimation again",
    )


def open_run(folder: Path | str) -> Run:
    """Read the folder of a run.

    Raises
    ------
    InputError
        There is no such folder, it holds no finished run, or a file of it cannot be read.
    """
    folder = Path(folder).expanduser()
    _check_folder(folder)
    metrics = _metrics(folder / METRICS)
    identity = sha256((folder / DATA).read_bytes()).hexdigest()
    data = _Data.read(folder / DATA)
    pixels = ("time", "camera", "keypoints", "pixel")
    run = Run(
        folder=folder,
        name=folder.resolve().name,
        identity=identity,
        metrics=metrics,
        fps=data.fps,
        frames=data.ordered("frame", ("time",)).astype(int),
        markers=data.names("keypoints"),
        camera_names=data.names("camera"),
        positions=data.ordered("position", ("individuals", "time", "keypoints", "space"))[0],
        detection=data.ordered("detection", pixels),
        residual=data.ordered("residual", pixels),
    )
    return replace(run, depth_residual=_depth(run)) if (folder / DEPTH).is_file() else run


def _depth(run: Run) -> np.ndarray:
    """(N, M) predicted − measured depth of ``depth.csv``, m; NaN where there is none."""
    residual = np.full(run.positions.shape[:2], np.nan)
    path = run.folder / DEPTH
    try:
        with path.open(encoding="utf-8", newline="") as file:
            for row in csv.DictReader(file):
                n, m = int(row["frame"]) - int(run.frames[0]), run.markers.index(row["marker"])
                if not 0 <= n < len(run.frames):
                    raise ValueError(f"frame {row['frame']}, which is not in the run")
                residual[n, m] = float(row["predicted"]) - float(row["measured"])
    except (KeyError, ValueError, TypeError, OSError, csv.Error) as error:
        raise InputError(
            "The depths of the run cannot be read.",
            file=path,
            expected="columns frame, marker, measured, predicted of the run's frames and markers",
            found=str(error) or type(error).__name__,
            remedy=_AGAIN,
        ) from None
    return residual


def _check_folder(folder: Path) -> None:
    """A folder that holds a finished run."""
    if not folder.exists():
        parent = folder.parent
        near = did_you_mean(folder.name, (p.name for p in parent.iterdir())) if parent.is_dir() else ""
        raise InputError(f"The run does not exist{near}", file=folder, remedy="check the path")
    if not folder.is_dir():
        raise InputError(
            "A run is a folder, not a file.",
            file=folder,
            expected=f"a folder with {DATA} and {METRICS}",
            found=folder.name,
            remedy="give the folder that the run was written to",
        )
    missing = [name for name in (DATA, METRICS, SEQUENCE) if not (folder / name).is_file()]
    if not missing:
        return
    entries = sorted(p.name for p in folder.iterdir())
    unfinished = ".tmp-" in folder.name or not {DATA, METRICS} <= set(missing)
    raise InputError(
        "The folder holds an unfinished run." if unfinished else "The folder holds no run.",
        file=folder,
        expected=f"{DATA}, {METRICS} and {SEQUENCE}",
        found=(", ".join(entries[:6]) + (", …" if len(entries) > 6 else "")) or "an empty folder",
        remedy=_AGAIN,
    )


def _metrics(path: Path) -> dict[str, Any]:
    try:
        metrics = json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, OSError) as error:
        raise InputError(
            "The metrics of the run cannot be read.", file=path, found=str(error), remedy=_AGAIN
        ) from None
    if not isinstance(metrics, dict) or "status" not in metrics:
        raise InputError(
            "This is not the metrics.json of a run.",
            file=path,
            expected="an object with 'status'",
            found=", ".join(list(metrics)[:6]) if isinstance(metrics, dict) else type(metrics).__name__,
            remedy=_AGAIN,
        )
    return metrics


@dataclass(frozen=True, eq=False)
class _Data:
    """Variables of a netCDF file, with their dimensions; read without xarray, whose import takes a second."""

    path: Path
    variables: dict[str, tuple[tuple[str, ...], np.ndarray]]
    fps: float

    @classmethod
    def read(cls, path: Path) -> _Data:
        import h5netcdf

        try:
            with h5netcdf.File(path, "r", decode_vlen_strings=True) as file:
                variables = {name: (tuple(v.dimensions), v[...]) for name, v in file.variables.items()}
                fps = float(file.attrs.get("fps", np.nan))
        except (OSError, ValueError, KeyError, RuntimeError, TypeError) as error:
            raise InputError(
                "The trajectory of the run cannot be read.",
                file=path,
                expected="netCDF as a run writes it",
                found=str(error).splitlines()[0][:120] if str(error) else type(error).__name__,
                remedy=_AGAIN,
            ) from None
        lacking = [name for name in _NEEDED if name not in variables]
        if lacking or not fps > 0:
            raise InputError(
                "The file is no trajectory of this program.",
                file=path,
                expected=f"the variables {', '.join(_NEEDED)} and the attribute fps",
                found=f"none called {', '.join(lacking)}" if lacking else "no attribute fps",
                remedy=_AGAIN,
            )
        return cls(path, variables, fps)

    def names(self, name: str) -> list[str]:
        """Labels of a dimension."""
        return [v.decode() if isinstance(v, bytes) else str(v) for v in self.variables[name][1]]

    def ordered(self, name: str, dims: tuple[str, ...]) -> np.ndarray:
        """Values with their dimensions in an order."""
        have, values = self.variables[name]
        if set(have) != set(dims):
            raise InputError(
                "The trajectory of the run has another form than this version reads.",
                file=self.path,
                key=name,
                expected=f"dimensions {', '.join(dims)}",
                found=", ".join(have),
                remedy=_AGAIN,
            )
        return np.asarray(values, dtype=float).transpose([have.index(dim) for dim in dims])


def open_runs(folders: Sequence[Path]) -> list[Run]:
    """Read several runs; where two folders have one name, their parents' names tell them apart.

    Raises
    ------
    InputError
        One of them is no run, or is given twice.
    """
    seen: set[Path] = set()
    for folder in folders:
        whole = folder.expanduser().resolve()
        if whole in seen:
            raise InputError("A run is given twice.", file=folder, remedy="give every run once")
        seen.add(whole)
    runs = [open_run(folder) for folder in folders]
    names = [run.name for run in runs]
    deep = [f"{run.folder.resolve().parent.name}/{run.name}" for run in runs]
    runs = [
        replace(run, name=long) if names.count(run.name) > 1 else run
        for run, long in zip(runs, deep, strict=True)
    ]
    if len({run.name for run in runs}) < len(runs):
        runs = [replace(run, name=str(run.folder)) for run in runs]
    return runs
