"""What each family of parameters is worth in cameras that took no part, over every camera of a recording.

    python benchmarks/bench_ladder.py SEQUENCE --species cheetah --fps 120 --frames 80:190 [--json FILE]

Runs `acino-fte run … --fit scale,delay,extrinsics,offsets --holdout-cameras each --ladder` without figures
and prints the errors of every rung, and whether the median falls at each. With six cameras it estimates 36
times; the tests do the same with two of the cameras of the real sequence.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from pathlib import Path

FAMILIES = "scale,delay,extrinsics,offsets"


def measure(arguments: argparse.Namespace, out: Path) -> dict:
    """metrics.json of the run."""
    from typer.testing import CliRunner

    from acino_fte.cli import app

    command = ["run", str(arguments.sequence), "--fit", FAMILIES, "--holdout-cameras", "each", "--ladder"]
    for name in ("species", "fps", "frames"):
        value = getattr(arguments, name)
        if value is not None:
            command += [f"--{name}", str(value)]
    result = CliRunner().invoke(app, [*command, "--no-figures", "-q", "-o", str(out)])
    if result.exit_code:
        sys.exit(result.output)
    return json.loads((out / "metrics.json").read_text())


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("sequence", type=Path)
    parser.add_argument("--species")
    parser.add_argument("--fps", type=float)
    parser.add_argument("--frames")
    parser.add_argument("--json", type=Path, help="write the rungs")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        ladder = measure(arguments, Path(folder) / "ladder")["ladder"]
    print(f"{'fitted':<36} median px  within 20 px  coverage")
    for rung in ladder:
        error = rung["heldout_px"]
        fitted = ", ".join(rung["fit"]) or "nothing"
        print(f"{fitted:<36} {error['median']:9.2f} {error['within_20px']:13.1%} {error['coverage']:9.1%}")
    medians = [rung["heldout_px"]["median"] for rung in ladder]
    print("falls at every rung:", "yes" if medians == sorted(medians, reverse=True) else "no")
    if arguments.json:
        arguments.json.write_text(json.dumps(ladder, indent=1))


if __name__ == "__main__":
    main()
