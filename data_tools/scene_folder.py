"""Writes a simulated scene as a folder: COLMAP model, 2D tracks, and the truth beside them.

==================  ========================================================================================
sparse/             COLMAP model as text: cameras, images, points3D
tracks/CAMERA.csv   frame, individual, x, y (px, pixel centres at integers), on the camera's own clock
scene.yaml          the pattern of the image names, frames per second, known distances
truth_3d.csv        frame, individual, x, y, z (m, z up), on the reference clock; for scoring only
truth_cameras.csv   camera, frame, x, y, z (centre, m), qw, qx, qy, qz (world to camera), in every frame
truth_tracks/       the true individual of each row of tracks/CAMERA.csv, and whether it is grossly wrong
simulation.json     all options, and the gauge: x_model = scale · rotation @ x_world + translation
==================  ========================================================================================
"""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from acino_fte.simulation_files import PROVENANCE, check_target, whole_folder

if TYPE_CHECKING:
    from acino_fte.data_tools.simulate_scene import SimulatedScene

Layout = Literal["prefix", "folder"]
FORMAT = "acino-fte/scene-simulation/1"
PATTERNS: dict[Layout, str] = {"prefix": "{camera}_{frame}.jpg", "folder": "{camera}/{frame}.jpg"}

_README = """# {name}

A simulated scene with moving cameras: path '{path}', formation '{formation}', {n_cameras} cameras,
{n_frames} frames at {fps:g} Hz, {individuals}. Made by

    {command}

which makes it again, number for number. All options are in `simulation.json`.

| file | what |
| --- | --- |
| `sparse/` | COLMAP model (text) in a world of its own; a key frame every {key_step} frames |
| `tracks/*.csv` | what trackers found in each camera: frame, individual, x, y, px |
| `scene.yaml` | the pattern of the image names, frames per second, known distances |
| `truth_3d.csv` | true positions, m, z up |
| `truth_cameras.csv` | true poses of the cameras in every frame: centre, m, and quaternion, world to camera |
| `truth_tracks/*.csv` | the true individual of each row of `tracks/*.csv`, and whether it is grossly wrong |
"""


def write_scene(
    scene: SimulatedScene,
    folder: Path | str,
    *,
    layout: Layout = "prefix",
    overwrite: bool = False,
    command: str | None = None,
) -> Path:
    """Write a scene; the folder appears whole or not at all.

    Parameters
    ----------
    scene : SimulatedScene
        From :func:`simulate_scene.simulate_scene`.
    folder : Path
        Where; its name becomes that of the scene.
    layout : str
        Names of the images: ``prefix`` (``cam0_000008.jpg``) or ``folder`` (``cam0/000008.jpg``).
    overwrite : bool
        Replace an earlier simulation there. Nothing else is ever replaced.
    command : str, optional
        The command that made it, for the note in the folder.

    Returns
    -------
    Path
        The folder.

    Raises
    ------
    InputError
        The folder exists and is not to be replaced, or cannot be made.
    """
    folder = check_target(folder, overwrite=overwrite)
    with whole_folder(folder) as work:
        _write_files(
            scene, work, folder.name, layout, command or "acino_fte.data_tools.scene_folder.write_scene"
        )
    return folder


def _write_files(scene: SimulatedScene, folder: Path, name: str, layout: Layout, command: str) -> None:
    options = scene.options
    (folder / "sparse").mkdir()
    _write_model(scene, folder / "sparse", layout)
    _write_tracks(scene, folder)
    _write_truth(scene, folder)
    _write_scene_file(scene, folder / "scene.yaml", layout)
    text = _README.format(
        name=name, command=command, individuals=", ".join(scene.individuals), **asdict(options)
    )
    (folder / "README.md").write_text(text, encoding="utf-8")
    _write_provenance(scene, folder / PROVENANCE, command)


def image_names(scene: SimulatedScene, layout: Layout) -> list[str]:
    """Names of the model's images, camera by camera, in order of the frames."""
    pattern = PATTERNS[layout].replace("{frame}", "{frame:06d}")
    return [
        pattern.format(camera=camera.name, frame=frame)
        for camera in scene.cameras()
        for frame in camera.frame
    ]


def _write_tracks(scene: SimulatedScene, folder: Path) -> None:
    import pandas as pd

    (folder / "tracks").mkdir()
    (folder / "truth_tracks").mkdir()
    for view, wild in zip(scene.tracks(), scene.outlier, strict=True):
        names = np.array(view.labels, dtype=object)
        x, y = view.xy.T
        table = pd.DataFrame({"frame": view.frame, "individual": names[view.track], "x": x, "y": y})
        _write_table(table, folder / "tracks" / f"{view.camera}.csv", "%.3f")
        truth = pd.DataFrame({"individual": names[view.animal], "outlier": wild.astype(int)})
        _write_table(truth, folder / "truth_tracks" / f"{view.camera}.csv")


def _write_truth(scene: SimulatedScene, folder: Path) -> None:
    import pandas as pd
    from scipy.spatial.transform import Rotation

    n_individuals, n_frames, _ = scene.true_positions.shape
    columns = {
        "frame": np.tile(np.arange(n_frames), n_individuals),
        "individual": np.repeat(np.array(scene.individuals, dtype=object), n_frames),
    }
    points = dict(zip("xyz", scene.true_positions.reshape(-1, 3).T, strict=True))
    _write_table(pd.DataFrame(columns | points), folder / "truth_3d.csv", "%.5f")
    parts = []
    for camera in scene.true_cameras:
        quaternion = Rotation.from_matrix(camera.rotation).as_quat()[:, [3, 0, 1, 2]]
        values = np.concatenate([camera.centre, quaternion], axis=1)
        part = pd.DataFrame(values, columns=["x", "y", "z", "qw", "qx", "qy", "qz"])
        part.insert(0, "frame", np.arange(len(part)))
        part.insert(0, "camera", camera.name)
        parts.append(part)
    _write_table(pd.concat(parts), folder / "truth_cameras.csv", "%.6f")


def _write_table(table, path: Path, number: str | None = None) -> None:
    table.to_csv(path, index=False, lineterminator="\n", float_format=number)


def _write_scene_file(scene: SimulatedScene, path: Path, layout: Layout) -> None:
    """The scene file: what the folder cannot say by itself."""
    import yaml

    options = scene.options
    scale = []
    if options.formation == "rig" and options.n_cameras > 1:
        scale.append(f"cam0-cam1={options.rig_side:g}")
    elif options.wand is not None:
        scale.append(f"tracks:wand_a-wand_b={options.wand:g}")
    content = {"pattern": PATTERNS[layout], "fps": float(options.fps)}
    path.write_text(yaml.safe_dump(content | ({"scale": scale} if scale else {}), sort_keys=False), "utf-8")


def _write_provenance(scene: SimulatedScene, path: Path, command: str) -> None:
    from acino_fte import __version__

    gauge = scene.gauge
    content = {
        "format": FORMAT,
        "version": __version__,
        "command": command,
        "options": asdict(scene.options),
        "gauge": {
            "scale": gauge.scale,
            "rotation": gauge.rotation.tolist(),
            "translation": gauge.translation.tolist(),
        },
    }
    path.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


def _write_model(scene: SimulatedScene, folder: Path, layout: Layout) -> None:
    from acino_fte.data_tools.colmap_write import write_colmap_text
    from acino_fte.data_tools.simulated_lenses import colmap_parameters

    s, cameras, cloud = scene.structure, scene.cameras(), scene.cloud()
    lenses = {
        camera.model_id: (name, *camera.lens.resolution, colmap_parameters(name, camera.lens))
        for name, camera in zip(scene.options.lenses, cameras, strict=True)
    }
    count = [len(camera.frame) for camera in cameras]
    image = np.empty(len(s.frame), dtype=int)
    for c, camera in enumerate(cameras):
        own = s.camera == c
        image[own] = sum(count[:c]) + np.searchsorted(camera.frame, s.frame[own])
    write_colmap_text(
        folder,
        lenses,
        image_names(scene, layout),
        np.repeat([camera.model_id for camera in cameras], count),
        np.concatenate([camera.rotation for camera in cameras]),
        np.concatenate([camera.translation for camera in cameras]),
        xyz=cloud.xyz,  # not rounded: the answer must not hang on the gauge
        rgb=cloud.rgb,
        error=np.round(cloud.error, 4),
        observed_image=image,
        observed_point=s.landmark,
        observed_xy=np.round(s.xy, 3),
    )
