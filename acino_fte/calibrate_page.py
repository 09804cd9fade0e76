"""The calibration page: the image on the left, the point cloud on the right, pairs of picks between them.

It is served on this computer only (:mod:`acino_fte.local_page`). What was picked is in
:mod:`acino_fte.calibrate_page_work`, and is on disk after every change.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from acino_fte.calibrate_page_input import Placement, read_placements
from acino_fte.calibrate_page_work import Save, Solve, Work
from acino_fte.local_page import Ending, PageSession, serve_page

if TYPE_CHECKING:
    import numpy as np

    from acino_fte.cameras import Camera
    from acino_fte.data_tools.lidar_pairs import LidarPairs
    from acino_fte.data_tools.lidar_solve import Calibration

TITLE = "Calibrate camera and lidar"


def serve(
    images: Sequence[Path],
    clouds: Sequence[Path],
    out: Path,
    pairs: Path | None = None,
    camera: Camera | None = None,
    *,
    fit: Collection[str] | str = "auto",
    focal_px: float | tuple[float, float] | None = None,
    report: bool = True,
    port: int = 0,
    open_browser: bool = True,
) -> int:
    """Calibrate by hand: what ``scripts/calibrate_lidar.py IMAGES --cloud CLOUDS`` does.

    Parameters
    ----------
    images, clouds : sequence of Path
        Images of one zoom, and a cloud for each, or one for all.
    out : Path
        The calibration, written when "Save" is pressed; its report goes to OUT_report/ beside it.
    pairs : Path, optional
        File of the pairs, written after every change and gone on with; without it, OUT_pairs.csv beside OUT.
    camera : Camera, optional
        Known intrinsics.
    fit, focal_px
        As :func:`~acino_fte.data_tools.lidar_solve.solve_lidar_camera` takes them.
    report : bool
        Write the report too.
    port, open_browser
        As :func:`acino_fte.local_page.serve_page` takes them.

    Returns
    -------
    int
        Exit code: 0.

    Raises
    ------
    InputError
        A file cannot be read, they do not fit together, or the page cannot be served.
    """
    from acino_fte.data_tools.lidar_solve import solve_lidar_camera

    placements = read_placements(images, clouds)
    resolution = placements[0].resolution

    def solve(picked: LidarPairs) -> Calibration:
        return solve_lidar_camera(picked, resolution, camera, fit, focal_px=focal_px)

    pictures = {path.name: path for path in images} if report else None
    shown = {one.name: one.xyz for one in placements}
    path = pairs or out.with_name(out.stem + "_pairs.csv")
    calibrate_by_hand(
        placements, path, solve, partial(_save, out, pictures, shown), port=port, open_browser=open_browser
    )
    return 0


def calibrate_by_hand(
    placements: Sequence[Placement],
    path: Path,
    solve: Solve,
    save: Save,
    *,
    port: int = 0,
    open_browser: bool = True,
    on_ready: Callable[[str], object] | None = None,
) -> Ending:
    """Open the calibration page, and come back when it is done with.

    Parameters
    ----------
    placements : sequence of Placement
        Images of one zoom and their clouds; see :func:`acino_fte.calibrate_page_input.placement`.
    path : Path
        File of the pairs: written after every change, and gone on with when it is there.
    solve : callable
        Takes :class:`~acino_fte.data_tools.lidar_pairs.LidarPairs` and gives a
        :class:`~acino_fte.data_tools.lidar_solve.Calibration`, or raises InputError. Called in a thread.
    save : callable
        Takes the calibration, when "Save" is pressed, and writes it and its report; the paths that it
        returns are said to the user. Called in a thread.
    port, open_browser, on_ready
        As :func:`acino_fte.local_page.serve_page` takes them.

    Returns
    -------
    str
        How the page ended: ``"done"`` or ``"interrupted"`` (Ctrl-C).

    Raises
    ------
    InputError
        The images do not fit together, the pairs cannot be read, or the page cannot be served.
    """
    work = Work(placements, path, solve, save)
    tabs: list = []

    def build(session: PageSession) -> None:
        from acino_fte.calibrate_page_view import Tab

        for index, one in enumerate(work.placements.values()):
            session.share(f"image{index}", one.picture, one.media_type)
            session.share(f"cloud{index}", one.packed)
            session.share(f"overlay{index}", partial(_overlay, work, one.name))
        Tab(work, session, tabs)

    return serve_page(build, title=TITLE, port=port, open_browser=open_browser, on_ready=on_ready)


def _overlay(work: Work, name: str) -> bytes:
    return work.overlay(name)[0]


def _save(
    out: Path, pictures: dict[str, Path] | None, clouds: dict[str, np.ndarray], calibration: Calibration
) -> tuple[Path, ...]:
    """Write the calibration, and its report where there are pictures for it."""
    from acino_fte.data_tools.lidar_camera import write_lidar_camera

    write_lidar_camera(out, calibration.lidar_camera)
    if pictures is None:
        return (out,)
    from acino_fte.data_tools.lidar_report import write_calibration_report

    folder = out.with_name(out.stem + "_report")
    write_calibration_report(folder, {out.stem: calibration}, pictures, clouds)
    return out, folder
