"""The probes: run in a process of its own by :mod:`acino_fte.doctor_ask`, which says why.

A probe returns a dict of what it found. What it raises becomes its fault.
"""

from __future__ import annotations

import json
import math
import os
import sys
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

HARDWARE_H264 = ("h264_nvenc", "h264_v4l2m2m", "h264_vaapi", "h264_videotoolbox")
"""Those that the rig's recorder takes, the best first: NVIDIA, the Linux kernel, Intel and AMD, Apple."""
_HS71 = (1.0, 4.7429994, 3.8211503, 1.3794082)  # its solution: Hock & Schittkowski 1981, problem 71
_SIZE = (320, 240)  # px, of the pictures that encoders are tried with; hardware refuses very small ones


def main() -> None:
    """Try the probes named on the command line, one after the other; a line of JSON for each."""
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)  # what libraries print must not mix with the answers
    for name in sys.argv[2:]:
        value, fault = {}, ""
        try:
            value = probe(name)
        except Exception as error:  # noqa: BLE001 - whatever a broken package raises is the answer
            fault = f"{type(error).__name__}: {_first_line(error)}"
        answers.write(json.dumps({"value": value, "fault": fault}) + "\n")
        answers.flush()
    os._exit(0)  # leaving must not depend on what was loaded


def probe(name: str) -> dict[str, Any]:
    """Try one: ``import:PACKAGE``, or the name of a function below."""
    kind, _, package = name.partition(":")
    if kind == "import":
        return {"file": str(getattr(import_module(package), "__file__", ""))}
    return PROBES[name]()


def _first_line(error: BaseException) -> str:
    text = str(error).strip()
    return text.splitlines()[0] if text else "no message"


def ipopt() -> dict[str, Any]:
    """Solve Hock–Schittkowski 71 by cyipopt with MUMPS, as a run does."""
    import cyipopt
    import numpy as np

    solver = cyipopt.Problem(
        n=4,
        m=2,
        problem_obj=_HockSchittkowski71(),
        lb=[1.0] * 4,
        ub=[5.0] * 4,
        cl=[25.0, 40.0],
        cu=[2e19, 40.0],
    )
    for key, value in (("print_level", 0), ("sb", "yes"), ("linear_solver", "mumps"), ("max_wall_time", 5.0)):
        solver.add_option(key, value)
    x, info = solver.solve(np.array([1.0, 5.0, 5.0, 1.0]))
    return {
        "version": ".".join(str(n) for n in getattr(cyipopt, "IPOPT_VERSION", ())),
        "wrapper": str(cyipopt.__version__),
        "status": int(info["status"]),
        "message": info["status_msg"].decode()
        if isinstance(info["status_msg"], bytes)
        else str(info["status_msg"]),
        "error": float(np.abs(x - _HS71).max()),
    }


class _HockSchittkowski71:
    """min x0 x3 (x0 + x1 + x2) + x2, product ≥ 25, sum of squares = 40; first derivatives only."""

    def objective(self, x: Any) -> float:
        return float(x[0] * x[3] * (x[0] + x[1] + x[2]) + x[2])

    def gradient(self, x: Any) -> list[float]:
        total = x[0] + x[1] + x[2]
        return [x[3] * (x[0] + total), x[0] * x[3], x[0] * x[3] + 1.0, x[0] * total]

    def constraints(self, x: Any) -> list[float]:
        return [math.prod(x), sum(v * v for v in x)]

    def jacobian(self, x: Any) -> list[float]:
        return [math.prod(v for j, v in enumerate(x) if j != i) for i in range(4)] + [2.0 * v for v in x]


def explicit() -> dict[str, Any]:
    """Solve Hock–Schittkowski 71 as a Pyomo model, by the route that the explicit model takes here."""
    import pyomo.environ as pyo

    from acino_fte.explicit_solve import available_route

    model = pyo.ConcreteModel()
    model.x = pyo.Var(range(4), bounds=(1, 5), initialize={0: 1.0, 1: 5.0, 2: 5.0, 3: 1.0})
    x = model.x
    model.product = pyo.Constraint(expr=x[0] * x[1] * x[2] * x[3] >= 25)
    model.squares = pyo.Constraint(expr=sum(x[i] ** 2 for i in range(4)) == 40)
    model.cost = pyo.Objective(expr=x[0] * x[3] * (x[0] + x[1] + x[2]) + x[2])
    route = available_route()
    found = {"route": route, "file": ""}
    if route == "casadi":
        values = _by_casadi(model)
    else:
        solver = pyo.SolverFactory("ipopt" if route == "ipopt" else "cyipopt")
        found["file"] = str(solver.executable() or "") if route == "ipopt" else ""
        try:
            solver.solve(model)
        except Exception as error:
            raise RuntimeError(
                f"{found['file'] or route}: {type(error).__name__}: {_first_line(error)}"
            ) from error
        values = [pyo.value(x[i]) for i in range(4)]
    return found | {"error": max(abs(a - b) for a, b in zip(values, _HS71, strict=True))}


def _by_casadi(model: Any) -> list[float]:
    import casadi as ca
    import pyomo.environ as pyo

    from acino_fte.explicit_solve import PyomoToCasadi

    walk = PyomoToCasadi()
    bodies = [walk(model.product.body), walk(model.squares.body)]
    cost = walk(model.cost.expr)
    order = list(walk.variables.values())
    x = ca.vertcat(*[walk.symbols[id(v)] for v in order])
    settings: dict[str, Any] = {
        "ipopt.print_level": 0,
        "ipopt.sb": "yes",
        "print_time": False,
        "ipopt.linear_solver": "mumps",
    }
    solver = ca.nlpsol("doctor", "ipopt", {"x": x, "f": cost, "g": ca.vertcat(*bodies)}, settings)
    start = [pyo.value(v) for v in order]
    solution = solver(x0=start, lbx=1.0, ubx=5.0, lbg=[25.0, 40.0], ubg=[ca.inf, 40.0])["x"].full().ravel()
    by_name = {v.name: float(value) for v, value in zip(order, solution, strict=True)}
    return [by_name[f"x[{i}]"] for i in range(4)]


def threads() -> dict[str, Any]:
    """Which BLAS NumPy has, and how many threads it takes."""
    import numpy as np

    blas = np.show_config(mode="dicts")["Build Dependencies"]["blas"]  # type: ignore[index,call-overload,unused-ignore]
    return {"blas": blas.get("name", ""), "version": blas.get("version", ""), "threads": _openblas_threads()}


def _openblas_threads() -> int | None:
    """Of the OpenBLAS that is loaded; None for another library, or where that cannot be told."""
    import ctypes

    try:
        lines = Path("/proc/self/maps").read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        return None
    for file in sorted({line.split()[-1] for line in lines if "openblas" in line}):
        library = ctypes.CDLL(file)
        for name in (
            "scipy_openblas_get_num_threads64_",
            "scipy_openblas_get_num_threads",
            "openblas_get_num_threads",
        ):
            if hasattr(library, name):
                return int(getattr(library, name)())
    return None


def codecs() -> dict[str, Any]:
    """Encode some pictures with every H.264 encoder that may be here, and read those of libx264 again."""
    import av  # noqa: F401 - a missing package is one fault, not one of every encoder

    works, faults = [], {}
    for name in ("libx264", *HARDWARE_H264):
        try:
            packets = _encode(name)
            if name == "libx264" and _decode(packets) != len(_PICTURES):
                raise ValueError("its pictures cannot be read again")
            works.append(name)
        except Exception as error:  # noqa: BLE001 - each codec has errors of its own
            faults[name] = f"{type(error).__name__}: {_first_line(error)}"
    return {"works": works, "faults": faults}


_PICTURES = range(4)


def _encode(name: str) -> list[bytes]:
    from fractions import Fraction

    import av

    context: Any = av.CodecContext.create(name, "w")
    context.width, context.height = _SIZE
    context.pix_fmt, context.time_base, context.framerate = "yuv420p", Fraction(1, 60), Fraction(60)
    packets = []
    for index in _PICTURES:
        picture = av.VideoFrame(*_SIZE, "yuv420p")
        for plane in picture.planes:
            plane.update(bytes([40 * index + 20]) * plane.buffer_size)
        picture.pts = index
        packets += [bytes(packet) for packet in context.encode(picture)]
    packets += [bytes(packet) for packet in context.encode(None)]
    if not packets:
        raise ValueError("it gave nothing")
    return packets


def _decode(packets: list[bytes]) -> int:
    import av

    context: Any = av.CodecContext.create("h264", "r")
    return sum(len(context.decode(av.Packet(data))) for data in packets) + len(context.decode(None))


def serial() -> dict[str, Any]:
    """The serial ports; none is opened, because opening one restarts some microcontrollers."""
    from serial.tools.list_ports import comports

    ports = [
        {"device": port.device, "what": port.description, "usb": port.vid is not None} for port in comports()
    ]
    return {"ports": sorted(ports, key=lambda port: str(port["device"]))}


def gpio() -> dict[str, Any]:
    """The GPIO chips: name, number of lines, or why one cannot be opened."""
    import gpiod

    chips = []
    for path in sorted(str(p) for p in Path("/dev").glob("gpiochip*")):
        chip: dict[str, Any] = {"device": path, "label": "", "lines": 0, "fault": ""}
        try:
            with gpiod.Chip(path) as opened:
                info = opened.get_info()
                chip |= {"label": info.label, "lines": info.num_lines}
        except OSError as error:
            chip["fault"] = error.strerror or str(error)
        chips.append(chip)
    return {"chips": chips}


def devices() -> dict[str, Any]:
    """The devices of the ``rig.yaml`` here, which ``acino-fte rig record`` would take, and their drivers.

    Drivers are loaded; no device is opened.
    """
    found: dict[str, Any] = {"file": "", "devices": {}, "faults": [], "remedy": ""}
    if not Path("rig.yaml").exists():  # what follows imports NumPy, and more
        return found
    from acino_fte.errors import InputError
    from acino_fte.rig.rig_read import find_rig_file, read_rig
    from acino_fte.rig.sources import SIMULATED, find_driver

    try:
        file = find_rig_file()
        if file is None:
            return found
        found["file"] = str(file.resolve())
        rig = read_rig(file)
    except InputError as error:
        return found | {"faults": [_one_line(error)], "remedy": error.remedy or ""}
    for kind, parts in (("cameras", rig.cameras), ("lidars", rig.lidars)):
        for name, part in parts.items():
            found["devices"][name] = part.device
            if part.device == SIMULATED:
                continue
            try:
                find_driver(part.device, f"{kind}.{name}.device")
            except InputError as error:
                found["faults"].append(_one_line(error))
                found["remedy"] = error.remedy or ""
            except Exception as error:  # noqa: BLE001 - whatever a driver raises when it is loaded
                found["faults"].append(f"{name}: {part.device} is broken: {_first_line(error)}")
    return found


def _one_line(error: Any) -> str:
    text = (
        error.problem + (f" {error.key}" if error.key else "") + (f": {error.found}" if error.found else "")
    )
    return " ".join(text.split())


PROBES: dict[str, Callable[[], dict[str, Any]]] = {
    "ipopt": ipopt,
    "explicit": explicit,
    "threads": threads,
    "codecs": codecs,
    "serial": serial,
    "gpio": gpio,
    "devices": devices,
}
