"""What else is true of a simulated recording: ``truth_parameters.json``.

Clocks, camera poses, proportions and left/right swaps, as
:attr:`acino_fte.simulate.Simulation.truth_parameters` has them.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from acino_fte.errors import InputError
from acino_fte.skeleton import Skeleton
from acino_fte.species_file import validation_message

FORMAT = "acino-fte/truth-parameters/1"
FILE_NAME = "truth_parameters.json"

_Vector = tuple[float, float, float]


class Correction(BaseModel):
    """What corrects the given pose of a camera: x_camera = Exp(rotation)·(R x + t) + translation."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)

    rotation_rad: _Vector = Field(description="rotation vector, rad")
    translation_m: _Vector = Field(description="m")


class TruthParametersFile(BaseModel):
    """The content of a ``truth_parameters.json``; what is not known is left out."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)

    format: Literal["acino-fte/truth-parameters/1"]
    time_offset_s: dict[str, float] = Field({}, description="frame n of a camera is seen at t_n + this, s")
    extrinsics: dict[str, Correction] = Field({}, description="by camera")
    segment_scale: dict[str, Annotated[float, Field(gt=0)]] = Field({}, description="by segment group")
    marker_offset_m: dict[str, _Vector] = Field({}, description="by marker, in its link's frame")
    swapped: list[tuple[Annotated[int, Field(ge=0)], str, list[str]]] = Field(
        [], description="frame, camera, markers that took the places of their twins"
    )


def read_truth_parameters(
    path: Path | str, skeleton: Skeleton, cameras: Iterable[str], n_frames: int
) -> dict[str, Any]:
    """Read the true parameters of a recording.

    Returns
    -------
    dict
        Plain values, of the cameras and frames of the recording and the groups and markers of the species
        only: a camera may be left out of a recording, another species be tried. What the file does not have
        is not there.

    Raises
    ------
    InputError
        The file is missing, is no such file, or is about other cameras.
    """
    path = Path(path)
    content = _read(path).model_dump(mode="json", exclude_unset=True, exclude={"format"})
    known = {
        "time_offset_s": set(cameras),
        "extrinsics": set(cameras),
        "segment_scale": set(skeleton.groups),
        "marker_offset_m": set(skeleton.marker_names),
    }
    for family in ("time_offset_s", "extrinsics"):
        if content.get(family) and known[family].isdisjoint(content[family]):
            raise InputError(
                "The true parameters are about other cameras.",
                file=path,
                key=family,
                expected=f"some of {', '.join(sorted(known[family]))}",
                found=", ".join(content[family]),
                remedy="leave 'truth_parameters' out, or name the file of this recording",
            )
    result: dict[str, Any] = {
        family: {name: value for name, value in content[family].items() if name in known[family]}
        for family in known
        if family in content
    }
    if "swapped" in content:
        swaps = [
            [frame, camera, [m for m in markers if m in known["marker_offset_m"]]]
            for frame, camera, markers in content["swapped"]
            if frame < n_frames and camera in known["extrinsics"]
        ]
        result["swapped"] = [swap for swap in swaps if swap[2]]
    return result


def _read(path: Path) -> TruthParametersFile:
    remedy = "mend it, or leave out 'truth_parameters'"
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise InputError(
            "The file of true parameters does not exist.", file=path, remedy="mend 'truth_parameters'"
        ) from None
    except (ValueError, OSError) as error:  # JSONDecodeError and UnicodeDecodeError are ValueErrors
        raise InputError(
            "The file of true parameters cannot be read.",
            file=path,
            expected="JSON",
            found=str(error),
            remedy=remedy,
        ) from None
    if not isinstance(data, dict) or data.get("format") != FORMAT:
        raise InputError(
            "These are not true parameters in a format that this version reads.",
            file=path,
            key="format",
            expected=FORMAT,
            found=repr(data.get("format")) if isinstance(data, dict) else type(data).__name__,
            remedy=remedy,
        )
    try:
        return TruthParametersFile.model_validate(data)
    except ValidationError as error:
        place, text = validation_message(error, TruthParametersFile)
        raise InputError(
            f"The file of true parameters has a fault at '{place}': {text}.",
            file=path,
            key=place,
            remedy=remedy,
        ) from None


def write_truth_parameters(path: Path | str, parameters: Mapping[str, Any]) -> None:
    """Write true parameters, one line per camera, group, marker or image; numbers keep every digit."""
    families = [f'"format": {json.dumps(FORMAT)}']
    for family, values in parameters.items():
        if isinstance(values, Mapping):
            lines = [f"{json.dumps(name)}: {json.dumps(value)}" for name, value in values.items()]
            text = "{\n  " + ",\n  ".join(lines) + "\n }" if lines else "{}"
        else:
            lines = [json.dumps(value) for value in values]
            text = "[\n  " + ",\n  ".join(lines) + "\n ]" if lines else "[]"
        families.append(f"{json.dumps(family)}: {text}")
    Path(path).write_text("{\n " + ",\n ".join(families) + "\n}\n", encoding="utf-8")
