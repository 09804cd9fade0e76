"""Packages of the extras: imported where they are used; without one, the error names the remedy."""

from __future__ import annotations

from typing import Any

from acino_fte.errors import InputError


def missing_package(what: str, error: ImportError, *, instead: str = "") -> InputError:
    """The error to raise where a package of the extra ``lidar`` is not installed.

    Parameters
    ----------
    what : str
        What needs it, in the plural: ``"Videos"``.
    error : ImportError
        It names the package.
    instead : str
        What else would do, as the end of a sentence.
    """
    return InputError(
        f"{what} need a package that is not installed.",
        found=str(error),
        remedy='pip install "acino-fte[lidar]"' + instead,
    )


def load_cv2() -> Any:
    """OpenCV.

    Raises
    ------
    InputError
        It is not installed.
    """
    try:
        import cv2
    except ImportError as error:
        raise missing_package("Pictures", error) from error
    return cv2
