"""All pieces of one view to the groups of the other views anew, at once: a linear assignment.

Joining groups two by two may end where no single step gains but an exchange does. For one view after another,
what each group holds in that view is taken out and given back so that the sum of the log-odds is largest
(Jonker and Volgenant's algorithm, scipy's :func:`~scipy.optimize.linear_sum_assignment`; solved apart for
every connected part of the sparse table). With whole tracks in two views this is the optimum itself.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from acino_fte.data_tools.track_groups import PieceGraph, total_log_odds

_ROUNDS = 5


def reassign(graph: PieceGraph, label: np.ndarray) -> np.ndarray:
    """Groups (V,) that are worth at least as much as those given, no view's assignment being improvable."""
    label = label.copy()
    for _ in range(_ROUNDS):
        changed = False
        for view in np.unique(graph.view):
            better = _reassign_view(graph, label, int(view))
            changed |= better is not None
            label = label if better is None else better
        if not changed:
            break
    return np.unique(label, return_inverse=True)[1]


def _reassign_view(graph: PieceGraph, label: np.ndarray, view: int) -> np.ndarray | None:
    """The groups after an assignment of one view; None when nothing is gained."""
    n = len(label)
    apart = label + np.where(graph.view == view, n, 0)  # a group's part in this view, and the rest of it
    crossing = (graph.view[graph.u] == view) != (graph.view[graph.v] == view)
    some = replace(graph, u=graph.u[crossing], v=graph.v[crossing], weight=graph.weight[crossing])
    rest, part, gain = total_log_odds(some, apart)
    part = part - n
    now = np.zeros(n)
    own = rest == part
    now[part[own]] = gain[own]
    target, fresh, improvement = np.arange(n), n, 0.0
    misplaced = np.flatnonzero(now < 0)
    target[misplaced] = fresh + np.arange(len(misplaced))
    fresh += len(misplaced)
    improvement -= now[misplaced].sum()
    now[misplaced] = 0.0
    useful = gain > 0
    rest, part, gain = rest[useful], part[useful], gain[useful]
    _, component = connected_components(
        coo_array((gain, (rest, part + n)), shape=(2 * n, 2 * n)), directed=False
    )
    order = np.argsort(component[rest], kind="stable")
    bounds = np.flatnonzero(np.r_[True, np.diff(component[rest][order]) > 0, True])
    for low, high in zip(bounds[:-1], bounds[1:], strict=True):
        e = order[low:high]
        rests, i = np.unique(rest[e], return_inverse=True)
        parts, j = np.unique(part[e], return_inverse=True)
        table = np.zeros((len(parts), len(rests)))
        table[j, i] = gain[e]
        rows, columns = linear_sum_assignment(table, maximize=True)
        value = table[rows, columns]
        better = value.sum() - now[parts].sum()
        if better <= 1e-6:
            continue
        improvement += better
        kept = value > 0
        leaving = np.union1d(parts, rests[columns[kept]])  # also what no evidence holds where another comes
        target[leaving] = fresh + np.arange(len(leaving))
        fresh += len(leaving)
        target[parts[rows[kept]]] = rests[columns[kept]]
    if improvement <= 0:
        return None
    return np.unique(np.where(graph.view == view, target[label], label), return_inverse=True)[1]
