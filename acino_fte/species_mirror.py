"""The right half of an animal, made from the left: what ``mirror:`` in a species file means.

The plane of symmetry is y = 0 of every frame. A twin has the y of its position negated, turns the other
way about x and z, and slides the other way along y. Equal values of the degrees of freedom on both sides
then give mirror-image poses, so ranges and noise are copied unchanged.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TypeVar

from acino_fte.species_file import DofEntry, LinkEntry, MarkerEntry, SpeciesFile

_Entry = TypeVar("_Entry", LinkEntry, MarkerEntry)


@dataclass(frozen=True)
class Mirrored:
    """A species file with its right-hand twins made.

    Attributes
    ----------
    links, markers : dict
        All entries by name, each twin after its original.
    link_twins, marker_twins : dict
        Name of the original → name of the twin.
    clashes : tuple of (str, str)
        ``("links", "l_thigh")``: the twin of that entry has a name that another entry has already.
    """

    links: dict[str, LinkEntry]
    markers: dict[str, MarkerEntry]
    link_twins: dict[str, str]
    marker_twins: dict[str, str]
    clashes: tuple[tuple[str, str], ...]

    def is_made(self, link: str) -> bool:
        """Whether a link is a twin made by mirroring."""
        return link in self.link_twins.values()


def mirror_species(species: SpeciesFile) -> Mirrored:
    """Make the twins. Where a name clashes the entry that has it stays, and the clash is listed."""
    links_of = {name: entry.mirror for name, entry in species.links.items() if entry.mirror}

    def link_twin(entry: LinkEntry) -> LinkEntry:
        return entry.model_copy(
            update={
                "at": across(entry.at),
                "parent": links_of.get(entry.parent, entry.parent),
                "dofs": {name: _twin_dof(dof) for name, dof in entry.dofs.items()},
                "mirror": None,
            }
        )

    def marker_twin(entry: MarkerEntry) -> MarkerEntry:
        return entry.model_copy(
            update={
                "at": across(entry.at),
                "link": links_of.get(entry.link, entry.link),
                "aliases": entry.mirror_aliases,
                "sd_px": entry.mirror_sd_px or entry.sd_px,
                "mirror": None,
            }
        )

    links, link_twins, link_clashes = _with_twins(species.links, link_twin)
    markers, marker_twins, marker_clashes = _with_twins(species.markers, marker_twin)
    clashes = [("links", name) for name in link_clashes] + [("markers", name) for name in marker_clashes]
    return Mirrored(links, markers, link_twins, marker_twins, tuple(clashes))


def across(at: list[float]) -> list[float]:
    """Reflect a position in the plane of symmetry, y = 0."""
    return [at[0], -at[1] if at[1] else 0.0, at[2]]


def turns_over(dof: DofEntry) -> bool:
    """Whether the twin of this degree of freedom moves the other way."""
    return dof.axis in ("x", "z") if dof.turn else dof.axis == "y"


def _twin_dof(dof: DofEntry) -> DofEntry:
    return dof.model_copy(update={"noise": dof.mirror_noise or dof.noise})


def _with_twins(
    entries: Mapping[str, _Entry], twin_of: Callable[[_Entry], _Entry]
) -> tuple[dict[str, _Entry], dict[str, str], list[str]]:
    """All entries with their twins, the names of the twins, and the originals whose twin's name is taken."""
    result: dict[str, _Entry] = {}
    twins: dict[str, str] = {}
    clashes: list[str] = []
    for name, entry in entries.items():
        result[name] = entry
        if entry.mirror is None:
            continue
        if entry.mirror in result or entry.mirror in entries:
            clashes.append(name)
            continue
        result[entry.mirror] = twin_of(entry)
        twins[name] = entry.mirror
    return result, twins, clashes
