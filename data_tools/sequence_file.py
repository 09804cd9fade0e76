"""``sequence.yaml``: what belongs to one recording."""

from __future__ import annotations

from math import hypot
from pathlib import Path
from typing import Annotated, Any, Literal

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator

from acino_fte.errors import InputError
from acino_fte.species_file import read_yaml, validation_message

FORMAT = "acino-fte/sequence/1"
FILE_NAME = "sequence.yaml"
Beam = Annotated[float, Field(ge=0, le=10)]


class Ground(BaseModel):
    """The plane that the animal stands on, in the world frame."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    normal: tuple[float, float, float] = Field((0.0, 0.0, 1.0), description="upwards, of any length")
    height: float = Field(0.0, description="of the plane along its normal, from the origin, m")

    @field_validator("normal")
    @classmethod
    def _has_a_direction(cls, value: tuple[float, float, float]) -> tuple[float, float, float]:
        if not 1e-9 < hypot(*value) < 1e9:
            raise ValueError(f"the normal {list(value)} has no direction; [0, 0, 1] is level ground")
        return value

    @property
    def plane(self) -> tuple[float, float, float, float]:
        """a, b, c, d with a x + b y + c z = d (m) and a unit normal (a, b, c)."""
        a, b, c = (float(v / hypot(*self.normal)) for v in self.normal)
        return a, b, c, self.height


class LidarEntry(BaseModel):
    """A lidar that is calibrated to one of the cameras."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    camera: str = Field(description="the camera that it is calibrated to")
    returns: str = Field(
        description=".npz with time (s since frame 0), xyz (m, the lidar's frame), intensity"
    )
    calibration: str = Field(description="file with lidar_to_camera, as calibrate_lidar.py writes it")
    direction: Literal["lidar_to_camera", "camera_to_lidar"] | None = Field(
        None, description="which way the calibration goes, where its file does not say so"
    )
    range_sd: float = Field(0.02, gt=0, description="standard deviation of a range close by, m")
    range_sd_per_m: float = Field(
        1e-4, ge=0, le=1, description="what it has in addition for every metre, in quadrature"
    )
    beam_deg: tuple[Beam, Beam] = Field(
        (0.02, 0.12), description="full width of the beam along y and z of the lidar's frame, degrees"
    )
    time_sd_ms: float = Field(0.0, ge=0, description="standard deviation of the synchronisation, ms")

    @field_validator("camera", mode="before")
    @classmethod
    def _text(cls, value: Any) -> Any:
        """YAML reads a camera called 1 as a number."""
        return str(value) if isinstance(value, int) else value


class SequenceFile(BaseModel):
    """The content of a ``sequence.yaml``. Paths are relative to the folder of the file."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    format: Literal["acino-fte/sequence/1"] = "acino-fte/sequence/1"
    name: str | None = Field(None, description="name of the recording; by default that of its folder")
    species: str | None = Field(None, description="a species, or the path of a species file (.yaml)")
    fps: float | None = Field(None, gt=0, description="frames per second")
    cameras: str = Field(description="camera file: cameras.json, an AcinoSet scene, or Anipose's TOML")
    camera_unit: Literal["m", "cm", "mm"] = Field("m", description="unit of the translations in that file")
    keypoints: dict[str, str] = Field(
        min_length=1, description="keypoint file (.csv, .h5, .pickle) by camera name"
    )
    frames: tuple[int, int] | None = Field(None, description="start and stop, half-open, counted from 0")
    truth: str | None = Field(None, description="CSV with frame, marker, x, y, z (m) where they are known")
    truth_parameters: str | None = Field(
        None, description="JSON with true time offsets, camera poses, proportions and swaps (simulations)"
    )
    ground: Ground | None = Field(None, description="the plane that the animal stands on")
    lidar: LidarEntry | None = Field(None, description="a lidar beside one of the cameras")

    @field_validator("keypoints", mode="before")
    @classmethod
    def _text_keys(cls, value: Any) -> Any:
        """YAML reads a camera called 1 as a number."""
        return {str(k): v for k, v in value.items()} if isinstance(value, dict) else value

    @field_validator("keypoints")
    @classmethod
    def _one_file_each(cls, value: dict[str, str]) -> dict[str, str]:
        owner: dict[str, str] = {}
        for camera, path in value.items():
            if path in owner:
                raise ValueError(f"cameras '{owner[path]}' and '{camera}' are given the same file '{path}'")
            owner[path] = camera
        return value

    @field_validator("frames")
    @classmethod
    def _rising(cls, value: tuple[int, int] | None) -> tuple[int, int] | None:
        if value is not None and not 0 <= value[0] < value[1]:
            raise ValueError(f"frames {list(value)} must be [start, stop] with 0 ≤ start < stop")
        return value

    def at(self, folder: Path) -> SequenceFile:
        """The same with absolute paths, read from a file in `folder`."""

        def absolute(path: str) -> str:
            return str((folder / Path(path).expanduser()).resolve())

        species = self.species
        if species is not None and species.endswith((".yaml", ".yml")):
            species = absolute(species)
        update: dict[str, Any] = {
            "species": species,
            "cameras": absolute(self.cameras),
            "keypoints": {name: absolute(path) for name, path in self.keypoints.items()},
            "truth": absolute(self.truth) if self.truth is not None else None,
            "truth_parameters": absolute(self.truth_parameters)
            if self.truth_parameters is not None
            else None,
        }
        if self.lidar is not None:
            paths = {key: absolute(getattr(self.lidar, key)) for key in ("returns", "calibration")}
            update["lidar"] = self.lidar.model_copy(update=paths)
        return self.model_copy(update=update)

    def to_dict(self) -> dict[str, Any]:
        """Plain values, in the order of the schema, without what is not set."""
        return self.model_dump(mode="json", exclude_none=True)


def read_sequence_file(path: Path | str) -> SequenceFile:
    """Read and validate a ``sequence.yaml``; its paths become absolute.

    Raises
    ------
    InputError
        The file is missing, is not YAML, or does not follow the schema.
    """
    path = Path(path)
    data = read_yaml(path)
    if not isinstance(data, dict) or data.get("format") != FORMAT:
        raise InputError(
            "This is not a sequence file of a format that this version reads.",
            file=path,
            key="format",
            expected=FORMAT,
            found=repr(data.get("format")) if isinstance(data, dict) else type(data).__name__,
            remedy=f"write 'format: {FORMAT}' as its first line",
        )
    try:
        return SequenceFile.model_validate(data).at(path.resolve().parent)
    except ValidationError as error:
        place, text = validation_message(error, SequenceFile)
        raise InputError(
            f"The sequence file has a fault at '{place}': {text}.",
            file=path,
            key=place,
            remedy="mend that key",
        ) from None


def write_sequence_file(path: Path | str, content: SequenceFile | dict[str, Any]) -> None:
    """Write a ``sequence.yaml``. Relative paths in it are meant from the folder of `path`.

    Raises
    ------
    InputError
        The content does not follow the schema.
    """
    path = Path(path)
    try:
        file = content if isinstance(content, SequenceFile) else SequenceFile.model_validate(content)
    except ValidationError as error:
        place, text = validation_message(error, SequenceFile)
        raise InputError(
            f"The sequence to be written has a fault at '{place}': {text}.",
            file=path,
            key=place,
            remedy="mend that value",
        ) from None
    text = yaml.safe_dump(file.to_dict(), sort_keys=False, allow_unicode=True, width=110)
    path.write_text(text, encoding="utf-8")
