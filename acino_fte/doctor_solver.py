"""Solvers: does IPOPT solve a small problem, how is the explicit model solved, how many BLAS threads?"""

from __future__ import annotations

import os

from acino_fte.doctor import LIDAR, RUN, Finding, Surroundings

_CLOSE = 1e-4  # to the solution of the small problem
_VARIABLES = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS")
_AGAIN = "pip install --force-reinstall cyipopt-wheels==1.7.0.dev0"


def look_at_ipopt(around: Surroundings) -> Finding:
    """IPOPT through cyipopt, with MUMPS, as every run solves."""
    answer = around.answers["ipopt"]
    if answer.fault:
        return Finding("failed", f"cannot solve: {answer.fault}", _AGAIN, RUN | LIDAR)
    found = answer.value
    if found["status"] not in (0, 1) or not found["error"] < _CLOSE:
        text = f"a problem with a known solution came out wrong: {found['message']}"
        return Finding("failed", text, _AGAIN, RUN | LIDAR, found)
    version = f"{found['version']} " if found["version"] else ""
    return Finding("ok", f"{version}with MUMPS solves a small problem", matters=RUN | LIDAR, details=found)


def look_at_explicit(around: Surroundings) -> Finding:
    """The route of the explicit Pyomo model; everyday runs do not need it."""
    answer = around.answers["explicit"]
    remedy = "only --lowering explicit needs it; pip install --force-reinstall pyomo casadi"
    if "/ipopt" in answer.fault or "\\ipopt" in answer.fault:
        remedy = (
            "only --lowering explicit needs it; take this ipopt off the PATH, or mend it: CasADi does without"
        )
    if answer.fault:
        return Finding("failed", f"cannot solve: {answer.fault}", remedy)
    found = answer.value
    names = {"ipopt": f"the program {found['file']}", "pynumero": "PyNumero", "casadi": "CasADi's IPOPT"}
    route = names.get(found["route"], found["route"])
    if not found["error"] < _CLOSE:
        return Finding("failed", f"{route}: a known solution came out wrong", remedy, details=found)
    return Finding("ok", f"{route} solves a small Pyomo model", details=found)


def look_at_threads(around: Surroundings) -> Finding:
    """Threads of NumPy's BLAS."""
    answer = around.answers["threads"]
    chosen = {name: os.environ[name] for name in _VARIABLES if os.environ.get(name)}
    if answer.fault:
        return Finding(
            "note", f"cannot tell: {answer.fault}", "see packages, below", details={"chosen": chosen}
        )
    found = answer.value
    number = found["threads"]
    by = ", ".join(f"{name}={value}" for name, value in chosen.items())
    text = f"{number if number is not None else 'an unknown number'} in {found['blas']} {found['version']}"
    text += f" ({by})" if by else ""
    details = found | {"chosen": chosen}
    if (number or 1) > (os.cpu_count() or 1):
        return Finding(
            "note", text, f"more than processors: unset {' '.join(chosen)}".rstrip(), details=details
        )
    return Finding("ok", text, details=details)
