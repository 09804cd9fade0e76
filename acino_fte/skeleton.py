"""A species as the program uses it: links, degrees of freedom and markers, mirrored and in SI units."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from hashlib import sha256
from pathlib import Path

import numpy as np

from acino_fte.errors import InputError, did_you_mean
from acino_fte.species_faults import plain_name, structure_faults
from acino_fte.species_file import AXES, DofEntry, SpeciesFile, raise_first, read_species_file
from acino_fte.species_mirror import Mirrored, mirror_species, turns_over

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

    The DOF are in the order of rotation, outermost first. ``group`` is the index in ``Skeleton.groups`` of
    the scale that everything attached to the link shares (−1: nothing is attached).
    """

    name: str
    parent: int
    at: tuple[float, float, float]
    dofs: tuple[int, ...]
    group: int = -1


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

    Attributes
    ----------
    links : tuple of Link
        Parents first.
    dofs : tuple of Dof
        In the order of the state vector q.
    edges : tuple of (int, int)
        Marker pairs to draw a line between.
    capsules : tuple of (int, int, float)
        Solid body: marker pairs and the radius (m) of the capsule between them.
    twins : tuple of (str, str)
        Markers and their mirrored twins: left, right.
    noise_fps : float
        Frame rate (Hz) that the process noise of the DOF is stated at.
    groups : tuple of str
        Names of the segment groups: the lengths of a group's links have one scale in common.
    contacts : tuple of int
        Markers that touch the ground when the animal stands, in the order of the markers.
    """

    name: str
    links: tuple[Link, ...]
    dofs: tuple[Dof, ...]
    markers: tuple[Marker, ...]
    edges: tuple[tuple[int, int], ...] = ()
    capsules: tuple[tuple[int, int, float], ...] = ()
    twins: tuple[tuple[str, str], ...] = ()
    noise_fps: float = 120.0
    groups: tuple[str, ...] = ()
    contacts: tuple[int, ...] = ()
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
        known = {plain_name(alias): m.name for m in self.markers for alias in (m.name, *m.aliases)}
        return {name: known[plain_name(name)] for name in names if plain_name(name) in known}

    @cached_property
    def content_hash(self) -> str:
        """Hash of everything the kinematics depend on."""
        parts = [
            (link.parent, link.at, link.group, [(self.dofs[d].kind, self.dofs[d].axis, d) for d in link.dofs])
            for link in self.links
        ]
        markers = [(m.link, m.at) for m in self.markers]
        return sha256(repr((parts, markers, len(self.dofs), len(self.groups))).encode()).hexdigest()[:24]


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
    path = species_file_path(species)
    return expand(read_species_file(path), path)


def species_file_path(species: str | Path) -> Path:
    """Path of a species file: of a bundled species by its name, else the path given.

    Raises
    ------
    InputError
        It is neither the name of a bundled species nor a file.
    """
    from acino_fte import models

    path, names = Path(species), models.species_names()
    if str(species) in names:
        return models.species_path(str(species))
    if path.suffix in (".yaml", ".yml") or path.is_file():
        return path
    raise InputError(
        f"There is no species '{species}'{did_you_mean(str(species), names)}",
        expected=f"one of {', '.join(names)}, or the path of a species file (.yaml)",
        remedy="'acino-fte skeleton list' shows the species, 'acino-fte skeleton new' starts your own",
    )


def expand(species: SpeciesFile, path: Path | None = None) -> Skeleton:
    """Turn a species file into a :class:`Skeleton`: twins, indices, metres, radians.

    Raises
    ------
    InputError
        The file follows the schema but contradicts itself (unknown names, loops, clashes).
    """
    whole = mirror_species(species)
    raise_first(structure_faults(species, whole), path)
    scale = _LENGTH[species.units.length]
    dofs = _expand_dofs(species, whole)
    state = species.order or list(dofs)
    groups, group_of = _groups(species, whole)
    links = _expand_links(whole, {name: i for i, name in enumerate(state)}, scale, group_of)
    link_index = {link.name: i for i, link in enumerate(links)}
    markers = tuple(
        Marker(name, link_index[entry.link], _vector(entry.at, scale), entry.sd_px, tuple(entry.aliases))
        for name, entry in whole.markers.items()
    )
    marker_index = {m.name: i for i, m in enumerate(markers)}
    capsules: dict[tuple[int, int], float] = {}
    for body in species.body:
        for pair in _with_mirror_images([body.between], marker_index, whole.marker_twins):
            capsules[pair] = body.radius * scale
    return Skeleton(
        name=species.name,
        links=links,
        dofs=tuple(dofs[name] for name in state),
        markers=markers,
        edges=_with_mirror_images(species.draw, marker_index, whole.marker_twins),
        capsules=tuple((a, b, radius) for (a, b), radius in capsules.items()),
        twins=tuple(whole.marker_twins.items()),
        noise_fps=species.noise_fps,
        groups=groups,
        contacts=_contacts(species, whole),
        source=species.source,
        path=path,
    )


def _vector(values: list[float], scale: float) -> tuple[float, float, float]:
    return values[0] * scale, values[1] * scale, values[2] * scale


def _groups(species: SpeciesFile, whole: Mirrored) -> tuple[tuple[str, ...], dict[str, int]]:
    """Names of the segment groups, and the group of every link that something is attached to.

    Twins share a group; a link in no declared group makes one of its own.
    """
    attached = [(entry.parent, entry.at) for entry in whole.links.values()]
    attached += [(entry.link, entry.at) for entry in whole.markers.values()]
    long = {name for name, at in attached if any(at)}
    original = {twin: name for name, twin in whole.link_twins.items()}
    declared = {original.get(n, n): group for group, names in species.groups.items() for n in names}
    group_of = {
        name: declared.get(original.get(name, name), original.get(name, name))
        for name in whole.links
        if name in long
    }
    names = tuple(dict.fromkeys(group_of.values()))
    return names, {name: names.index(group) for name, group in group_of.items()}


def _contacts(species: SpeciesFile, whole: Mirrored) -> tuple[int, ...]:
    """Indices of the markers that touch the ground; twins touch it with their originals."""
    original = {twin: name for name, twin in whole.marker_twins.items()}
    touching = {original.get(name, name) for name in species.contacts}
    return tuple(i for i, name in enumerate(whole.markers) if original.get(name, name) in touching)


def deformed(
    skeleton: Skeleton,
    scales: Mapping[str, float] | None = None,
    offsets: Mapping[str, Iterable[float]] | None = None,
) -> Skeleton:
    """The same species with other proportions: one individual.

    Parameters
    ----------
    skeleton : Skeleton
        The species.
    scales : dict, optional
        Factor on the lengths of a segment group, by its name.
    offsets : dict, optional
        Displacement (x, y, z) of a marker in its link's frame, m, by its name.
    """
    factor = np.ones(len(skeleton.groups) + 1)  # the last one is for links without a group
    for name, value in (scales or {}).items():
        factor[_index(list(skeleton.groups), name, "segment group", skeleton.name)] = value
    shift = np.zeros((len(skeleton.markers), 3))
    for name, vector in (offsets or {}).items():
        shift[skeleton.marker(name)] = list(vector)

    def scaled(at: tuple[float, float, float], parent: int) -> np.ndarray:
        group = skeleton.links[parent].group if parent >= 0 else -1
        return np.array(at) * factor[group]

    links = tuple(replace(link, at=tuple(scaled(link.at, link.parent).tolist())) for link in skeleton.links)
    markers = tuple(
        replace(m, at=tuple((scaled(m.at, m.link) + shift[i]).tolist()))
        for i, m in enumerate(skeleton.markers)
    )
    return replace(skeleton, links=links, markers=markers)


def _expand_links(
    whole: Mirrored, place: Mapping[str, int], scale: float, group_of: Mapping[str, int]
) -> tuple[Link, ...]:
    """Links, parents first, otherwise in the order of the file."""
    parents = {name: entry.parent for name, entry in whole.links.items()}
    order: list[str] = []
    while len(order) < len(parents):
        order.append(next(n for n, p in parents.items() if n not in order and p in ("world", *order)))
    return tuple(
        Link(
            name,
            order.index(parents[name]) if parents[name] != "world" else -1,
            _vector(whole.links[name].at, scale),
            tuple(place[f"{name}.{dof}"] for dof in whole.links[name].dofs),
            group_of.get(name, -1),
        )
        for name in order
    )


def _expand_dofs(species: SpeciesFile, whole: Mirrored) -> dict[str, Dof]:
    """Degrees of freedom by name, in the order of the file."""
    scales = {
        "turn": math.pi / 180.0 if species.units.angle == "deg" else 1.0,
        "slide": _LENGTH[species.units.length],
    }
    return {
        f"{link}.{name}": _expand_dof(f"{link}.{name}", dof, scales, whole.is_made(link) and turns_over(dof))
        for link, entry in whole.links.items()
        for name, dof in entry.dofs.items()
    }


def _expand_dof(name: str, entry: DofEntry, scales: Mapping[str, float], flip: bool) -> Dof:
    kind = "turn" if entry.turn else "slide"
    scale = scales[kind]
    axis = [0.0, 0.0, 0.0]
    axis[AXES.index(entry.axis)] = -1.0 if flip else 1.0
    lower, upper = entry.range or (-math.inf, math.inf)
    noise = entry.noise * scale if entry.noise else DEFAULT_NOISE[kind]
    return Dof(name, kind, (axis[0], axis[1], axis[2]), lower * scale, upper * scale, noise)


def _with_mirror_images(
    pairs: list[list[str]], index: Mapping[str, int], twins: Mapping[str, str]
) -> tuple[tuple[int, int], ...]:
    """Marker pairs as indices, each followed by its mirror image where it has one; none twice."""
    result: list[tuple[int, int]] = []
    image = {**twins, **{right: left for left, right in twins.items()}}
    for pair in pairs:
        for a, b in (pair, [image.get(name, name) for name in pair]):
            edge = (index[a], index[b])
            if edge not in result and edge[::-1] not in result:
                result.append(edge)
    return tuple(result)
