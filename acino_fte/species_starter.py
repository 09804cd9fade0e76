"""Starter species files: a commented quadruped, or a copy of another species under a new name."""

from __future__ import annotations

import re
from pathlib import Path

from acino_fte.errors import InputError
from acino_fte.skeleton import species_file_path
from acino_fte.species_file import NAME_PATTERN, read_species_file

_STARTER = """\
format: acino-fte/skeleton/1
name: NAME
source: starter of a quadruped the size of a fox; replace the numbers and say here who measured yours
units: {length: m, angle: deg}
noise_fps: 120  # the frame rate that 'noise' below is stated at; recordings may have any other

# Axes: x forward, y to the left, z up. At zero every frame is turned alike, the trunk is level and the legs
# hang straight down. Turns follow the right-hand rule: about y a positive angle lowers the nose and swings
# a hanging leg backwards; about z it turns to the left; about x it rolls the left side up.
#
# A link is a rigid part. 'parent' and 'at' say where it hangs, 'dofs' how it moves there, outermost first.
#   range  lowest and highest value; leave it out where the animal is free.
#   noise  how fast the motion may change: the jump in acceleration from one frame to the next, in m/s^2 or
#          deg/s^2. Larger follows the detections more closely, smaller is smoother.
#   mirror makes the right-hand twin: same numbers, other side.
links:
  trunk:  # its origin is between the shoulder blades
    parent: world
    dofs:
      x: {slide: x, noise: 4}
      y: {slide: y, noise: 4}
      z: {slide: z, noise: 5}
      yaw: {turn: z, noise: 1500}  # heading: no range, it may face every way
      pitch: {turn: y, range: [-60, 60], noise: 1500}
      roll: {turn: x, range: [-60, 60], noise: 1500}
  head:  # from the base of the neck
    parent: trunk
    at: [0.07, 0, 0]
    dofs:
      yaw: {turn: z, range: [-80, 80], noise: 2500}
      pitch: {turn: y, range: [-70, 70], noise: 2500}
  rump:  # the back bends here
    parent: trunk
    at: [-0.18, 0, 0]
    dofs:
      yaw: {turn: z, range: [-35, 35], noise: 3000}
      pitch: {turn: y, range: [-45, 45], noise: 3000}
  tail:
    parent: rump
    at: [-0.18, 0, -0.01]
    dofs:
      yaw: {turn: z, range: [-90, 90], noise: 5000}
      pitch: {turn: y, range: [-100, 100], noise: 5000}
  l_upper_arm:
    parent: trunk
    at: [0.03, 0.05, -0.11]
    mirror: r_upper_arm
    dofs: {shoulder: {turn: y, range: [-60, 90], noise: 5000}}
  l_forearm:
    parent: l_upper_arm
    at: [0, 0, -0.11]
    mirror: r_forearm
    dofs: {elbow: {turn: y, range: [-145, 0], noise: 8000}}  # bends forward: negative
  l_front_foot:
    parent: l_forearm
    at: [0, 0, -0.13]
    mirror: r_front_foot
    dofs: {wrist: {turn: y, range: [-45, 140], noise: 12000}}
  l_thigh:
    parent: rump
    at: [-0.13, 0.04, -0.07]
    mirror: r_thigh
    dofs: {hip: {turn: y, range: [-90, 45], noise: 5000}}
  l_shank:
    parent: l_thigh
    at: [0, 0, -0.12]
    mirror: r_shank
    dofs: {knee: {turn: y, range: [0, 140], noise: 8000}}  # bends backward: positive
  l_back_foot:
    parent: l_shank
    at: [0, 0, -0.14]
    mirror: r_back_foot
    dofs: {ankle: {turn: y, range: [-140, 0], noise: 8000}}

# A marker is a point that your keypoint detector finds; its name, or one of its 'aliases', is the name in
# the keypoint file (case, spaces and _ do not matter). 'at' is its place in the frame of its link; 'sd_px'
# is how far, in pixels, a good detection usually lies from the true point.
markers:
  nose: {link: head, at: [0.23, 0, 0.04], sd_px: 2}
  l_eye:
    link: head
    at: [0.16, 0.025, 0.08]
    sd_px: 2
    aliases: [left_eye]
    mirror: r_eye
    mirror_aliases: [right_eye]
  withers: {link: trunk, sd_px: 4, aliases: [back_base]}
  mid_back: {link: rump, sd_px: 4, aliases: [back_middle, spine]}
  tail_base: {link: tail, sd_px: 4, aliases: [root_of_tail]}
  tail_tip: {link: tail, at: [-0.3, 0, 0], sd_px: 4, aliases: [tail_end]}
  l_shoulder: {link: l_upper_arm, sd_px: 5, mirror: r_shoulder}
  l_elbow: {link: l_forearm, sd_px: 4.5, mirror: r_elbow}
  l_wrist: {link: l_front_foot, sd_px: 4, mirror: r_wrist}
  l_front_paw: {link: l_front_foot, at: [0, 0, -0.06], sd_px: 3.5, mirror: r_front_paw}
  l_hip: {link: l_thigh, sd_px: 5, mirror: r_hip}
  l_knee: {link: l_shank, sd_px: 4.5, mirror: r_knee}
  l_ankle: {link: l_back_foot, sd_px: 4, mirror: r_ankle}
  l_back_paw: {link: l_back_foot, at: [0, 0, -0.1], sd_px: 3.5, mirror: r_back_paw}

# Links whose lengths are estimated together, by one factor for each group ('--fit scale'). A link that is
# not named here makes a group of its own; the right side shares the factor of the left.
groups:
  front_leg: [l_upper_arm, l_forearm, l_front_foot]
  back_leg: [l_thigh, l_shank, l_back_foot]

# Markers that touch the ground when the animal stands; the right side does with the left.
contacts: [l_front_paw, l_back_paw]

# Lines of the pictures; the right side is drawn by mirroring.
draw:
  - [nose, l_eye]
  - [l_eye, withers]
  - [withers, mid_back]
  - [mid_back, tail_base]
  - [tail_base, tail_tip]
  - [withers, l_shoulder]
  - [l_shoulder, l_elbow]
  - [l_elbow, l_wrist]
  - [l_wrist, l_front_paw]
  - [tail_base, l_hip]
  - [l_hip, l_knee]
  - [l_knee, l_ankle]
  - [l_ankle, l_back_paw]

# Solid body, used in simulations: it hides what is behind it (radius in m).
body:
  - {between: [withers, mid_back], radius: 0.06}
  - {between: [mid_back, tail_base], radius: 0.05}
"""


def starter_text(name: str, like: str | None = None) -> str:
    """Text of a new species file.

    Parameters
    ----------
    name : str
        Name of the species: letters, digits and _.
    like : str, optional
        A species (by name or path) to copy; by default a commented quadruped the size of a fox.

    Raises
    ------
    InputError
        The name is not allowed, or there is no species `like` or it has a fault.
    """
    if not re.match(NAME_PATTERN, name):
        raise InputError(
            f"'{name}' cannot be the name of a species.",
            expected="a letter, then letters, digits and _",
            remedy="use a name such as 'red_fox', and -o to write somewhere else",
        )
    if like is None:
        return _STARTER.replace("NAME", name, 1)
    path = species_file_path(like)
    species = read_species_file(path)
    text = path.read_text(encoding="utf-8")
    text = re.sub(r"(?m)^name:.*$", f"name: {name}", text, count=1)
    note = f"# Started as a copy of '{species.name}': its numbers and sources hold until you replace them.\n"
    head, line, rest = text.partition(f"name: {name}\n")
    return head + line + note + rest


def write_starter(name: str, path: Path, like: str | None = None) -> None:
    """Write a starter file; an existing file is never overwritten.

    Raises
    ------
    InputError
        As :func:`starter_text`, or the file exists or cannot be written.
    """
    text = starter_text(name, like)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("x", encoding="utf-8") as file:
            file.write(text)
    except FileExistsError:
        raise InputError(
            "The file exists already and is left as it is.", file=path, remedy="choose another name with -o"
        ) from None
    except OSError as error:
        raise InputError("The file cannot be written.", file=path, found=error.strerror) from None
