"""What the figures of a scene show, as plain arrays, and the process that draws them.

Half of a figure's time is the import of matplotlib. So a process of its own begins with that while the scene
is read and triangulated, and draws while the tables are written. It is only there for speed: whatever goes
wrong with it, the figures are drawn here instead.
"""

from __future__ import annotations

import io
import json
import os
import subprocess
import sys
import time
from dataclasses import dataclass, fields
from pathlib import Path
from tempfile import TemporaryDirectory
from threading import Thread
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from acino_fte.data_tools.scene import SceneResult

_MOST_CLOUD = 3000  # points of the cloud in a figure
_PATIENCE = 600.0  # s
_CHILD = (
    "import json, sys; sys.path[:] = json.loads(sys.argv[1]); "
    "from acino_fte.data_tools.scene_drawing import serve; serve()"
)


@dataclass(frozen=True, eq=False)
class SceneDrawing:
    """Arrays of a scene. T points, sorted by individual, then frame; P dots; K poses; Q points of the cloud.

    Attributes
    ----------
    name, unit : str
        Of the scene; ``m`` or ``units``.
    fps, noise_px : float
        NaN where it is not known.
    individuals, cameras : (…,) str
    individual, frame, source, n_views : (T,) int
    position, sd : (T, 3)
    dot_camera : (P,) int
        Camera of each dot that counts.
    dot_error : (P,)
        Its distance from the projected point, px.
    pose_camera : (K,) int
        Camera of each known pose, sorted by camera, then frame.
    pose_frame : (K,) int
    pose_centre : (K, 3)
    cloud : (Q, 3)
        Thinned.
    """

    name: str
    unit: str
    fps: float
    noise_px: float
    individuals: np.ndarray
    cameras: np.ndarray
    individual: np.ndarray
    frame: np.ndarray
    source: np.ndarray
    n_views: np.ndarray
    position: np.ndarray
    sd: np.ndarray
    dot_camera: np.ndarray
    dot_error: np.ndarray
    pose_camera: np.ndarray
    pose_frame: np.ndarray
    pose_centre: np.ndarray
    cloud: np.ndarray

    def to_bytes(self) -> bytes:
        """As an .npz file."""
        file = io.BytesIO()
        np.savez(file, **{f.name: getattr(self, f.name) for f in fields(self)})
        return file.getvalue()

    @classmethod
    def from_bytes(cls, data: bytes) -> SceneDrawing:
        """From what :meth:`to_bytes` made."""
        with np.load(io.BytesIO(data), allow_pickle=False) as file:
            values: dict[str, Any] = {name: file[name] for name in file.files}
        return cls(**{name: v.item() if v.ndim == 0 else v for name, v in values.items()})


def scene_drawing(result: SceneResult) -> SceneDrawing:
    """What the figures need of a result."""
    scene, tracks = result.scene, result.tracks
    counted = [np.flatnonzero(u & np.isfinite(d)) for d, u in zip(tracks.distance, tracks.used, strict=True)]
    known = [np.flatnonzero(path.known) for path in result.paths]
    cloud = scene.cloud.xyz
    return SceneDrawing(
        name=scene.name,
        unit="m" if result.numbers.get("scale") else "units",
        fps=np.nan if scene.fps is None else float(scene.fps),
        noise_px=np.nan if result.noise_px is None else float(result.noise_px),
        individuals=np.array(tracks.individuals, dtype=str),
        cameras=np.array([camera.name for camera in scene.cameras], dtype=str),
        individual=tracks.individual,
        frame=tracks.frame,
        source=tracks.source,
        n_views=tracks.n_views,
        position=tracks.position,
        sd=tracks.standard_deviation,
        dot_camera=_owners(counted),
        dot_error=_joined([d[k] for d, k in zip(tracks.distance, counted, strict=True)], ()),
        pose_camera=_owners(known),
        pose_frame=_joined([path.frame[k] for path, k in zip(result.paths, known, strict=True)], ()),
        pose_centre=_joined([path.centre[k] for path, k in zip(result.paths, known, strict=True)], (3,)),
        cloud=thinned(cloud, _MOST_CLOUD),
    )


def thinned(rows: np.ndarray, most: int) -> np.ndarray:
    """No more than so many rows, evenly from all of them."""
    if len(rows) <= most:
        return rows
    return rows[np.linspace(0, len(rows) - 1, most).astype(int)]


def _owners(rows: list[np.ndarray]) -> np.ndarray:
    return np.repeat(np.arange(len(rows)), [len(some) for some in rows])


def _joined(parts: list[np.ndarray], shape: tuple[int, ...]) -> np.ndarray:
    return np.concatenate(parts) if parts else np.empty((0, *shape))


class FigureProcess:
    """A process that imports matplotlib at once and draws the figures of one scene when it is asked to.

    Used as a context: at its end the process is gone, whatever happened.
    """

    def __init__(self) -> None:
        self._process: subprocess.Popen[bytes] | None = None
        self._thread: Thread | None = None
        self._asked: tuple[SceneDrawing, Path] | None = None
        self._folder: TemporaryDirectory[str] | None = None

    def __enter__(self) -> FigureProcess:
        self._folder = TemporaryDirectory(prefix="acino_fte-figures-", ignore_cleanup_errors=True)
        try:
            self._process = subprocess.Popen(
                [sys.executable, "-c", _CHILD, json.dumps([str(p) for p in sys.path]), self._folder.name],
                stdin=subprocess.PIPE,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
            )
        except (OSError, ValueError, TypeError):  # no interpreter that can be started
            self._process = None
        return self

    def draw(self, drawing: SceneDrawing, folder: Path) -> None:
        """Ask for the figures in a folder, which is made if need be; this does not wait for them."""
        self._asked = drawing, folder
        if self._process is None:
            return
        head = json.dumps(str(folder)).encode() + b"\n"
        self._thread = Thread(target=_send, args=(self._process, head + drawing.to_bytes()), daemon=True)
        self._thread.start()

    def wait(self) -> None:
        """Until the figures are there; they are drawn here when the process did not draw them."""
        if self._asked is None:
            return
        if self._process is not None and _drawn(self._process):
            return
        from acino_fte.data_tools.scene_plots import save_scene_figures

        save_scene_figures(*self._asked)

    def __exit__(self, *error: object) -> None:
        if self._process is not None:
            self._end(self._process)
        if self._folder is not None:
            self._folder.cleanup()

    def _end(self, process: subprocess.Popen[bytes]) -> None:
        """The process ends, and is waited for."""
        if process.poll() is None:
            process.kill()
        process.wait()
        if self._thread is not None:
            self._thread.join()
        elif process.stdin is not None:
            _close(process.stdin)


def _drawn(process: subprocess.Popen[bytes]) -> bool:
    """Whether the process has done its work; it is not waited for without end."""
    end = time.monotonic() + _PATIENCE
    while process.poll() is None:  # Popen.wait would sleep for longer and longer
        if time.monotonic() > end:
            return False
        time.sleep(0.004)
    return process.returncode == 0


def _send(process: subprocess.Popen[bytes], data: bytes) -> None:
    """Give the process its work; what it does not want any more is lost."""
    assert process.stdin is not None
    try:
        process.stdin.write(data)
    except OSError:
        return
    finally:
        _close(process.stdin)


def _close(pipe: Any) -> None:
    try:
        pipe.close()
    except OSError:
        return


def serve() -> None:
    """What the process does: import, wait for a scene, draw it. Without one it leaves.

    It leaves at once when all is written: taking down what it has imported would take a fifth of its time.
    """
    from acino_fte.data_tools.scene_plots import FIGURES, prepare, save_scene_figures

    families = prepare(Path(sys.argv[2]))
    head = sys.stdin.buffer.readline()
    if not head:
        os._exit(0)
    drawing, folder = SceneDrawing.from_bytes(sys.stdin.buffer.read()), Path(json.loads(head))
    names = list(FIGURES)
    twin = os.fork() if sys.platform == "linux" else -1
    if twin == 0:  # half of the figures, on another core
        try:
            save_scene_figures(drawing, folder, families, names[1::2])
        except BaseException:  # noqa: BLE001 - a forked process must end here, whatever happened
            os._exit(1)
        os._exit(0)
    save_scene_figures(drawing, folder, families, names if twin < 0 else names[::2])
    os._exit(0 if twin < 0 else os.waitstatus_to_exitcode(os.waitpid(twin, 0)[1]))
