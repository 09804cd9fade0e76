"""Groups of pieces: against every partition of small graphs, and against the best assignment of two views."""

from collections.abc import Iterator

import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment

from acino_fte.data_tools.track_groups import (
    ABSENT,
    PieceGraph,
    group_pieces,
    margins,
    total_log_odds,
)
from acino_fte.data_tools.track_reassignment import reassign

Pairs = dict[tuple[int, int], float]


def graph(view, first, last, edges: Pairs) -> PieceGraph:
    u, v = (np.array([pair[side] for pair in edges], dtype=int) for side in (0, 1))
    weight = np.array(list(edges.values()), dtype=float)
    return PieceGraph(np.array(view), np.array(first), np.array(last), u, v, weight)


def whole(view, edges: Pairs) -> PieceGraph:
    """Pieces that all last ten frames."""
    return graph(view, [0] * len(view), [9] * len(view), edges)


def overlap(g: PieceGraph, i: int, j: int) -> int:
    return max(0, int(min(g.last[i], g.last[j]) - max(g.first[i], g.first[j])) + 1)


def allowed(g: PieceGraph, members: list[int]) -> bool:
    return not any(
        g.view[i] == g.view[j] and overlap(g, i, j) for n, i in enumerate(members) for j in members[:n]
    )


def worth(g: PieceGraph, groups: list[list[int]]) -> float:
    """Sum of the log-odds within groups; pieces of two views without an edge pay for every common frame."""
    weight = {frozenset(pair): w for *pair, w in zip(g.u.tolist(), g.v.tolist(), g.weight, strict=True)}
    total = 0.0
    for members in groups:
        for n, i in enumerate(members):
            for j in members[:n]:
                if frozenset((i, j)) in weight:
                    total += weight[frozenset((i, j))]
                elif g.view[i] != g.view[j]:
                    total += ABSENT * overlap(g, i, j)
    return total


def as_groups(label: np.ndarray) -> list[list[int]]:
    return [np.flatnonzero(label == k).tolist() for k in np.unique(label)]


def partitions(g: PieceGraph, n: int) -> Iterator[list[list[int]]]:
    """All allowed partitions of the first n pieces."""
    if not n:
        yield []
        return
    for groups in partitions(g, n - 1):
        for k, members in enumerate(groups):
            if allowed(g, [*members, n - 1]):
                yield [*groups[:k], [*members, n - 1], *groups[k + 1 :]]
        yield [*groups, [n - 1]]


def best(g: PieceGraph) -> float:
    return max(worth(g, groups) for groups in partitions(g, len(g.view)))


def random_graph(seed: int, n_views: int, n_pieces: int, scale: float = 6.0) -> PieceGraph:
    """Pieces of a few animals in some views, here and there in time, with evidence of about `scale`."""
    rng = np.random.default_rng(seed)
    view = rng.integers(0, n_views, n_pieces)
    first = rng.integers(0, 20, n_pieces)
    last = first + rng.integers(3, 25, n_pieces)
    animal = rng.integers(0, 3, n_pieces)
    edges: Pairs = {}
    for i in range(n_pieces):
        for j in range(i):
            common = min(last[i], last[j]) - max(first[i], first[j]) + 1
            if (view[i] == view[j]) == (common > 0):
                continue  # one view at one time, or two views at different times
            same = animal[i] == animal[j]
            if same or rng.random() < 0.5:
                edges[i, j] = float(rng.normal(scale if same else -scale, scale))
    return graph(view, first, last, edges)


def test_pairs_by_hand():
    """Two animals in two views; a third piece has evidence against everyone."""
    g = whole([0, 0, 1, 1, 1], {(0, 2): 5.0, (0, 3): -2.0, (1, 3): 4.0, (1, 2): 1.0, (1, 4): -3.0})
    label = group_pieces(g)
    assert label[0] == label[2]
    assert label[1] == label[3]
    assert len(np.unique(label)) == 3


def test_a_third_view_decides_what_two_leave_open():
    """Views 0 and 1 cannot tell; view 2 knows both, crosswise."""
    tie = {(0, 2): 3.0, (0, 3): 3.0, (1, 2): 3.0, (1, 3): 3.0}
    third = {(0, 4): 8.0, (1, 5): 8.0, (3, 4): 8.0, (2, 5): 8.0, (0, 5): -5.0, (1, 4): -5.0}
    label = group_pieces(whole([0, 0, 1, 1, 2, 2], tie | third))
    assert label[0] == label[3] == label[4]
    assert label[1] == label[2] == label[5]


def test_an_even_tie_is_left_open():
    g = whole([0, 0, 1, 1], {(0, 2): 3.0, (0, 3): 3.0, (1, 2): 3.0, (1, 3): 3.0})
    assert len(np.unique(group_pieces(g, least=1.0))) == 4


def test_views_that_disagree_pay():
    """0–2 and 2–4 go together, 0–4 speaks against it: by less it is one animal, by more it is not."""
    for against, n_groups in ((-5.0, 1), (-9.0, 2), (-30.0, 2)):
        label = group_pieces(whole([0, 1, 2], {(0, 1): 10.0, (1, 2): 8.0, (0, 2): against}))
        assert len(np.unique(label)) == n_groups


def test_pieces_that_were_never_near_pay_for_their_common_frames():
    g = whole([0, 1, 2], {(0, 1): 10.0, (1, 2): 8.0})  # no edge 0–2, ten common frames
    assert len(np.unique(group_pieces(g))) == 2
    g = graph([0, 1, 2], [0, 0, 9], [9, 20, 20], {(0, 1): 10.0, (1, 2): 8.0})  # one common frame
    assert len(np.unique(group_pieces(g))) == 1


def test_pieces_after_one_another_are_chained_by_another_view():
    """Both are near one long track of the other view; nothing is known of a link between them."""
    g = graph([0, 0, 1], [0, 30, 0], [20, 50, 60], {(0, 2): 6.0, (1, 2): 5.0})
    assert len(np.unique(group_pieces(g))) == 1
    g = graph([0, 0, 1], [0, 20, 0], [20, 50, 60], {(0, 2): 6.0, (1, 2): 5.0})  # one frame in common
    label = group_pieces(g)
    assert label[0] == label[2] != label[1]


def test_without_edges_everyone_is_alone():
    assert group_pieces(whole([0, 1, 1], {})).tolist() == [0, 1, 2]
    assert reassign(whole([0, 1, 1], {}), np.arange(3)).tolist() == [0, 1, 2]


def test_margin_by_hand():
    """Log-odds against apart (1) and against what is excluded: of the surer side."""
    occupied = np.zeros((4, 2, 1), dtype=np.uint8)
    occupied[[0, 1], 0], occupied[[2, 3], 1] = 255, 255
    u, v, total = np.array([0, 0, 1]), np.array([2, 3, 3]), np.array([5.0, 3.0, -1.0])
    found = margins(u, v, total, occupied)
    assert found[0] == pytest.approx(5.0 - np.log(1 + np.exp(3.0)))
    assert found[1] == pytest.approx(3.0 - np.log(1 + np.exp(5.0)))
    assert found[2] == -np.inf


@pytest.mark.parametrize("seed", range(20))
def test_totals_against_the_definition(seed):
    g = random_graph(seed, 3, 9)
    label = group_pieces(g)
    groups = {k: np.flatnonzero(label == k).tolist() for k in np.unique(label)}
    u, v, total = total_log_odds(g, label)
    joined = {tuple(sorted((label[a], label[b]))) for a, b in zip(g.u, g.v, strict=True)}
    wanted = {
        (p, q): worth(g, [groups[p] + groups[q]]) - worth(g, [groups[p], groups[q]])
        for p, q in joined
        if p != q and allowed(g, groups[p] + groups[q])
    }
    assert set(zip(u.tolist(), v.tolist(), strict=True)) == wanted.keys()
    np.testing.assert_allclose(total, [wanted[pair] for pair in zip(u.tolist(), v.tolist(), strict=True)])


@pytest.mark.parametrize("n_views", [2, 3, 4])
def test_against_every_partition(n_views):
    """The optimum nearly always; never two pieces of one view at a time; never worse than before."""
    equal, ratio, n = 0, [], 40
    for seed in range(n):
        g = random_graph(1000 * n_views + seed, n_views, 8)
        greedy = group_pieces(g)
        label = reassign(g, greedy)
        for some in (greedy, label):
            assert all(allowed(g, members) for members in as_groups(some)), seed
        found, before, optimum = worth(g, as_groups(label)), worth(g, as_groups(greedy)), best(g)
        assert found >= before - 1e-9, seed
        assert before >= 0
        equal += found >= optimum - 1e-9
        ratio.append(found / max(optimum, 1e-9) if optimum > 0 else 1.0)
    assert equal >= 0.75 * n, equal
    assert np.mean(ratio) > 0.95


@pytest.mark.parametrize("seed", range(30))
def test_reassigned_from_anywhere_is_allowed_and_not_worse(seed):
    """Also from groupings that hold pieces which speak against their group."""
    g = random_graph(seed, 3, 9)
    rng = np.random.default_rng(seed)
    groups: list[list[int]] = []
    for i in rng.permutation(9).tolist():
        fitting = [members for members in groups if allowed(g, [*members, i])]
        if fitting and rng.random() < 0.7:
            fitting[rng.integers(len(fitting))].append(i)
        else:
            groups.append([i])
    label = np.empty(9, dtype=int)
    for k, members in enumerate(groups):
        label[members] = k
    after = reassign(g, label)
    assert all(allowed(g, members) for members in as_groups(after))
    assert worth(g, as_groups(after)) >= worth(g, groups) - 1e-9


@pytest.mark.parametrize("seed", range(10))
def test_whole_tracks_of_two_views_are_assigned_best(seed):
    """There the optimum is an assignment (Jonker and Volgenant's algorithm, scipy)."""
    rng = np.random.default_rng(seed)
    n, m = 14, 11
    table = rng.normal(-1.0, 3.0, (n, m))
    table[np.arange(m), np.arange(m)] += 3.0
    edges = {(i, n + j): table[i, j] for i in range(n) for j in range(m)}
    g = whole([0] * n + [1] * m, edges)
    label = reassign(g, group_pieces(g))
    rows, columns = linear_sum_assignment(np.maximum(table, 0.0), maximize=True)
    assert worth(g, as_groups(label)) == pytest.approx(np.maximum(table, 0.0)[rows, columns].sum())
    assert all(allowed(g, members) for members in as_groups(label))


def test_an_exchange_that_no_single_step_finds():
    """Greedy takes 10 + 1; the other way round is 9 + 9."""
    edges = {(0, 2): 10.0, (0, 3): 9.0, (1, 2): 9.0, (1, 3): 1.0}
    g = whole([0, 0, 1, 1], edges)
    wrong = np.array([0, 1, 0, 1])
    label = reassign(g, wrong)
    assert label[0] == label[3]
    assert label[1] == label[2]
