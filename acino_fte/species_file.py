"""The species file: its schema, and how it is read.

A species file declares links, degrees of freedom and markers. It is validated here; what it means
(mirrored twins, indices, radians) is worked out in :mod:`acino_fte.skeleton`.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator

from acino_fte.errors import InputError, did_you_mean

FORMAT = "acino-fte/skeleton/1"
AXES = ("x", "y", "z")
NAME_PATTERN = r"^[A-Za-z][A-Za-z0-9_]*$"

Axis = Literal["x", "y", "z"]
Vector = Annotated[list[float], Field(min_length=3, max_length=3)]
Name = Annotated[str, Field(pattern=NAME_PATTERN)]


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class Units(_Strict):
    """Units of the numbers in the file; they become metres and radians when it is read."""

    length: Literal["m", "cm", "mm"] = "m"
    angle: Literal["deg", "rad"] = "deg"


class DofEntry(_Strict):
    """One degree of freedom: a turn about, or a slide along, an axis of its link."""

    turn: Axis | None = Field(None, description="axis the link turns about (right-hand rule)")
    slide: Axis | None = Field(None, description="axis the link slides along")
    range: Annotated[list[float], Field(min_length=2, max_length=2)] | None = Field(
        None, description="lowest and highest value; leave out for a free one"
    )
    noise: float | None = Field(
        None,
        gt=0,
        description="process noise: standard deviation of the jump in acceleration from one frame to the "
        "next at noise_fps, in length/s² or angle/s²; 5 m/s² or 4000 deg/s² when left out",
    )
    mirror_noise: float | None = Field(None, gt=0, description="noise of the twin when it differs")

    @model_validator(mode="after")
    def _one_motion(self) -> DofEntry:
        if (self.turn is None) == (self.slide is None):
            raise ValueError("give exactly one of 'turn: x|y|z' or 'slide: x|y|z'")
        if self.range is not None and not self.range[0] < self.range[1]:
            raise ValueError(f"range {self.range} must rise from its lowest to its highest value")
        return self

    @property
    def axis(self) -> str:
        """Axis name, whichever the motion."""
        return self.turn or self.slide or ""


class LinkEntry(_Strict):
    """A rigid link: where it hangs on its parent, and how it moves there."""

    parent: str = Field(description="another link, or 'world'")
    at: Vector = Field([0.0, 0.0, 0.0], description="origin of the link in its parent's frame")
    dofs: dict[Name, DofEntry] = Field(
        default_factory=dict, description="degrees of freedom in the order of rotation, outermost first"
    )
    mirror: Name | None = Field(None, description="name of the right-hand twin to make")


class MarkerEntry(_Strict):
    """A point that a keypoint detector sees."""

    link: str
    at: Vector = Field([0.0, 0.0, 0.0], description="position in the link's frame")
    sd_px: float = Field(3.0, gt=0, description="standard deviation of a detection, pixels")
    aliases: list[str] = Field(default_factory=list, description="names that keypoint files use for it")
    mirror: Name | None = Field(None, description="name of the right-hand twin to make")
    mirror_sd_px: float | None = Field(None, gt=0, description="sd_px of the twin when it differs")
    mirror_aliases: list[str] = Field(default_factory=list, description="aliases of the twin")


class BodyEntry(_Strict):
    """A capsule between two markers: the solid body, which hides what is behind it."""

    between: Annotated[list[str], Field(min_length=2, max_length=2)]
    radius: float = Field(gt=0)


class SpeciesFile(_Strict):
    """A whole species file."""

    format: Literal["acino-fte/skeleton/1"]
    name: Name
    source: str = Field("", description="who measured this, and where it is published")
    units: Units = Field(default_factory=Units)
    noise_fps: float = Field(120.0, gt=0, description="frame rate that the process noise is stated at, Hz")
    links: dict[Name, LinkEntry] = Field(min_length=1)
    markers: dict[Name, MarkerEntry] = Field(min_length=1)
    draw: list[Annotated[list[str], Field(min_length=2, max_length=2)]] = Field(default_factory=list)
    body: list[BodyEntry] = Field(default_factory=list)
    groups: dict[Name, Annotated[list[str], Field(min_length=1)]] = Field(
        default_factory=dict,
        description="links whose lengths are estimated together (--fit scale); twins are included, and "
        "every link that is not named makes a group of its own",
    )
    contacts: list[str] = Field(
        default_factory=list,
        description="markers that touch the ground when the animal stands; twins are included",
    )
    order: list[str] | None = Field(
        None, description="order of the state vector (link.dof); by default that of the file"
    )

    @field_validator("links")
    @classmethod
    def _no_world(cls, links: dict[str, LinkEntry]) -> dict[str, LinkEntry]:
        if "world" in links:
            raise ValueError("'world' is the fixed frame; give the link another name")
        return links


class _UniqueKeyLoader(yaml.SafeLoader):
    """Safe loader that refuses a key given twice instead of keeping the last one."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        seen: set[str] = set()
        for key_node, _ in node.value:
            if not isinstance(key_node, yaml.ScalarNode):
                raise yaml.constructor.ConstructorError(
                    None, None, "a key must be a plain word", key_node.start_mark
                )
            if key_node.value in seen:
                raise yaml.constructor.ConstructorError(
                    None, None, f"key '{key_node.value}' is given twice", key_node.start_mark
                )
            seen.add(key_node.value)
        return super().construct_mapping(node, deep)


def read_yaml(path: Path) -> Any:
    """Read a YAML file with the safe loader; duplicate keys are refused.

    Raises
    ------
    InputError
        The file is missing, unreadable, or not YAML.
    """
    try:
        loader = _UniqueKeyLoader(path.read_text(encoding="utf-8"))
        return loader.get_single_data()
    except FileNotFoundError:
        raise InputError("The file does not exist.", file=path, remedy="check the path") from None
    except IsADirectoryError:
        raise InputError("A file is wanted, this is a folder.", file=path) from None
    except OSError as error:
        raise InputError("The file cannot be read.", file=path, found=error.strerror) from None
    except UnicodeDecodeError:
        raise InputError(
            "The file is not text.", file=path, expected="YAML in UTF-8", remedy="check the path"
        ) from None
    except (yaml.YAMLError, RecursionError) as error:
        mark = getattr(error, "problem_mark", None)
        where = f"line {mark.line + 1}, column {mark.column + 1}" if mark else None
        raise InputError(
            "The file is not valid YAML.",
            file=path,
            key=where,
            found=getattr(error, "problem", None) or str(error).split("\n")[0],
            remedy="mend that line (indentation with spaces, a colon after each key)",
        ) from None


@dataclass(frozen=True)
class Fault:
    """One thing that is wrong in a file; the fields are those of :class:`~acino_fte.errors.InputError`."""

    key: str
    problem: str
    expected: str | None = None
    found: str | None = None
    remedy: str | None = None


def raise_first(faults: list[Fault], path: Path | None) -> None:
    """Raise the first of the faults, if any, as an InputError that says how many more there are."""
    if not faults:
        return
    first, more = faults[0], len(faults) - 1
    remedy = first.remedy
    if more:
        hint = f"'acino-fte skeleton check {path}' lists this fault and {more} more"
        remedy = f"{remedy}; {hint}" if remedy else hint
    raise InputError(
        first.problem, file=path, key=first.key, expected=first.expected, found=first.found, remedy=remedy
    )


def validation_faults(error: ValidationError, model: type[BaseModel]) -> list[tuple[str, str]]:
    """Place and description of every validation error, with suggestions for misspelt keys."""
    return [
        (".".join(str(part) for part in item["loc"] if part != "[key]"), _description(dict(item), model))
        for item in error.errors()
    ]


def validation_message(error: ValidationError, model: type[BaseModel]) -> tuple[str, str]:
    """The place and the fault of the first validation error, with a suggestion for a misspelt key."""
    (place, text), *others = validation_faults(error, model)
    return place, text + (f" (and {len(others)} more faults)" if others else "")


def _description(item: dict[str, Any], model: type[BaseModel]) -> str:
    """One validation error in words a biologist can act on."""
    name = str(item["loc"][-1]) if item["loc"] else ""
    if item["type"] == "extra_forbidden":
        known = _known_keys(model, item["loc"][:-1])
        listed = f" (known: {', '.join(known)})" if known else ""
        return f"unknown key '{name}'{did_you_mean(name, known)}{listed}"
    if item["type"] == "missing":
        return "this key is missing"
    if item["type"] == "string_pattern_mismatch":
        return f"'{item['input']}' is no name: begin with a letter, then only letters, digits and _"
    if name == "[key]":
        return (
            f"the name reads as {item['input']!r}, not as text; put it in quotes (YAML takes on, off, "
            "yes, no and numbers for something else)"
        )
    if item["type"] == "value_error":
        return item["msg"].removeprefix("Value error, ")
    return f"{item['msg'][:1].lower()}{item['msg'][1:]}, found {_short(item['input'])}"


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."


def _known_keys(model: type[BaseModel], loc: tuple[int | str, ...]) -> list[str]:
    """Fields of the pydantic model that sits at a location of the document."""
    current: Any = model
    for part in loc:
        if isinstance(current, type) and issubclass(current, BaseModel):
            field = current.model_fields.get(str(part))
            current = _bare(field.annotation) if field else None
        else:  # a dict or a list: step into what it holds
            current = _bare((get_args(current) or (None,))[-1])
    if isinstance(current, type) and issubclass(current, BaseModel):
        return list(current.model_fields)
    return []


def _bare(annotation: Any) -> Any:
    """An annotation without its Annotated and Optional wrapping."""
    while get_origin(annotation) in (Annotated, Union, UnionType):
        annotation = next(a for a in get_args(annotation) if a is not NoneType)
    return annotation


def read_species_file(path: Path) -> SpeciesFile:
    """Read and validate one species file.

    Raises
    ------
    InputError
        The file is missing, is not YAML, or does not follow the schema.
    """
    data = read_species_mapping(path)
    try:
        return SpeciesFile.model_validate(data)
    except ValidationError as error:
        raise_first(schema_faults(error), path)
        raise  # never reached: a validation error has at least one fault


def read_species_mapping(path: Path) -> dict[str, Any]:
    """Read a species file as plain data; only its format line is checked."""
    data = read_yaml(path)
    if not isinstance(data, dict):
        raise InputError(
            "The species file holds no mapping.",
            file=path,
            expected=f"'format: {FORMAT}', then 'name', 'links' and 'markers'",
            found="nothing" if data is None else type(data).__name__,
            remedy="start from 'acino-fte skeleton new NAME'",
        )
    if data.get("format") != FORMAT:
        raise InputError(
            "This is not a species file of a format this version reads.",
            file=path,
            key="format",
            expected=FORMAT,
            found=repr(data.get("format")),
            remedy=f"write 'format: {FORMAT}' as its first line",
        )
    return data


def schema_faults(error: ValidationError) -> list[Fault]:
    """Every place where a species file departs from the schema."""
    remedy = "mend that key; 'acino-fte skeleton schema' prints what is allowed"
    return [
        Fault(place, f"The species file has a fault at '{place}': {text}.", remedy=remedy)
        for place, text in validation_faults(error, SpeciesFile)
    ]


def json_schema() -> dict[str, Any]:
    """JSON Schema of a species file, for completion and checks in an editor."""
    schema = SpeciesFile.model_json_schema()
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **schema}
