"""The command ``acino-fte rig``: plan, drive, record, check and rescue a field recording."""

from __future__ import annotations

import typer

app = typer.Typer(
    help="A rig in the field: plan, drive, record, check, rescue.",
    no_args_is_help=True,
    rich_markup_mode="rich",
    pretty_exceptions_show_locals=False,
)
