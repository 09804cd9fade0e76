"""Where the sparse model of a folder lies."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from acino_fte.errors import InputError

_FILES = ("cameras", "images", "points3D")
_PLACES = (".", "sparse", "colmap/sparse", "sfm", "dense/sparse")


def model_ending(folder: Path) -> str | None:
    """``bin`` or ``txt`` of a folder with a whole model (binary first, as COLMAP has it), else None."""
    for ending in ("bin", "txt"):
        if all((folder / f"{name}.{ending}").is_file() for name in _FILES):
            return ending
    return None


def find_model(path: Path) -> tuple[Path, list[str]]:
    """The folder of the model, and what to note about the choice.

    Raises
    ------
    InputError
        There is none, or one of its files is missing.
    """
    if not path.is_dir():
        found = "a file" if path.exists() else "nothing"
        raise InputError(
            "There is no such COLMAP model.",
            file=path,
            expected="a folder",
            found=found,
            remedy="check the path",
        )
    for place in _PLACES:
        base = path / place
        if model_ending(base):
            return base, []
        if base.is_dir():
            numbered = [p for p in base.iterdir() if p.name.isdigit() and model_ending(p)]
            if numbered:
                return _largest(sorted(numbered, key=lambda p: int(p.name)))
    _refuse_part(path)
    raise InputError(
        "The folder holds no COLMAP model.",
        file=path,
        expected="cameras, images and points3D (.bin or .txt), here or in sparse, sparse/0, …",
        found=", ".join(sorted(p.name for p in path.iterdir())[:12]) or "an empty folder",
        remedy="give the folder of the model, or export it: `colmap model_converter --output_type BIN`",
    )


def _refuse_part(path: Path) -> None:
    """Raise when there is a model of which a file is missing."""
    for place in _PLACES:
        for ending in ("bin", "txt"):
            missing = [f"{n}.{ending}" for n in _FILES if not (path / place / f"{n}.{ending}").is_file()]
            if len(missing) < len(_FILES):
                raise InputError(
                    "A file of the COLMAP model is missing.",
                    file=path / place,
                    expected=", ".join(f"{name}.{ending}" for name in _FILES),
                    found=f"no {', no '.join(missing)}",
                    remedy="copy the whole folder of the model",
                )


def _largest(folders: list[Path]) -> tuple[Path, list[str]]:
    """The model with most images, the first of equals."""
    if len(folders) == 1:
        return folders[0], []
    counts = [_count_images(folder) for folder in folders]
    best = int(np.argmax(counts))
    others = ", ".join(
        f"{f.name} ({n})" for i, (f, n) in enumerate(zip(folders, counts, strict=True)) if i != best
    )
    note = (
        f"Of {len(folders)} models, {folders[best]} is read, which has most images ({counts[best]}); "
        f"left out: {others}."
    )
    return folders[best], [note]


def _count_images(folder: Path) -> int:
    if model_ending(folder) == "bin":
        with (folder / "images.bin").open("rb") as file:
            return int.from_bytes(file.read(8), "little")
    with (folder / "images.txt").open("rb") as file:
        return sum(1 for line in file if not line.startswith(b"#")) // 2
