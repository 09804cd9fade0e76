"""Do the keypoint files belong to the cameras they are paired with? (stub until measured)"""

from __future__ import annotations


def check_pairing(detections, cameras, likelihood):  # type: ignore[no-untyped-def]
    """Warnings."""
    return []
