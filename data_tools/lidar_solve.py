"""Calibration of a camera to a lidar from pairs of picks: lens and pose together, without a guess.

The residual of a pair is the projection of its return minus its pick. Each is weighted by the noise of both
picks; the size of the noise, outliers, and whether the lens bends come from the pairs. P pairs, D parameters.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from datetime import UTC, datetime

import numpy as np

from acino_fte.cameras import Camera
from acino_fte.data_tools.lidar_camera import LidarCamera
from acino_fte.data_tools.lidar_pairs import LidarPairs
from acino_fte.data_tools.lidar_solve_advice import advice, focal_and_depth
from acino_fte.data_tools.lidar_solve_fit import OUTLIER, Fit, at, inverse, polished, robust_fit
from acino_fte.data_tools.lidar_solve_holdout import choose_lens, left_out
from acino_fte.data_tools.lidar_solve_model import POSE, PickNoise, Priors
from acino_fte.data_tools.lidar_solve_start import starts
from acino_fte.errors import InputError

FIT = {"f": ("log_f",), "aspect": ("log_aspect",), "c": ("cx", "cy"), "distortion": ("k1", "k2")}
"""What can be asked for, and the parameters that it frees."""
RIG, ANYWHERE = 0.5, 50.0
"""How far a camera is from its lidar, m (standard deviation of each coordinate): on a rig, or anywhere."""
_CENTRE = 0.02  # how far the principal point is from the middle, in widths of the image
_FINALISTS = 2  # starts that are followed to the end
_WORST = 0.1  # of the width of the image: picks farther off than that say nothing
_NO_POSE = "No pose was found that these pairs agree with."
_LOOK = "check that pixels and points belong together and that all images have one zoom"
_LENS = {"log_aspect": 0.02, "k1": 0.5, "k2": 1.0}


@dataclass(frozen=True, eq=False)
class Calibration:
    """A calibration, and how good it is.

    Attributes
    ----------
    lidar_camera : LidarCamera
        The result, as it is saved.
    pairs : LidarPairs
        All of them, used and not.
    residual : (P, 2)
        Projection minus pick, px, of all pairs; NaN behind the camera.
    left_out : (P, 2)
        The same of each pair under the calibration from all others (first order); of pairs that did not
        count the same as `residual`.
    outlier : (P,) bool
        Pairs that were used but do not fit the others.
    scale : float
        Size of the noise of the picks, compared to what was assumed.
    bound : (D, D)
        Cramér-Rao bound of `lidar_camera.parameters` under the assumed noise, from the pairs that count and
        what was known before.
    fitted : tuple of str
        What was estimated besides the pose: of ``f``, ``aspect``, ``c``, ``distortion``.
    determined : bool
        Whether the pairs fix focal length and depth apart.
    messages : tuple of str
        What to know, and what to do about it.
    converged : bool
    """

    lidar_camera: LidarCamera
    pairs: LidarPairs
    residual: np.ndarray
    left_out: np.ndarray
    outlier: np.ndarray
    scale: float
    bound: np.ndarray
    fitted: tuple[str, ...]
    determined: bool
    messages: tuple[str, ...]
    converged: bool = True

    @property
    def camera(self) -> Camera:
        """The camera; its world is the frame of the lidar."""
        return self.lidar_camera.camera

    @property
    def counted(self) -> np.ndarray:
        """Pairs that count (P,): used, and no outliers."""
        return self.pairs.used_mask & ~self.outlier

    @property
    def error_px(self) -> np.ndarray:
        """Distances in the image (P,), px."""
        return np.linalg.norm(self.residual, axis=1)

    @property
    def rmse_px(self) -> float:
        """Root mean square of the distances of the pairs that count, px."""
        return float(np.sqrt(np.mean(self.error_px[self.counted] ** 2)))

    @property
    def median_px(self) -> float:
        """Median distance of all used pairs, outliers too, px."""
        return float(np.median(np.nan_to_num(self.error_px[self.pairs.used_mask], nan=np.inf)))

    @property
    def left_out_rmse_px(self) -> float:
        """Root mean square of the distances of pairs that count, each under the others' calibration, px."""
        return float(np.sqrt(np.mean((self.left_out[self.counted] ** 2).sum(axis=1))))

    @property
    def focal_px(self) -> float:
        """Focal length √(fx fy), px."""
        return float(np.sqrt(self.camera.matrix[0, 0] * self.camera.matrix[1, 1]))


def solve_lidar_camera(
    pairs: LidarPairs,
    resolution: tuple[int, int],
    camera: Camera | None = None,
    fit: Collection[str] | str = "auto",
    *,
    noise: PickNoise | None = None,
    focal_px: float | tuple[float, float] | None = None,
    rig_m: float | None = None,
    name: str = "cam1",
) -> Calibration:
    """Calibrate a camera to a lidar from pairs of picks.

    Parameters
    ----------
    pairs : LidarPairs
        From any number of images at one zoom, of planar or non-planar targets.
    resolution : (width, height)
        Of the images, px.
    camera : Camera, optional
        Known intrinsics; they are held, unless `fit` frees some of them, which then begin there.
    fit : "auto" or some of {"f", "aspect", "c", "distortion"}
        What to estimate besides the pose. ``"auto"``: nothing where `camera` is given; else focal length and
        principal point, and then unequal fx and fy and distortion (k1, k1 and k2) where pairs that were left
        out say so.
    noise : PickNoise, optional
        Of the picks: 1 px and 2 cm along the ray, unless told.
    focal_px : float or (float, float), optional
        The focal length, px, known from the lens: held, or with its standard deviation a prior.
    rig_m : float, optional
        About how far the camera may be from the lidar, m (standard deviation of each coordinate). Unless
        told, 0.5 m and 50 m are both tried, and the pairs choose.
    name : str
        Of the camera, where `camera` is not given.

    Returns
    -------
    Calibration
        The one with least robust error. Its messages say where pairs cannot tell focal length from depth.

    Raises
    ------
    InputError
        Too few pairs, all on one line, an unknown name in `fit`, or nothing fits.
    """
    noise = noise or PickNoise()
    begin = first_camera(resolution, camera, name, focal_px)
    free = _free(fit, camera, focal_px)
    used = np.flatnonzero(pairs.used_mask)
    pixel, xyz = pairs.pixel[used], pairs.xyz[used]
    names = POSE + tuple(p for key in ("f", "aspect", "c", "distortion") if key in free for p in FIT[key])
    _check_enough(pixel, xyz, len(names), begin)
    rigs = (rig_m,) if rig_m else (RIG, ANYWHERE)
    guesses = starts(begin, "f" in free, pixel, xyz)
    fits = [
        _best_fit(guesses, names, pixel, xyz, noise, known_before(begin, camera, focal_px, rig))
        for rig in rigs
    ]
    best = min(fits, key=_evidence)
    if fit == "auto" and camera is None:
        best = choose_lens(best, pixel, xyz, noise)
    _check_fits(best, noise)
    return _calibration(pairs, used, best, pixel, xyz, noise)


def first_camera(
    resolution: tuple[int, int], camera: Camera | None, name: str, focal: float | tuple[float, float] | None
) -> Camera:
    """The lens to begin with: the given one, or one with the principal point in the middle."""
    width, height = (int(v) for v in resolution)
    if min(width, height) < 1:
        raise InputError(
            "The resolution is impossible.", expected="width, height in px", found=f"{resolution}"
        )
    pose = (np.eye(3), np.zeros(3))
    if camera is not None:
        if tuple(camera.resolution) != (width, height):
            raise InputError(
                "The intrinsics are of images of another size than the picks.",
                key="resolution",
                expected="{} × {} px".format(*camera.resolution),
                found=f"{width} × {height} px",
                remedy="give the intrinsics of these images; after cropping or scaling they are others",
            )
        return Camera(camera.name, camera.model, camera.matrix, camera.distortion, *pose, (width, height))
    given = focal[0] if isinstance(focal, tuple) else focal
    f = float(given) if given else 2.0 * width
    matrix = np.array([[f, 0, 0.5 * (width - 1)], [0, f, 0.5 * (height - 1)], [0, 0, 1]])
    return Camera(name, "pinhole", matrix, np.zeros(5), *pose, (width, height))


def _free(
    fit: Collection[str] | str, camera: Camera | None, focal: float | tuple[float, float] | None
) -> tuple[str, ...]:
    """What is estimated at first."""
    if isinstance(fit, str):
        fit = (("f", "c") if camera is None else ()) if fit == "auto" else (fit,)
    unknown = [key for key in fit if key not in FIT]
    if unknown:
        raise InputError(
            f"'{unknown[0]}' cannot be fitted.", key="fit", expected=f"auto, or some of {', '.join(FIT)}"
        )
    if focal is not None and not isinstance(focal, tuple):
        fit = tuple(key for key in fit if key != "f")
    if "distortion" in fit and camera is not None and not _plain(camera):
        raise InputError(
            "The distortion of this lens cannot be fitted.",
            key="fit",
            expected="a pinhole lens with at most 5 coefficients",
            found=f"'{camera.model}' with {len(camera.distortion)}",
            remedy="hold the distortion as it was calibrated",
        )
    return tuple(fit)


def _plain(camera: Camera) -> bool:
    return camera.model == "pinhole" and len(camera.distortion) <= 5


def _check_enough(pixel: np.ndarray, xyz: np.ndarray, n_parameters: int, camera: Camera) -> None:
    """Raise InputError where no calibration can come of the pairs."""
    least = max(4, (n_parameters + 1) // 2 + 1)
    if len(pixel) < least:
        raise InputError(
            "There are too few pairs.",
            expected=f"{least} or more pairs in use; 12 and more give a result to rely on",
            found=str(len(pixel)),
            remedy="pick more, spread over the image and over distances",
        )
    for what, points in (("in the cloud", xyz), ("in the image", pixel)):
        spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
        if spread[1] < 1e-3 * spread[0] or spread[0] == 0:
            raise InputError(
                f"All pairs lie on one line {what}.",
                expected="places spread over an area",
                found=f"{len(points)} pairs on a line",
                remedy="pick places to both sides of it",
            )
    inside = camera.inside(pixel)
    if not inside.all():
        row = int(np.argmin(inside))
        width, height = camera.resolution
        raise InputError(
            f"A pick lies outside the image ({np.sum(~inside)} of {len(pixel)} do).",
            expected=f"0 to {width - 1} and 0 to {height - 1} px",
            found="{:g}, {:g}".format(*pixel[row]),
            remedy="check the resolution, and that u (to the right) comes before v (down)",
        )


def known_before(
    begin: Camera,
    camera: Camera | None,
    focal: float | tuple[float, float] | None,
    rig: float,
) -> Priors:
    """What is known before the pairs: roughly where the camera is, and what was told of its lens."""
    width, height = begin.resolution
    value = {"cx": begin.matrix[0, 2], "cy": begin.matrix[1, 2]}
    sd = dict.fromkeys(POSE[3:], rig) | {"cx": _CENTRE * width, "cy": _CENTRE * width} | _LENS
    if camera is not None:
        k = np.append(begin.distortion, np.zeros(2))
        value |= {"k1": float(k[0]), "k2": float(k[1])}
        value["log_aspect"] = float(np.log(begin.matrix[0, 0] / begin.matrix[1, 1]))
    if isinstance(focal, tuple):
        value["log_f"], sd["log_f"] = float(np.log(focal[0])), float(focal[1] / focal[0])
    return Priors(value, sd)


def _best_fit(
    guesses: list[Camera],
    names: tuple[str, ...],
    pixel: np.ndarray,
    xyz: np.ndarray,
    noise: PickNoise,
    priors: Priors,
) -> Fit:
    """The best of the least squares from all starts."""
    problem = (names, pixel, xyz, noise, priors)
    rough = [robust_fit(guess, *problem, rough=True) for guess in guesses]
    if not rough:
        raise InputError(_NO_POSE, remedy=_LOOK)
    fits = [robust_fit(fit.camera, *problem) for fit in sorted(rough, key=lambda fit: fit.scale)[:_FINALISTS]]
    return min((polished(fit.camera, *problem, fit.scale) for fit in fits), key=_evidence)


def _check_fits(fit: Fit, noise: PickNoise) -> None:
    """Raise InputError where the best there is fits nothing."""
    off, width = fit.scale * noise.pixel, fit.camera.resolution[0]
    seen = int(np.isfinite(fit.residual).all(axis=1).sum())
    if off > _WORST * width or 2 * seen < len(fit.residual):
        raise InputError(
            _NO_POSE,
            expected=f"most pairs before the camera, and picks much nearer than {_WORST * width:.0f} px",
            found=f"{seen} of {len(fit.residual)} before it, about {off:.0f} px off",
            remedy=_LOOK,
        )


def _evidence(fit: Fit) -> float:
    """Twice the negative logarithm of how likely the pairs are, but for a constant.

    Gaussian with the scale of the fit for pairs that count, a constant for outliers; what was known before
    with its normalisation, so that 0.5 m and 50 m may be compared (MacKay 2003, section 28.1).
    """
    off, weight = fit.priors.terms(fit.camera, fit.names)
    known = weight > 0
    each = np.minimum(fit.squared / fit.scale**2, OUTLIER)
    n = len(fit.weight)
    return float(each.sum() + 4.0 * n * np.log(fit.scale) + off @ off - 2.0 * np.log(weight[known]).sum())


def _calibration(
    pairs: LidarPairs, used: np.ndarray, fit: Fit, pixel: np.ndarray, xyz: np.ndarray, noise: PickNoise
) -> Calibration:
    """The result, with what is to be said of it."""
    residual = fit.camera.project(pairs.xyz) - pairs.pixel
    left = residual.copy()
    left[used] = left_out(fit)
    outlier = np.zeros(len(pairs), dtype=bool)
    outlier[used] = fit.weight == 0
    exact = at(fit.camera, fit.names, pixel, xyz, noise, fit.priors)
    bound = inverse(type(fit)(**{**exact.__dict__, "weight": fit.weight}).information)
    ambiguity = focal_and_depth(fit)
    error = np.linalg.norm(residual, axis=1)[used][fit.weight > 0]
    saved = LidarCamera(
        fit.camera,
        fit.covariance,
        fit.names,
        float(np.sqrt(np.mean(error**2))),
        int(np.sum(fit.weight > 0)),
        datetime.now(UTC).isoformat(timespec="seconds"),
    )
    fitted = tuple(key for key, parts in FIT.items() if any(p in fit.names for p in parts))
    messages = advice(fit, ambiguity, xyz, noise, used)
    return Calibration(
        saved, pairs, residual, left, outlier, fit.scale, bound, fitted, ambiguity.determined, messages,
        fit.converged,
    )  # fmt: skip
