"""Formulas of a lidar beside a camera: what both see, and how many returns an animal gives.

The field of the lidar is an ellipse about the camera's optical axis, and its points are spread evenly over it
in the time of a frame. (The pattern of a Livox Tele-15 does not repeat, and is denser in the middle: there an
animal gets more than the mean that is counted with, at the edge fewer.)
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from acino_fte.rig.plan_optics import focal_for_field
from acino_fte.rig.rig_file import CameraPart, LidarPart


@dataclass(frozen=True)
class Overlap:
    """What a camera and a lidar see of each other's field.

    Attributes
    ----------
    camera, lidar : str
    of_lidar : float
        Share of the lidar's field that is in the picture.
    of_picture : float
        Share of the picture that is in the lidar's field.
    focal_whole_mm : float
        Up to this focal length the lidar's whole field is in the picture.
    focal_wide_mm : float
        At this one the picture is as wide as the lidar's field.
    focal_inside_mm : float
        From this one on every pixel is in the lidar's field.
    """

    camera: str
    lidar: str
    of_lidar: float
    of_picture: float
    focal_whole_mm: float
    focal_wide_mm: float
    focal_inside_mm: float


def field_overlap(camera: CameraPart, lidar: LidarPart, names: tuple[str, str] = ("", "")) -> Overlap:
    """Overlap of a picture and a lidar's field with a common axis.

    Both are taken to a plane at a distance of 1: the picture is a rectangle with half sides n p / (2 f), the
    field of the lidar an ellipse with half axes tan(α / 2).
    """
    focal = camera.lens.used_mm
    half = [0.5 * n * camera.pixel_um * 1e-3 / focal for n in (camera.width, camera.height)]
    axes = [math.tan(math.radians(0.5 * angle)) for angle in lidar.fov_deg]
    shared = axes[0] * axes[1] * disc_in_rectangle(half[0] / axes[0], half[1] / axes[1])
    wide = focal_for_field(camera.width, camera.pixel_um, lidar.fov_deg[0])
    high = focal_for_field(camera.height, camera.pixel_um, lidar.fov_deg[1])
    return Overlap(
        *names,
        of_lidar=shared / (math.pi * axes[0] * axes[1]),
        of_picture=shared / (4.0 * half[0] * half[1]),
        focal_whole_mm=min(wide, high),
        focal_wide_mm=wide,
        focal_inside_mm=math.hypot(wide, high),
    )


def disc_in_rectangle(half_width: float, half_height: float) -> float:
    """Area that a disc of radius 1 shares with a rectangle about the same middle.

    Four times the integral of min(b, √(1 − x²)) from 0 to a, in closed form.
    """
    a, b = min(half_width, 1.0), min(half_height, 1.0)
    if a * a + b * b <= 1.0:
        return 4.0 * a * b
    corner = math.sqrt(1.0 - b * b)  # there the circle leaves the upper side
    return 4.0 * (b * corner + _under_circle(a) - _under_circle(corner))


def _under_circle(x: float) -> float:
    """Area between the axis and a quarter of a circle of radius 1, from 0 to x."""
    return 0.5 * (x * math.sqrt(1.0 - x * x) + math.asin(x))


def points_per_steradian(points: float, fov_deg: tuple[float, float]) -> float:
    """Mean density of the points of a frame: N / (π/4 · α · β), angles in radians."""
    horizontal, vertical = (math.radians(angle) for angle in fov_deg)
    return points / (math.pi / 4.0 * horizontal * vertical)


def points_on_target(area_m2: float, distance_m: float, points: float, fov_deg: tuple[float, float]) -> float:
    """Points of a frame that meet a surface that faces the lidar: its solid angle A / d² × the density.

    All of them at most. An upper bound too because a dark coat or rain send fewer back.
    """
    return min(points, area_m2 / distance_m**2 * points_per_steradian(points, fov_deg))
