"""The recorder at full size, and killed at random moments.

Run: python benchmarks/bench_recorder.py [--minutes 10] [--kills 100] [--folder FOLDER]
First a recording of a simulated rig, compressed in time: 60 fps of 2048×1088, a lidar at 10 Hz of 24 000
points and its inertial sensor at 200 Hz, H.264, with faults of every kind, the last of them a full disk. All
that was delivered must be on the disk, every frame stamped, every fault told with its time and length, and
nothing else. Then one without faults on the real clock, as long as --real says. Then recorders are killed
(SIGKILL) at random moments, four at a time; the folder and the copy of ``rig recover`` must hold 99 % of what
was written a second before.
"""

import argparse
import shutil
import tempfile
import time
from pathlib import Path

import numpy as np

from acino_fte.rig.faults import parse_fault
from acino_fte.rig.recorder_verdict import unexplained
from acino_fte.rig.rig_file import CameraPart, LidarPart, RigFile, Storage
from acino_fte.rig.session import Session, SessionOptions
from acino_fte.rig.simulated_kills import kill_recorders
from acino_fte.rig.simulated_proof import expected_events, problems_of

AT_ONCE = 4  # recorders that are killed
DECODE_EVERY = 60  # frames of which one is decoded: key frames
LONGEST_S = 6.0  # until a kill


def faults_of(seconds: float) -> list[str]:
    """Faults of every kind, spread over a recording; the last one, a full disk, ends it."""
    at = [*(round(seconds * share, 1) for share in np.linspace(0.05, 0.95, 13)), seconds]
    return [
        f"stall:cam1@{at[0]}+2",
        f"stall:lidar1@{at[1]}+2",
        f"stall:lidar1/imu@{at[2]}+2",
        f"unplug:cam1@{at[3]}+3",
        f"unplug:lidar1@{at[4]}+3",
        f"lost:cam1@{at[5]}+7",
        f"lost:lidar1/points@{at[6]}+2",
        f"lost:lidar1/imu@{at[7]}+11",
        f"clock@{at[8]}+5",
        f"clock@{at[9]}-5",
        f"lens:zoom@{at[10]}+1.5",
        f"lens:focus@{at[11]}+1.5",
        f"stall:cam1@{at[12]}+2",
        f"disk@{at[13]}",
    ]


def recording(seconds: float, folder: Path, fast: bool, with_faults: bool) -> int:
    """Record, prove and tell; how many problems there were."""
    rig = RigFile(
        cameras={"cam1": CameraPart()}, lidars={"lidar1": LidarPart()}, storage=Storage(reserve_gb=0.5)
    )
    faults = tuple(parse_fault(text, rig) for text in (faults_of(seconds) if with_faults else []))
    session = Session(rig, folder, SessionOptions(simulate=True, fast=fast, faults=faults))
    session.preflight()
    begun, used = time.perf_counter(), time.process_time()
    manifest = session.record(seconds + with_faults)  # a full disk ends it before
    took, used = time.perf_counter() - begun, time.process_time() - used
    sources = session.equipment.sources
    problems = problems_of(folder, rig, sources, faults, DECODE_EVERY) + unexplained(manifest, faults)
    lasted = ((manifest.ended_ns or 0) - manifest.started_ns) * 1e-9
    size = sum(segment.n_bytes for segment in manifest.segments)
    clock = "compressed" if fast else "real"
    print(f"{lasted:.1f} s on a {clock} clock, {len(faults)} faults")
    print(f"  took {took:.1f} s ({lasted / took:.2f} times real time), processor {used / took:.2f} cores")
    print(f"  {size / 1e9:.2f} GB, {size / lasted / 1e6:.1f} MB/s, {len(manifest.segments)} files")
    for stream in manifest.streams:
        print(
            f"  {stream.name}: {stream.received} received, {stream.written} written, {stream.dropped} dropped"
        )
    told = sum(event.kind not in ("started", "stopped") for event in manifest.events)
    print(f"  events expected {len(expected_events(rig, sources, faults))}, told {told}")
    print(f"  problems: {len(problems)}")
    for problem in problems[:20]:
        print(f"    {problem}")
    return len(problems)


def kills(n: int, folder: Path, seed: int) -> int:
    """Kill recorders and tell what was left; how many were not as they must be."""
    rng = np.random.default_rng(seed)
    found = []
    while len(found) < n:
        delays = rng.uniform(0, LONGEST_S, min(AT_ONCE, n - len(found))).tolist()
        found += list(kill_recorders(folder, delays))
    judged = [left for left in found if any(left.expected.values())]
    print(f"{n} kills from {min(f.after_s for f in found):.2f} to {max(f.after_s for f in found):.2f} s")
    print(f"  {len(judged)} of them after more than a second, with something to hold")
    print(f"  least share of what was written a second before: {min(f.share for f in judged):.3f}")
    bad = [left for left in found if left.problems]
    print(f"  with problems: {len(bad)}")
    for left in bad[:10]:
        print(f"    after {left.after_s:.2f} s: {'; '.join(left.problems)}")
    return len(bad)


def main() -> None:
    """Run what was asked for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=10.0, help="of the compressed recording")
    parser.add_argument("--real", type=float, default=0.0, help="minutes of one on the real clock, no faults")
    parser.add_argument("--kills", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--folder", type=Path, default=None, help="on the disk to be tried; emptied afterwards"
    )
    options = parser.parse_args()
    folder = Path(tempfile.mkdtemp(prefix="bench-recorder-", dir=options.folder))
    bad = 0
    try:
        if options.minutes:
            bad += recording(60 * options.minutes, folder / "fast", True, True)
            shutil.rmtree(folder / "fast")
        if options.real:
            bad += recording(60 * options.real, folder / "real", False, False)
            shutil.rmtree(folder / "real")
        if options.kills:
            bad += kills(options.kills, folder, options.seed)
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    raise SystemExit(1 if bad else 0)


if __name__ == "__main__":
    main()
