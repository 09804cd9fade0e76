"""Simulated recordings of many animals without markers, with their truth.

Points move (:mod:`track_motions`) in front of cameras (:mod:`track_rigs`), are seen with noise, and become
2D tracks with the faults of real trackers. Everything follows from one seed.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields
from typing import Literal, get_args

import numpy as np

from acino_fte.cameras import Camera, CameraArray
from acino_fte.data_tools.track_motions import BOXES, MOTIONS, Box, Motion, animal_paths
from acino_fte.data_tools.track_rigs import LENSES, Lens, ring_rig, thesis_rig
from acino_fte.data_tools.tracks2d import BARE, CLUTTER, TrackRecording, Tracks2D
from acino_fte.errors import InputError

Rig = Literal["thesis", "ring"]
TrackKind = Literal["whole", "fragments", "bare"]


@dataclass(frozen=True)
class TrackSimulation:
    """What to simulate.

    Attributes
    ----------
    n_animals, n_frames : int
    fps : float
        Frames per second.
    motion : str
        ``smooth``, ``jumpy``, ``perched`` or ``flock``; see :mod:`track_motions`. On 100 animals × 600 frames
        at 30 Hz the project's reference sets and this generator give (speed of a step in m/s; correlation of
        steps one and five frames apart, mean of the axes):

        ==================  ==========  =======================  =====================
        set                 mean speed  5 %, 50 %, 95 %          correlations
        ==================  ==========  =======================  =====================
        thesis's text       9.5         6.2, 9.6, 11.7           .75, −.22
        ``smooth``          9.5         6.2, 9.6, 11.7           .75, −.21
        thesis's code       4.6         2.0, 4.7, 6.7            .58, .18
        ``jumpy``           4.6         2.2, 4.7, 6.5            .58, .12
        ==================  ==========  =======================  =====================
    rig : str
        ``thesis``: two cameras 2 m apart, each turned in by 10°; ``ring``: `n_cameras` about the animals.
    n_cameras : int
        Of the ring; the thesis's rig has two.
    lens : str
        ``pinhole``, ``distorted`` or ``fisheye``.
    moving : bool
        The cameras of the ring sway as in a hand.
    box : tuple, optional
        Lowest and highest (x, y, z) of the animals, m; by default that of the motion.
    noise_px : float
        Standard deviation of each pixel coordinate.
    tracks : str
        ``whole``: one track per animal and view; ``fragments``: pieces of `piece_frames` frames, in each
        view its own; ``bare``: no tracks.
    piece_frames : tuple of int
        Shortest and longest piece.
    missed, clutter : float
        Share of the animals' rows that are lost; rows of clutter as a share of the animals' rows.
        Clutter comes as tracks of 1–3 frames at random places.
    swap_px : float, optional
        Two tracks that come within this distance in a view exchange their identities with `swap_chance`,
        once per encounter. None: never.
    swap_chance : float
    seed : int
    """

    n_animals: int = 20
    n_frames: int = 600
    fps: float = 30.0
    motion: Motion = "jumpy"
    rig: Rig = "thesis"
    n_cameras: int = 2
    lens: Lens = "pinhole"
    moving: bool = False
    box: Box | None = None
    noise_px: float = 3.0
    tracks: TrackKind = "whole"
    piece_frames: tuple[int, int] = (20, 100)
    missed: float = 0.0
    clutter: float = 0.0
    swap_px: float | None = None
    swap_chance: float = 0.5
    seed: int = 0

    def __post_init__(self) -> None:
        _check(self)


def simulate_tracks(options: TrackSimulation, name: str | None = None) -> TrackRecording:
    """Simulate a recording.

    Parameters
    ----------
    options : TrackSimulation
        What to simulate.
    name : str, optional
        Of the recording; by default made from the options.

    Returns
    -------
    TrackRecording
        With `animal` in every view, and `truth_3d`: every animal in every frame, seen or not.
        Rows are sorted by frame and shuffled within a frame; labels say nothing about the animal.
    """
    motion_rng, rig_rng, *view_rngs = _generators(options)
    box = options.box or BOXES[options.motion]
    paths = animal_paths(options.motion, options.n_animals, options.n_frames, options.fps, box, motion_rng)
    if options.rig == "thesis":
        cameras = thesis_rig(options.lens)
    else:
        n_moving = options.n_frames if options.moving else None
        cameras = ring_rig(options.n_cameras, box, options.lens, rig_rng, n_moving)
    views = tuple(_view(c, paths, options, rng) for c, rng in zip(cameras, view_rngs, strict=True))
    first = min((int(view.frame[0]) for view in views if len(view)), default=0)
    return TrackRecording(
        name or f"{options.motion}_n{options.n_animals}_seed{options.seed}",
        _from_frame(cameras, first),
        views,
        options.fps,
        _truth(paths),
    )


def _generators(options: TrackSimulation) -> Iterator[np.random.Generator]:
    """One generator for the motion, one for the rig, one for each view: an option of one moves no other."""
    n_cameras = 2 if options.rig == "thesis" else options.n_cameras
    seeds = np.random.SeedSequence(options.seed).spawn(2 + n_cameras)
    return map(np.random.default_rng, seeds)


def _from_frame(cameras: CameraArray, first: int) -> CameraArray:
    """Moving cameras begin with the first frame that has a row (:class:`TrackRecording`)."""
    return cameras.at_frames(slice(first, None))


def _truth(paths: np.ndarray):
    import pandas as pd

    n, a, _ = paths.shape
    columns = {"frame": np.repeat(np.arange(n), a), "animal": np.tile(np.arange(a), n)}
    return pd.DataFrame(columns | dict(zip("xyz", paths.reshape(-1, 3).T, strict=True)))


def _view(camera: Camera, paths: np.ndarray, options: TrackSimulation, rng: np.random.Generator) -> Tracks2D:
    """The rows of one camera."""
    exact = camera.project(paths)
    seen = exact + rng.normal(0.0, options.noise_px, exact.shape)
    there = camera.inside(exact) & camera.inside(seen)
    track = _tracks(len(paths), options, rng)  # (N, A)
    if options.swap_px is not None:
        track = _swapped(track, np.where(there[..., None], seen, np.nan), options, rng)
    kept = there & (rng.random(there.shape) >= options.missed)
    frame, animal = np.nonzero(kept)
    rows = [frame, track[kept], animal, seen[kept]]
    clutter = _clutter(round(options.clutter * len(frame)), camera, options, rng)
    clutter[1] += track.max(initial=-1) + 1
    frame, ids, animal, xy = (np.concatenate(pair) for pair in zip(rows, clutter, strict=True))
    order = np.lexsort((rng.random(len(frame)), frame))
    frame, ids, animal, xy = frame[order], ids[order], animal[order], xy[order]
    if options.tracks == "bare":
        return Tracks2D(camera.name, frame, np.full(len(frame), BARE), xy, (), animal)
    _, ids = np.unique(ids, return_inverse=True)
    n_tracks = int(ids.max(initial=-1)) + 1
    ids = rng.permutation(n_tracks)[ids]
    return Tracks2D(camera.name, frame, ids, xy, tuple(map(str, range(n_tracks))), animal)


def _tracks(n_frames: int, options: TrackSimulation, rng: np.random.Generator) -> np.ndarray:
    """Track of every animal in every frame, (N, A)."""
    n_animals = options.n_animals
    if options.tracks != "fragments":
        return np.tile(np.arange(n_animals), (n_frames, 1))
    low, high = options.piece_frames
    lengths = rng.integers(low, high + 1, (n_frames // low + 1, n_animals))
    ends = np.cumsum(lengths, axis=0)
    frames = np.arange(n_frames)[:, None]
    piece = np.stack([np.searchsorted(ends[:, a], frames[:, 0], side="right") for a in range(n_animals)], 1)
    return piece + len(ends) * np.arange(n_animals)


def _swapped(
    track: np.ndarray, seen: np.ndarray, options: TrackSimulation, rng: np.random.Generator
) -> np.ndarray:
    """Tracks (N, A) after identities are exchanged at encounters in a view."""
    track = track.copy()
    chance = rng.random((len(track), *[track.shape[1]] * 2))
    near_before = np.zeros((track.shape[1],) * 2, dtype=bool)
    for n, pixels in enumerate(seen):
        near = np.hypot(*(pixels[:, None] - pixels).transpose(2, 0, 1)) < options.swap_px
        for a, b in np.argwhere(np.triu(near & ~near_before & (chance[n] < options.swap_chance), 1)):
            track[n:, [a, b]] = track[n:, [b, a]]
        near_before = near
    return track


def _clutter(
    n_rows: int, camera: Camera, options: TrackSimulation, rng: np.random.Generator
) -> list[np.ndarray]:
    """Frame, track, animal and pixels of false tracks of 1–3 frames that drift a few pixels."""
    length = rng.integers(1, 4, n_rows)
    length = length[: np.searchsorted(np.cumsum(length), n_rows, side="left") + 1]
    track = np.repeat(np.arange(len(length)), length)[:n_rows]
    begin = np.concatenate([[0], np.cumsum(length)[:-1]]) if len(length) else np.zeros(0, dtype=int)
    age = np.arange(len(track)) - begin[track]
    start = rng.integers(0, max(options.n_frames - 2, 1), len(length))
    place = rng.uniform(0.0, np.array(camera.resolution) - 1.0, (len(length), 2))
    drift = rng.normal(0.0, 8.0, place.shape)
    xy = np.clip(place[track] + age[:, None] * drift[track], 0.0, np.array(camera.resolution) - 1.0)
    frame = np.minimum(start[track] + age, options.n_frames - 1)
    return [frame, track, np.full(len(track), CLUTTER), xy]


def _check(options: TrackSimulation) -> None:
    """Raise InputError for options that cannot be."""
    allowed = {"motion": MOTIONS, "rig": get_args(Rig), "lens": LENSES, "tracks": get_args(TrackKind)}
    for key, names in allowed.items():
        if getattr(options, key) not in names:
            _fail(options, key, f"one of {', '.join(names)}")
    lowest = {
        "n_animals": 1,
        "n_frames": 1,
        "n_cameras": 2,
        "fps": 1e-6,
        "noise_px": 0,
        "missed": 0,
        "clutter": 0,
    }
    highest = {"missed": 1.0, "swap_chance": 1.0}
    for key in (field.name for field in fields(options)):
        value = getattr(options, key)
        if key in lowest and not lowest[key] <= value < np.inf:
            _fail(options, key, f"at least {lowest[key]:g}")
        if key in highest and not 0 <= value <= highest[key]:
            _fail(options, key, f"between 0 and {highest[key]:g}")
    if not 1 <= options.piece_frames[0] <= options.piece_frames[1]:
        _fail(options, "piece_frames", "shortest and longest piece, 1 frame or more")
    if options.rig == "thesis" and (options.moving or options.n_cameras != 2):
        _fail(options, "rig", "rig 'ring' for moving cameras or any number but two")
    if options.swap_px is not None and options.tracks != "whole":
        _fail(options, "swap_px", "whole tracks: pieces and bare points have no identity to exchange")
    if options.box is not None and not (np.array(options.box[0]) < np.array(options.box[1])).all():
        _fail(options, "box", "lowest and highest (x, y, z), m")


def _fail(options: TrackSimulation, key: str, expected: str) -> None:
    raise InputError(
        "The simulation cannot be made.", key=key, expected=expected, found=str(getattr(options, key))
    )
