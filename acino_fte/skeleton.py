"""A species as the program uses it: links, degrees of freedom and markers, mirrored and in SI units."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from functools import cached_property
from hashlib import sha256
from pathlib import Path
from typing import Any

from acino_fte.errors import InputError, did_you_mean
from acino_fte.species_file import AXES, LinkEntry, MarkerEntry, SpeciesFile, read_species_file

_LENGTH = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}
DEFAULT_NOISE = {"turn": math.radians(4000.0), "slide": 5.0}


@dataclass(frozen=True)
class Dof:
    """One degree of freedom.

    Attributes
    ----------
    name : str
        ``link.dof``.
    kind : str
        ``"turn"`` (rad) or ``"slide"`` (m).
    axis : tuple of float
        Unit axis in the link's frame before this motion; negated for a mirrored twin where that
        makes equal values mirror images of each other.
    lower, upper : float
        Range, rad or m; infinite when free.
    noise : float
        Standard deviation of the jump in acceleration per frame at ``Skeleton.noise_fps``,
        rad/s² or m/s².
    """

    name: str
    kind: str
    axis: tuple[float, float, float]
    lower: float
    upper: float
    noise: float

    @property
    def middle(self) -> float:
        """Middle of the range; zero when free."""
        return 0.5 * (self.lower + self.upper) if math.isfinite(self.lower + self.upper) else 0.0

    @property
    def unit(self) -> str:
        """``"rad"`` or ``"m"``."""
        return "rad" if self.kind == "turn" else "m"


@dataclass(frozen=True)
class Link:
    """A rigid link: name, index of its parent (−1: world), origin in the parent (m), its DOF indices.

    The DOF are in the order of rotation, outermost first.
    """

    name: str
    parent: int
    at: tuple[float, float, float]
    dofs: tuple[int, ...]


@dataclass(frozen=True)
class Marker:
    """A marker: its link, position in the link's frame (m), detection noise (px), other names."""

    name: str
    link: int
    at: tuple[float, float, float]
    sd_px: float
    aliases: tuple[str, ...] = ()


@dataclass(frozen=True)
class Skeleton:
    """A species, expanded: mirrored twins made, names resolved, metres and radians.

    ``links`` are ordered parents first; ``dofs`` are in the order of the state vector q.
    """

    name: str
    links: tuple[Link, ...]
    dofs: tuple[Dof, ...]
    markers: tuple[Marker, ...]
    edges: tuple[tuple[int, int], ...] = ()
    capsules: tuple[tuple[int, int, float], ...] = ()
    twins: tuple[tuple[str, str], ...] = ()
    noise_fps: float = 120.0
    source: str = ""
    path: Path | None = field(default=None, compare=False)

    @cached_property
    def dof_names(self) -> list[str]:
        """Names of the degrees of freedom in the order of q."""
        return [d.name for d in self.dofs]

    @cached_property
    def marker_names(self) -> list[str]:
        """Names of the markers."""
        return [m.name for m in self.markers]

    def dof(self, name: str) -> int:
        """Index of a degree of freedom in q."""
        return _index(self.dof_names, name, "degree of freedom", self.name)

    def marker(self, name: str) -> int:
        """Index of a marker."""
        return _index(self.marker_names, name, "marker", self.name)

    def ancestors(self, link: int) -> list[int]:
        """Indices of the DOF that move a link, root first, each link's in the order of rotation."""
        chain: list[int] = []
        while link >= 0:
            chain = [*self.links[link].dofs, *chain]
            link = self.links[link].parent
        return chain

    def match_keypoints(self, names: Iterable[str]) -> dict[str, str]:
        """Map keypoint names of a file to marker names, by name or alias, case and punctuation ignored."""
        known = {_plain(alias): m.name for m in self.markers for alias in m.aliases}
        known |= {_plain(m.name): m.name for m in self.markers}
        return {name: known[_plain(name)] for name in names if _plain(name) in known}

    @cached_property
    def content_hash(self) -> str:
        """Hash of everything the kinematics depend on."""
        parts = [
            (link.parent, link.at, [(self.dofs[d].kind, self.dofs[d].axis, d) for d in link.dofs])
            for link in self.links
        ]
        markers = [(m.link, m.at) for m in self.markers]
        return sha256(repr((parts, markers, len(self.dofs))).encode()).hexdigest()[:24]


def _plain(name: str) -> str:
    return "".join(c for c in name.lower() if c.isalnum())


def _index(names: list[str], name: str, what: str, species: str) -> int:
    try:
        return names.index(name)
    except ValueError:
        raise InputError(
            f"Species '{species}' has no {what} '{name}'{did_you_mean(name, names)}",
            expected=f"one of {', '.join(names)}",
        ) from None


def load_skeleton(species: str | Path) -> Skeleton:
    """Load a species by name (``"cheetah"``) or by the path of its YAML file.

    Raises
    ------
    InputError
        No such species, or the file has a fault.
    """
    from acino_fte import models

    path = Path(species)
    if path.suffix not in (".yaml", ".yml") and not path.is_file():
        names = models.species_names()
        if str(species) not in names:
            raise InputError(
                f"There is no species '{species}'{did_you_mean(str(species), names)}",
                expected=f"one of {', '.join(names)}, or the path of a species file (.yaml)",
                remedy="'acino-fte skeleton list' shows the species, 'acino-fte skeleton new' starts your own",
            )
        path = models.species_path(str(species))
    return expand(read_species_file(path), path)


def expand(species: SpeciesFile, path: Path | None = None) -> Skeleton:
    """Turn a species file into a :class:`Skeleton`: twins, indices, metres, radians."""
    links = _mirror_links(species.links, path)
    markers = _mirror_markers(species, path)
    order = _parents_first({name: entry.parent for name, (entry, _) in links.items()}, path)
    scale = _LENGTH[species.units.length]
    dofs = _expand_dofs(species, links)
    state = _state_order(species, list(dofs), path)
    place = {name: i for i, name in enumerate(state)}
    link_index = {name: i for i, name in enumerate(order)}
    built_links = [
        Link(
            name,
            link_index.get(links[name][0].parent, -1),
            _vector(links[name][0].at, scale),
            tuple(place[f"{name}.{d}"] for d in links[name][0].dofs),
        )
        for name in order
    ]
    built_markers = []
    for name, (entry, _) in markers.items():
        if entry.link not in link_index:
            raise InputError(
                f"Marker '{name}' sits on link '{entry.link}', which is not declared"
                f"{did_you_mean(entry.link, link_index)}",
                file=path,
                key=f"markers.{name}.link",
                expected=f"one of {', '.join(link_index)}",
                remedy="mend the name, or declare the link",
            )
        built_markers.append(
            Marker(name, link_index[entry.link], _vector(entry.at, scale), entry.sd_px, tuple(entry.aliases))
        )
    marker_index = {m.name: i for i, m in enumerate(built_markers)}
    twin = {e.mirror: n for n, (e, made) in markers.items() if e.mirror and not made}
    twins = tuple((original, right) for right, original in twin.items())
    edges = _pairs([(e, f"draw[{i}]") for i, e in enumerate(species.draw)], marker_index, dict(twins), path)
    capsules: list[tuple[int, int, float]] = []
    for i, body in enumerate(species.body):
        pairs = _pairs([(body.between, f"body[{i}].between")], marker_index, dict(twins), path)
        capsules += [(a, b, body.radius * scale) for a, b in pairs]
    _check_aliases(built_markers, path)
    return Skeleton(
        name=species.name,
        links=tuple(built_links),
        dofs=tuple(dofs[name] for name in state),
        markers=tuple(built_markers),
        edges=tuple(edges),
        capsules=tuple(capsules),
        twins=twins,
        noise_fps=species.noise_fps,
        source=species.source,
        path=path,
    )


def _vector(values: list[float], scale: float) -> tuple[float, float, float]:
    return values[0] * scale, values[1] * scale, values[2] * scale


def _with_twins(entries: dict, what: str, path: Path | None, twin_of: Callable) -> dict[str, tuple[Any, bool]]:
    """Add the right-hand twins, each after its original; the flag says which were made."""
    result: dict[str, tuple[Any, bool]] = {}
    for name, entry in entries.items():
        result[name] = (entry, False)
        if entry.mirror is None:
            continue
        if entry.mirror in result or entry.mirror in entries:
            raise InputError(
                f"Two {what}s would be called '{entry.mirror}' after mirroring.",
                file=path,
                key=f"{what}s.{name}.mirror",
                remedy=f"declare '{entry.mirror}' once: as the mirror of '{name}', or by hand",
            )
        result[entry.mirror] = (twin_of(entry), True)
    return result


def _mirror_links(entries: dict[str, LinkEntry], path: Path | None) -> dict[str, tuple[LinkEntry, bool]]:
    twins = {name: entry.mirror for name, entry in entries.items() if entry.mirror}

    def twin_of(entry: LinkEntry) -> LinkEntry:
        parent = twins.get(entry.parent, entry.parent)
        return entry.model_copy(update={"at": _across(entry.at), "parent": parent})

    return _with_twins(entries, "link", path, twin_of)


def _mirror_markers(species: SpeciesFile, path: Path | None) -> dict[str, tuple[MarkerEntry, bool]]:
    twins = {name: entry.mirror for name, entry in species.links.items() if entry.mirror}

    def twin_of(entry: MarkerEntry) -> MarkerEntry:
        update = {
            "at": _across(entry.at),
            "link": twins.get(entry.link, entry.link),
            "aliases": entry.mirror_aliases,
            "sd_px": entry.mirror_sd_px or entry.sd_px,
        }
        return entry.model_copy(update=update)

    return _with_twins(species.markers, "marker", path, twin_of)


def _across(at: list[float]) -> list[float]:
    """Reflect a position in the animal's plane of symmetry (y = 0)."""
    return [at[0], -at[1] if at[1] else 0.0, at[2]]


def _parents_first(parents: dict[str, str], path: Path | None) -> list[str]:
    """Order links so that parents come first; report unknown parents and loops."""
    for name, parent in parents.items():
        if parent != "world" and parent not in parents:
            raise InputError(
                f"Link '{name}' hangs on '{parent}', which is not declared{did_you_mean(parent, parents)}",
                file=path,
                key=f"links.{name}.parent",
                expected=f"'world' or one of {', '.join(parents)}",
                remedy="mend the name, or declare the link",
            )
    order: list[str] = []
    done = {"world"}
    while len(order) < len(parents):
        ready = [n for n, p in parents.items() if n not in done and p in done]
        if not ready:
            loop = [n for n in parents if n not in done]
            raise InputError(
                "The links form a loop: none of them leads to the world.",
                file=path,
                key="links." + loop[0],
                found=" <- ".join(loop),
                remedy="give one of them 'parent: world'",
            )
        order += ready[:1]
        done.add(ready[0])
    return order


def _expand_dofs(species: SpeciesFile, links: dict) -> dict[str, Dof]:
    """Degrees of freedom by name; a twin turns the other way about x and z and slides the other way in y."""
    angle = math.pi / 180.0 if species.units.angle == "deg" else 1.0
    length = _LENGTH[species.units.length]
    dofs = {}
    for link, (entry, made) in links.items():
        for name, dof in entry.dofs.items():
            kind = "turn" if dof.turn else "slide"
            scale = angle if kind == "turn" else length
            flip = made and ((kind == "turn") == (dof.axis in "xz"))
            axis = [0.0, 0.0, 0.0]
            axis[AXES.index(dof.axis)] = -1.0 if flip else 1.0
            lower, upper = dof.range or (-math.inf, math.inf)
            noise = dof.noise * scale if dof.noise else DEFAULT_NOISE[kind]
            dofs[f"{link}.{name}"] = Dof(
                f"{link}.{name}", kind, (axis[0], axis[1], axis[2]), lower * scale, upper * scale, noise
            )
    return dofs


def _state_order(species: SpeciesFile, names: list[str], path: Path | None) -> list[str]:
    if species.order is None:
        return names
    for name in species.order:
        if name not in names:
            raise InputError(
                f"The state order names '{name}', which is no degree of freedom{did_you_mean(name, names)}",
                file=path,
                key="order",
                remedy="use link.dof, as 'acino-fte skeleton show' prints them",
            )
    if sorted(species.order) != sorted(names):
        missing = [n for n in names if n not in species.order]
        raise InputError(
            "The state order must name every degree of freedom once.",
            file=path,
            key="order",
            found=f"missing {', '.join(missing)}" if missing else "a name given twice",
            remedy="complete the list, or leave 'order' out",
        )
    return list(species.order)


def _pairs(
    pairs: list[tuple[list[str], str]], index: dict[str, int], twins: dict[str, str], path: Path | None
) -> list[tuple[int, int]]:
    """Marker pairs as indices, with the mirror image of each pair that has one."""
    result: list[tuple[int, int]] = []
    for pair, key in pairs:
        for name in pair:
            if name not in index:
                raise InputError(
                    f"'{name}' is no marker{did_you_mean(name, index)}",
                    file=path,
                    key=key,
                    expected=f"one of {', '.join(index)}",
                    remedy="mend the name, or declare the marker",
                )
        for names in (pair, [twins.get(n, n) for n in pair]):
            edge = (index[names[0]], index[names[1]])
            if edge not in result and edge[::-1] not in result:
                result.append(edge)
    return result


def _check_aliases(markers: list[Marker], path: Path | None) -> None:
    """One keypoint name must never mean two markers."""
    owner: dict[str, str] = {}
    for marker in markers:
        for alias in (marker.name, *marker.aliases):
            other = owner.setdefault(_plain(alias), marker.name)
            if other != marker.name:
                raise InputError(
                    f"The name '{alias}' means both marker '{other}' and marker '{marker.name}'.",
                    file=path,
                    key=f"markers.{marker.name}.aliases",
                    remedy="remove it from one of them",
                )
