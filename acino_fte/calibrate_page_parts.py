"""The two views of the calibration page as NiceGUI elements. What they do is in JavaScript beside them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from nicegui.element import Element

STYLE = Path(__file__).with_name("calibrate_page.css")


class ImageView(Element, component="calibrate_page_image.js"):
    """An image with numbered picks.

    Events: ``pick`` {u, v} (px), ``nudge`` {du, dv} (px), ``failed`` text.
    """

    def show(
        self,
        *,
        source: str | None = None,
        marks: list[dict[str, Any]] | None = None,
        overlay: dict[str, Any] | None = None,
    ) -> None:
        """Change what is shown: address of the image, marks, and the projected cloud (None: without)."""
        if source is not None:
            self._props["source"] = source
        self._props["marks"] = marks or []
        self._props["overlay"] = overlay
        self._props["dim"] = overlay is not None
        self.update()

    def show_pixel(self, u: float, v: float) -> None:
        """Bring a pixel into view."""
        self.run_method("show_pixel", u, v)


class CloudView(Element, component="calibrate_page_cloud.js"):
    """A point cloud that turns, with numbered picks. Event: ``pick`` {index}."""

    def show(self, *, source: str | None = None, marks: list[dict[str, Any]] | None = None) -> None:
        """Change what is shown: address of the cloud, and marks."""
        if source is not None:
            self._props["source"] = source
        self._props["marks"] = marks or []
        self.update()

    def look(self, **values: Any) -> None:
        """Change how it is shown: colour, range, intensity ({min, max}), size."""
        self._props.update(values)
        self.update()

    def show_point(self, x: float, y: float, z: float) -> None:
        """Bring a point into view."""
        self.run_method("show_point", x, y, z)
