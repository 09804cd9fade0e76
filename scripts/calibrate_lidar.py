"""A camera calibrated to a lidar by hand: ``python scripts/calibrate_lidar.py IMAGE --cloud CLOUD``."""

import typer

from acino_fte.cli_calibrate import calibrate_lidar

if __name__ == "__main__":
    typer.run(calibrate_lidar)
