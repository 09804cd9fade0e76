"""A comparison on disk: tables, numbers and a figure in one folder, whole or not at all."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from acino_fte.comparison import Block
from acino_fte.comparison_tables import as_json, latex, markdown, table
from acino_fte.errors import InputError
from acino_fte.result_files import Contents, written_whole

COMPARISON = Contents(
    "comparison",
    tuple(f"comparison.{kind}" for kind in ("csv", "md", "tex", "json", "png", "pdf")),
    ("comparison.csv", "comparison.json"),
)
"""What the folder of a comparison holds."""


def save_comparison(blocks: list[Block], mean: Block | None, options: dict[str, Any], folder: Path) -> None:
    """Write a comparison into a folder that :func:`acino_fte.result_files.check_output_folder` has passed.

    Parameters
    ----------
    blocks : list of Block
        One a sequence.
    mean : Block, optional
        Their mean, when there are several.
    options : dict
        How it was made, for the record.
    folder : Path
        An earlier comparison there is replaced.

    Raises
    ------
    InputError
        The folder cannot be written.
    """
    from acino_fte.plots_comparison import save_comparison_figure

    shown = [*blocks, mean] if mean is not None else blocks
    numbers = json.dumps(as_json(blocks, mean, options), indent=2, ensure_ascii=False, allow_nan=False)
    try:
        with written_whole(folder, COMPARISON) as working:
            table(blocks).to_csv(working / "comparison.csv", index=False)
            (working / "comparison.md").write_text(markdown(shown), encoding="utf-8")
            (working / "comparison.tex").write_text(latex(shown), encoding="utf-8")
            (working / "comparison.json").write_text(numbers + "\n", encoding="utf-8")
            save_comparison_figure(blocks, mean, working)
    except OSError as error:
        raise InputError(
            "The comparison cannot be written.",
            file=folder,
            found=error.strerror or str(error),
            remedy="free some space or choose another folder with -o, and run again",
        ) from None
