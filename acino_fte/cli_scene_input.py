"""From the options of ``acino-fte scene`` to a triangulated scene."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from acino_fte.errors import InputError

if TYPE_CHECKING:
    from acino_fte.data_tools.scene import SceneResult


@dataclass(frozen=True)
class SceneOptions:
    """What the user asked for, on the command line and in ``scene.yaml``."""

    tracks: str | None
    model: Path | None
    pattern: str | None
    fps: float | None
    pixel_origin: str | None
    node: str | None
    cm_per_pixel: float | None
    dense: Path | None
    rig: Any
    max_pose_gap: str | None
    time_offsets: bool | None
    adjust_poses: bool
    scale: tuple[str, ...] | None
    gravity: str | None
    smooth: bool
    max_gap: str | None
    noise_px: float | None

    def completed(self, folder: Path) -> SceneOptions:
        """With what the recording's ``scene.yaml`` says, where the command line says nothing."""
        from acino_fte.data_tools.scene_settings import read_scene_settings

        said = asdict(read_scene_settings(folder))
        usual: dict[str, Any] = {"tracks": "tracks", "rig": "auto", "gravity": "cameras", "scale": ()}
        usual |= {"pixel_origin": "centre", "time_offsets": False}
        mine = asdict(self)
        first: dict[str, Any] = {
            key: next((v for v in (mine[key], said[key], usual.get(key)) if v is not None), None)
            for key in said
        }
        return replace(self, **first)


def triangulated(folder: Path, given: SceneOptions, tell: Callable[[str], None]) -> SceneResult:
    """The scene of a folder, triangulated; `tell` is called with the name of every step."""
    from acino_fte.data_tools.scene import Scene

    gaps = {"max_gap": gap_frames("--max-gap", given.max_gap, given.fps)}
    gaps["max_pose_gap"] = gap_frames("--max-pose-gap", given.max_pose_gap, given.fps)
    found = Scene.from_colmap(
        folder,
        given.tracks or "tracks",
        model=given.model,
        pattern=given.pattern,
        fps=given.fps,
        pixel_origin="corner" if given.pixel_origin == "corner" else "centre",
        node=given.node,
        cm_per_pixel=given.cm_per_pixel,
        dense=given.dense,
        adjust_poses=given.adjust_poses,
    )
    if given.time_offsets:
        tell("clocks")
        found = found.synchronised()
    tell("scale and axes")
    found = found.placed(scale=given.scale or (), gravity=given.gravity or "cameras")
    return found.triangulate(given.rig, smooth=given.smooth, noise_px=given.noise_px, tell=tell, **gaps)


def rig_choice(text: str | None) -> Any:
    """``auto``, ``none``, or the names of the cameras of each rig; None for no word."""
    if text is None:
        return None
    if text.strip().lower() in ("auto", "none"):
        return text.strip().lower()
    rigs = tuple(
        tuple(name.strip() for name in part.split(",") if name.strip())
        for part in text.split(";")
        if part.strip()
    )
    if not rigs or any(len(rig) < 2 for rig in rigs):
        raise InputError(
            "A rig has two cameras or more.",
            key="--rig",
            expected="auto, none, or names of cameras with commas between them",
            found=repr(text),
        )
    return rigs


def gap_frames(key: str, text: str | None, fps: float | None) -> int | None:
    """A gap in frames, from frames or seconds."""
    if text is None:
        return None
    number = text.strip().lower()
    seconds = number.endswith("s")
    try:
        value = float(number.removesuffix("s"))
    except ValueError:
        value = -1.0
    if not 0 <= value < float("inf"):
        raise InputError(
            "A gap cannot be read.", key=key, expected="frames, as 40, or seconds, as 1.5s", found=text
        )
    if seconds and fps is None:
        raise InputError(
            "A gap in seconds needs the frame rate.", key=key, found=text, remedy="give --fps, or frames"
        )
    return round(value * fps) if seconds and fps is not None else round(value)


def positive(key: str, value: float | None) -> float | None:
    """An option that has to be above 0, or None."""
    if value is not None and not 0 < value < float("inf"):
        raise InputError("The option is impossible.", key=key, expected="above 0", found=f"{value:g}")
    return value
