"""Real picks by hand, shipped with their result: the robust solve is at or below the shipped error.

Measured the same way for both: median over all 16 pairs of the distance between pick and projection, in the
image as it was recorded, with the shipped intrinsics (ost.yaml, distortion included). Nothing is left out.
"""

from pathlib import Path

import numpy as np
import pytest

from acino_fte.data_tools.lidar_camera import read_lidar_camera
from acino_fte.data_tools.lidar_intrinsics import read_intrinsics
from acino_fte.data_tools.lidar_pairs import LidarPairs
from acino_fte.data_tools.lidar_solve import solve_lidar_camera

FOLDER = Path(__file__).resolve().parents[2] / "shared" / "data" / "lidar_hand_corners"
pytestmark = pytest.mark.skipif(not FOLDER.is_dir(), reason="shared/data/lidar_hand_corners is absent")


@pytest.fixture(scope="module")
def pairs() -> LidarPairs:
    corners = (np.load(FOLDER / f"{name}_corners.npy", allow_pickle=False) for name in ("img", "pcl"))
    return LidarPairs(*corners, "left.png")


def test_at_or_below_the_shipped_error(pairs):
    lens = read_intrinsics(FOLDER / "ost.yaml")
    shipped = read_lidar_camera(FOLDER / "extrinsics.npz", "lidar_to_camera", camera=lens)
    median = np.median(np.linalg.norm(shipped.project(pairs.xyz) - pairs.pixel, axis=1))
    assert median == pytest.approx(7.156, abs=0.001)
    found = solve_lidar_camera(pairs, lens.resolution, lens)
    assert found.fitted == () and found.camera.matrix[0, 0] == lens.matrix[0, 0] and found.converged
    assert found.median_px <= median
    rmse = np.sqrt(np.mean(np.linalg.norm(shipped.project(pairs.xyz) - pairs.pixel, axis=1) ** 2))
    assert np.sqrt(np.mean(found.error_px**2)) < rmse
    assert found.scale > 3 and any("less exact" in message for message in found.messages)


def test_without_the_intrinsics_the_lens_is_found(pairs):
    """The picks are 5 px off and 1.5 m away: the focal length still comes out within a tenth."""
    found = solve_lidar_camera(pairs, (964, 724))
    assert found.focal_px == pytest.approx(484, rel=0.1) and found.converged


def test_the_direction_is_asked_for_with_evidence(pairs):
    from data_tools_synthetic import message

    lens = read_intrinsics(FOLDER / "ost.yaml")
    error = message(read_lidar_camera, FOLDER / "extrinsics.npz", camera=lens, points=pairs.xyz)
    assert error.key == "direction"
    assert "as lidar_to_camera, 16 of 16 points lie in front of the camera and 16 in the image" in error.found
    assert "as camera_to_lidar, 5 of 16" in error.found
