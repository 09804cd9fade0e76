"""Maps the repository's rooms to the packages they install as (everything else is in pyproject.toml)."""

from setuptools import setup

setup(
    packages=["acino_fte", "acino_fte.models", "acino_fte.data_tools", "acino_fte.rig"],
    package_dir={
        "acino_fte": "acino_fte",
        "acino_fte.models": "models",
        "acino_fte.data_tools": "data_tools",
        "acino_fte.rig": "rig",
    },
)
