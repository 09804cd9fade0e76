"""One tab of the calibration page: its elements, and what their events do."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from nicegui import run, ui
from nicegui.client import Client

from acino_fte.calibrate_page_parts import STYLE, CloudView, ImageView
from acino_fte.calibrate_page_text import ACTIONS, COLUMNS, HELP, facts, saved_text, step, table_rows
from acino_fte.calibrate_page_work import Work
from acino_fte.errors import InputError
from acino_fte.local_page import PageSession, show_error

_PAUSE = 0.5  # s without a change before the pairs are solved


class Tab:
    """The page in one tab of the browser. All tabs share the work, and follow its changes.

    Parameters
    ----------
    work : Work
    session : PageSession
    tabs : list of Tab
        All tabs; this one adds itself.
    """

    def __init__(self, work: Work, session: PageSession, tabs: list[Tab]) -> None:
        self.work, self.session, self.tabs = work, session, tabs
        self.images = list(work.placements)
        self.image = self.images[0]
        self.chosen: int | None = None
        self.overlaid = False
        self.client = ui.context.client
        self.cloud: CloudView
        self._shown_image = ""
        ui.dark_mode(True)
        ui.add_css(STYLE)
        self._head()
        with ui.element("div").classes("panes"):
            self._image_pane()
            self._cloud_pane()
        with ui.element("div").classes("below"):
            self._table()
            self._verdict()
        ui.keyboard(on_key=self._key, ignore=["input", "select", "textarea"])
        tabs.append(self)
        self.show_image(self.image)
        if work.n_found:
            ui.notify(f"{work.n_found} pairs found in {work.path}; go on.", type="info", position="bottom")
        ui.timer(0.1, self.solve_if_due)

    # -- elements --------------------------------------------------------------------------------------
    def _head(self) -> None:
        with ui.element("div").classes("bar"):
            ui.label("Camera ↔ lidar").classes("title")
            if len(self.images) > 1:
                _icon("chevron_left", "Previous image", lambda: self._turn_page(-1))
                self.selector = ui.select(
                    self.images, value=self.image, on_change=lambda e: self.show_image(e.value)
                ).props("dense outlined options-dense")
                _icon("chevron_right", "Next image", lambda: self._turn_page(1))
            self.undo = _icon("undo", "Undo (Ctrl-Z)", lambda: self.do(self.work.book.undo))
            self.redo = _icon("redo", "Redo (Ctrl-Y)", lambda: self.do(self.work.book.redo))
            self.step = ui.label().classes("step grow")
            self.solve_button = ui.button("Solve", icon="calculate", on_click=self.solve).props(
                "dense outline"
            )
            self.save_button = ui.button("Save", icon="save", on_click=self.save).props(
                "dense color=positive"
            )
            ui.button("Done", icon="check", on_click=self.finish).props("dense flat")
            _icon("help_outline", "Help", self._help)

    def _image_pane(self) -> None:
        with ui.element("div").classes("pane"):
            with ui.element("div").classes("bar"):
                self.image_title = ui.label().classes("grow step").style("color: inherit")
                self.overlay_switch = ui.switch("projected cloud", on_change=self._overlay_switched).props(
                    "dense"
                )
                _icon("fit_screen", "Whole image", lambda: self.view.run_method("fit"))
            self.view = ImageView()
            self.view.on("pick", lambda e: self.pick(pixel=(e.args["u"], e.args["v"])))
            self.view.on("nudge", self._nudge)
            self.view.on("failed", lambda e: show_error(str(e.args)))

    def _cloud_pane(self) -> None:
        with ui.element("div").classes("pane"):
            with ui.element("div").classes("bar"):
                colour = ui.select(["intensity", "range", "height"], value="intensity")
                colour.props("dense borderless options-dense").tooltip("Colour of the points")
                colour.on_value_change(lambda e: self.cloud.look(colour=e.value))
                self.range = self._clip("range")
                self.intensity = self._clip("intensity")
                size = (
                    ui.slider(min=1, max=8, value=2)
                    .props("dense")
                    .style("width: 60px")
                    .tooltip("Size of the points")
                )
                size.on_value_change(lambda e: self.cloud.look(size=e.value))
                _icon("videocam", "Seen from the lidar", lambda: self.cloud.run_method("from_lidar"))
                _icon("vertical_align_bottom", "Seen from above", lambda: self.cloud.run_method("from_above"))
                _icon("switch_right", "Seen from the side", lambda: self.cloud.run_method("from_side"))
            self.cloud = CloudView()
            self.cloud.look(colour="intensity", size=2)
            self.cloud.on("pick", self._picked_point)

    def _clip(self, name: str) -> ui.range:
        """A slider with two ends."""
        ui.label(name).style("font-size: 12px; color: var(--soft)")
        slider = ui.range(min=0, max=1, value={"min": 0, "max": 1}).props("label dense")
        slider.style("flex: 1 1 60px; min-width: 50px; margin: 0 8px")
        slider.on_value_change(lambda e: self.cloud.look(**{name: _open_ends(e.value, slider)}))
        return slider

    def _table(self) -> None:
        with ui.element("div").classes("pairs"):
            columns = [column for column in COLUMNS if len(self.images) > 1 or column["name"] != "image"]
            self.table = ui.table(rows=[], columns=columns, row_key="number").props(
                "flat dense hide-pagination :pagination='{rowsPerPage: 0}' dark "
                "no-data-label='No pairs yet: click a place in the image, then the same place in the cloud.'"
            )
            self.table.add_slot("body", ACTIONS)
            for name, action in {
                "choose": self.choose,
                "drop": self._drop,
                "again": self._again,
                "remove": lambda n: self.do(lambda: self.work.book.delete(n)),
            }.items():
                self.table.on(name, lambda e, action=action: action(int(e.args)))
            self.table.on(
                "label", lambda e: self.do(lambda: self.work.book.label(int(e.args[0]), str(e.args[1])))
            )

    def _verdict(self) -> None:
        with ui.element("div").classes("verdict"):
            self.headline = ui.label().classes("big")
            self.facts = ui.label().classes("facts")
            self.message = ui.label().classes("message")
            self.problem = ui.label().classes("problem")
            ui.label(HELP[0]).classes("hint")

    # -- what events do ----------------------------------------------------------------------------------
    def do(self, action: Callable[[], Any]) -> Any:
        """Do something to the picks; say what was wrong with it; show what came of it."""
        try:
            outcome = action()
        except InputError as error:
            show_error(error)
            outcome = None
        self.refresh_all()
        return outcome

    def pick(self, **side: Any) -> None:
        """Take a pick in the image or the cloud that is shown."""
        number = self.do(lambda: self.work.book.pick(self.image, **side))
        if number is not None and self.work.book.redoing is None:
            self.chosen = None
            self.refresh()

    def _picked_point(self, event: Any) -> None:
        x, y, z = self.work.placements[self.image].xyz[int(event.args["index"])].tolist()
        self.pick(xyz=(x, y, z))

    def _nudge(self, event: Any) -> None:
        self.do(lambda: self.work.book.nudge(self.image, event.args["du"], event.args["dv"]))

    def choose(self, number: int) -> None:
        """Highlight a pair, and bring it into both views."""
        pair = self.work.book.pair(number)
        chosen = None if self.chosen == number else number
        if pair.image != self.image:
            self.show_image(pair.image)
        self.chosen = chosen
        self.refresh()
        if self.chosen and pair.pixel and pair.xyz:
            self.view.show_pixel(*pair.pixel)
            self.cloud.show_point(*pair.xyz)

    def _drop(self, number: int) -> None:
        self.do(lambda: self.work.book.use(number, not self.work.book.pair(number).used))

    def _again(self, number: int) -> None:
        """Have the next picks replace those of a pair, or stop that."""
        book = self.work.book
        if book.redoing == number:
            book.redo_pair(None)
            self.chosen = None
        else:
            book.redo_pair(number)
            self.chosen = None  # `choose` sets it
            self.choose(number)
        self.refresh_all()

    def _key(self, event: Any) -> None:
        if not event.action.keydown:
            return
        book, key, ctrl = self.work.book, event.key.name, event.modifiers.ctrl or event.modifiers.meta
        if ctrl and key.lower() == "z":
            self.do(book.redo if event.modifiers.shift else book.undo)
        elif ctrl and key.lower() == "y":
            self.do(book.redo)
        elif ctrl:
            return
        elif key in ("Delete", "Backspace") and self.chosen:
            number, self.chosen = self.chosen, None
            self.do(lambda: book.delete(number))
        elif key == "Escape":
            self.do(lambda: book.escape(self.image))
            self.chosen = None
            self.refresh()
        elif key in ("PageUp", "PageDown"):
            self._turn_page(1 if key == "PageDown" else -1)

    def _turn_page(self, by: int) -> None:
        self.show_image(self.images[(self.images.index(self.image) + by) % len(self.images)])

    def _overlay_switched(self, event: Any) -> None:
        self.overlaid = bool(event.value)
        self.refresh()

    def _help(self) -> None:
        with ui.dialog(value=True) as dialog, ui.card().style("max-width: 640px"):
            for text in HELP:
                ui.label(text).style("white-space: pre-line")
            ui.button("Close", on_click=dialog.close).props("flat")

    # -- solving, saving -------------------------------------------------------------------------------
    async def solve_if_due(self) -> None:
        """Solve in the background where the pairs have changed, once they rest for a moment."""
        if self.work.due and self.work.quiet > _PAUSE:
            await self.solve()

    async def solve(self) -> None:
        """Solve now."""
        if self.work.solving:
            return
        self.work.solving = True
        self.solve_button.props("loading")
        try:
            await run.io_bound(self.work.solve)
        finally:
            self.work.solving = False
            self.solve_button.props(remove="loading")
        self.refresh_all()

    async def save(self) -> bool:
        """Write the calibration and its report; False where there is none."""
        self.save_button.props("loading")
        try:
            written = await run.io_bound(self.work.save)
        except InputError as error:
            show_error(error)
            return False
        finally:
            self.save_button.props(remove="loading")
        ui.notify(
            saved_text(written, self.work), type="positive", multi_line=True, position="bottom", timeout=8000
        )
        self.refresh_all()
        return True

    async def finish(self) -> None:
        """End the page; ask first where a calibration was not saved."""
        if self.work.current is not None and not self.work.saved:
            with ui.dialog(value=True) as dialog, ui.card():
                ui.label("The calibration was not saved. (The picks are.)")
                with ui.row():
                    ui.button("Save and end", on_click=lambda: dialog.submit("save")).props("color=positive")
                    ui.button("End without", on_click=lambda: dialog.submit("end")).props("flat")
                    ui.button("Go on", on_click=lambda: dialog.submit(None)).props("flat")
            answer = await dialog
            if answer is None or (answer == "save" and not await self.save()):
                return
        book = self.work.book
        self.session.finish(f"{len(book.pairs)} pairs are in {self.work.path}.\nYou may close this tab.")

    # -- showing ---------------------------------------------------------------------------------------
    def show_image(self, name: str) -> None:
        """Show another image and its cloud."""
        self.image, self.chosen = name, None
        if len(self.images) > 1:
            self.selector.value = name
        self.refresh()

    def refresh_all(self) -> None:
        """Bring all open tabs up to date."""
        self.tabs[:] = [tab for tab in self.tabs if tab.client.id in Client.instances]
        for tab in self.tabs:
            tab.refresh()

    def refresh(self) -> None:
        """Bring everything up to date."""
        work, book = self.work, self.work.book
        if self.chosen is not None and self.chosen > len(book.pairs):
            self.chosen = None
        index = self.images.index(self.image)
        new = self._shown_image != self.image
        sources = (f"/files/image{index}", f"/files/cloud{index}") if new else (None, None)
        self._shown_image = self.image
        if new:
            self._set_clips()
        solved = work.current is not None
        self.overlay_switch.set_enabled(solved)
        overlay = None
        if solved and self.overlaid:
            _, near, far = work.overlay(self.image)
            overlay = {"source": f"/files/overlay{index}?v={work.version}", "near": near, "far": far}
        self.view.show(source=sources[0], marks=work.image_marks(self.image, self.chosen), overlay=overlay)
        self.cloud.show(source=sources[1], marks=work.cloud_marks(self.image, self.chosen))
        width, height = work.placements[self.image].resolution
        self.image_title.set_text(f"{self.image} · {width} × {height} px")
        self.table.rows = table_rows(work, self.chosen)
        self.undo.set_enabled(book.can_undo)
        self.redo.set_enabled(book.can_redo)
        self.step.set_text(step(work, self.image))
        headline, lines, message = facts(work)
        self.headline.set_text(headline)
        self.facts.set_text(lines)
        self.message.set_text(message)
        self.problem.set_text(work.problem)
        self.save_button.set_enabled(solved)

    def _set_clips(self) -> None:
        """Bring the ends of the sliders to those of the cloud."""
        one = self.work.placements[self.image]
        for slider, values in (
            (self.range, np.linalg.norm(one.xyz, axis=1)),
            (self.intensity, one.intensity),
        ):
            low, high = float(np.min(values)), float(np.max(values))
            size = (high - low) / 200 or 1.0
            step_size = float(10.0 ** np.floor(np.log10(size)))
            low, high = np.floor(low / step_size) * step_size, np.ceil(high / step_size) * step_size
            slider._props.update(min=low, max=max(high, low + step_size), step=step_size)
            slider.value = {"min": slider._props["min"], "max": slider._props["max"]}
            slider.update()


def _open_ends(value: dict[str, float], slider: ui.range) -> dict[str, float | None]:
    """The clip; an end of the slider clips nothing."""
    low, high = slider._props["min"], slider._props["max"]
    return {
        "min": None if value["min"] <= low else value["min"],
        "max": None if value["max"] >= high else value["max"],
    }


def _icon(icon: str, says: str, action: Callable[[], Any]) -> ui.button:
    button = ui.button(icon=icon, on_click=action).props(f'flat dense round aria-label="{says}"')
    return button.tooltip(says)
