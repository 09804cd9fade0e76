"""Quadrature edges at 100 kHz, decoded: how many times faster than they come.

Run: python benchmarks/bench_quadrature.py [--seconds 10]
Prints the ratio of the shaft's time to the decoder's, whole and in chunks of 20 ms (as ``acino-fte rig
drive`` reads them), without and with the bounce filter, and the same for sampled levels at 1 MHz. It must
reach 10 with edges.
"""

import argparse
import time

import numpy as np

from acino_fte.rig.quadrature import EdgeDecoder, Edges, SampleDecoder, edges_of

RATE = 100_000  # edges a second
SAMPLED = 1_000_000  # samples a second
CHUNK_S = 0.02


def shaft(seconds: float) -> tuple[np.ndarray, np.ndarray]:
    """Counts of a shaft that turns to and fro, and their times in ns."""
    rng = np.random.default_rng(0)
    n = round(seconds * RATE)
    runs = rng.geometric(0.001, n // 500 + 10)
    steps = np.repeat(rng.choice([-1, 1], len(runs)), runs)[:n]
    return np.cumsum(steps), np.arange(1, len(steps) + 1) * (1_000_000_000 // RATE)


def decode(edges: Edges, levels: tuple[int, int], cuts: list[int], min_pulse_ns: int) -> tuple[int, float]:
    """The last position, and the seconds that it took."""
    start = time.perf_counter()
    decoder = EdgeDecoder(levels, min_pulse_ns=min_pulse_ns)
    for i, j in zip(cuts, [*cuts[1:], len(edges.time_ns)], strict=True):
        decoder.feed(Edges(edges.time_ns[i:j], edges.line[i:j], edges.level[i:j]))
    decoder.flush()
    return decoder.position, time.perf_counter() - start


def main() -> None:
    """Simulate, decode, print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seconds", type=float, default=10.0)
    seconds = parser.parse_args().seconds
    position, when = shaft(seconds)
    edges, levels = edges_of(position, when)
    chunked = list(range(0, len(when), round(CHUNK_S * RATE)))
    worst = np.inf
    for name, cuts in (("whole array", [0]), ("chunks of 20 ms", chunked)):
        for min_pulse in (0, 4_000):
            last, took = decode(edges, levels, cuts, min_pulse)
            assert last == position[-1]
            ratio = seconds / took
            worst = min(worst, ratio)
            print(f"edges at 100 kHz, {name:<15} filter {min_pulse:>5} ns: {ratio:8.1f} x real time")
    held = np.repeat(position, SAMPLED // RATE) & 3
    a, b = (held & 1) ^ (held >> 1), held >> 1
    for name, length in (("whole array", len(a)), ("chunks of 20 ms", round(CHUNK_S * SAMPLED))):
        start = time.perf_counter()
        sampled = SampleDecoder(position=int(position[0]))
        for i in range(0, len(a), length):
            sampled.feed(a[i : i + length], b[i : i + length])
        sampled.flush()
        assert sampled.position == position[-1]
        ratio = seconds / (time.perf_counter() - start)
        print(f"levels at 1 MHz,  {name:<15}                 : {ratio:8.1f} x real time")
    print(f"edges at 100 kHz, worst: {worst:.1f} x real time; must reach 10")


if __name__ == "__main__":
    main()
