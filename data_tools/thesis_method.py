"""The matching of the thesis "3D Trajectory Reconstruction for Animal Data": dot by dot, frame by frame.

For comparison only; :mod:`track_matching` is the method to use. The rules are those of the thesis's public
code, which says more than its text. What it leaves open was settled by the numbers measured with it.

*Candidates.* For a dot of camera 1 every dot of camera 2 in the frame has a distance: that of the first dot
to the epipolar line which the second draws in image 1. Nearest first, a candidate must pass the two-way
check: of all lines that the dots of camera 1 draw in image 2, that of the first dot must be nearest to it. A
candidate that does not pass is dropped, and the next nearest is looked at, until there are none. So more
than the mutually nearest dots are paired: of 20 animals with noise of 3 px 0.866 instead of 0.837. The pair
is triangulated by the linear method. When its z in the *world* is not above zero, the dot stays alone.

*Set 1* takes the first candidate that passes. There is no threshold.

*Set 2* asks more of it. The history of a candidate is that of its track in camera 2: the points of earlier
pairs, right or wrong. When the Kalman forecast is within 30 cm of the point, the pair is accepted. Otherwise,
when five frames of the window or fewer have a point, it is accepted if both distances to the lines are below
50 px. Otherwise the candidate is dropped and the next is looked at.

*Set 3* does so with forecasts from a whole run of Set 1, from the frames before or those after: whichever
have more points, the later ones at a tie. (From a run of Set 2 the numbers are others.)

Faults of the code that `fixed` mends: the window ends two frames before the dot, not one; with exactly six
points, that of the last frame among them, there is neither a forecast nor the rule of 50 px, and the dot is
lost. Faults that stay: the filter starts with position and velocity exchanged; after a gap the forecast is
for the frame after the last point; no forecast is (−1, −1, −1) and is compared all the same; the first eleven
rows of camera 1 pass every gate; z is the world's. One is not kept: the code undistorts one dot of a pair,
here both are undistorted. Where the code compares coordinates to about 0.1 px to find a dot again, here the
dot is known.

On the thesis's own 20 animals one draw of the noise differs from another by 0.003 (3 px) to 0.005 (5 px) in
accuracy, and in the used-data ratio by 0.003 in Set 1, 0.001 in Set 2, 0.008 in Set 3 (one standard
deviation). The numbers measured with the code, of how many draws is not known, lie within about two such
deviations of the mean here but for two: the used-data ratio of Set 1 at 5 px (0.802, here 0.810) and the
accuracy of Set 2 at 3 px (0.885, here 0.876).

With more than two cameras, the first is paired with each of the others.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from acino_fte.errors import InputError

from .thesis_candidates import Candidates, find_candidates
from .thesis_kalman import AllEstimates, Forecasts, RecentEstimates, forecast
from .tracks2d import BARE, TrackRecording, Tracks2D

_CHUNK = 100_000
_LONGEST_WINDOW = 60  # a pattern of seen frames is one integer


@dataclass(frozen=True)
class ThesisOptions:
    """What the thesis's code can be told, with its values.

    Attributes
    ----------
    sets : {1, 2, 3}
        1: epipolar lines and two-way check; 2: and the Kalman forecast; 3: a second run, with the future.
    gate_m : float
        Largest distance to the forecast, m.
    gate_px : float
        Largest distance to the epipolar lines when there are too few estimates, px.
    min_estimates : int
        Estimates that a forecast needs.
    window : int
        Frames that the filter looks back, and forth in Set 3.
    unchecked : int
        Rows of camera 1, in the order of frames, that no gate judges.
    fixed : bool
        Mend the two faults of the Kalman forecast: the window includes the frame next to the dot, and
        `min_estimates` are always enough for a forecast.
    vote : bool
        Decide for whole tracks of camera 2: the track of camera 1 that most of its pairs name.
    """

    sets: int = 2
    gate_m: float = 0.3
    gate_px: float = 50.0
    min_estimates: int = 5
    window: int = 10
    unchecked: int = 11
    fixed: bool = False
    vote: bool = False

    def __post_init__(self) -> None:
        limits = {"sets": (1, 3), "window": (3, _LONGEST_WINDOW), "min_estimates": (1, self.window)}
        for key, (low, high) in limits.items():
            if not low <= getattr(self, key) <= high:
                raise InputError(
                    "The thesis's method cannot run with this option.",
                    key=key,
                    expected=f"{low} to {high}",
                    found=str(getattr(self, key)),
                )

    @property
    def offsets(self) -> np.ndarray:
        """Frames of the window relative to the dot, in the order in which the filter meets them."""
        return np.arange(-self.window, 0 if self.fixed else -1)


@dataclass(frozen=True, eq=False)
class ThesisPairs:
    """Pairs of dots of two views; K of them, in the order of frames.

    Attributes
    ----------
    first, second : (K,) int
        Rows of the two views.
    frame : (K,) int
    points : (K, 3)
        Triangulated, world frame, m.
    """

    first: np.ndarray
    second: np.ndarray
    frame: np.ndarray
    points: np.ndarray


def match_thesis(recording: TrackRecording, options: ThesisOptions | None = None) -> list[np.ndarray]:
    """Groups of all rows by the thesis's method.

    The thesis pairs dots, not tracks. Each pair carries the track of camera 1 as its group, so the pairs of a
    frame are exactly the rows with equal groups in that frame; a bare point has a group of its own. Rows
    without a pair have −1. With `vote` the group of a whole track of another camera is the track of camera 1
    that its pairs name most often, and all rows of both tracks have it.

    Parameters
    ----------
    recording : TrackRecording
        Two views or more.
    options : ThesisOptions
        By default the thesis's Set 2.

    Returns
    -------
    list of (P,) int
        For every view, in the order of its rows.
    """
    options = options or ThesisOptions()
    views = recording.views
    label = _labels(views[0])
    groups = [np.full(len(view), -1, dtype=np.int64) for view in views]
    for other in range(1, len(views)):
        pairs = pair_points(recording, options, (0, other))
        groups[other][pairs.second] = label[pairs.first]
        if options.vote:
            groups[other] = _vote(views[other].track, groups[other])
            used = np.isin(label, groups[other][groups[other] >= 0])
            groups[0][used] = label[used]
        else:
            groups[0][pairs.first] = label[pairs.first]
    return groups


def _labels(view: Tracks2D) -> np.ndarray:
    """A label for every row: its track, or one of its own for bare points and for tracks twice in a frame."""
    label = view.track.astype(np.int64)
    order = np.lexsort((view.frame, label))
    again = (np.diff(label[order]) == 0) & (np.diff(view.frame[order]) == 0)
    own = label == BARE
    own[order[1:][again]] = True
    label[own] = len(view.labels) + np.arange(int(own.sum()))
    return label


def _vote(track: np.ndarray, group: np.ndarray) -> np.ndarray:
    """The most frequent group of each track, for all its rows; bare points keep theirs."""
    use = (track >= 0) & (group >= 0)
    if not use.any():
        return group
    choices, count = np.unique(np.stack([track[use], group[use]]), axis=1, return_counts=True)
    elected = np.full(int(track.max()) + 1, -1, dtype=np.int64)
    order = np.lexsort((-choices[1], count))  # the most frequent, then the smallest, is written last
    elected[choices[0, order]] = choices[1, order]
    return np.where(track >= 0, elected[track], group)


def pair_points(
    recording: TrackRecording, options: ThesisOptions | None = None, views: tuple[int, int] = (0, 1)
) -> ThesisPairs:
    """Pairs of dots of two views by the thesis's method, without its vote.

    Parameters
    ----------
    recording : TrackRecording
        Two views or more.
    options : ThesisOptions
        By default the thesis's Set 2.
    views : (int, int)
        The thesis's camera 1 and camera 2.
    """
    options = options or ThesisOptions()
    n_tracks = len(recording.views[views[1]].labels)
    candidates = find_candidates(recording, views, options.unchecked)
    if options.sets == 2:
        chosen = _run(candidates, options, n_tracks)
    else:
        chosen = candidates.accept(np.ones(len(candidates.frame), dtype=bool))
    if options.sets == 3:
        chosen = _rerun(candidates, chosen, options, n_tracks)
    return ThesisPairs(
        candidates.first[chosen],
        candidates.second[chosen],
        candidates.frame[chosen],
        candidates.points[chosen],
    )


def _gate(
    candidates: Candidates, part: slice | np.ndarray, forecasts: Forecasts, options: ThesisOptions
) -> np.ndarray:
    """Whether candidates pass the gates of Sets 2 and 3."""
    near = np.linalg.norm(candidates.points[part] - forecasts.points, axis=1) < options.gate_m
    on_lines = (candidates.to_line[part] < options.gate_px).all(1)
    return candidates.unchecked[part] | near | (on_lines & (forecasts.count <= options.min_estimates))


def _run(candidates: Candidates, options: ThesisOptions, n_tracks: int) -> np.ndarray:
    """Set 2: candidates that are paired, each frame by the forecasts from the frames before it."""
    recent = RecentEstimates(n_tracks + 1, options.window)  # the last is that of bare points: always empty
    offsets = options.offsets
    frames, starts = np.unique(candidates.frame, return_index=True)
    bounds = [*starts.tolist(), len(candidates.frame)]
    accepted = []
    for frame, start, end in zip(frames.tolist(), bounds[:-1], bounds[1:], strict=True):
        tracks = candidates.track[start:end]
        forecasts = forecast(
            recent.before(tracks, frame, offsets), recent.first[tracks], options.min_estimates, options.fixed
        )
        chosen = candidates.accept(_gate(candidates, slice(start, end), forecasts, options), start, end)
        known = chosen[candidates.track[chosen] >= 0]
        recent.add(candidates.track[known], frame, candidates.points[known])
        accepted.append(chosen)
    return np.concatenate(accepted) if accepted else np.empty(0, dtype=int)


def _rerun(candidates: Candidates, before: np.ndarray, options: ThesisOptions, n_tracks: int) -> np.ndarray:
    """Set 3: candidates that are paired by forecasts from all results of a run before, or backwards."""
    before = before[candidates.track[before] >= 0]
    results = AllEstimates(
        candidates.track[before], candidates.frame[before], candidates.points[before], n_tracks + 1
    )
    passes = np.zeros(len(candidates.frame), dtype=bool)
    for start in range(0, len(passes), _CHUNK):
        part = slice(start, start + _CHUNK)
        tracks, frames = candidates.track[part], candidates.frame[part]
        forwards, backwards = (
            forecast(
                results.around(tracks, frames, sign * options.offsets),
                results.first[tracks],
                options.min_estimates,
                options.fixed,
            )
            for sign in (1, -1)
        )
        past = forwards.count > backwards.count
        best = Forecasts(
            np.where(past[:, None], forwards.points, backwards.points),
            np.where(past, forwards.count, backwards.count),
            np.where(past, forwards.known, backwards.known),
        )
        passes[part] = _gate(candidates, part, best, options)
    return candidates.accept(passes)
