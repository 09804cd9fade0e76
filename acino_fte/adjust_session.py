"""Adjusting a run, without a page: what a view shows, what a drag does, which frame is next, autosave.

The page asks and is told numbers: pixels of every marker in every view, positions, what changed. All of it
can be used and tested without a browser. Shapes: N frames, C cameras, M markers.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from hashlib import sha256
from pathlib import Path
from typing import Any, Literal

import numpy as np

from acino_fte.adjust_files import as_text, positions_csv, read_adjustments
from acino_fte.adjust_geometry import (
    Sight,
    at_distance,
    moved_along_ray,
    moved_in_image,
    still,
    triangulated,
)
from acino_fte.adjustments import Adjustments
from acino_fte.cameras import Camera
from acino_fte.data_tools.whole_text import write_text_whole
from acino_fte.errors import InputError
from acino_fte.evaluation_runs import Run
from acino_fte.prediction import positions_at

LARGE_PX = 20.0
"""A residual is large from here on, and from the 90th percentile of the frames' largest ones on."""
Mode = Literal["image", "depth", "place"]


@dataclass
class AdjustSession:
    """One run being adjusted, and the file that every change goes to.

    Attributes
    ----------
    document : Adjustments
    path : Path
        Of the file of adjustments.
    large_px : float
        Frames with a residual beyond it are worth a look, px.
    error : InputError, optional
        Why the last change could not be saved.
    """

    document: Adjustments
    path: Path
    large_px: float = 0.0
    error: InputError | None = None
    _shift: dict[str, np.ndarray] = field(default_factory=dict)
    _written: str | None = None

    def __post_init__(self) -> None:
        run = self.run
        for camera in run.cameras:
            late = run.offsets.get(camera.name, 0.0)
            shift = positions_at(run.positions, late, 1.0 / run.fps) - run.positions
            self._shift[camera.name] = np.where(np.isfinite(shift), shift, 0.0)
        if self.path.exists():
            self._written = _digest(self.path)
        if not self.large_px:
            self.large_px = self._usual_large()

    @property
    def run(self) -> Run:
        """The run."""
        return self.document.run

    @property
    def problem(self) -> str:
        """Why the last change could not be saved; empty when it could."""
        return "" if self.error is None else str(self.error)

    # --- what is shown -----------------------------------------------------------------------------

    def about(self) -> dict[str, Any]:
        """What stays the same: names, sizes, edges, frames."""
        run, skeleton = self.run, self.run.skeleton
        place = {name: m for m, name in enumerate(run.markers)}
        names = skeleton.marker_names
        sides = [_side(name, skeleton.twins) for name in run.markers]
        edges = [(names[a], names[b]) for a, b in skeleton.edges]
        return {
            "run": run.name,
            "markers": run.markers,
            "sides": sides,
            "edges": [
                [place[a], place[b], sides[place[b]] if sides[place[a]] == "middle" else sides[place[a]]]
                for a, b in edges
                if a in place and b in place
            ],
            "views": [{"name": c.name, "size": list(c.resolution)} for c in run.cameras],
            "frames": [int(run.frames[0]), int(run.frames[-1])],
            "fps": run.fps,
            "large": LARGE_PX,
            "cameras": [_listed(still(c, 0).centre) for c in run.cameras],
        }

    def frame(self, frame: int) -> dict[str, Any]:
        """What is to be seen in a frame; px and m, None where there is nothing."""
        run, row = self.run, self._row(frame)
        entries = {m: self.document.entries.get((frame, name)) for m, name in enumerate(run.markers)}
        before = run.positions[row]
        after = before.copy()
        for m, entry in entries.items():
            if entry is not None:
                after[m] = entry.after
        return {
            "frame": frame,
            "now": [_pixels(self._project(camera, row, after)) for camera in run.cameras],
            "before": [_pixels(self._project(camera, row, before)) for camera in run.cameras],
            "detected": [_pixels(run.detection[row, c]) for c in range(len(run.cameras))],
            "xyz": [_listed(p) for p in after],
            "xyz_before": [_listed(p) for p in before],
            "centres": [_listed(still(camera, row).centre) for camera in run.cameras],
            "moved": [
                None if e is None else (e.length if e.before is not None else -1.0) for e in entries.values()
            ],
            "pins": [{} if e is None else e.pins for e in entries.values()],
            "residual": _numbers(self._residuals(row, after)),
            "checked": frame in self.document.checked,
            **self.state(),
        }

    def state(self) -> dict[str, Any]:
        """What a change may have changed beside a frame."""
        document = self.document
        return {
            "undo": document.can_undo,
            "redo": document.can_redo,
            "n_adjusted": len(document.entries),
            "n_checked": len(document.checked),
            "problem": self.problem,
        }

    def _project(self, camera: Camera, row: int, points: np.ndarray) -> np.ndarray:
        return still(camera, row).project(points + self._shift[camera.name][row])

    def _residuals(self, row: int, points: np.ndarray) -> np.ndarray:
        """(M,) largest distance over the views from the detection, px; NaN without one."""
        shown = np.stack([self._project(camera, row, points) for camera in self.run.cameras])
        return _largest(np.linalg.norm(shown - self.run.detection[row], axis=-1), 0)

    def _all_residuals(self) -> np.ndarray:
        """(N, M) the same for all frames."""
        run, positions = self.run, self.document.positions()
        shown = [camera.project(positions + self._shift[camera.name]) for camera in run.cameras]
        return _largest(np.linalg.norm(np.stack(shown, axis=1) - run.detection, axis=-1), 1)

    def _usual_large(self) -> float:
        worst = _largest(np.linalg.norm(self.run.residual, axis=-1), (1, 2))
        worst = worst[np.isfinite(worst)]
        return max(LARGE_PX, float(np.round(np.percentile(worst, 90)))) if worst.size else LARGE_PX

    # --- what is done ------------------------------------------------------------------------------

    def dragged(
        self, frame: int, marker: str, view: str, mode: Mode, pixel: tuple[float, float], factor: float = 1.0
    ) -> tuple[np.ndarray | None, dict[str, tuple[float, float]]]:
        """Where a marker would be, and the pixels by hand that hold from then on.

        Parameters
        ----------
        frame : int
            Counted from the start of the recording.
        marker : str
            Its name.
        view : str
            Camera in whose image it is moved.
        mode : {"image", "depth", "place"}
            To a pixel: in the plane parallel to the image, or triangulated with the pixels by hand in other
            views; along its ray; a marker without a position, at the depth of the others.
        pixel : (u, v)
            px; of no meaning to ``depth``.
        factor : float
            Of the distance from the camera (``depth``).
        """
        m, row = self.run.markers.index(marker), self._row(frame)
        entry = self.document.entries.get((frame, marker))
        pins = dict(entry.pins) if entry is not None else {}
        point = np.array(entry.after) if entry is not None else self.run.positions[row, m]
        sight = self._sight(view, row, m, pixel)
        if not np.isfinite(point).all():
            return at_distance(sight, self._usual_distance(sight.camera, row)), {view: pixel}
        if mode == "depth":
            return moved_along_ray(sight, point, factor), ({view: pins[view]} if view in pins else {})
        pins[view] = pixel
        if len(pins) == 1:
            return moved_in_image(sight, point), pins
        found = triangulated([self._sight(v, row, m, p) for v, p in pins.items()], point)
        return (found, pins) if found is not None else (moved_in_image(sight, point), {view: pixel})

    def drag(self, request: dict[str, Any], *, commit: bool) -> dict[str, Any] | None:
        """Answer to a drag: where the marker is now; with ``commit`` it stays there and is saved.

        None where it cannot be moved to.
        """
        frame, marker, view = int(request["frame"]), str(request["marker"]), str(request["view"])
        u, v = (float(x) for x in request["pixel"])
        mode, factor = request.get("mode", "image"), float(request.get("factor", 1.0))
        point, pins = self.dragged(frame, marker, view, mode, (u, v), factor)
        if point is None or not np.isfinite(point).all():
            return None
        if commit:
            together = bool(request.get("together"))
            self.document.change(frame, marker, point, view, pins, together=together)
            self.save()
        m, row = self.run.markers.index(marker), self._row(frame)
        shown = [
            still(c, row).project((point + self._shift[c.name][row, m])[None])[0] for c in self.run.cameras
        ]
        return {
            "frame": frame,
            "marker": m,
            "xyz": _listed(point),
            "now": [_listed(p, 2) for p in shown],
            "pins": pins,
        }

    def undo(self) -> int | None:
        """Take back the last change and save; its frame."""
        return self._saved(self.document.undo())

    def redo(self) -> int | None:
        """Make a change again and save; its frame."""
        return self._saved(self.document.redo())

    def reset(self, frame: int, marker: str) -> int | None:
        """Put a marker back to where the run has it and save; the frame, None when it was there."""
        return self._saved(frame if self.document.reset(frame, marker) else None)

    def check(self, frame: int) -> int:
        """Mark a frame as checked, or take the mark away, and save."""
        self.document.check(frame)
        self._saved(frame)
        return frame

    def _saved(self, frame: int | None) -> int | None:
        if frame is not None:
            self.save()
        return frame

    def next_large(self, frame: int, direction: int = 1) -> tuple[int, str] | None:
        """The next frame with a residual beyond ``large_px``, and its worst marker; None when there is none.

        Residuals are those of the adjusted positions; frames that are checked are passed over.
        """
        residual, frames = self._all_residuals(), self.run.frames
        worst = _largest(residual, 1)
        rows = range(self._row(frame) + direction, len(frames) if direction > 0 else -1, direction)
        for row in rows:
            if worst[row] > self.large_px and int(frames[row]) not in self.document.checked:
                return int(frames[row]), self.run.markers[int(np.nanargmax(residual[row]))]
        return None

    def save(self) -> None:
        """Write the file; when it cannot be written, ``error`` says why and nothing is lost here."""
        try:
            if self.path.exists() and _digest(self.path) != self._written:
                raise InputError(
                    "The file of adjustments was changed by another program; it is not overwritten.",
                    file=self.path,
                    remedy="end the other one, move the file away, and change something here",
                )
            text = as_text(self.document)
            write_text_whole(self.path, text)
            self._written = sha256(text.encode()).hexdigest()
            self.error = None
        except InputError as error:
            self.error = error

    def export(self) -> Path:
        """Write the adjusted positions as CSV beside the file of adjustments."""
        path = self.path.with_suffix(".csv")
        write_text_whole(path, positions_csv(self.document))
        return path

    # --- parts -------------------------------------------------------------------------------------

    def _row(self, frame: int) -> int:
        return int(np.clip(frame - int(self.run.frames[0]), 0, len(self.run.frames) - 1))

    def _sight(self, view: str, row: int, m: int, pixel: tuple[float, float]) -> Sight:
        camera = still(self.run.cameras[view], row)
        return Sight(camera, np.asarray(pixel, dtype=float), self._shift[view][row, m])

    def _usual_distance(self, camera: Camera, row: int) -> float:
        """Median distance of the markers of a frame (else of all frames) from a camera, m."""
        for points in (self.run.positions[row], self.run.positions.reshape(-1, 3)):
            known = points[np.isfinite(points).all(-1)]
            if len(known):
                return float(np.median(np.linalg.norm(known - camera.centre, axis=-1)))
        return 10.0


def open_session(run: Run, path: Path, large_px: float | None = None) -> AdjustSession:
    """Begin, or go on with the file of adjustments when there is one.

    Raises
    ------
    InputError
        The file belongs to another run or is damaged; the cameras of the run are gone; it cannot be written.
    """
    document = read_adjustments(path, [run]) if path.exists() else Adjustments(run)
    session = AdjustSession(document, path, large_px or 0.0)
    session.save()
    if session.error is not None:
        raise session.error
    return session


def _digest(path: Path) -> str:
    return sha256(path.read_bytes()).hexdigest()


def _side(name: str, twins: tuple[tuple[str, str], ...]) -> str:
    if any(name == left for left, _ in twins):
        return "left"
    return "right" if any(name == right for _, right in twins) else "middle"


def _largest(values: np.ndarray, axis: int | tuple[int, ...]) -> np.ndarray:
    """Maximum of the values that are numbers; NaN without any."""
    largest = np.max(np.where(np.isfinite(values), values, -np.inf), axis=axis)
    return np.where(np.isfinite(largest), largest, np.nan)


def _pixels(values: np.ndarray) -> list[list[float] | None]:
    return [_listed(p, 2) for p in values]


def _listed(values: np.ndarray, digits: int = 5) -> list[float] | None:
    return [round(float(v), digits) for v in values] if np.isfinite(values).all() else None


def _numbers(values: np.ndarray) -> list[float | None]:
    return [round(float(v), 2) if np.isfinite(v) else None for v in values]
