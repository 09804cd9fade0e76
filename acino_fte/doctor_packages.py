"""Packages: are those that everything needs here, and those of each extra, new enough and not broken?"""

from __future__ import annotations

import platform
import re
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import metadata
from importlib.util import find_spec

from acino_fte import __version__
from acino_fte.doctor import ALL, LIDAR, RIG, Finding, Surroundings

PYTHON = (3, 11), (3, 14)  # from, and before


@dataclass(frozen=True)
class Package:
    """A package of pyproject.toml.

    Attributes
    ----------
    name : str
        In the package index.
    module : str
        By which it is imported.
    least : str
        The oldest version that will do; empty for any.
    system : str
        ``platform.system()`` that it is for; empty for all.
    or_else : tuple of str
        Other packages that bring the same module.
    """

    name: str
    module: str
    least: str = ""
    system: str = ""
    or_else: tuple[str, ...] = ()


CORE = (
    Package("numpy", "numpy", "1.26"),
    Package("scipy", "scipy", "1.11"),
    Package("sympy", "sympy", "1.12"),
    Package("pandas", "pandas", "2.1"),
    Package("xarray", "xarray", "2024.1"),
    Package("h5netcdf", "h5netcdf", "1.3"),
    Package("h5py", "h5py", "3.10"),
    Package("pyomo", "pyomo", "6.7"),
    Package("cyipopt-wheels", "cyipopt", "1.7.0.dev0", or_else=("cyipopt",)),
    Package("casadi", "casadi", "3.6.5"),
    Package("filterpy", "filterpy", "2.0"),
    Package("pydantic", "pydantic", "2.6"),
    Package("pyyaml", "yaml", "6.0"),
    Package("typer", "typer", "0.12"),
    Package("rich", "rich", "13.7"),
    Package("matplotlib", "matplotlib", "3.8"),
    Package("plyfile", "plyfile", "1.0"),
)
_BAGS = (
    Package("rosbags", "rosbags.highlevel", "0.10"),
    Package("mcap", "mcap", "1.2"),
    Package("av", "av", "13"),
)
EXTRAS = {
    "colmap": (Package("pycolmap", "pycolmap", "3.12"),),
    "lidar": (
        *_BAGS,
        Package("pypcd4", "pypcd4", "1.3"),
        Package("nicegui", "nicegui", "3.10"),
        Package("opencv-python-headless", "cv2", "4.9", or_else=("opencv-python", "opencv-contrib-python")),
    ),
    "rig": (
        *_BAGS,
        Package("pyserial", "serial", "3.5"),
        Package("gpiozero", "gpiozero", "2.0"),
        Package("gpiod", "gpiod", "2.1", system="Linux"),
    ),
}
_SHOWN = ("numpy", "scipy", "pyomo", "cyipopt-wheels")


def look_at_core(around: Surroundings) -> Finding:
    """Python and the packages that everything needs."""
    python = platform.python_version()
    versions, faults = _examine(CORE, around)
    shown = [f"{name.removesuffix('-wheels')} {versions[name]}" for name in _SHOWN if name in versions]
    remedy = "pip install --upgrade acino-fte"
    if not PYTHON[0] <= sys.version_info[:2] < PYTHON[1]:
        faults.insert(0, f"Python {python} is not supported")
        remedy = "make an environment with Python 3.11, 3.12 or 3.13 and install acino-fte there"
    details = {"acino_fte": __version__, "python": python, "versions": versions, "faults": faults}
    head = f"acino-fte {__version__}, Python {python}"
    if faults:
        return Finding("failed", f"{head}; {'; '.join(faults)}", remedy, ALL, details)
    return Finding("ok", ", ".join([head, *shown]), matters=ALL, details=details)


def look_at_lidar(around: Surroundings) -> Finding:
    """The extra ``lidar``: recordings, clouds, videos, pages in the browser."""
    return _look_at_extra("lidar", LIDAR, around)


def look_at_rig(around: Surroundings) -> Finding:
    """The extra ``rig``: recordings, videos, serial ports, GPIO."""
    return _look_at_extra("rig", RIG, around)


def look_at_colmap(around: Surroundings) -> Finding:
    """The extra ``colmap``: for `acino-fte scene` on a COLMAP model; no purpose of the three needs it."""
    return _look_at_extra("colmap", frozenset(), around)


def _look_at_extra(extra: str, matters: frozenset[str], around: Surroundings) -> Finding:
    packages = [p for p in EXTRAS[extra] if not p.system or p.system == platform.system()]
    versions, faults = _examine(packages, around)
    present = [f"{name} {version}" for name, version in versions.items()]
    details = {"versions": versions, "faults": faults}
    if not faults:
        return Finding("ok", ", ".join(present), matters=matters, details=details)
    if not versions:
        return Finding("failed", "not installed", f'pip install "acino-fte[{extra}]"', matters, details)
    broken = any(" is broken: " in fault for fault in faults)
    again = "--force-reinstall " if broken else "--upgrade "
    return Finding("failed", "; ".join(faults), f'pip install {again}"acino-fte[{extra}]"', matters, details)


def _examine(packages: Sequence[Package], around: Surroundings) -> tuple[dict[str, str], list[str]]:
    """Versions of the packages that are here, and what is wrong with any."""
    versions, faults = {}, []
    for package in packages:
        version = _version(package)
        if version is None:
            faults.append(f"{package.name} is missing")
            continue
        versions[package.name] = version
        probe = f"import:{package.module}"
        if version and _older(version, package.least):
            faults.append(f"{package.name} {version} is older than {package.least}")
        elif probe in around.answers and (fault := around.answers[probe].fault):
            faults.append(f"{package.name} {version} is broken: {fault}")
    return versions, faults


def _version(package: Package) -> str | None:
    """Of an installed package; empty where nothing tells, None where it is missing."""
    for name in (package.name, *package.or_else):
        try:
            return metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    try:
        return "" if find_spec(package.module.partition(".")[0]) else None
    except (ImportError, ValueError):
        return None


def _older(version: str, least: str) -> bool:
    """Whether a version comes before another, by their numbers; what is behind the numbers does not count."""
    return _numbers(version) < _numbers(least)


def _numbers(version: str) -> tuple[int, ...]:
    match = re.match(r"\d+(?:\.\d+)*", version)
    return tuple(int(n) for n in match[0].split(".")) if match else ()
