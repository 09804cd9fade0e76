"""A scene that moving cameras saw: a model of structure from motion, 2D tracks, and the 3D tracks they give.

    scene = Scene.from_colmap("recording", fps=30).placed(scale=["left-right=0.6"])
    result = scene.triangulate()
    result.tracks.position

Nothing is changed in place: every method gives a new scene.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from acino_fte.data_tools.camera_keys import KeyedCamera
from acino_fte.data_tools.point_cloud import PointCloud
from acino_fte.data_tools.scene_noise import NOISE_FLOOR
from acino_fte.data_tools.scene_notes import (
    after_all_moving,
    misfits,
    needed_keys,
    unseen_individuals,
    unused_dots,
)
from acino_fte.data_tools.scene_paths import RigChoice, ScenePaths, scene_paths
from acino_fte.data_tools.scene_points import retriangulate, triangulate_points
from acino_fte.data_tools.scene_reading import SceneFiles
from acino_fte.data_tools.scene_record import scene_record
from acino_fte.data_tools.scene_result import (
    SceneResult,
    single_frames,
    smooth_tracks,
    with_single_views,
)
from acino_fte.data_tools.scene_rows import scene_rows
from acino_fte.data_tools.scene_smoothing import smooth_points
from acino_fte.data_tools.similarity import Similarity
from acino_fte.data_tools.tracks import PixelOrigin
from acino_fte.data_tools.tracks2d import Tracks2D
from acino_fte.errors import InputError

if TYPE_CHECKING:
    from acino_fte.data_tools.scene_axes import AxesEstimate
    from acino_fte.data_tools.scene_scale import KnownDistance, ScaleEstimate
    from acino_fte.data_tools.time_offsets import TimeOffsets

_GAP_S, _GAP = 1.0, 30  # longest gap of a track that is filled: seconds, or frames
Tell = Callable[[str], None]


@dataclass(frozen=True, eq=False)
class Scene:
    """Cameras, their key frames, and 2D tracks, in one world.

    Attributes
    ----------
    name : str
    cameras : tuple of KeyedCamera
        In natural order of their names.
    tracks : tuple of Tracks2D
        One for each camera; their labels are the individuals.
    cloud : PointCloud
    world_from_model : Similarity
        From the structure-from-motion model to the world of this scene.
    scale : ScaleEstimate, optional
        Where the metres come from; without it lengths are in units of the model.
    axes : AxesEstimate, optional
        Where up comes from; without it the axes are those of the model.
    clocks : TimeOffsets, optional
        How the cameras' clocks were brought together; without it frames with one number are of one time.
    declared_rigs : tuple of tuple of str
        Cameras that the model declares as rigs.
    fps : float, optional
        Frames per second.
    warnings : tuple of str
        What the readers noticed.
    """

    name: str
    cameras: tuple[KeyedCamera, ...]
    tracks: tuple[Tracks2D, ...]
    cloud: PointCloud
    world_from_model: Similarity = field(default_factory=Similarity)
    scale: ScaleEstimate | None = None
    axes: AxesEstimate | None = None
    clocks: TimeOffsets | None = None
    declared_rigs: tuple[tuple[str, ...], ...] = ()
    fps: float | None = None
    warnings: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        names = [camera.name for camera in self.cameras]
        if [view.camera for view in self.tracks] != names:
            raise InputError(
                "The tracks and the cameras do not belong together.",
                expected=f"tracks of {', '.join(names)}",
                found=", ".join(view.camera for view in self.tracks) or "none",
            )

    @classmethod
    def from_colmap(
        cls,
        path: Path | str,
        tracks: Path | str = "tracks",
        *,
        model: Path | str | None = None,
        pattern: str | None = None,
        fps: float | None = None,
        pixel_origin: PixelOrigin = "centre",
        node: str | None = None,
        cm_per_pixel: float | None = None,
        dense: Path | str | None = None,
        adjust_poses: bool = False,
    ) -> Scene:
        """Read a scene from a folder with a COLMAP model and 2D tracks.

        Parameters
        ----------
        path : Path
            The folder. The model is in it or in its ``sparse``.
        tracks : Path
            Folder or file of the tracks, in `path` or anywhere.
        model : Path, optional
            The model, where it is elsewhere.
        pattern : str, optional
            How image names give camera and frame (:func:`colmap_images.parse_image_names`).
        fps : float, optional
            Frames per second.
        pixel_origin : {"centre", "corner"}
            Which point of the upper left pixel the tracks count from.
        node : str, optional
            The node of SLEAP's skeleton that stands for the individual.
        cm_per_pixel : float, optional
            TRex's setting.
        dense : Path, optional
            A PLY file with a dense cloud, in place of the model's points.
        adjust_poses : bool
            Poses that are not where the model's own observations have them (they may come from GPS, or from
            resection alone) are moved there. Adjusted models stay as they are.

        Raises
        ------
        InputError
            A file is missing, cannot be read, or does not fit the others.
        """
        read = SceneFiles(Path(path), tracks, model, dense)
        found = read.model(pattern, adjust_poses)
        files = read.tracks(found.cameras, node, cm_per_pixel, pixel_origin)
        return cls(
            name=read.folder.resolve().name,
            cameras=found.cameras,
            tracks=files.tracks,
            cloud=read.cloud(found.cloud),
            declared_rigs=found.rigs,
            fps=fps,
            warnings=(*found.notes, *files.notes),
        )

    @property
    def individuals(self) -> tuple[str, ...]:
        """Names of the individuals."""
        return tuple(dict.fromkeys(label for view in self.tracks for label in view.labels))

    def moved(self, change: Similarity) -> Scene:
        """The same scene in another world."""
        return replace(
            self,
            cameras=tuple(camera.moved(change) for camera in self.cameras),
            cloud=self.cloud.moved(change),
            world_from_model=change @ self.world_from_model,
        )

    def synchronised(
        self, *, reference: str | None = None, max_offset: int = 90, drift: bool = True
    ) -> Scene:
        """The scene on one clock: offsets and drifts of the cameras are estimated from the individuals.

        Dots and key frames of the other cameras are moved to whole frames of the reference camera, between
        consecutive frames only.

        Parameters
        ----------
        reference : str, optional
            The camera whose clock counts.
        max_offset : int
            Greatest offset that is looked for, frames.
        drift : bool
            Whether clocks may run at different rates.

        Raises
        ------
        InputError
            The reference is not there, or there is one camera only.
        """
        from acino_fte.data_tools.time_offsets import (
            estimate_time_offsets,
            keys_on_one_clock,
            tracks_on_reference_clock,
        )

        paths = self.camera_paths("none").paths
        lenses = [camera.lens for camera in self.cameras]
        clocks = estimate_time_offsets(
            paths, self.tracks, lenses, reference=reference, max_offset=max_offset, drift=drift
        )
        shifts = [
            (float(o), float(d), clocks.middle) for o, d in zip(clocks.offset, clocks.drift, strict=True)
        ]
        return replace(
            self,
            cameras=keys_on_one_clock(self.cameras, paths, shifts),
            tracks=tuple(tracks_on_reference_clock(t, *s) for t, s in zip(self.tracks, shifts, strict=True)),
            clocks=clocks,
            warnings=(*self.warnings, *clocks.notes),
        )

    def placed(self, scale: Sequence[KnownDistance | str] = (), gravity: Path | str = "cameras") -> Scene:
        """The scene in metres and upright: cameras and cloud alike.

        Parameters
        ----------
        scale : sequence of KnownDistance or str
            Known distances, ``"1-3=0.6"`` or ``"tracks:0-1=0.5"`` (:func:`scene_scale.parse_distance`).
            Without any, lengths stay in the model's units.
        gravity : str or Path
            ``"cameras"``, ``"plane"``, ``"down"``, ``"none"``, or a file of accelerations
            (:func:`scene_axes.upright`).

        Raises
        ------
        InputError
            A distance names what is not there or cannot be measured, or nothing tells what is up.
        """
        from acino_fte.data_tools.scene_axes import metric_upright, upright

        estimate = self._scale(scale) if scale else None
        axes = upright(self.cameras, gravity=gravity, cloud=self.cloud)
        change = metric_upright(axes, 1.0 if estimate is None else estimate.factor)
        notes = (*(estimate.notes if estimate else ()), *axes.notes)
        return replace(self.moved(change), scale=estimate, axes=axes, warnings=(*self.warnings, *notes))

    def _scale(self, scale: Sequence[KnownDistance | str]) -> ScaleEstimate:
        from acino_fte.data_tools.scene_scale import measure_distance, parse_distance, resolve, scene_scale

        known = [
            resolve(parse_distance(one) if isinstance(one, str) else one, self.cameras, self.individuals)
            for one in scale
        ]
        points = None
        if any(distance.kind == "individuals" for distance in known):
            points = self.triangulate(smooth=False).points
        return scene_scale([(one, measure_distance(one, self.cameras, points)) for one in known])

    def camera_paths(
        self,
        rig: RigChoice = "auto",
        max_pose_gap: float | None = None,
        not_standing: Collection[str] = (),
    ) -> ScenePaths:
        """The paths of all cameras (:func:`scene_paths.scene_paths`)."""
        cameras, frames = needed_keys(self.cameras, self.tracks)
        return scene_paths(
            cameras,
            rig=rig,
            declared=self.declared_rigs,
            max_gap=max_pose_gap,
            frames=frames,
            not_standing=not_standing,
        )

    def triangulate(
        self,
        rig: RigChoice = "auto",
        *,
        smooth: bool = True,
        max_gap: int | None = None,
        max_pose_gap: float | None = None,
        noise_px: float | None = None,
        tell: Tell | None = None,
    ) -> SceneResult:
        """3D tracks of all individuals.

        Parameters
        ----------
        rig : "auto", "none", or sequence of sequences of names
            Which cameras one body carries.
        smooth : bool
            Whether the tracks are most probable paths, or points triangulated frame by frame; what one view
            alone saw comes from the paths either way.
        max_gap : int, optional
            Frames without any dot that are filled; by default those of a second, or 30.
        max_pose_gap : float, optional
            Frames between key frames beyond which no pose is invented.
        noise_px : float, optional
            Standard deviation of a dot's coordinate; by default it is estimated.
        tell : callable, optional
            Called with the name of every step.

        Raises
        ------
        InputError
            A rig cannot be made, or the noise is impossible.
        """
        tell = tell or (lambda step: None)
        if noise_px is not None and not NOISE_FLOOR <= noise_px < np.inf:
            raise InputError(
                "The noise of the dots is impossible.",
                key="noise_px",
                expected=f"{NOISE_FLOOR:g} px or more",
                found=f"{noise_px:g}",
            )
        tell("camera paths")
        paths = self.camera_paths(rig, max_pose_gap)
        tell("triangulation")
        names = self.individuals
        rows = scene_rows(paths.views, self.tracks, names)
        fit = triangulate_points(rows, paths.views, noise_px)
        moved = after_all_moving(self.cameras, rows, fit)
        if moved:
            paths = self.camera_paths(rig, max_pose_gap, moved)
            rows = scene_rows(paths.views, self.tracks, names)
            fit = triangulate_points(rows, paths.views, noise_px)
        tracks = points = single_frames(rows, fit, self.tracks, names)
        notes = [*paths.notes, *unused_dots(rows, paths.views, self.tracks), *misfits(rows, fit)]
        if len(points):
            tell("smoothing")
            gap = max_gap if max_gap is not None else round(_GAP_S * self.fps) if self.fps else _GAP
            try:
                smoothed = smooth_points(rows, paths.views, fit, gap)
            except np.linalg.LinAlgError:
                notes.append("The paths cannot be smoothed: points are triangulated frame by frame.")
            else:
                fit = retriangulate(rows, paths.views, fit, smoothed.used)
                points = single_frames(rows, fit, self.tracks, names)
                tracks = smooth_tracks(rows, smoothed, self.tracks, names)
                if not smooth:
                    tracks = with_single_views(points, tracks)
        notes += unseen_individuals(names, tracks.individual)
        numbers = {
            **scene_record(self, paths),
            "pose_noise_share": {"own": fit.noise.own, "common": fit.noise.common},
            "warnings": notes,
        }
        return SceneResult(self, tracks, points, paths.paths, paths.rigs, fit.noise.px, numbers)
