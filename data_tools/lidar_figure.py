"""Figures of calibrations to a lidar: histograms by distance, residuals and depth over the images."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from acino_fte.errors import InputError

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from acino_fte.data_tools.lidar_solve import Calibration

DPI = 150
_DEPTH_MAP = "turbo"  # many hues: near and far of one place are told apart over any image
_POINTS = 40_000  # of a cloud that are drawn
_ARROW = 0.06  # length of the median residual's arrow, in widths of the image


def save_figures(
    calibrations: Mapping[str, Calibration],
    folder: Path,
    images: Mapping[str, Path],
    clouds: Mapping[str, np.ndarray],
) -> list[Path]:
    """Draw all figures of a report into a folder, as PNG and as vector PDF."""
    import matplotlib

    from acino_fte.plots_style import STYLE

    folder.mkdir(parents=True, exist_ok=True)
    written: list[Path] = []
    style: Any = {**dict(matplotlib.rcParamsDefault), **STYLE}
    with matplotlib.rc_context(style):
        figures = {"errors": error_figure(calibrations)}
        for name, each in calibrations.items():
            for image in each.pairs.images:
                picture = _picture(images[image]) if image in images else None
                stem = _file_name(f"{name}_{Path(image).stem}" if image else name)
                figures[f"residuals_{stem}"] = residual_figure(each, name, image, picture)
                if image in clouds:
                    figures[f"depth_{stem}"] = depth_figure(each, name, image, picture, clouds[image])
        for stem, figure in figures.items():
            written += [folder / f"{stem}.png", folder / f"{stem}.pdf"]
            figure.savefig(written[-2], dpi=DPI, metadata={"Software": None})
            figure.savefig(written[-1], dpi=DPI, metadata={"CreationDate": None, "Producer": None})
    return written


def _file_name(text: str) -> str:
    return re.sub(r"[^\w.-]+", "_", text)[:80]


def _picture(path: Path) -> np.ndarray:
    """An image (H, W, 3), red, green, blue."""
    import cv2

    data = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if data is None:
        raise InputError("The image cannot be read.", file=path, remedy="check the path")
    return data[:, :, ::-1]


def error_figure(calibrations: Mapping[str, Calibration]) -> Figure:
    """Signed errors in u and v and absolute errors: a row of histograms for each calibration and distance."""
    from acino_fte.plots_style import BLUE, GREEN, GREY, ORANGE

    rows = _groups(calibrations)
    figure = _figure(
        "Reprojection error by distance", "signed: projection − pick", 9.0, 0.95 + 1.45 * len(rows)
    )
    height = figure.get_size_inches()[1]
    figure.subplots_adjust(left=0.09, right=0.985, top=1 - 0.72 / height, bottom=0.48 / height)
    figure.subplots_adjust(wspace=0.24, hspace=0.5)
    panels = figure.subplots(len(rows), 3, squeeze=False)
    for (title, error), line in zip(rows, panels, strict=True):
        length = np.linalg.norm(error, axis=1)
        reach = _round_up(max(float(np.abs(error).max(initial=0.0)), 1.0))
        for values, axes, colour, what in (
            (error[:, 0], line[0], BLUE, "u"),
            (error[:, 1], line[1], ORANGE, "v"),
            (length, line[2], GREEN, "absolute"),
        ):
            span = (0.0, _round_up(length.max(initial=1.0))) if what == "absolute" else (-reach, reach)
            _histogram(axes, values, span, colour)
            if what != "absolute":
                axes.axvline(0, color=GREY, lw=0.7)
        line[0].set_title(title, loc="left")
        line[0].set_ylabel("Pairs")
    for axes, label in zip(
        panels[-1], ("Error in u (px)", "Error in v (px)", "Absolute error (px)"), strict=True
    ):
        axes.set_xlabel(label)
    return figure


def _groups(calibrations: Mapping[str, Calibration]) -> list[tuple[str, np.ndarray]]:
    """Title and residuals (n, 2) of the pairs that count, by calibration and distance."""
    from acino_fte.data_tools.lidar_report import distance_groups

    out = []
    for name, each in calibrations.items():
        rows = np.flatnonzero(each.counted)
        for group in distance_groups(each.pairs.distance[rows]):
            chosen = rows[group]
            distance = each.pairs.distance[chosen].mean()
            out.append(
                (
                    f"{name} · {distance:.1f} m · {len(chosen)} {'pair' if len(chosen) == 1 else 'pairs'}",
                    each.residual[chosen],
                )
            )
    return out


def _histogram(axes: Axes, values: np.ndarray, span: tuple[float, float], colour: str) -> None:
    from matplotlib.ticker import MaxNLocator

    n_bins = int(np.clip(2 * np.sqrt(len(values)), 8, 40))
    counts, edges = np.histogram(values, bins=n_bins, range=span)
    axes.stairs(counts, edges, fill=True, color=colour, alpha=0.8)
    axes.set(xlim=span, ylim=(0, 1.55 * max(1, counts.max())))
    axes.yaxis.set_major_locator(MaxNLocator(4, integer=True))
    rms = np.sqrt(np.mean(values**2))
    text = f"mean {values.mean():+.2f}, SD {values.std():.2f}, RMSE {rms:.2f} px".replace("-", "−")
    axes.text(0.985, 0.97, text, transform=axes.transAxes, ha="right", va="top", fontsize=7)


def _round_up(value: float) -> float:
    unit = 10.0 ** np.floor(np.log10(value))
    return float(np.ceil(2 * value / unit) / 2 * unit)


def residual_figure(calibration: Calibration, name: str, image: str, picture: np.ndarray | None) -> Figure:
    """Residuals as arrows from pick to projection, made longer, over the image."""
    from acino_fte.plots_style import BLUE, GREY, RED

    rows = np.flatnonzero([each == image for each in calibration.pairs.image])
    width = calibration.camera.resolution[0]
    counted = calibration.counted[rows]
    typical = float(np.median(calibration.error_px[rows][counted])) if counted.any() else 1.0
    times = max(1.0, round(_ARROW * width / max(typical, 1e-3), -int(np.log10(_ARROW * width / typical))))
    figure, axes = _over_image(
        calibration, picture, f"Residuals · {name} · {image}" if image else f"Residuals · {name}",
        f"pick → projection, {times:g} × longer; red: outliers; grey: not used",
    )  # fmt: skip
    used = calibration.pairs.used_mask[rows]
    for mask, colour in ((counted, BLUE), (used & ~counted, RED), (~used, GREY)):
        at, by = calibration.pairs.pixel[rows][mask], calibration.residual[rows][mask]
        if len(at):
            arrows = {"angles": "xy", "scale_units": "xy", "scale": 1.0 / times, "width": 0.0025}
            axes.plot(*at.T, "o", ms=4, mfc="none", mec="white", mew=1.8)
            axes.plot(*at.T, "o", ms=4, mfc="none", mec=colour, mew=1.0)
            axes.quiver(*at.T, *by.T, color=colour, edgecolor="white", linewidth=0.4, **arrows)
    return figure


def depth_figure(
    calibration: Calibration, name: str, image: str, picture: np.ndarray | None, cloud: np.ndarray
) -> Figure:
    """The cloud (K, 3) over the image, coloured by depth: edges of things must meet."""
    camera = calibration.camera
    cloud = np.asarray(cloud, dtype=float)[:, :3]
    pixel, depth = camera.project(cloud), camera.to_camera(cloud)[:, 2]
    seen = np.flatnonzero(camera.inside(pixel) & (depth > 0))
    if len(seen) > _POINTS:
        seen = seen[:: -(-len(seen) // _POINTS)]
    seen = seen[np.argsort(-depth[seen])]  # near ones last, on top
    title = f"Cloud by depth · {name} · {image}" if image else f"Cloud by depth · {name}"
    figure, axes = _over_image(calibration, picture, title, f"{len(seen)} returns in the image")
    size = float(np.clip(4e4 / max(len(seen), 1), 0.6, 12.0))
    low, high = np.percentile(depth[seen], (2, 98)) if len(seen) else (0.0, 1.0)
    dots = axes.scatter(
        pixel[seen, 0],
        pixel[seen, 1],
        c=depth[seen],
        s=size,
        lw=0,
        cmap=_DEPTH_MAP,
        vmin=low,
        vmax=high,
        rasterized=True,
    )
    figure.colorbar(dots, ax=axes, fraction=0.03, pad=0.01, label="Depth (m)")
    return figure


def _over_image(
    calibration: Calibration, picture: np.ndarray | None, title: str, below: str
) -> tuple[Figure, Axes]:
    """A figure with the image in the camera's pixels; pale where there is no picture."""
    from acino_fte.plots_style import PALE

    width, height = calibration.camera.resolution
    tall = 7.6 * height / width
    figure = _figure(title, below, 9.0, tall + 1.15)
    axes = figure.add_axes((0.07, 0.42 / (tall + 1.15), 0.86, tall / (tall + 1.15)))
    if picture is None:
        axes.set_facecolor(PALE)
    else:
        axes.imshow(picture, extent=(-0.5, width - 0.5, height - 0.5, -0.5), interpolation="nearest")
    axes.set(
        xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5), aspect="equal", xlabel="u (px)", ylabel="v (px)"
    )
    return figure, axes


def _figure(title: str, below: str, width: float, height: float) -> Figure:
    from matplotlib.figure import Figure as NewFigure

    from acino_fte.plots_style import GREY

    figure = NewFigure(figsize=(width, height))
    figure.text(0.012, 1 - 0.08 / height, title, va="top", fontsize=12)
    figure.text(0.012, 1 - 0.30 / height, below, va="top", fontsize=8.5, color=GREY)
    return figure
