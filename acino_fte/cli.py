"""The command ``acino-fte``. Heavy imports wait inside the commands, so that ``--help`` is instant."""

from __future__ import annotations

import typer

from acino_fte import (
    cli_adjust,
    cli_calibrate,
    cli_compare,
    cli_doctor,
    cli_histograms,
    cli_import,
    cli_match,
    cli_motion,
    cli_rig,
    cli_run,
    cli_scene,
    cli_simulate,
    cli_simulate_rig,
    cli_simulate_scene,
    cli_skeleton,
)

app = typer.Typer(
    name="acino-fte",
    help="3D trajectories of animals from 2D keypoints and calibrated cameras.",
    no_args_is_help=True,
    rich_markup_mode="rich",
    pretty_exceptions_show_locals=False,
)
app.command("run")(cli_run.run)
app.command("compare")(cli_compare.compare)
app.command("match")(cli_match.match)
app.command("scene")(cli_scene.scene)
app.command("simulate")(cli_simulate.simulate)
app.command("simulate-scene")(cli_simulate_scene.simulate_scene)
app.command("simulate-rig")(cli_simulate_rig.simulate_rig)
app.command("calibrate-lidar")(cli_calibrate.calibrate_lidar)
app.command("camera-motion")(cli_motion.camera_motion)
app.command("import-recording")(cli_import.import_recording)
app.command("adjust")(cli_adjust.adjust)
app.command("doctor")(cli_doctor.doctor)
app.command("histograms")(cli_histograms.histograms)
app.add_typer(cli_skeleton.app, name="skeleton")
app.add_typer(cli_rig.app, name="rig")


@app.callback(invoke_without_command=True)
def _root(
    version: bool = typer.Option(False, "--version", help="Print the version and leave.", is_eager=True),
) -> None:
    if version:
        from acino_fte import __version__

        typer.echo(__version__)
        raise typer.Exit


def main() -> None:
    """Entry point of the command."""
    app()
