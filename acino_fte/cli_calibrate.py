"""The command ``acino-fte calibrate-lidar``: a camera calibrated to a lidar, from pairs picked by hand."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from acino_fte.cli_common import reported_errors, stdout, warn
from acino_fte.errors import InputError

if TYPE_CHECKING:
    from acino_fte.cameras import Camera
    from acino_fte.data_tools.lidar_solve import Calibration

_OUTPUT = "Output"


def calibrate_lidar(
    images: Annotated[
        list[Path] | None,
        typer.Argument(
            metavar="IMAGE…",
            help="Images at one zoom, for the page where pairs are picked, or for the report.",
            show_default=False,
        ),
    ] = None,
    cloud: Annotated[
        list[Path] | None,
        typer.Option(metavar="CLOUD", help="Point clouds (PCD, PLY, LVX, bag), one an image or one for all."),
    ] = None,
    pairs: Annotated[
        Path | None,
        typer.Option(
            metavar="PAIRS",
            help="Pairs of picks, image,u,v,x,y,z[,use,label], CSV or JSON. With --resolution: calibrate at "
            "once, without a page.",
        ),
    ] = None,
    resolution: Annotated[
        str | None, typer.Option(metavar="WxH", help="Width and height of the images, px.")
    ] = None,
    camera: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Known intrinsics, which are held: ROS' ost.yaml, cameras.json."),
    ] = None,
    focal: Annotated[
        str | None,
        typer.Option(metavar="PX|PX+-PX", help="Focal length from the lens, px: held, or as a prior."),
    ] = None,
    fit: Annotated[
        str,
        typer.Option(help="auto, pose, or some of f, aspect, c, distortion, with commas: what is estimated."),
    ] = "auto",
    port: Annotated[int, typer.Option(help="Port of the page on this computer; 0: any.")] = 0,
    browser: Annotated[bool, typer.Option(help="Open the page in a browser.")] = True,
    out: Annotated[
        Path,
        typer.Option(
            "--out", "-o", help="Calibration file; report and pairs go beside it.", rich_help_panel=_OUTPUT
        ),
    ] = Path("lidar_camera.json"),
    report: Annotated[bool, typer.Option(help="Write the report.", rich_help_panel=_OUTPUT)] = True,
) -> None:
    """Calibrate a camera to a lidar from pairs picked by hand: on a page in the browser, or from a file.

    Camera matrix and pose are estimated together, without a guess; distortion where the pairs support it.
    """
    with reported_errors():
        _check_out(out, [*(images or ()), *(cloud or ()), *filter(None, (pairs, camera))])
        lens = _lens(camera)
        if resolution is None and images:
            from acino_fte.calibrate_page import serve

            code = serve(
                images,
                cloud or (),
                out,
                pairs,
                lens,
                fit=_fit(fit),
                focal_px=_focal(focal),
                report=report,
                port=port,
                open_browser=browser,
            )
            if code:
                raise typer.Exit(code)
            return
        if pairs is None:
            raise InputError(
                "There is nothing to calibrate.",
                expected="images and clouds for the page, or --pairs PAIRS.csv --resolution WxH",
            )
        calibrate_from_pairs(
            pairs,
            _resolution(resolution, lens),
            out,
            lens,
            _fit(fit),
            _focal(focal),
            report,
            list(images or ()),
        )


def calibrate_from_pairs(
    pairs: Path,
    resolution: tuple[int, int],
    out: Path,
    camera: Camera | None = None,
    fit: tuple[str, ...] | str = "auto",
    focal_px: float | tuple[float, float] | None = None,
    report: bool = True,
    images: list[Path] | None = None,
) -> Calibration:
    """Calibrate from a file of pairs; write the calibration and, beside it, the report in OUT_report/.

    Raises
    ------
    InputError
        The pairs cannot be read or do not make a calibration, or a file cannot be written.
    """
    from acino_fte.data_tools.lidar_camera import write_lidar_camera
    from acino_fte.data_tools.lidar_pairs import read_lidar_pairs
    from acino_fte.data_tools.lidar_report import write_calibration_report
    from acino_fte.data_tools.lidar_solve import solve_lidar_camera

    found = read_lidar_pairs(pairs)
    calibration = solve_lidar_camera(found, resolution, camera, fit, focal_px=focal_px)
    for message in calibration.messages:
        warn(message)
    write_lidar_camera(out, calibration.lidar_camera)
    lines = [
        f"{int(calibration.counted.sum())} of {found.n_used} pairs count",
        f"RMSE {calibration.rmse_px:.2f} px, each pair left out {calibration.left_out_rmse_px:.2f} px",
        f"f {calibration.focal_px:.1f} px",
        f"calibration {out}",
    ]
    if report:
        folder = out.with_name(out.stem + "_report")
        pictures = {path.name: path for path in images or ()}
        write_calibration_report(folder, {pairs.stem: calibration}, pictures)
        lines.append(f"report {folder}")
    for line in lines:
        stdout.print(line, markup=False)
    return calibration


def _check_out(out: Path, inputs: list[Path]) -> None:
    """Raise InputError where the calibration would take the place of what it comes from, or of a folder."""
    if any(out.resolve() == path.resolve() for path in inputs):
        raise InputError(
            "The calibration would be written over what it is made from.",
            file=out,
            key="--out",
            remedy="give it another name, as lidar_camera.json",
        )
    if out.is_dir():
        raise InputError(
            "There is a folder of that name.", file=out, key="--out", remedy=f"{out / 'lidar_camera.json'}"
        )


def _lens(path: Path | None) -> Camera | None:
    if path is None:
        return None
    from acino_fte.data_tools.lidar_intrinsics import read_intrinsics

    return read_intrinsics(path)


def _resolution(text: str | None, camera: Camera | None) -> tuple[int, int]:
    if text is None and camera is not None:
        return camera.resolution
    match = re.fullmatch(r"\s*(\d+)\s*[xX×,]\s*(\d+)\s*", text or "")
    if not match or min(int(match[1]), int(match[2])) < 1:
        raise InputError(
            "The size of the images is not known.",
            key="--resolution",
            expected="width and height, as 2048x1088",
            found=repr(text) if text else "nothing",
        )
    return int(match[1]), int(match[2])


def _fit(text: str) -> tuple[str, ...] | str:
    names = tuple(name.strip().lower() for name in text.split(",") if name.strip())
    if not names:
        raise InputError(
            "Nothing is said of what to fit.", key="--fit", expected="auto, pose, or f, aspect, c, distortion"
        )
    if names == ("auto",):
        return "auto"
    return () if names == ("pose",) else names


def _focal(text: str | None) -> float | tuple[float, float] | None:
    if text is None:
        return None
    try:
        values = [float(part) for part in re.split(r"\+-|±|\+/-", text)]
        if len(values) > 2 or not all(0 < value < 1e9 for value in values):
            raise ValueError
    except ValueError:
        raise InputError(
            "This is no focal length.", key="--focal", expected="4000 or 4000+-100, px", found=repr(text)
        ) from None
    return values[0] if len(values) == 1 else (values[0], values[1])
