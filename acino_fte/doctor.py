"""Does this computer have what a run, a lidar or a rig needs? One finding for every part of it.

:func:`examine` looks at everything and gives findings, each with what was found and, where something is
wrong, a sentence that says what to do. No check can stop the others: an exception in one becomes its finding,
and what may crash, or never answer, is tried in a process of its own (:mod:`acino_fte.doctor_ask`). This
module and the checks import the standard library only, so that they also work where NumPy does not.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

from acino_fte.doctor_ask import Answer, asked

FORMAT = "acino-fte/doctor/1"
State = Literal["ok", "note", "failed"]
PURPOSES = ("run", "lidar", "rig")
RUN, LIDAR, RIG = (frozenset({purpose}) for purpose in PURPOSES)
ALL = frozenset(PURPOSES)


@dataclass(frozen=True)
class Finding:
    """What a check found.

    Attributes
    ----------
    state : {"ok", "note", "failed"}
        A note is worth reading, but nothing fails for it.
    found : str
        One line.
    remedy : str
        What to do; empty where all is well.
    matters : frozenset of str
        Purposes that need it: ``run``, ``lidar``, ``rig``. Where it is empty, a failure only costs what it
        names.
    details : dict
        Numbers and names, for programs.
    name, title : str
        Of the check.
    seconds : float
        That it took.
    """

    state: State
    found: str
    remedy: str = ""
    matters: frozenset[str] = frozenset()
    details: dict[str, Any] = field(default_factory=dict)
    name: str = ""
    title: str = ""
    seconds: float = 0.0

    def concerns(self, purpose: str) -> bool:
        """Whether the purpose has to do with it."""
        return not self.matters or purpose in self.matters

    def stops(self, purpose: str) -> bool:
        """Whether the purpose fails for it."""
        return self.state == "failed" and purpose in self.matters


@dataclass(frozen=True)
class Surroundings:
    """Where checks look.

    Attributes
    ----------
    path : Path
        Folder whose disk is tried.
    root : Path
        Of the file system: ``/proc``, ``/sys`` and ``/dev`` are looked up in it.
    answers : Mapping
        Of the probes, by name; see :mod:`acino_fte.doctor_ask`.
    """

    path: Path
    root: Path = Path("/")
    answers: Mapping[str, Answer] = field(default_factory=dict)


@dataclass(frozen=True)
class Check:
    """One check: its name, its title, who needs it, and what looks."""

    name: str
    title: str
    matters: frozenset[str]
    look: Callable[[Surroundings], Finding]


def all_checks() -> tuple[Check, ...]:
    """Every check, in the order of the screen: what has its answer at once comes first."""
    from acino_fte import doctor_devices as devices
    from acino_fte import doctor_machine as machine
    from acino_fte import doctor_packages as packages
    from acino_fte import doctor_solver as solver
    from acino_fte import doctor_storage as storage

    return (
        Check("disk", "disk", ALL, storage.look_at_disk),
        Check("memory", "memory", ALL, machine.look_at_memory),
        Check("processor", "processor", frozenset(), machine.look_at_processor),
        Check("clock", "clock", RIG, machine.look_at_clock),
        Check("cache", "cache", frozenset(), storage.look_at_cache),
        Check("page", "local pages", LIDAR, devices.look_at_page),
        Check("serial", "serial ports", RIG, devices.look_at_serial),
        Check("gpio", "GPIO", RIG, devices.look_at_gpio),
        Check("devices", "rig devices", RIG, devices.look_at_devices),
        Check("codecs", "video", LIDAR | RIG, devices.look_at_codecs),
        Check("ipopt", "IPOPT", RUN | LIDAR, solver.look_at_ipopt),
        Check("threads", "BLAS threads", frozenset(), solver.look_at_threads),
        Check("packages", "packages", ALL, packages.look_at_core),
        Check("colmap", "extra colmap", frozenset(), packages.look_at_colmap),
        Check("lidar", "extra lidar", LIDAR, packages.look_at_lidar),
        Check("rig", "extra rig", RIG, packages.look_at_rig),
        Check("explicit", "explicit model", frozenset(), solver.look_at_explicit),
    )


def examine(path: Path, root: Path = Path("/"), checks: Sequence[Check] | None = None) -> Iterator[Finding]:
    """Look at everything, which takes a few seconds; findings come as they are found.

    Parameters
    ----------
    path : Path
        Folder whose disk is tried: a temporary file of at most 64 MiB, gone afterwards.
    root : Path
        Of the file system.
    checks : sequence of Check, optional
        By default all.
    """
    with asked() as answers:
        around = Surroundings(path, root, answers)
        for check in checks if checks is not None else all_checks():
            yield looked(check, around)


def looked(check: Check, around: Surroundings) -> Finding:
    """What a check finds; a check that breaks is a finding too."""
    begun = time.perf_counter()
    try:
        finding = check.look(around)
    except Exception as error:  # noqa: BLE001 - one broken check must not stop the others
        finding = Finding(
            "failed",
            f"the check itself broke: {type(error).__name__}: {error}",
            "please report this line as a fault of acino-fte",
            check.matters,
        )
    return replace(finding, name=check.name, title=check.title, seconds=time.perf_counter() - begun)


def ready(findings: Sequence[Finding]) -> dict[str, bool]:
    """Whether each purpose has all that it needs."""
    return {purpose: not any(f.stops(purpose) for f in findings) for purpose in PURPOSES}


def as_json(findings: Sequence[Finding], purpose: str) -> dict[str, Any]:
    """What ``acino-fte doctor --json`` prints."""
    able = ready(findings)
    return {
        "format": FORMAT,
        "for": purpose,
        "works": able[purpose],
        "ready": able,
        "checks": [
            {
                "name": f.name,
                "state": f.state,
                "found": f.found,
                "remedy": f.remedy,
                "matters_for": sorted(f.matters),
                "seconds": round(f.seconds, 3),
                "details": f.details,
            }
            for f in findings
        ],
    }
