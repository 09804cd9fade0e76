"""The scale of a structure-from-motion model from known distances, with its uncertainty.

A distance is between two cameras (the side of a rig), two individuals (the ends of a wand, the length of a
body), or two places on the way of cameras (surveyed, or from a satellite receiver). Each known length L and
what the model measures for it, m, say the scale: log s = log L − log m. Their mean, weighted by the relative
variances of both, is the scale; their scatter about it is a test. Nothing here depends on the gauge of the
model.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from acino_fte.data_tools.scene_distances import (
    MeasuredDistance,
    between_cameras,
    between_places,
    between_points,
)
from acino_fte.errors import InputError

if TYPE_CHECKING:
    from acino_fte.data_tools.camera_keys import KeyedCamera
    from acino_fte.data_tools.scene_tracks import SceneTracks

_KINDS = ("cameras", "individuals", "places")
_UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001}
_NUMBER = r"(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?"
_LENGTH = re.compile(
    rf"\s*({_NUMBER})\s*(mm|cm|m)?\s*(?:(?:\+-|\+/-|±)\s*({_NUMBER})\s*(mm|cm|m)?)?\s*", re.IGNORECASE
)
_EXAMPLE = "FIRST-SECOND=LENGTH, as 1-3=0.6, cam_a:cam_b=60cm+-2mm or tracks:0-1=0.5"
_PLACE = re.compile(r"(.+)@(\d+)")
_P_ODD = 0.01  # chance of a scatter this large that is still believed


@dataclass(frozen=True)
class KnownDistance:
    """A distance that is known in metres.

    Attributes
    ----------
    kind : {"cameras", "individuals", "places"}
    first, second : str
        Names; of places NAME@FRAME. `second` is empty while `first` holds both in a text with several dashes;
        :func:`resolve` tells them apart.
    length : float
        m.
    sd : float
        Standard deviation of the length, m; 0 for a length that counts as exact.
    """

    kind: str
    first: str
    second: str
    length: float
    sd: float = 0.0

    def __post_init__(self) -> None:
        if self.kind not in _KINDS:
            raise InputError(
                "A distance is of an unknown kind.", expected=", ".join(_KINDS), found=repr(self.kind)
            )
        possible = np.isfinite([self.length, self.sd]).all() and self.length > 0 and self.sd >= 0
        if not possible or self.sd >= self.length:
            raise InputError(
                f"The known distance {self} is impossible.",
                expected="a length above 0 m, and a smaller standard deviation of 0 or more",
                found=f"{self.length:g} ± {self.sd:g} m",
            )

    def __str__(self) -> str:
        pair = f"{self.first}–{self.second}" if self.second else self.first
        return f"tracks {pair}" if self.kind == "individuals" else pair


def parse_distance(text: str) -> KnownDistance:
    """A known distance as it is written on the command line.

    ``1-3=0.6``, ``left:right=0.537``, ``cam_a-cam_b=60cm+-2mm`` (also ± or +/-) are between cameras,
    ``tracks:0-1=0.5`` is between individuals, ``left@0:left@190=22.7`` between where a camera was in two of
    its key frames. Units are m (the default), cm and mm; one unit is enough for
    length and standard deviation.

    Raises
    ------
    InputError
        The text is not of this form, or the length is impossible.
    """
    pair, equals, number = text.rpartition("=")
    match = _LENGTH.fullmatch(number)
    if not (equals and pair.strip() and match):
        raise InputError("A known distance cannot be read.", expected=_EXAMPLE, found=repr(text))
    value, unit, deviation, deviation_unit = match.groups()
    unit, deviation_unit = unit or deviation_unit or "m", deviation_unit or unit or "m"
    length = float(value) * _UNITS[unit.lower()]
    sd = float(deviation or 0.0) * _UNITS[deviation_unit.lower()]
    kind, pair = "cameras", pair.strip()
    for prefix, meant in (("tracks:", "individuals"), ("cameras:", "cameras")):
        if pair.startswith(prefix) and re.search("[-:]", pair[len(prefix) :]):
            kind, pair = meant, pair[len(prefix) :].strip()
    splits = _splits(pair)
    if not splits:
        raise InputError("A known distance names one end only.", expected=_EXAMPLE, found=repr(text))
    first, second = splits[0] if len(splits) == 1 else (pair, "")
    return KnownDistance(kind, first, second, length, sd)


def _splits(pair: str) -> list[tuple[str, str]]:
    """The ways to read two names: at a colon when there is one, else at each dash."""
    mark = ":" if ":" in pair else "-"
    cuts = [i for i, letter in enumerate(pair) if letter == mark]
    both = [(pair[:i].strip(), pair[i + 1 :].strip()) for i in cuts]
    return [(first, second) for first, second in both if first and second]


def resolve(
    distance: KnownDistance, cameras: Sequence[KeyedCamera], individuals: Sequence[str] = ()
) -> KnownDistance:
    """The distance with the full names of what it is between.

    A camera is meant by its name, or by the number of its camera in the COLMAP model (``3`` or ``#3``) when
    no other camera shares that; ``@3`` is always the name "3". ``3@120`` is where it was in key frame 120.

    Parameters
    ----------
    distance : KnownDistance
        As :func:`parse_distance` gives it.
    cameras : sequence of KeyedCamera
        Those of the scene.
    individuals : sequence of str
        Names of the individuals.

    Raises
    ------
    InputError
        A name is unknown or means several; the message lists what there is.
    """
    known = {name: {name} for name in individuals}
    if distance.kind != "individuals":
        known = _camera_words(cameras)
    ways = [(distance.first, distance.second)] if distance.second else _splits(distance.first)
    frames = {}
    if distance.kind != "individuals":
        frames = {word: _PLACE.fullmatch(word) for way in ways for word in way if word not in known}
        for word, match in frames.items():
            if match and match[1] in known:
                known[word] = {f"{name}@{match[2]}" for name in known[match[1]]}
    found = [way for way in ways if way[0] in known and way[1] in known]
    if len(found) != 1:
        raise _unclear(distance, found, [word for way in ways for word in way if word not in known], known)
    ends: list[str] = []
    for word in found[0]:
        if len(known[word]) > 1:
            raise InputError(
                f"The known distance {distance} is ambiguous: '{word}' means more than one camera.",
                found=", ".join(sorted(known[word])),
                remedy=f"use the names; @{word} is the name '{word}', #{word} the camera {word} of COLMAP",
            )
        ends += known[word]
    if ends[0] == ends[1]:
        raise InputError(f"The known distance {distance} is from '{ends[0]}' to itself.", expected="two ends")
    n_places = sum(word in frames for word in found[0])
    if n_places == 1:
        raise InputError(
            f"The known distance {distance} has one end with a frame and one without.",
            expected="NAME@FRAME:NAME@FRAME, or two names",
        )
    return replace(distance, kind="places" if n_places else distance.kind, first=ends[0], second=ends[1])


def _camera_words(cameras: Sequence[KeyedCamera]) -> dict[str, set[str]]:
    """What a camera may be called, and the cameras that are meant then."""
    words: dict[str, set[str]] = {}
    for camera in cameras:
        called = (camera.name, f"@{camera.name}", str(camera.model_id), f"#{camera.model_id}")
        for word in called:
            words.setdefault(word, set()).add(camera.name)
    return words


def _unclear(
    distance: KnownDistance,
    found: Sequence[tuple[str, str]],
    strangers: Sequence[str],
    known: dict[str, set[str]],
) -> InputError:
    listed = ", ".join(sorted(word for word in known if not word.startswith("@"))) or "none"
    if len(found) > 1:
        return InputError(
            f"The known distance {distance} is ambiguous.",
            found=" or ".join(f"{first} : {second}" for first, second in found),
            remedy=f"put a colon between the two names: {found[0][0]}:{found[0][1]}",
        )
    what = "individuals" if distance.kind == "individuals" else "cameras"
    return InputError(
        f"The known distance {distance} names {what} that are not there.",
        expected=f"two of {listed}",
        found=", ".join(dict.fromkeys(strangers)),
    )


def measure_distance(
    distance: KnownDistance, cameras: Sequence[KeyedCamera], tracks: SceneTracks | None = None
) -> MeasuredDistance:
    """What the model says of a known distance (resolved: :func:`resolve`).

    Parameters
    ----------
    distance : KnownDistance
        With full names.
    cameras : sequence of KeyedCamera
        Of the model.
    tracks : SceneTracks, optional
        Of the individuals, in the model's units; only points that two views or more have seen are used.

    Raises
    ------
    InputError
        The two are never seen at the same time, or a name is not there.
    """
    if distance.kind == "cameras":
        ends = {camera.name: camera for camera in cameras}
        return between_cameras(ends[distance.first], ends[distance.second])
    if distance.kind == "places":
        by_name = {camera.name: camera for camera in cameras}
        places = [word.rpartition("@") for word in (distance.first, distance.second)]
        (here, _, one), (there, _, other) = places
        return between_places(by_name[here], int(one), by_name[there], int(other))
    if tracks is None:
        raise InputError(f"The known distance {distance} needs tracks.", expected="triangulated tracks")
    chosen = []
    for name in (distance.first, distance.second):
        of = (tracks.individual == tracks.individuals.index(name)) & (tracks.source == 0)
        chosen.append(np.flatnonzero(of))
    frame, first, second = np.intersect1d(
        tracks.frame[chosen[0]], tracks.frame[chosen[1]], assume_unique=True, return_indices=True
    )
    if not len(frame):
        raise InputError(
            f"The known distance {distance} cannot be measured.",
            expected="frames in which two views or more see both",
            found="none",
        )
    rows = chosen[0][first], chosen[1][second]
    return between_points(
        tracks.position[rows[0]],
        tracks.position[rows[1]],
        tracks.covariance[rows[0]] + tracks.covariance[rows[1]],
        names=f"{distance.first}–{distance.second}",
    )


@dataclass(frozen=True, eq=False)
class ScaleEstimate:
    """The scale and how well the distances agree on it.

    Attributes
    ----------
    factor : float
        Metres per unit of the model.
    sd : float
        Standard deviation of the factor; larger by √(chi2 / degrees of freedom) when the distances do not
        agree.
    distances : tuple of KnownDistance
    measured : tuple of MeasuredDistance
    residual : (D,)
        Known length minus factor times measured length, m.
    normalised : (D,)
        Residuals in standard deviations of the length known and the length measured.
    chi2 : float
        Sum of the squares of the normalised residuals, of D − 1 degrees of freedom.
    notes : tuple of str
        Warnings.
    """

    factor: float
    sd: float
    distances: tuple[KnownDistance, ...]
    measured: tuple[MeasuredDistance, ...]
    residual: np.ndarray
    normalised: np.ndarray
    chi2: float
    notes: tuple[str, ...] = ()

    @property
    def relative_sd(self) -> float:
        """Standard deviation of the scale as a share of it."""
        return self.sd / self.factor


def scene_scale(measured: Sequence[tuple[KnownDistance, MeasuredDistance]]) -> ScaleEstimate:
    """The scale from any number of distances: the weighted mean of log L − log m.

    Parameters
    ----------
    measured : sequence of (KnownDistance, MeasuredDistance)
        What is known in metres and what :func:`measure_distance` found for it.

    Raises
    ------
    InputError
        There is no distance.
    """
    if not measured:
        raise InputError("The scale needs a known distance.", expected=_EXAMPLE, found="none")
    known, lengths = zip(*measured, strict=True)
    length = np.array([distance.length for distance in known])
    model = np.array([one.length for one in lengths])
    log = np.log(length / model)
    relative = np.array([distance.sd for distance in known]) / length
    variance = relative**2 + (np.array([one.sd for one in lengths]) / model) ** 2 + 1e-18
    mean = float(np.average(log, weights=1 / variance))
    chi2 = float(((log - mean) ** 2 / variance).sum())
    sd = 1.0 / np.sqrt((1 / variance).sum())
    notes = [note for one in lengths for note in one.notes]
    freedom = len(log) - 1
    if freedom and _chance(freedom, chi2) < _P_ODD:
        sd *= np.sqrt(chi2 / freedom)
        notes.append(_odd_one(known, log, variance))
    factor = float(np.exp(mean))
    return ScaleEstimate(
        factor=factor,
        sd=factor * float(sd),
        distances=tuple(known),
        measured=tuple(lengths),
        residual=length - factor * model,
        normalised=(log - mean) / np.sqrt(variance),
        chi2=chi2,
        notes=tuple(notes),
    )


def _chance(freedom: int, chi2: float) -> float:
    """Of a χ² this large or larger."""
    from scipy.special import chdtrc

    return float(chdtrc(freedom, chi2))


def _odd_one(known: Sequence[KnownDistance], log: np.ndarray, variance: np.ndarray) -> str:
    """Says which distance lies farthest from what the others say, in standard deviations."""
    weight = 1 / variance
    rest = weight.sum() - weight
    others = ((weight * log).sum() - weight * log) / rest
    gap = log - others
    if len(log) == 2:
        return (
            f"The known distances {known[0]} and {known[1]} do not agree: the scales that they say differ by "
            f"{100 * abs(np.expm1(gap[0])):.2g} %. One of them is wrong."
        )
    odd = int(np.argmax(np.abs(gap) / np.sqrt(variance + 1 / rest)))
    return (
        f"The known distances do not agree: {known[odd]} says a scale {100 * abs(np.expm1(gap[odd])):.2g} % "
        f"{'larger' if gap[odd] > 0 else 'smaller'} than the others."
    )
