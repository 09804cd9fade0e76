"""How 2D tracks are to be matched."""

from __future__ import annotations

from dataclasses import dataclass

from acino_fte.errors import InputError


@dataclass(frozen=True)
class MatchOptions:
    """How to match.

    Attributes
    ----------
    noise_px : float, optional
        Standard deviation of a dot's coordinate, px; estimated when not given.
    max_gap_s : float
        Longest gap within a view across which a piece of track is continued, s.
    encounter : float
        Dots of one view closer than this, in standard deviations of the noise, may have been exchanged.
    tracks : bool
        Whether the tracker's tracks are used; if not, all dots are taken as bare points.
    follow : bool
        Whether 3D paths drop dots that do not belong to them and claim loose ones.
    min_confidence : float
        Matches less probable than this are left out.
    """

    noise_px: float | None = None
    max_gap_s: float = 1.0
    encounter: float = 4.0
    tracks: bool = True
    follow: bool = True
    min_confidence: float = 0.5

    def __post_init__(self) -> None:
        limits = {
            "noise_px": (self.noise_px is None or self.noise_px > 0, "more than 0"),
            "max_gap_s": (self.max_gap_s >= 0, "0 or more"),
            "encounter": (self.encounter >= 0, "0 or more"),
            "min_confidence": (0 <= self.min_confidence <= 1, "0 to 1"),
        }
        for key, (good, expected) in limits.items():
            if not good:  # NaN is not good either
                raise InputError(
                    "An option of the matching is out of range.",
                    key=key,
                    expected=expected,
                    found=str(getattr(self, key)),
                )
