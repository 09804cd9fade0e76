"""The computer: memory, clocks, processor. Where a system does not tell, that is said, and nothing fails."""

from __future__ import annotations

import ctypes
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from acino_fte.doctor import ALL, RIG, Finding, Surroundings

_GB = 1e9
_LEAST_GB, _GOOD_GB = 0.5, 2.0  # available memory: a run of the example takes 0.4 GB
_COARSE = 1e-4  # s; stamps should be finer than a tenth of a millisecond
_HOT = 85.0  # °C
_STA_UNSYNC, _TIME_ERROR = 0x40, 5  # of <sys/timex.h>


def look_at_memory(around: Surroundings) -> Finding:
    """Memory that is free for programs."""
    total, available = _memory(around.root)
    details = {"total_gb": _rounded(total), "available_gb": _rounded(available)}
    if total is None:
        return Finding("note", "this system does not tell", matters=ALL, details=details)
    if available is None:
        return Finding("ok", f"{total:.1f} GB", matters=ALL, details=details)
    text = f"{available:.1f} of {total:.1f} GB available"
    if available < _LEAST_GB:
        return Finding(
            "failed", text, "close other programs; a run needs half a gigabyte or more", ALL, details
        )
    if available < _GOOD_GB:
        return Finding("note", text, "close other programs before long runs and recordings", ALL, details)
    return Finding("ok", text, matters=ALL, details=details)


def _rounded(value: float | None) -> float | None:
    return None if value is None else round(value, 2)


def _memory(root: Path) -> tuple[float | None, float | None]:
    """Total and available, GB."""
    with suppress(OSError, ValueError, IndexError, KeyError):
        lines = (root / "proc/meminfo").read_text(encoding="ascii", errors="replace").splitlines()
        kilobytes = {line.split(":")[0]: float(line.split()[1]) for line in lines if ":" in line}
        return kilobytes["MemTotal"] * 1024 / _GB, kilobytes["MemAvailable"] * 1024 / _GB
    with suppress(OSError, ValueError, AttributeError):
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") / _GB, None
    return None, None


def look_at_clock(around: Surroundings) -> Finding:
    """Is the wall clock right and synchronised, and is the monotonic one fine enough for stamps?"""
    info = time.get_clock_info("monotonic")
    step = monotonic_step()
    synchronised = is_synchronised()
    installed = newest_file(Path(__file__).parent)
    now = time.time()
    details = {
        "utc": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime(now)),
        "synchronised": synchronised,
        "monotonic_resolution_s": info.resolution,
        "monotonic_step_s": step,
    }
    told = {True: "synchronised", False: "not synchronised", None: "synchronised or not, nothing here tells"}
    text = f"{details['utc']}, {told[synchronised]}, monotonic to {_duration(max(step, info.resolution))}"
    if now < installed - 86400.0:
        return Finding(
            "failed",
            f"{text}: earlier than this program's own files",
            'set it, as sudo date -u -s "YYYY-MM-DD HH:MM:SS"; is the battery of the clock empty?',
            RIG,
            details,
        )
    if not info.monotonic or max(step, info.resolution) > _COARSE:
        remedy = "stamps will be coarse: record on another computer, or use the devices' own stamps"
        return Finding("failed", text, remedy, RIG, details)
    if synchronised is False:
        remedy = (
            "connect to a network or a GPS receiver once before the trip; stamps within a recording are right"
        )
        return Finding("note", text, remedy, RIG, details)
    return Finding("ok", text, matters=RIG, details=details)


def monotonic_step() -> float:
    """The smallest step of the monotonic clock that is seen, s."""
    steps: list[int] = []
    begun = time.perf_counter()
    while len(steps) < 20 and time.perf_counter() - begun < 0.1:
        first = last = time.monotonic_ns()
        while last == first and time.perf_counter() - begun < 0.1:
            last = time.monotonic_ns()
        if last > first:
            steps.append(last - first)
    return min(steps) * 1e-9 if steps else 0.1


def newest_file(folder: Path) -> float:
    """When the newest Python file of a folder was written, s since 1970; 0 where nothing tells."""
    with suppress(OSError):
        return max((p.stat().st_mtime for p in folder.glob("*.py")), default=0.0)
    return 0.0


def is_synchronised() -> bool | None:
    """Whether the system holds its wall clock to be synchronised; None where nothing tells."""
    ways: tuple[Callable[[], bool | None], ...] = (_by_adjtimex, _by_timedatectl)
    for way in ways:
        with suppress(OSError, ValueError, AttributeError, subprocess.SubprocessError):
            told = way()
            if told is not None:
                return told
    return None


class _Timex(ctypes.Structure):
    """The head of ``struct timex`` on systems with 64 bits; `rest` is longer than what follows."""

    _fields_ = (
        ("modes", ctypes.c_uint),
        ("offset", ctypes.c_long),
        ("freq", ctypes.c_long),
        ("maxerror", ctypes.c_long),
        ("esterror", ctypes.c_long),
        ("status", ctypes.c_int),
        ("rest", ctypes.c_char * 512),
    )


def _by_adjtimex() -> bool | None:
    """Ask the kernel; with modes = 0 nothing is changed."""
    if not sys.platform.startswith("linux") or ctypes.sizeof(ctypes.c_long) != 8:
        return None
    timex = _Timex()
    state = ctypes.CDLL(None, use_errno=True).adjtimex(ctypes.byref(timex))
    return None if state < 0 else state != _TIME_ERROR and not timex.status & _STA_UNSYNC


def _by_timedatectl() -> bool | None:
    program = shutil.which("timedatectl")
    if program is None:
        return None
    command = [program, "show", "--property=NTPSynchronized", "--value"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=1.0, check=False)
    return {"yes": True, "no": False}.get(done.stdout.strip())


def _duration(seconds: float) -> str:
    return f"{1e9 * seconds:.0f} ns" if seconds < 1e-6 else f"{1e6 * seconds:.0f} µs"


def look_at_processor(around: Surroundings) -> Finding:
    """Processors, and what may slow them down: governor, heat, throttling."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    cpus = around.root / "sys/devices/system/cpu"
    governors = sorted(set(_texts(cpus, "cpu[0-9]*/cpufreq/scaling_governor")))
    throttled = sum(
        int(t) for t in _texts(cpus, "cpu[0-9]*/thermal_throttle/core_throttle_count") if t.isdigit()
    )
    heat = [
        int(t) / 1000.0 for t in _texts(around.root / "sys/class/thermal", "thermal_zone*/temp") if _whole(t)
    ]
    hottest = max((t for t in heat if t < 150.0), default=None)
    details = {"cores": cores, "governors": governors, "throttled": throttled, "hottest_c": hottest}
    text = f"{cores} processors"
    text += f", governor {', '.join(governors)}" if governors else ""
    text += f", hottest {hottest:.0f} °C" if hottest is not None else ""
    if hottest is not None and hottest >= _HOT:
        return Finding(
            "note",
            text,
            "give it air and shade: it slows down to cool, and pictures are lost",
            details=details,
        )
    if throttled:
        text += f", slowed down by heat {throttled} times since it was switched on"
        return Finding("note", text, "give it air and shade before a recording", details=details)
    if "powersave" in governors:
        remedy = "for a recording: sudo cpupower frequency-set -g performance (Jetson: sudo jetson_clocks)"
        return Finding("note", text, remedy, details=details)
    return Finding("ok", text, details=details)


def _whole(text: str) -> bool:
    return text.removeprefix("-").isdigit()


def _texts(folder: Path, pattern: str) -> list[str]:
    """Contents of the small files of a pattern that can be read."""
    texts = []
    for path in sorted(folder.glob(pattern)):
        with suppress(OSError, UnicodeDecodeError):
            texts.append(path.read_text(encoding="ascii").strip())
    return texts
