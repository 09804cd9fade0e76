"""A plan on disk: JSON, a page of Markdown, tables as CSV, figures, and the rig that was planned."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

from acino_fte.data_tools.whole_text import write_text_whole
from acino_fte.rig.plan import RigPlan
from acino_fte.rig.plan_tables import csv_tables, plan_markdown
from acino_fte.rig.plan_verdicts import verdicts
from acino_fte.rig.rig_file import FILE_NAME
from acino_fte.rig.rig_read import write_rig

FILES = (
    *("plan.json", "plan.md", "requirements.csv", "storage.csv", "pixels.csv", "distances.csv"),
    *(FILE_NAME, "figures"),
)
"""What a plan's folder holds."""


def plan_json(plan: RigPlan) -> dict[str, Any]:
    """Everything about a plan, as plain values: what is infinite or unknown is None."""
    found = [asdict(one) | {"tight": one.tight} for one in verdicts(plan)]
    return {**plan.to_dict(), "requirements": found, "passed": all(one["verdict"] != "fail" for one in found)}


def write_plan(plan: RigPlan, folder: Path, *, figures: bool = True) -> None:
    """Write a plan into an existing folder.

    Raises
    ------
    InputError
        A file cannot be written.
    """
    text = json.dumps(plan_json(plan), indent=1, ensure_ascii=False, allow_nan=False)
    write_text_whole(folder / "plan.json", text + "\n")
    write_text_whole(folder / "plan.md", plan_markdown(plan))
    for name, table in csv_tables(plan).items():
        write_text_whole(folder / name, table)
    write_rig(folder / FILE_NAME, plan.rig)
    if figures:
        from acino_fte.rig.plan_figure import save_plan_figures

        save_plan_figures(plan, folder / "figures")
