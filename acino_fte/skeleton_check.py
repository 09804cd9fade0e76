"""Check a species file: all that is wrong with it, and what is likely to be a mistake."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from copy import deepcopy
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import ValidationError

from acino_fte.errors import InputError, did_you_mean
from acino_fte.skeleton import Skeleton, expand, species_file_path
from acino_fte.species_faults import structure_faults
from acino_fte.species_file import (
    Fault,
    LinkEntry,
    MarkerEntry,
    SpeciesFile,
    read_species_mapping,
    schema_faults,
)
from acino_fte.species_mirror import Mirrored, mirror_species

_SMALLEST, _LARGEST = 0.002, 15.0  # m: from a fruit fly to a whale that is not stretched out


@dataclass(frozen=True)
class Finding:
    """One thing found by :func:`check_skeleton`.

    Attributes
    ----------
    severity : str
        ``"error"``: the file cannot be used, or something in it can have no effect. ``"warning"``: it can
        be used, but is probably not what was meant.
    where : str
        Key in the species file, such as ``links.head.dofs.yaw``.
    message, remedy : str
        What is wrong, and what to do.
    """

    severity: Literal["error", "warning"]
    where: str
    message: str
    remedy: str = ""


def check_skeleton(species: str | Path, keypoints: Path | None = None) -> list[Finding]:
    """Check a species file, and optionally that a keypoint file fits it.

    Parameters
    ----------
    species : str or Path
        A bundled species by name, or the path of a species file.
    keypoints : Path, optional
        A DeepLabCut table whose body parts are matched with the markers.

    Returns
    -------
    list of Finding
        Errors before warnings, otherwise in the order of the file; empty when all is well.

    Raises
    ------
    InputError
        There is no such file, or the keypoint file cannot be read.
    """
    path = species_file_path(species)
    if not path.exists():
        raise InputError("The species file does not exist.", file=path, remedy="check the path")
    file, faults = _read(path)
    findings = [_as_error(fault) for fault in faults]
    whole = mirror_species(file) if file else None
    if file and whole:
        findings += [_as_error(fault) for fault in structure_faults(file, whole)]
    if file and whole and not findings:
        skeleton = expand(file, path)
        findings += [
            *_root(skeleton),
            *_unused_links(skeleton, whole),
            *_one_sided(file, whole),
            *_ranges(file),
        ]
        findings += [*_size(skeleton), *_undrawn(skeleton), *_unseen(skeleton)]
        if keypoints is not None:
            findings += match_keypoints(skeleton, keypoints).findings
    return sorted(findings, key=lambda finding: finding.severity)


def _as_error(fault: Fault) -> Finding:
    message = fault.problem + (f" Found: {fault.found}." if fault.found else "")
    return Finding("error", fault.key, message, fault.remedy or "")


def _read(path: Path) -> tuple[SpeciesFile | None, list[Fault]]:
    """The species file and its departures from the schema; unknown keys are set aside to see further."""
    try:
        data = read_species_mapping(path)
    except InputError as error:
        found = f"{error.found}, expected {error.expected}" if error.found and error.expected else error.found
        return None, [Fault(error.key or "file", error.problem, found=found, remedy=error.remedy)]
    try:
        return SpeciesFile.model_validate(data), []
    except ValidationError as error:
        faults = schema_faults(error)
        try:
            return SpeciesFile.model_validate(_without_unknown_keys(data, error)), faults
        except ValidationError:
            return None, faults


def _without_unknown_keys(data: dict[str, Any], error: ValidationError) -> dict[str, Any]:
    result = deepcopy(data)
    for item in error.errors():
        if item["type"] == "extra_forbidden":
            holder: Any = result
            for part in item["loc"][:-1]:
                holder = holder[part]
            del holder[item["loc"][-1]]
    return result


def _root(skeleton: Skeleton) -> Iterator[Finding]:
    """The animal must be able to go and turn anywhere: three slides and a free turn about the vertical."""
    roots = [link for link in skeleton.links if link.parent < 0]
    dofs = [skeleton.dofs[j] for link in roots for j in link.dofs]
    slides = {abs(np.array(d.axis)).argmax() for d in dofs if d.kind == "slide"}
    missing = [axis for i, axis in enumerate("xyz") if i not in slides]
    if missing:
        yield Finding(
            "warning",
            f"links.{roots[0].name}.dofs",
            f"The animal cannot move along {', '.join(missing)}: no link on the world slides there.",
            f"add {', '.join(f'{a}: {{slide: {a}}}' for a in missing)} unless the animal is held there",
        )
    headings = [d for d in dofs if d.kind == "turn" and d.axis[2]]
    if not headings:
        yield Finding(
            "warning",
            f"links.{roots[0].name}.dofs",
            "The animal cannot turn round: no link on the world turns about z.",
            "add yaw: {turn: z} unless the animal is held",
        )
    for dof in headings:
        if math.isfinite(dof.upper - dof.lower):
            yield Finding(
                "warning",
                f"links.{dof.name.replace('.', '.dofs.')}.range",
                f"The heading '{dof.name}' has a range, so the animal cannot face every way.",
                "leave 'range' out",
            )
    for link in roots[1:]:
        yield Finding(
            "warning",
            f"links.{link.name}.parent",
            f"Link '{link.name}' hangs on the world as '{roots[0].name}' does: they can drift apart.",
            f"let it hang on '{roots[0].name}', unless it is another body",
        )


def _carriers(skeleton: Skeleton) -> set[int]:
    """Links that carry a marker, themselves or on what hangs on them."""
    used: set[int] = set()
    for marker in skeleton.markers:
        link = marker.link
        while link >= 0 and link not in used:
            used.add(link)
            link = skeleton.links[link].parent
    return used


def _unused_links(skeleton: Skeleton, whole: Mirrored) -> Iterator[Finding]:
    used = _carriers(skeleton)
    for i, link in enumerate(skeleton.links):
        if i not in used and not whole.is_made(link.name):
            yield Finding(
                "error" if link.dofs else "warning",
                f"links.{link.name}",
                f"Link '{link.name}' is unused: it carries no marker, and nothing on it does.",
                "put a marker on it, or remove the link",
            )


def _one_sided(file: SpeciesFile, whole: Mirrored) -> Iterator[Finding]:
    """Things on a mirrored link that stay on the left, and twins that lie on top of each other."""
    entries: list[tuple[str, Mapping[str, LinkEntry] | Mapping[str, MarkerEntry], bool]] = [
        ("links", file.links, True),
        ("markers", file.markers, False),
    ]
    for group, listed, is_link in entries:
        for name, entry in listed.items():
            holder = entry.parent if isinstance(entry, LinkEntry) else entry.link
            where, what = f"{group}.{name}", "Link" if is_link else "Marker"
            twin = whole.link_twins.get(holder)
            users = [e.parent if isinstance(e, LinkEntry) else e.link for e in listed.values()]
            if entry.mirror is None and twin and twin not in users:
                yield Finding(
                    "warning",
                    where,
                    f"{what} '{name}' is on '{holder}', which has the twin '{twin}', but has no twin itself.",
                    f"add 'mirror: NAME' to '{name}', unless the animal is one-sided there",
                )
            if entry.mirror and not twin and entry.at[1] == 0:
                yield Finding(
                    "warning",
                    f"{where}.at",
                    f"{what} '{name}' and its twin '{entry.mirror}' start at the same point: y is 0.",
                    "give y its distance from the midline, positive to the left",
                )


def _ranges(file: SpeciesFile) -> Iterator[Finding]:
    """Ranges that look like degrees for radians or the reverse."""
    full = 360.0 if file.units.angle == "deg" else math.tau
    other = "radians" if file.units.angle == "deg" else "degrees"
    for link, entry in file.links.items():
        for name, dof in entry.dofs.items():
            if dof.turn is None or dof.range is None:
                continue
            where, span = f"links.{link}.dofs.{name}.range", dof.range[1] - dof.range[0]
            if span > full:
                text = f"allows more than a whole turn; are these {other}?"
            elif span < full / 200:
                text = f"allows less than two degrees; are these {other}?"
            elif max(map(abs, dof.range)) > full:
                text = "lies beyond a whole turn"
            else:
                continue
            yield Finding(
                "warning",
                where,
                f"The range {dof.range} of '{link}.{name}' {text}",
                f"the file's unit is {file.units.angle} (units.angle)",
            )


def _size(skeleton: Skeleton) -> Iterator[Finding]:
    """An animal of an unlikely size, and markers that lie on each other for ever."""
    reach: list[float] = []
    for link in skeleton.links:
        reach.append((reach[link.parent] if link.parent >= 0 else 0.0) + math.hypot(*link.at))
    size = max(reach[m.link] + math.hypot(*m.at) for m in skeleton.markers)
    if not _SMALLEST < size < _LARGEST:
        yield Finding(
            "warning",
            "units.length",
            f"From its root to its farthest marker the animal measures {size:.3g} m.",
            "check 'units: {length: m|cm|mm}'",
        )
    seen: dict[tuple[int, tuple[float, float, float]], str] = {}
    for marker in skeleton.markers:
        other = seen.setdefault((marker.link, marker.at), marker.name)
        if other != marker.name:
            yield Finding(
                "warning",
                f"markers.{marker.name}.at",
                f"Markers '{other}' and '{marker.name}' are the same point.",
                f"move one, or make its name an alias of '{other}'",
            )


def _undrawn(skeleton: Skeleton) -> Iterator[Finding]:
    """Markers on no line of the picture."""
    drawn = {i for edge in skeleton.edges for i in edge}
    free = [m.name for i, m in enumerate(skeleton.markers) if i not in drawn]
    if free:
        yield Finding(
            "warning",
            "draw",
            f"No line leads to {', '.join(free)}: pictures show {'it' if len(free) == 1 else 'them'} alone.",
            "add a pair such as [marker, marker] to 'draw'",
        )


def _unseen(skeleton: Skeleton, only: list[str] | None = None) -> Iterator[Finding]:
    """Degrees of freedom that no marker observes, alone or together."""
    from acino_fte.observability import observability

    found = observability(skeleton, only)
    by = "the markers of this keypoint file" if only else "the markers"
    unused = {j for i, link in enumerate(skeleton.links) if i not in _carriers(skeleton) for j in link.dofs}
    for name in found.unseen:
        if skeleton.dof(name) in unused:
            continue  # _unused_links has said so
        yield Finding(
            "warning" if only else "error",
            f"links.{name.replace('.', '.dofs.')}",
            f"No marker moves with '{name}': {by} can never tell its value.",
            "add a marker off its axis on that link or further out, or remove the degree of freedom",
        )
    for group in found.confounded:
        yield Finding(
            "warning",
            f"links.{group[0].replace('.', '.dofs.')}",
            f"{by.capitalize()} cannot tell {', '.join(group)} apart: together they can move without "
            "moving any marker.",
            "add a marker between them, or remove one; else the estimate spreads the motion over them",
        )


@dataclass(frozen=True)
class KeypointMatch:
    """Which markers a keypoint file has: marker name by keypoint name, and what does not fit."""

    matched: dict[str, str]
    findings: list[Finding]


def match_keypoints(skeleton: Skeleton, path: Path) -> KeypointMatch:
    """Match the body parts of a DeepLabCut table with the markers of a species.

    Raises
    ------
    InputError
        The table cannot be read.
    """
    from acino_fte.data_tools.deeplabcut import read_deeplabcut

    names = read_deeplabcut(path).names
    matched = skeleton.match_keypoints(names)
    free = [m for m in skeleton.marker_names if m not in matched.values()]
    findings = []
    for name in names:
        if name not in matched:
            findings.append(
                Finding(
                    "warning",
                    str(path),
                    f"Keypoint '{name}' is no marker{did_you_mean(name, free)}",
                    f"add '{name}' to the 'aliases' of its marker, else it is left out",
                )
            )
    for marker in sorted({m for m in matched.values() if list(matched.values()).count(m) > 1}):
        both = [name for name, m in matched.items() if m == marker]
        findings.append(
            Finding(
                "error",
                f"markers.{marker}.aliases",
                f"Keypoints {', '.join(both)} all mean marker '{marker}'.",
                "make one of them a marker of its own, or remove its alias",
            )
        )
    if not matched:
        text = f"None of the {len(names)} keypoints is a marker of species '{skeleton.name}'."
        findings.append(Finding("error", str(path), text, "choose another species, or add aliases"))
    elif free:
        text = f"Markers without a keypoint: {', '.join(free)}."
        findings.append(Finding("warning", str(path), text, "nothing to do; they follow from the rest"))
        findings += _unseen(skeleton, sorted(set(matched.values())))
    return KeypointMatch(matched, findings)
