"""Keypoint names of files against marker names of a species."""

from __future__ import annotations

from collections.abc import Mapping
from difflib import get_close_matches
from pathlib import Path

from acino_fte.errors import InputError, did_you_mean
from acino_fte.skeleton import Skeleton

_MISSPELT = 0.8  # r_front_knee is no misspelt r_knee (0.67), tail_bass is a misspelt tail_base (0.89)


def match_markers(names: tuple[str, ...], skeleton: Skeleton, path: Path) -> dict[str, str]:
    """Marker by keypoint name, for the keypoints of one file that the species has.

    Raises
    ------
    InputError
        None of them is a marker, or two of them are the same.
    """
    match = skeleton.match_keypoints(names)
    if not match:
        near = [f"'{name}'{did_you_mean(name, skeleton.marker_names)}" for name in names]
        raise InputError(
            f"The keypoint file has no marker of species '{skeleton.name}'.",
            file=path,
            key="bodyparts",
            expected=f"some of {', '.join(skeleton.marker_names)}",
            found=", ".join(near),
            remedy="choose another --species, or add these names as 'aliases' in a species file of your own",
        )
    owner: dict[str, str] = {}
    for name, marker in match.items():
        if marker in owner:
            raise InputError(
                f"Two keypoints mean the same marker '{marker}'.",
                file=path,
                key="bodyparts",
                expected="one keypoint for each marker",
                found=f"'{owner[marker]}' and '{name}'",
                remedy="rename one of them in the file, or remove an alias in the species file",
            )
        owner[marker] = name
    return match


def match_warnings(
    names: Mapping[str, tuple[str, ...]], matches: Mapping[str, Mapping[str, str]], skeleton: Skeleton
) -> list[str]:
    """What the matching left over: keypoints without a marker, markers without a keypoint.

    Parameters
    ----------
    names : mapping
        Keypoint names of each camera's file.
    matches : mapping
        Marker by keypoint name, for each camera.
    skeleton : Skeleton
        The species.
    """
    found = {marker for match in matches.values() for marker in match.values()}
    free = [m for m in skeleton.marker_names if m not in found]
    every = dict.fromkeys(name for listed in names.values() for name in listed)
    dropped = [n for n in every if not any(n in match for match in matches.values())]
    warnings = []
    if dropped:
        near = ", ".join(f"'{name}'{_misspelt(name, free)}" for name in dropped)
        warnings.append(f"Keypoints that species '{skeleton.name}' does not have are left out: {near}")
    if len(dropped) > 0.5 * len(every):
        warnings.append(
            f"Only {len(every) - len(dropped)} of {len(every)} keypoints belong to species "
            f"'{skeleton.name}': is it the right one?"
        )
    if free:
        warnings.append(
            f"Markers of species '{skeleton.name}' that no keypoint file has: {', '.join(free)}. "
            "They follow from the rest of the body."
        )
    for camera, match in matches.items():
        lacking = [m for m in skeleton.marker_names if m in found and m not in match.values()]
        if lacking:
            warnings.append(f"The keypoint file of camera '{camera}' lacks {', '.join(lacking)}.")
    return warnings


def _misspelt(name: str, markers: list[str]) -> str:
    """A suggestion for a keypoint that is a marker but for a letter or so."""
    near = get_close_matches(name.lower(), markers, n=1, cutoff=_MISSPELT)
    return f"; did you mean '{near[0]}'?" if near else ""
