"""Bags of 1 GB: peak memory and speed of reading, each in a process of its own.

Run: python benchmarks/bench_bags.py [--megabytes 1000] [--cut]
Prints, of every format, the peak resident memory against the bound of 300 MiB, the memory of a process that
only imports the reader, and the speed; ``rosbags`` reads the same bag beside it, undecoded.
"""

import argparse
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from acino_fte.data_tools.bags_serial import CDR, ROS1, definitions, encode
from acino_fte.data_tools.bags_write import BagWriter
from acino_fte.data_tools.recording import ImuSamples, LidarReturns
from acino_fte.data_tools.ros_messages import to_message

BOUND = 300.0  # MiB
START = 1_700_000_000_000_000_000
FORMS = {
    "ros1": {"version": 1},
    "ros1 lz4": {"version": 1, "compression": "lz4"},
    "db3": {"version": 2},
    "mcap": {"version": 2, "storage": "mcap"},
    "mcap zstd": {"version": 2, "storage": "mcap", "compression": "zstd"},
}
CHILD = """
import json, resource, sys, time
from acino_fte.data_tools.open_recording import open_recording
import rosbags.highlevel, cv2
base = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
start, n, kinds = time.perf_counter(), 0, {}
if sys.argv[2] == "acino":
    with open_recording(sys.argv[1]) as reader:
        reader.streams
        for record in reader.records():
            n += 1
        whole = reader.damage.whole
else:
    from pathlib import Path
    with rosbags.highlevel.AnyReader([Path(sys.argv[1])]) as reader:
        n, whole = sum(1 for _ in reader.messages()), True
peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
print(json.dumps({"n": n, "peak": peak, "base": base, "s": time.perf_counter() - start, "whole": whole}))
"""


def write(path: Path, megabytes: int, options: dict) -> None:
    """A rig's bag: a lidar at 10 Hz (24 000 returns), its sensor at 200 Hz, and images of 2 MB at 30 Hz."""
    rng = np.random.default_rng(0)
    k = 24_000
    zeros = np.zeros(k, np.uint8)
    times = START + np.arange(k) * 4167
    returns = LidarReturns(times, rng.normal(0, 30, (k, 3)), rng.uniform(0, 150, k), zeros, zeros)
    sample = ImuSamples(np.array([START]), np.zeros((1, 3)), np.array([[0.0, 0.0, 1.0]]))
    version = options["version"]
    layout = ROS1 if version == 1 else CDR
    raw = {}
    for topic, value in (("/livox/lidar", returns), ("/livox/imu", sample)):
        name, message = to_message(value, "livox_frame")
        raw[topic] = (name, encode(message, name, definitions(name, "", version), layout))
    image = ("std_msgs/msg/UInt8MultiArray", rng.integers(0, 256, 2_000_000).astype(np.uint8).tobytes())
    written, tick = 0, 0
    with BagWriter(path, **options) as bag:
        while written < megabytes * 1_000_000:
            now = START + tick * 5_000_000
            due = [("/livox/imu", raw["/livox/imu"])]
            due += [("/livox/lidar", raw["/livox/lidar"])] if tick % 20 == 0 else []
            due += [("/image", image)] if tick % 7 == 0 else []
            for topic, (name, data) in due:
                bag.write_raw(topic, name, data, now)
                written += len(data)
            tick += 1


def measure(path: Path, which: str) -> dict:
    """What a fresh process that reads the bag needs."""
    out = subprocess.run(
        [sys.executable, "-c", CHILD, str(path), which], capture_output=True, text=True, check=True
    )
    return json.loads(out.stdout.splitlines()[-1])


def main() -> None:
    """Write, read, print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--megabytes", type=int, default=1000)
    parser.add_argument("--cut", action="store_true", help="cut the last hundredth off each file")
    parser.add_argument("--only", choices=list(FORMS))
    args = parser.parse_args()
    heads = ("MB", "messages", "peak MiB", "/ 300", "MB/s")
    print(f"{'format':12s}" + "".join(f"{head:>10s}" for head in heads) + f"{'rosbags':>20s}")
    for name, options in FORMS.items():
        if args.only not in (None, name):
            continue
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / ("bag.bag" if options["version"] == 1 else "bag")
            start = time.perf_counter()
            write(path, args.megabytes, options)
            wrote = time.perf_counter() - start
            files = [path] if path.is_file() else [f for f in path.iterdir() if f.suffix != ".yaml"]
            size = sum(f.stat().st_size for f in files) / 1e6
            if args.cut:
                for file in files:
                    with file.open("r+b") as opened:
                        opened.truncate(int(file.stat().st_size * 0.99))
            ours = measure(path, "acino")
            theirs = None if args.cut else measure(path, "rosbags")
            beside = f"{theirs['peak']:.0f} MiB, {size / theirs['s']:.0f} MB/s" if theirs else "refuses"
            numbers = (size, ours["n"], ours["peak"], ours["peak"] / BOUND, size / ours["s"])
            row = "".join(f"{x:10.2f}" if x < 10 else f"{x:10.0f}" for x in numbers)
            notes = f"import {ours['base']:.0f} MiB, whole {ours['whole']}, written in {wrote:.0f} s"
            print(f"{name:12s}{row}{beside:>20s}   ({notes})", flush=True)


if __name__ == "__main__":
    main()
