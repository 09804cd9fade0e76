"""The command ``acino-fte rig``: plan, drive, record, check and rescue a field recording."""

from __future__ import annotations

import typer

from acino_fte import cli_rig_check, cli_rig_drive, cli_rig_plan, cli_rig_record, cli_rig_recover

app = typer.Typer(
    help="A rig in the field: plan, drive, record, check, rescue.",
    no_args_is_help=True,
    rich_markup_mode="rich",
    pretty_exceptions_show_locals=False,
)
app.command("plan")(cli_rig_plan.plan)
app.command("drive")(cli_rig_drive.drive)
app.command("record")(cli_rig_record.record)
app.command("check")(cli_rig_check.check)
app.command("recover")(cli_rig_recover.recover)
