"""Pictures of a simulated rig: the animal as shaded capsules before a landscape that pans as it must.

The camera turns about its centre, so all that stands still is one panorama: bearing to the right, elevation
upwards, the same angle a pixel as the picture has in its middle. A picture looks it up along its rays.
Pictures may be smaller than what the detector saw; their field of view is the same.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from acino_fte.cameras import Camera
from acino_fte.extras import load_cv2
from acino_fte.rig_lidar import Body

if TYPE_CHECKING:
    from acino_fte.simulate_rig import RigSimulation

_LARGEST = 40_000_000  # pixels of a panorama
_SKY, _GRASS, _BUSH = (170, 195, 225), (150, 145, 85), (70, 85, 45)
_COAT, _SPOT, _PAW = (215, 170, 105), (70, 50, 30), (235, 205, 160)
_SHIFT = 4  # binary places of OpenCV's fixed-point coordinates
_SPOTS = (0.25, 0.5, 0.75)


@dataclass(frozen=True, eq=False)
class Panorama:
    """All that stands still, by bearing and elevation.

    Attributes
    ----------
    image : (H, W, 3) uint8
        Red, green, blue.
    left, top : float
        Bearing (clockwise from y) and elevation of the pixel (0, 0), rad.
    scale : float
        px/rad.
    """

    image: np.ndarray
    left: float
    top: float
    scale: float


def small_camera(camera: Camera, width: int) -> Camera:
    """The camera with pictures of another width and the same field of view; pixel centres at integers."""
    scale = width / camera.resolution[0]
    matrix = camera.matrix.copy()
    matrix[:2] *= scale
    matrix[:2, 2] += 0.5 * scale - 0.5
    height = max(2, 2 * round(camera.resolution[1] * scale / 2))  # codecs take even sizes
    return replace(camera, matrix=matrix, resolution=(width, height))


def render_pictures(simulation: RigSimulation, width: int = 512) -> Iterator[np.ndarray]:
    """Pictures (H, W, 3), uint8, red, green, blue, one for every frame, dropped ones included.

    Raises
    ------
    InputError
        OpenCV is not installed.
    """
    camera = small_camera(simulation.true_camera, width)
    panorama = make_panorama(simulation, camera)
    body = Body.of(simulation.options, simulation.motion)
    u, v = np.meshgrid(np.arange(camera.resolution[0]), np.arange(camera.resolution[1]))
    rays = camera.directions(np.stack([u, v], axis=-1).reshape(-1, 2))
    for n in range(simulation.options.n_frames):
        picture = _look_up(panorama, rays @ camera.rotation[n]).reshape(*u.shape, 3)
        _draw_animal(picture, simulation.positions[n], body, camera.at_frames(slice(n, n + 1)))
        yield picture


def _look_up(panorama: Panorama, world: np.ndarray) -> np.ndarray:
    """Colours (K, 3) along directions (K, 3), world."""
    cv2 = load_cv2()
    bearing = np.arctan2(world[:, 0], world[:, 1])
    elevation = np.arcsin(np.clip(world[:, 2], -1.0, 1.0))
    x = ((bearing - panorama.left) * panorama.scale).astype(np.float32)
    y = ((panorama.top - elevation) * panorama.scale).astype(np.float32)
    rows = max(1, len(world) // 1024 + 1)  # OpenCV takes pictures of at most 32 767 px a side
    shape = (rows, -(-len(world) // rows))
    pad = shape[0] * shape[1] - len(world)
    maps = [np.pad(m, (0, pad)).reshape(shape) for m in (x, y)]
    found = cv2.remap(panorama.image, *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT_101)
    return found.reshape(-1, 3)[: len(world)]


def make_panorama(simulation: RigSimulation, camera: Camera) -> Panorama:
    """Sky, grass and the lidar's bushes as `camera` sees them from its place, all over its pan."""
    width, height = camera.resolution
    scale = camera.matrix[0, 0]
    forward = camera.rotation[:, 2]
    bearing = np.unwrap(np.arctan2(forward[:, 0], forward[:, 1]))
    elevation = np.arcsin(forward[:, 2])
    margin = 0.6 * np.hypot(width, height) / scale
    left, right = bearing.min() - margin, bearing.max() + margin
    bottom, top = elevation.min() - margin, elevation.max() + margin
    size = (right - left) * (top - bottom) * scale**2
    scale = scale * min(1.0, float(np.sqrt(_LARGEST / size)))
    shape = (int((top - bottom) * scale) + 2, int((right - left) * scale) + 2)
    rng = simulation.options.stream("landscape")
    up = top - np.arange(shape[0]) / scale
    image = np.where(
        (up > 0)[:, None, None], np.array(_SKY, dtype=np.float32), np.array(_GRASS, dtype=np.float32)
    )
    image = np.broadcast_to(image, (*shape, 3)).copy()
    image += (_grain(rng, shape, (2, 1)) * np.where(up > 0, 3.0, 26.0)[:, None])[..., None]
    _plant(image, simulation, camera, rng, Panorama(image, left, top, scale))
    return Panorama(np.clip(image, 0, 255).astype(np.uint8), float(left), float(top), float(scale))


def _grain(rng: np.random.Generator, shape: tuple[int, int], stretch: tuple[int, int]) -> np.ndarray:
    """Noise (H, W) of several sizes, standard deviation 1; `stretch` is how much wider and higher it is."""
    cv2 = load_cv2()
    total = np.zeros(shape, dtype=np.float32)
    for size in (1.2, 4.0, 14.0):
        noise = rng.standard_normal(shape, dtype=np.float32)
        blurred = cv2.GaussianBlur(noise, (0, 0), sigmaX=size * stretch[0], sigmaY=size * stretch[1])
        total += blurred / max(float(blurred.std()), 1e-6)
    return total / np.sqrt(3.0)


def _plant(
    image: np.ndarray, simulation: RigSimulation, camera: Camera, rng: np.random.Generator, frame: Panorama
) -> None:
    """Draw the bushes, the furthest first, each with leaves of its own."""
    cv2 = load_cv2()
    offset = simulation.scenery.centre - camera.centre[0]
    away = np.linalg.norm(offset, axis=1)
    leaves = _grain(rng, image.shape[:2], (1, 1))
    above = frame.top - np.arange(image.shape[0]) / frame.scale
    for i in np.argsort(-away):
        ahead = offset[i]
        bearing = np.arctan2(ahead[0], ahead[1])
        x, y = (bearing - frame.left) * frame.scale, (frame.top - np.arcsin(ahead[2] / away[i])) * frame.scale
        radius = np.arcsin(min(1.0, simulation.scenery.radius[i] / away[i])) * frame.scale
        mask = np.zeros(image.shape[:2], dtype=np.uint8)
        cv2.circle(mask, (round(x), round(y)), max(1, round(radius)), 255, -1)
        tone = np.array(_BUSH) * rng.uniform(0.7, 1.3)
        foot = -np.arctan2(camera.centre[0, 2], np.hypot(ahead[0], ahead[1]))  # where it meets the ground
        inside = (mask > 0) & (above > foot)[:, None]
        image[inside] = tone + 22.0 * leaves[inside][:, None]


def _draw_animal(picture: np.ndarray, points: np.ndarray, body: Body, camera: Camera) -> None:
    """Draw the capsules of points (M, 3) into a picture, the furthest first: lighter above, with spots."""
    if not len(body.radius):
        return
    local = camera.to_camera(points[None])[0]
    pixels = camera.project(points[None])[0]
    if not np.isfinite(pixels).all():
        return
    focal = camera.matrix[0, 0]
    depth = local[body.pairs, 2].mean(axis=1)
    near, far = depth.min(), depth.max()
    for e in np.argsort(-depth):
        ends, radius = pixels[body.pairs[e]], focal * body.radius[e] / depth[e]
        light = 1.0 - 0.35 * (depth[e] - near) / max(far - near, 1e-9)
        _draw_capsule(picture, ends, radius, light * np.array(_COAT))
        _draw_capsule(picture, ends - [0.0, 0.45 * radius], 0.45 * radius, light * np.array(_PAW))
        for share in _SPOTS:
            middle = ends[0] + share * (ends[1] - ends[0])
            _draw_capsule(picture, np.stack([middle, middle]), 0.28 * radius, np.array(_SPOT))


def _draw_capsule(picture: np.ndarray, ends: np.ndarray, radius: float, colour: np.ndarray) -> None:
    cv2 = load_cv2()
    tint = tuple(float(c) for c in colour)
    along = ends[1] - ends[0]
    length = float(np.linalg.norm(along))
    if length > 0:
        side = radius * np.array([-along[1], along[0]]) / length
        corners = np.stack([ends[0] + side, ends[1] + side, ends[1] - side, ends[0] - side])
        fixed = np.round(corners * 2**_SHIFT).astype(np.int32)
        cv2.fillPoly(picture, [fixed], tint, lineType=cv2.LINE_AA, shift=_SHIFT)
    for end in ends:
        x, y, r = (int(round(value * 2**_SHIFT)) for value in (*end, radius))
        cv2.circle(picture, (x, y), max(r, 1), tint, -1, cv2.LINE_AA, _SHIFT)
