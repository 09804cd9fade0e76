"""A species as a tree on the terminal."""

from __future__ import annotations

import math

from rich.markup import escape
from rich.tree import Tree

from acino_fte.skeleton import Dof, Skeleton


def skeleton_tree(skeleton: Skeleton) -> Tree:
    """Links as they hang on each other, with their degrees of freedom and markers."""
    head = (
        f"[bold]{escape(skeleton.name)}[/]  {len(skeleton.links)} links, {len(skeleton.dofs)} degrees of "
        f"freedom, {len(skeleton.markers)} markers; noise at {skeleton.noise_fps:g} fps"
    )
    tree = Tree(head)
    nodes: list[Tree] = []
    for i, link in enumerate(skeleton.links):
        holder = nodes[link.parent] if link.parent >= 0 else tree
        node = holder.add(f"[bold]{escape(link.name)}[/] [dim]at {_place(link.at)}[/]")
        nodes.append(node)
        for j in link.dofs:
            node.add(f"[cyan]{escape(describe_dof(skeleton.dofs[j]))}[/]")
        for marker in skeleton.markers:
            if marker.link == i:
                also = f", also {', '.join(marker.aliases)}" if marker.aliases else ""
                text = f"marker {marker.name}, sd {marker.sd_px:g} px, at {_place(marker.at)}{also}"
                node.add(f"[green]{escape(text)}[/]")
    return tree


def describe_dof(dof: Dof) -> str:
    """One line: ``pitch  turn y  -30° to 30°  noise 516°/s²``."""
    axis = "xyz"[max(range(3), key=lambda i: abs(dof.axis[i]))]
    sign = "-" if sum(dof.axis) < 0 else ""
    unit, scale = ("°", math.degrees(1.0)) if dof.kind == "turn" else (" m", 1.0)
    if math.isfinite(dof.lower + dof.upper):
        limits = f"{round(dof.lower * scale, 3):g}{unit} to {round(dof.upper * scale, 3):g}{unit}"
    else:
        limits = "free"
    name = dof.name.split(".", 1)[1]
    return f"{name}: {dof.kind} {sign}{axis}, {limits}, noise {round(dof.noise * scale, 3):g}{unit}/s²"


def _place(at: tuple[float, float, float]) -> str:
    return "[" + ", ".join(f"{v:g}" for v in at) + "] m"
