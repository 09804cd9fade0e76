"""Probes in processes of their own: a package that crashes, or never answers, loses only its own answer.

A worker goes through its probes and writes a line for each (:mod:`acino_fte.doctor_probe`). When it dies, or
is silent for too long, the probe under way has no answer, and another worker goes on with the next.
"""

from __future__ import annotations

import json
import queue
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from typing import Any

PATIENCE = 20.0  # s for one probe; a large package on a cold, slow card, or a busy computer, takes several
WORKERS = (  # side by side; those that import the same in one
    ("import:numpy", "import:scipy", "ipopt", "threads", "explicit", "import:pyomo", "import:casadi"),
    (
        *("devices", "import:pandas", "import:xarray", "import:h5netcdf", "import:matplotlib"),
        *("import:pypcd4", "import:cv2", "import:pycolmap"),
    ),
    (
        *("serial", "gpio", "codecs", "import:nicegui", "import:rosbags.highlevel", "import:mcap"),
        *("import:av", "import:serial", "import:gpiozero", "import:gpiod"),
    ),
)
_START = (
    "import sys, json; sys.path[:] = json.loads(sys.argv[1]); from acino_fte.doctor_probe import main; main()"
)


@dataclass(frozen=True)
class Answer:
    """Of a probe: what it found, or in `fault` why there is nothing."""

    value: dict[str, Any] = field(default_factory=dict)
    fault: str = ""


class Answers(Mapping[str, Answer]):
    """Answers by the name of the probe; asking for one waits until it is there."""

    def __init__(self, waiting: Mapping[str, Future[Answer]]) -> None:
        self._waiting = waiting

    def __getitem__(self, name: str) -> Answer:
        return self._waiting[name].result()

    def __iter__(self) -> Iterator[str]:
        return iter(self._waiting)

    def __len__(self) -> int:
        return len(self._waiting)


@contextmanager
def asked(workers: Sequence[Sequence[str]] = WORKERS, patience: float = PATIENCE) -> Iterator[Answers]:
    """Have all probes tried in the background, and give their answers as they come."""
    waiting: dict[str, Future[Answer]] = {name: Future() for names in workers for name in names}
    with ThreadPoolExecutor(max(1, len(workers))) as pool:
        for names in workers:
            pool.submit(_work, names, waiting, patience)
        yield Answers(waiting)


def _work(names: Sequence[str], waiting: Mapping[str, Future[Answer]], patience: float) -> None:
    fault = "cannot be tried"
    try:
        done = 0
        while done < len(names):
            done += _one_worker(names[done:], waiting, patience)
    except (OSError, ValueError, LookupError, TypeError) as error:  # no process, or not its own words
        fault += f": {error}"
    finally:
        for name in names:
            if not waiting[name].done():
                waiting[name].set_result(Answer(fault=fault))


def _one_worker(names: Sequence[str], waiting: Mapping[str, Future[Answer]], patience: float) -> int:
    """Let one process go through the probes; returns how many have an answer then, at least one."""
    command = [sys.executable, "-P", "-c", _START, json.dumps(sys.path), *names]
    with subprocess.Popen(
        command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL
    ) as process:
        lines: queue.SimpleQueue[bytes] = queue.SimpleQueue()
        threading.Thread(target=_read, args=(process.stdout, lines), daemon=True).start()
        try:
            for done, name in enumerate(names, 1):
                line = _next(lines, patience)
                if not line:
                    silent = f"no answer within {patience:g} s"
                    waiting[name].set_result(
                        Answer(fault=silent if line is None else _ending(process.wait()))
                    )
                    return done
                content = json.loads(line)
                waiting[name].set_result(Answer(content["value"], content["fault"]))
        finally:
            process.kill()  # nothing is left that it should do
    return len(names)


def _read(pipe: Any, lines: queue.SimpleQueue[bytes]) -> None:
    with suppress(ValueError, OSError):  # closed meanwhile
        for line in pipe:
            lines.put(line)
    lines.put(b"")


def _next(lines: queue.SimpleQueue[bytes], patience: float) -> bytes | None:
    """The next line, empty at the end; None when it takes too long."""
    try:
        return lines.get(timeout=patience)
    except queue.Empty:
        return None


def _ending(code: int) -> str:
    """What an exit code of a process that should not have ended says."""
    if code >= 0:
        return f"the program ended (exit code {code})"
    try:
        return f"crashed ({signal.Signals(-code).name})"
    except ValueError:
        return f"crashed (signal {-code})"
