"""The page of adjustments: a bar, the views, the 3D view and the list of markers, on a local page."""

from __future__ import annotations

import json
from functools import partial
from typing import Any

from acino_fte.adjust_page_script import SCRIPT
from acino_fte.adjust_page_style import CSS, FRAME, KEYS, SIDE, SLIDER, STATUS, VIEWS
from acino_fte.adjust_pictures import Pictures
from acino_fte.adjust_session import AdjustSession
from acino_fte.errors import InputError
from acino_fte.local_page import PageSession, show_error

_STEPS = (
    ("first_page", "First frame (Home)", "adjust.go(-1e9)"),
    ("chevron_left", "Frame before (←)", "adjust.step(-1)"),
    ("chevron_right", "Next frame (→)", "adjust.step(1)"),
    ("last_page", "Last frame (End)", "adjust.go(1e9)"),
)
_CHANGES = (
    ("undo", "Undo (Ctrl+Z)", "undo", "adjust-undo"),
    ("redo", "Redo (Ctrl+Y)", "redo", "adjust-redo"),
    ("restart_alt", "Put the marker back (R)", "reset", "adjust-reset"),
    ("check_circle", "This frame is checked (C)", "check", "adjust-check"),
)


def build_page(page: PageSession, session: AdjustSession, pictures: Pictures) -> None:
    """The elements of one tab.

    Parameters
    ----------
    page : PageSession
        What is served.
    session : AdjustSession
        What is adjusted; all tabs share it.
    pictures : Pictures
        Frames of the views that have some.
    """
    from nicegui import ui

    ui.add_css(CSS)
    ui.dark_mode(True)
    with ui.element("div").props('id="adjust"'):
        _bar(page, session)
        ui.html(VIEWS, sanitize=False).style("display: contents")
        ui.html(SIDE, sanitize=False).style("display: contents")
        ui.html(KEYS, sanitize=False).style("display: contents")
    about = session.about()
    for c, view in enumerate(about["views"]):
        view["pictures"] = view["name"] in pictures.sources
        if view["pictures"]:
            for frame in range(about["frames"][0], about["frames"][1] + 1):
                page.share(f"p{c}-{frame}.jpg", partial(pictures.jpeg, view["name"], frame), "image/jpeg")
    ui.on("adjust", lambda event: _answer(session, event.args))
    first = session.frame(about["frames"][0])
    ui.run_javascript(f"{SCRIPT}\nadjust.start({json.dumps(about)}, {json.dumps(first)});")


def _bar(page: PageSession, session: AdjustSession) -> None:
    from nicegui import ui

    with ui.element("div").props('id="adjust-bar"'):
        ui.label(session.run.name).classes("adjust-run").tooltip(str(session.path))
        for icon, text, call in _STEPS[:2]:
            _button(icon, text, call)
        ui.html(FRAME, sanitize=False)
        for icon, text, call in _STEPS[2:]:
            _button(icon, text, call)
        ui.html(SLIDER, sanitize=False).style("display: contents")
        _button("skip_previous", "Large residual before (Shift+N)", "adjust.act('previous')")
        _button("skip_next", "Next large residual (N)", "adjust.act('next')").classes("adjust-next")
        ui.element("div").classes("adjust-gap")
        for icon, text, what, name in _CHANGES:
            _button(icon, text, f"adjust.act('{what}')").classes(name)
        _button("center_focus_strong", "Follow the animal (F)", "adjust.followAll()")
        _button("zoom_out_map", "Whole images (0)", "adjust.resetZoom()")
        ui.element("div").classes("adjust-gap")
        ui.html(STATUS, sanitize=False).style("display: contents")
        ui.button("CSV", on_click=lambda: _export(session)).props("flat dense no-caps tabindex=-1").tooltip(
            "Write the adjusted positions as CSV"
        )
        ui.button("Done", on_click=lambda: _finish(page, session)).props(
            "dense no-caps unelevated color=primary tabindex=-1"
        ).classes("adjust-done px-2")


def _button(icon: str, text: str, call: str) -> Any:
    from nicegui import ui

    button = ui.button(icon=icon).props("flat dense round size=sm tabindex=-1").tooltip(text)
    return button.on("click", js_handler=f"() => {call}")


def _answer(session: AdjustSession, request: dict[str, Any]) -> None:
    """What a tab asks for or does."""
    what = request.get("do")
    if what == "frame":
        _show(session, int(request["frame"]))
    elif what == "drag":
        _tell(f"adjust.dragged({json.dumps(session.drag(request, commit=False))})")
    elif what == "commit":
        session.drag(request, commit=True)
        _changed(session, int(request["frame"]))
    elif what in ("next", "previous"):
        found = session.next_large(int(request["frame"]), 1 if what == "next" else -1)
        if found is None:
            _say(f"No {what} frame with a residual beyond {session.large_px:g} px that is not checked.")
        else:
            _show(session, found[0], session.run.markers.index(found[1]))
    else:
        _act(session, str(what), int(request["frame"]), str(request["marker"]))


def _act(session: AdjustSession, what: str, frame: int, marker: str) -> None:
    """Undo, redo, reset, check; the tab goes to the frame that changed."""
    if what in ("undo", "redo"):
        changed = session.undo() if what == "undo" else session.redo()
    elif what == "reset":
        changed = session.reset(frame, marker)
    elif what == "check":
        changed = session.check(frame)
    else:
        return
    if changed is not None:
        _changed(session, changed)


def _changed(session: AdjustSession, frame: int) -> None:
    """Show the frame in the tab that changed it; the others ask anew."""
    from nicegui import context
    from nicegui.client import Client

    _show(session, frame, keep=True)
    for client in list(Client.instances.values()):
        if client is not context.client and client.has_socket_connection:
            client.run_javascript("adjust.stale()")


def _show(session: AdjustSession, frame: int, marker: int | None = None, *, keep: bool = False) -> None:
    chosen = json.dumps("keep" if keep else marker)
    _tell(f"adjust.receive({json.dumps(session.frame(frame))}, {chosen})")


def _tell(script: str) -> None:
    from nicegui import ui

    ui.run_javascript(script)


def _say(text: str) -> None:
    from nicegui import ui

    ui.notify(text, position="bottom", type="info")


def _export(session: AdjustSession) -> None:
    try:
        path = session.export()
    except InputError as error:
        show_error(error)
        return
    _say(f"Written: {path}")


def _finish(page: PageSession, session: AdjustSession) -> None:
    """End the page; when the last change is not saved, say so instead."""
    session.save()
    if session.problem:
        show_error(session.problem)
        return
    page.finish(f"Saved in {session.path}.\nYou may close this tab.")
