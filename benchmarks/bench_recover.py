"""Rescue of recordings cut at 200 places, and its speed.

Run: python benchmarks/bench_recover.py [--megabytes 200]
Prints, of every format, how many of the whole messages before each of 200 cuts are in the copies, as readers
that others wrote count them (it must be all of them); then how fast a large bag of each is rescued, against
copying its bytes.
"""

import argparse
import shutil
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests"))
from recover_made import BAGS, LVXS, cuts, make, messages_before, read_standard  # noqa: E402

from acino_fte.data_tools.bags_write import BagWriter  # noqa: E402
from acino_fte.errors import InputError  # noqa: E402
from acino_fte.rig.recover import recover  # noqa: E402

START = 1_700_000_000_000_000_000
LARGE = {
    "ros1": {"version": 1},
    "ros1-lz4": {"version": 1, "compression": "lz4"},
    "mcap": {"version": 2, "storage": "mcap"},
    "mcap-zstd": {"version": 2, "storage": "mcap", "compression": "zstd"},
    "db3": {"version": 2},
}


def cut_everywhere(form: str, folder: Path) -> str:
    """One line: what was saved of what was whole at 200 cuts."""
    folder.mkdir()
    path, needed = make(folder, form)
    data, everything = path.read_bytes(), read_standard(path, form)
    cut, copy = folder / f"cut{path.suffix}", folder / f"copy{path.suffix}"
    whole = saved = more = short = wrong = 0
    for length in cuts(len(data)):
        cut.write_bytes(data[:length])
        before = messages_before(needed, length)
        try:
            recover(cut, copy)
            found = read_standard(copy, form)
            copy.unlink()
            copy.with_name(f"{copy.name}.recovery.json").unlink()
        except InputError:
            found = []
        whole, saved = whole + before, saved + min(len(found), before)
        more += max(len(found) - before, 0)
        short += len(found) < before
        wrong += found != everything[: len(found)]
    return (
        f"{form:<10} {len(data) / 1e3:5.0f} kB   {saved} of {whole} whole messages saved, {more} more of cut "
        f"chunks, {short} cuts with less, {wrong} with other messages"
    )


def speed(form: str, megabytes: float, folder: Path) -> str:
    """One line: time to rescue a bag without its last tenth, and to copy it."""
    path, noise = folder / "large", np.random.default_rng(1).integers(0, 16, 45_000).astype("u1").tobytes()
    with BagWriter(path, **LARGE[form]) as bag:
        for n in range(int(megabytes * 1e6 / len(noise))):
            bag.write_raw("/lidar", "std_msgs/msg/UInt8MultiArray", noise, START + n * 10_000_000)
    file = next(path.glob("*.[dm]*")) if path.is_dir() else path
    suffix = ".bag" if form.startswith("ros1") else file.suffix
    damaged, copy = folder / f"damaged{suffix}", folder / f"copy{suffix}"
    shutil.copyfile(file, damaged)
    with damaged.open("r+b") as handle:
        handle.truncate(int(damaged.stat().st_size * 0.9))
    start = time.perf_counter()
    shutil.copyfile(damaged, copy)
    plain = time.perf_counter() - start
    copy.unlink()
    start = time.perf_counter()
    found = recover(damaged, copy)
    took = time.perf_counter() - start
    size = found.saved * len(noise) / 1e6
    for used in (damaged, copy, copy.with_name(f"{copy.name}.recovery.json")):
        used.unlink()
    shutil.rmtree(path, ignore_errors=True)
    path.unlink(missing_ok=True)
    return (
        f"{form:<10} {size:5.0f} MB of messages, {size / took:5.0f} MB/s, {took / plain:.1f} × a plain copy"
    )


def main() -> None:
    """All formats, one line each."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--megabytes", type=float, default=200.0)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        for form in (*BAGS, *LVXS):
            print(cut_everywhere(form, Path(name) / form))
        for form in LARGE:
            print(speed(form, options.megabytes, Path(name)))


if __name__ == "__main__":
    main()
