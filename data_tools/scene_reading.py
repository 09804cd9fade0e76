"""The files of a scene: a structure-from-motion model, 2D tracks, and perhaps a dense cloud."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from acino_fte.data_tools.camera_keys import KeyedCamera
from acino_fte.data_tools.colmap import ColmapModel, read_colmap
from acino_fte.data_tools.colmap_covariance import PoseErrors, mended, pose_errors
from acino_fte.data_tools.colmap_images import keyed_cameras, parse_image_names
from acino_fte.data_tools.point_cloud import PointCloud, read_ply
from acino_fte.data_tools.tracks import PixelOrigin, SceneTrackFiles, read_scene_tracks
from acino_fte.errors import InputError


@dataclass(frozen=True, eq=False)
class ModelCameras:
    """What a model tells of a scene: its cameras, its points, the rigs that it declares, and notes."""

    cameras: tuple[KeyedCamera, ...]
    cloud: PointCloud
    rigs: tuple[tuple[str, ...], ...]
    notes: tuple[str, ...]


class SceneFiles:
    """Where the files of a scene are.

    Parameters
    ----------
    folder : Path
        With the model in it or in its ``sparse``.
    tracks : Path
        Folder or file of the tracks, in `folder` or anywhere.
    model, dense : Path, optional
        The model, where it is elsewhere; a PLY file with a dense cloud.

    Raises
    ------
    InputError
        There is no such folder.
    """

    def __init__(
        self, folder: Path, tracks: Path | str, model: Path | str | None, dense: Path | str | None
    ) -> None:
        if not folder.is_dir():
            raise InputError(
                "There is no such folder.",
                file=folder,
                expected="a folder with a COLMAP model and 2D tracks",
                remedy="check the path",
            )
        self.folder, self._tracks, self._model, self._dense = folder, tracks, model, dense

    def model(self, pattern: str | None, adjust_poses: bool) -> ModelCameras:
        """The cameras of the model, with the errors of their poses."""
        model = read_colmap(self.folder if self._model is None else self._model)
        images = parse_image_names(model.names, pattern)
        errors = pose_errors(model)
        covariance = errors.covariance
        if adjust_poses:
            model, covariance = mended(model, errors), errors.after_step
        return ModelCameras(
            keyed_cameras(model, images, covariance),
            model.cloud,
            _declared(model, images.camera),
            (*model.notes, *_adjustment_notes(errors, adjust_poses)),
        )

    def tracks(
        self,
        cameras: Sequence[KeyedCamera],
        node: str | None,
        cm_per_pixel: float | None,
        pixel_origin: PixelOrigin,
    ) -> SceneTrackFiles:
        """The 2D tracks of the cameras."""
        names = [camera.name for camera in cameras]
        place = self.folder / self._tracks  # an absolute path stays as it is
        place = place if place.exists() else Path(self._tracks)
        if not place.exists():
            raise InputError(
                "There are no tracks.",
                file=self.folder / self._tracks,
                expected=f"a folder with a file of tracks for each of {', '.join(names)}",
                remedy="name the folder or file of the tracks (--tracks)",
            )
        return read_scene_tracks(
            place, names, node=node, cm_per_pixel=cm_per_pixel, pixel_origin=pixel_origin
        )

    def cloud(self, points: PointCloud) -> PointCloud:
        """The dense cloud where there is one, else the points of the model."""
        return points if self._dense is None else read_ply(self._dense)


def _declared(model: ColmapModel, names: Sequence[str]) -> tuple[tuple[str, ...], ...]:
    """The cameras of each rig that the model declares, where each of its sensors is one camera here."""
    by_id: dict[int, set[str]] = {}
    for camera_id, name in zip(model.camera_ids.tolist(), names, strict=True):
        by_id.setdefault(camera_id, set()).add(name)
    rigs = [[by_id.get(sensor, set()) for sensor in rig.camera_ids] for rig in model.declared_rigs]
    whole = [rig for rig in rigs if all(len(name) == 1 for name in rig)]
    return tuple(tuple(name for sensor in rig for name in sensor) for rig in whole)


def _adjustment_notes(errors: PoseErrors, adjusted: bool) -> list[str]:
    if errors.adjusted:
        return []
    if adjusted:
        return ["The poses were moved to where the model's own observations have them."]
    return [
        "The poses are not where the model's own observations have them. Run a bundle adjustment, or let "
        "them be moved there (--adjust-poses)."
    ]
