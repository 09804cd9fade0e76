"""The command ``acino-fte adjust``: a trajectory put right by hand, on a page in the browser."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape

from acino_fte.cli_common import reported_errors, stdout, warn
from acino_fte.errors import InputError

if TYPE_CHECKING:
    from acino_fte.adjust_session import AdjustSession

_PAGE = "Page"


def adjust(
    run: Annotated[
        Path, typer.Argument(metavar="RUN", help="Result folder of acino-fte run.", show_default=False)
    ],
    video: Annotated[
        list[str] | None,
        typer.Option(
            metavar="CAMERA=VIDEO", help="Video of a camera. As often as needed.", show_default=False
        ),
    ] = None,
    images: Annotated[
        list[str] | None,
        typer.Option(
            metavar="[CAMERA=]FOLDER",
            help="Folder with an image a frame, or with such folders called as the cameras.",
            show_default=False,
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            "-o",
            metavar="JSON",
            help="File of adjustments; one that is there is gone on with.",
            show_default="RUN.adjustments.json beside RUN",
        ),
    ] = None,
    large_px: Annotated[
        float | None,
        typer.Option(
            help="A residual beyond this many px is worth a jump.",
            show_default="20, or the worst tenth of the frames",
        ),
    ] = None,
    export: Annotated[
        bool, typer.Option("--export", help="Write the adjusted positions as CSV, without a page.")
    ] = False,
    port: Annotated[int, typer.Option(help="Port of the page; 0 for any.", rich_help_panel=_PAGE)] = 0,
    browser: Annotated[bool, typer.Option(help="Open the browser.", rich_help_panel=_PAGE)] = True,
) -> None:
    """Adjust a trajectory by hand: the skeleton over the frames of every view.

    Opens a page on this computer only. Every change is saved at once, with the
    position before and after it; the run itself is never changed. Adjusted positions
    are written as CSV beside the file at the end. Leaves with 2 when the input is
    wrong.

    Example: acino-fte adjust out/gallop --video cam1=cam1.mp4 --video cam2=cam2.mp4
    """
    with reported_errors():
        from acino_fte.adjust_files import adjustments_path
        from acino_fte.adjust_session import open_session
        from acino_fte.evaluation_runs import open_run

        if large_px is not None and not large_px > 0:
            raise InputError(
                "The threshold is impossible.",
                key="--large-px",
                expected="more than 0",
                found=f"{large_px:g}",
            )
        opened = open_run(run)
        path = _target(out, run) if out is not None else adjustments_path(opened)
        session = open_session(opened, path, large_px)
        if not opened.converged:
            warn(f"the run did not converge ({opened.metrics['status']})")
        if not export:
            _serve(session, video or [], images or [], port, browser)
            if not session.document.entries:
                return
        stdout.print(f"adjusted positions: {escape(str(session.export()))}")


def _target(out: Path, run: Path) -> Path:
    """A file that is no folder and does not lie in the run, which is never written to."""
    path = out.expanduser().resolve()
    inside = run.expanduser().resolve() in path.parents
    if path.is_dir() or inside or path.suffix.lower() != ".json":
        raise InputError(
            "The file of adjustments cannot be there.",
            file=path,
            key="-o",
            expected="a file that ends in .json, outside of the run's folder",
            found="a folder" if path.is_dir() else "inside the run's folder" if inside else path.name,
        )
    return path


def _serve(session: AdjustSession, videos: list[str], folders: list[str], port: int, browser: bool) -> None:
    from acino_fte.adjust_page import build_page
    from acino_fte.adjust_pictures import pictures_of_run
    from acino_fte.local_page import serve_page

    pictures = pictures_of_run(session.run, videos, folders)
    n = len(session.document.entries)
    stdout.print(f"{escape(str(session.path))}: {n} adjustments so far")
    serve_page(
        lambda page: build_page(page, session, pictures),
        title=f"Adjust {session.run.name}",
        port=port,
        open_browser=browser,
    )
    if session.problem:
        warn(session.problem)
    stdout.print(f"{len(session.document.entries)} adjustments in {escape(str(session.path))}")
