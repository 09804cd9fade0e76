"""Check a recording: what was lost, which clocks jumped, what the sensors warn of, and whether it will do.

Any recording that can be read can be checked. One of the rig's recorder is also held against its manifest:
what the data show must be what the recorder noted.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from acino_fte.rig.check_events import add_ends, compare_events
from acino_fte.rig.check_types import Requirement, Verdict, worst
from acino_fte.rig.check_verdict import requirements
from acino_fte.rig.check_walk import Findings, walk_recording


@dataclass(frozen=True)
class Check:
    """A checked recording.

    Attributes
    ----------
    found : Findings
        Streams, cameras, clocks, damage.
    requirements : tuple of Requirement
    unexplained : tuple of str
        What events do not tell or data do not show; only of the rig's recorder.
    """

    found: Findings
    requirements: tuple[Requirement, ...]
    unexplained: tuple[str, ...]

    @property
    def verdict(self) -> Verdict:
        """The worst of all requirements."""
        return worst([requirement.verdict for requirement in self.requirements])


def check_recording(
    path: Path | str, tell: Callable[[str], None] | None = None, *, every_frame: bool = False
) -> Check:
    """Check a recording, in one walk and constant memory.

    Parameters
    ----------
    path : Path
        LVX, a bag of ROS 1 or ROS 2, eCAL, a video, or the folder of the rig's recorder.
    tell : callable, optional
        Is told how far it is.
    every_frame : bool
        Decode every picture of a video; else some, and the others are only counted.

    Raises
    ------
    InputError
        There is no such recording.
    """
    found = walk_recording(path, tell, every_frame)
    add_ends(found)
    unexplained = compare_events(found)
    return Check(found, tuple(requirements(found, unexplained)), tuple(unexplained))
