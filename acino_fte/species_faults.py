"""Faults of a species file that its schema cannot see: names that lead nowhere, loops, clashes."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from acino_fte.errors import did_you_mean
from acino_fte.species_file import Fault, SpeciesFile
from acino_fte.species_mirror import Mirrored, mirror_species


def plain_name(name: str) -> str:
    """A keypoint name as it is compared: lower case, letters and digits only."""
    return "".join(c for c in name.lower() if c.isalnum())


def structure_faults(species: SpeciesFile, mirrored: Mirrored | None = None) -> list[Fault]:
    """Every structural fault of a species file, in the order of the file; empty when it is sound.

    Parameters
    ----------
    species : SpeciesFile
        A file that follows the schema.
    mirrored : Mirrored, optional
        Its twins, when they have been made already.
    """
    whole = mirrored or mirror_species(species)
    return [
        *_clashes(species, whole),
        *_parents(whole),
        *_loops({name: entry.parent for name, entry in whole.links.items()}),
        *_marker_links(whole),
        *_pairs(species, whole.markers),
        *_groups(species, whole),
        *_contacts(species, whole),
        *_order(species, whole),
        *_aliases(whole),
    ]


def _clashes(species: SpeciesFile, whole: Mirrored) -> Iterator[Fault]:
    for group, name in whole.clashes:
        twin = (species.links if group == "links" else species.markers)[name].mirror
        yield Fault(
            f"{group}.{name}.mirror",
            f"Two {group} would be called '{twin}' after mirroring.",
            remedy=f"declare '{twin}' once: as the mirror of '{name}', or by hand",
        )


def _parents(whole: Mirrored) -> Iterator[Fault]:
    for name, entry in whole.links.items():
        if entry.parent != "world" and entry.parent not in whole.links and not whole.is_made(name):
            yield Fault(
                f"links.{name}.parent",
                f"Link '{name}' hangs on '{entry.parent}', which is not declared"
                f"{did_you_mean(entry.parent, whole.links)}",
                expected=f"'world' or one of {', '.join(whole.links)}",
                remedy="mend the name, or declare the link",
            )


def _loops(parents: dict[str, str]) -> Iterator[Fault]:
    """Each closed chain of parents once."""
    reported: set[str] = set()
    for start in parents:
        chain = [start]
        while (parent := parents.get(chain[-1])) is not None and parent not in chain:
            chain.append(parent)
        if parent is None or parent in reported:
            continue
        loop = chain[chain.index(parent) :]
        reported |= set(loop)
        yield Fault(
            f"links.{loop[0]}",
            "The links form a loop: none of them leads to the world.",
            found=" <- ".join([*loop, loop[0]]),
            remedy="give one of them 'parent: world', or a parent outside the loop",
        )


def _marker_links(whole: Mirrored) -> Iterator[Fault]:
    made = set(whole.marker_twins.values())
    for name, entry in whole.markers.items():
        if entry.link not in whole.links and name not in made:
            yield Fault(
                f"markers.{name}.link",
                f"Marker '{name}' sits on link '{entry.link}', which is not declared"
                f"{did_you_mean(entry.link, whole.links)}",
                expected=f"one of {', '.join(whole.links)}",
                remedy="mend the name, or declare the link",
            )


def _pairs(species: SpeciesFile, markers: Iterable[str]) -> Iterator[Fault]:
    known = list(markers)
    places = [(f"draw[{i}]", pair) for i, pair in enumerate(species.draw)]
    places += [(f"body[{i}].between", body.between) for i, body in enumerate(species.body)]
    for key, pair in places:
        for name in pair:
            if name not in known:
                yield Fault(
                    key,
                    f"'{name}' is no marker{did_you_mean(name, known)}",
                    expected=f"one of {', '.join(known)}",
                    remedy="mend the name, or declare the marker",
                )
        if pair[0] == pair[1]:
            yield Fault(key, f"'{pair[0]}' is paired with itself.", remedy="name two different markers")


def _groups(species: SpeciesFile, whole: Mirrored) -> Iterator[Fault]:
    """Links that do not exist, and links in two groups (a twin counts as its original)."""
    original = {twin: name for name, twin in whole.link_twins.items()}
    owner: dict[str, str] = {}
    for group, names in species.groups.items():
        for name in names:
            if name not in whole.links:
                yield Fault(
                    f"groups.{group}",
                    f"'{name}' is no link{did_you_mean(name, whole.links)}",
                    expected=f"one of {', '.join(whole.links)}",
                    remedy="mend the name, or declare the link",
                )
            elif owner.setdefault(original.get(name, name), group) != group:
                yield Fault(
                    f"groups.{group}",
                    f"Link '{name}' is in the groups '{owner[original.get(name, name)]}' and '{group}'.",
                    remedy="keep it in one of them; twins always share a group",
                )
        if group in whole.links and original.get(group, group) not in [original.get(n, n) for n in names]:
            yield Fault(
                f"groups.{group}",
                f"The group '{group}' is named like a link that is not in it.",
                remedy="give the group another name",
            )


def _contacts(species: SpeciesFile, whole: Mirrored) -> Iterator[Fault]:
    for name in species.contacts:
        if name not in whole.markers:
            yield Fault(
                "contacts",
                f"'{name}' is no marker{did_you_mean(name, whole.markers)}",
                expected=f"one of {', '.join(whole.markers)}",
                remedy="mend the name, or declare the marker",
            )


def _order(species: SpeciesFile, whole: Mirrored) -> Iterator[Fault]:
    if species.order is None:
        return
    names = [f"{link}.{dof}" for link, entry in whole.links.items() for dof in entry.dofs]
    for name in dict.fromkeys(species.order):
        if name not in names:
            yield Fault(
                "order",
                f"The state order names '{name}', which is no degree of freedom{did_you_mean(name, names)}",
                remedy="use link.dof, as 'acino-fte skeleton show' prints them",
            )
        elif species.order.count(name) > 1:
            yield Fault("order", f"The state order names '{name}' twice.", remedy="keep one of them")
    missing = [name for name in names if name not in species.order]
    if missing:
        yield Fault(
            "order",
            "The state order must name every degree of freedom once.",
            found=f"missing {', '.join(missing)}",
            remedy="complete the list, or leave 'order' out",
        )


def _aliases(whole: Mirrored) -> Iterator[Fault]:
    """One keypoint name must never mean two markers."""
    owner = {plain_name(name): name for name in reversed(whole.markers)}
    for name, entry in whole.markers.items():
        for alias in (name, *entry.aliases):
            other = owner.setdefault(plain_name(alias), name)
            if other != name:
                yield Fault(
                    f"markers.{name}.aliases",
                    f"The name '{alias}' means both marker '{other}' and marker '{name}'.",
                    remedy="remove it from one of them (case and punctuation do not tell names apart)",
                )
