"""3D trajectories of animals from 2D keypoints and calibrated cameras.

The names below are the public interface. They are imported on first use, so that
``import acino_fte`` costs next to nothing.

Examples
--------
>>> import acino_fte as af                                       # doctest: +SKIP
>>> sequence = af.load_sequence("examples/cheetah_gallop")       # doctest: +SKIP
>>> kinematics = af.load_kinematics(af.load_skeleton("cheetah")) # doctest: +SKIP
>>> result = af.estimate_fte(sequence, kinematics)               # doctest: +SKIP

The trajectory problem alone, without estimating noise or parameters:

>>> problem = af.build_fte(sequence, kinematics)                 # doctest: +SKIP
>>> start = af.initial_trajectory(sequence, kinematics)          # doctest: +SKIP
>>> result = af.solve_fte(problem, start)                        # doctest: +SKIP

Animals without markers, as 2D tracks of several cameras:

>>> matches = af.match_tracks(af.load_tracks("examples/bird_tracks"))  # doctest: +SKIP

Animals that moving cameras saw, from a COLMAP model and their 2D tracks:

>>> scene = af.Scene.from_colmap("examples/wand_rig").placed(["cam0-cam1=0.6"])  # doctest: +SKIP
>>> tracks = scene.triangulate().tracks                          # doctest: +SKIP
"""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import Any

__version__ = "0.1.0"

_PUBLIC = {
    "InputError": "errors",
    "Camera": "cameras",
    "CameraArray": "cameras",
    "Sequence": "sequence",
    "Skeleton": "skeleton",
    "load_skeleton": "skeleton",
    "Kinematics": "kinematics",
    "load_kinematics": "kinematics",
    "FTEOptions": "problem",
    "FTEProblem": "problem",
    "build_fte": "problem",
    "initial_trajectory": "initialise",
    "SolveOptions": "solve",
    "solve_fte": "solve",
    "EstimateOptions": "estimate",
    "estimate_fte": "estimate",
    "Assumptions": "problem",
    "FTEResult": "result",
    "Status": "result",
    "load_sequence": "data_tools.load",
    "load_tracks": "data_tools.load_tracks",
    "MatchOptions": "data_tools.match_options",
    "match_tracks": "data_tools.track_matching",
    "score_matching": "data_tools.match_metrics",
    "smooth_trajectories": "data_tools.trajectories3d",
    "TrackSimulation": "data_tools.simulate_tracks",
    "simulate_tracks": "data_tools.simulate_tracks",
    "Scene": "data_tools.scene",
    "SceneSimulation": "data_tools.simulate_scene",
    "simulate_scene": "data_tools.simulate_scene",
}

__all__ = ["__version__", *_PUBLIC]

# In a checkout the packages acino_fte.models and acino_fte.data_tools are sibling folders of this
# one; an installed copy has them inside and does not need this line.
_checkout = Path(__file__).resolve().parent.parent
if (_checkout / "models" / "__init__.py").is_file() and (_checkout / "pyproject.toml").is_file():
    __path__.append(str(_checkout))


def __getattr__(name: str) -> Any:
    """Import a public name on first use (PEP 562)."""
    if name not in _PUBLIC:
        raise AttributeError(f"module 'acino_fte' has no attribute {name!r}")
    return getattr(import_module(f"acino_fte.{_PUBLIC[name]}"), name)


def __dir__() -> list[str]:
    return sorted(__all__)
