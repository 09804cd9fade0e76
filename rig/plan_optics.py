"""Formulas of a camera with a lens: size in the picture, field of view, sharpness, motion blur, frame rate.

Lengths are in the unit that a name ends with. A distance is from the lens, and a picture is made as by a
pinhole: the image lies one focal length behind the lens, which is right to 0.2 % from 500 focal lengths on.
"""

from __future__ import annotations

import math


def pixels_on_target(length_m: float, distance_m: float, focal_mm: float, pixel_um: float) -> float:
    """Pixels that something which faces the camera covers: f L / (p d).

    Similar triangles of the pinhole camera (Hartley and Zisserman 2004, Multiple View Geometry, eq. 6.1).
    An animal of 1.5 m at 100 m covers 409 px with 150 mm and pixels of 5.5 µm.
    """
    return focal_mm * length_m / (pixel_um * 1e-3 * distance_m)


def focal_for_pixels(pixels: float, length_m: float, distance_m: float, pixel_um: float) -> float:
    """Focal length (mm) at which something covers so many pixels: f = n p d / L.

    50 px of 5.5 µm on 1.5 m at 100 m ask for 18.33 mm.
    """
    return pixels * pixel_um * 1e-3 * distance_m / length_m


def field_of_view_deg(pixels: int, pixel_um: float, focal_mm: float) -> float:
    """Angle (degrees) that a row or a column of pixels sees: 2 atan(n p / (2 f))."""
    return math.degrees(2.0 * math.atan(0.5 * pixels * pixel_um * 1e-3 / focal_mm))


def focal_for_field(pixels: int, pixel_um: float, field_deg: float) -> float:
    """Focal length (mm) at which a row or a column of pixels sees an angle (degrees)."""
    return 0.5 * pixels * pixel_um * 1e-3 / math.tan(math.radians(0.5 * field_deg))


def hyperfocal_m(focal_mm: float, f_number: float, blur_um: float) -> float:
    """Focused at this distance (m), a lens is sharp to infinity: f² / (N c) + f.

    `blur_um` is the diameter c of the largest blur that counts as sharp. (Greenleaf 1950, Photographic
    Optics, p. 25.)
    """
    return 1e-3 * (focal_mm**2 / (f_number * blur_um * 1e-3) + focal_mm)


def depth_of_field_m(focus_m: float, focal_mm: float, f_number: float, blur_um: float) -> tuple[float, float]:
    """Nearest and farthest distance (m) that is sharp; the farthest may be infinite.

    s (H − f) / (H + s − 2 f) and s (H − f) / (H − s) with the hyperfocal distance H, the focus s and the
    focal length f (Greenleaf 1950, Photographic Optics, pp. 26–27).
    """
    f = 1e-3 * focal_mm
    hyperfocal = hyperfocal_m(focal_mm, f_number, blur_um)
    near = focus_m * (hyperfocal - f) / (hyperfocal + focus_m - 2.0 * f)
    far = focus_m * (hyperfocal - f) / (hyperfocal - focus_m) if focus_m < hyperfocal else math.inf
    return near, far


def motion_blur_px(
    speed_m_s: float, exposure_us: float, distance_m: float, focal_mm: float, pixel_um: float
) -> float:
    """Pixels by which something that crosses the picture moves while the shutter is open: f v t / (p d).

    For a camera that stands still. One that follows the animal blurs its body less, and its legs by about
    as much as they move beside the body.
    """
    return pixels_on_target(speed_m_s * exposure_us * 1e-6, distance_m, focal_mm, pixel_um)


def frame_time_us(lines: int, overhead_us: float, line_us: float) -> float:
    """Shortest time (µs) from image to image: overhead + lines × time of a line.

    XIMEA, xiQ Technical Manual, timing of the MQ022xG-CM: 37.6 µs + 5.375 µs × lines, where the exposure is
    shorter and overlaps the readout.
    """
    return overhead_us + line_us * lines


def highest_fps(lines: int, overhead_us: float, line_us: float, exposure_us: float = 0.0) -> float:
    """Images a second that the camera can take at most; 170 with 1088 lines.

    The time from image to image is that of the readout, or of the exposure and the overhead where that is
    longer (ibid.: minimum trigger period).
    """
    return 1e6 / max(frame_time_us(lines, overhead_us, line_us), exposure_us + overhead_us)
