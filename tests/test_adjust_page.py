"""The page of adjustments in a real browser: one server and one tab for the whole file, in order."""

import json
from contextlib import ExitStack, contextmanager
from pathlib import Path

import numpy as np
import pytest
from browser import browser, served, tab  # noqa: F401
from evaluation_made import START, STOP, make_run
from test_run_cli import ENVIRONMENT

from acino_fte.adjust_files import read_adjustments
from acino_fte.evaluation_runs import open_run

pytest.importorskip("nicegui", reason="nicegui is not installed")
SCRIPT = Path(__file__).resolve().parent.parent / "scripts" / "adjust.py"
WIDTH, HEIGHT = 1920, 1080


@pytest.fixture(scope="module")
def place(browser, tmp_path_factory):  # noqa: F811 - skips before anything is made when there is no browser
    """A run of three views; the first has a video, a folder of images stands for the second."""
    folder = tmp_path_factory.mktemp("page")
    make_run(folder, "run", parameters={"time_offset_s": {"cam2": 0.003}})
    images = folder / "images"
    images.mkdir()
    cv2 = pytest.importorskip("cv2")
    for frame in range(START, STOP):
        picture = np.full((HEIGHT, WIDTH, 3), (200, 20 * (frame - START), 0), np.uint8)  # blue, green, red
        cv2.imwrite(str(images / f"img{frame:04d}.jpg"), picture)
    return folder


@pytest.fixture(scope="module")
def page(browser, place):  # noqa: F811
    """The served process, its file, and a tab that is open and has its first frame."""
    with opened_page(browser, place, "--images", f"cam2={place / 'images'}") as opened:
        yield opened


@contextmanager
def opened_page(browser, place, *options):  # noqa: F811
    arguments = [str(place / "run"), "--no-browser", *options]
    with ExitStack() as stack:
        patch = stack.enter_context(pytest.MonkeyPatch.context())
        patch.setenv("PYTHONPATH", ENVIRONMENT["PYTHONPATH"])
        server = stack.enter_context(served(str(SCRIPT), *arguments))
        opened = stack.enter_context(tab(browser))
        opened.page.goto(server.address)
        opened.page.wait_for_function("window.adjust && adjust.data")
        yield Opened(server, opened, place / "run.adjustments.json", place)


class Opened:
    """Shorthands for what the tests do again and again."""

    def __init__(self, server, opened, path, place):
        self.server, self.tab, self.page, self.path, self.place = server, opened, opened.page, path, place

    def ask(self, expression):
        return self.page.evaluate(expression)

    def until(self, condition):
        self.page.wait_for_function(condition)

    def entries(self):
        return json.loads(self.path.read_text(encoding="utf-8"))["adjustments"]

    def at(self, frame):
        self.page.evaluate(f"adjust.go({frame})")
        self.until(f"adjust.data.frame === {frame}")

    def where(self, view, marker):
        return self.ask(f"adjust.where('{view}', {marker})")

    def drag(self, view, marker, dx, dy, key=None):
        x, y = self.where(view, marker)
        mouse = self.page.mouse
        mouse.move(x, y)
        if key:
            self.page.keyboard.down(key)
        mouse.down()
        for k in (0.3, 0.7, 1.0):
            mouse.move(x + k * dx, y + k * dy)
        mouse.up()
        if key:
            self.page.keyboard.up(key)
        return x, y


def alone(opened, frame):
    """A marker (index) that no other is near to in cam1, so that the mouse takes it and no other."""
    opened.at(frame)
    points = np.array([opened.where("cam1", m) for m in range(24)])
    distance = np.linalg.norm(points[:, None] - points, axis=-1) + 1e9 * np.eye(24)
    return int(np.argmax(distance.min(axis=1)))


def test_the_page_is_complete_and_stays_on_this_computer(page):
    assert page.ask("document.querySelectorAll('.adjust-view').length") == 3
    assert page.ask("document.querySelectorAll('#adjust-list tbody tr').length") == 24
    assert page.page.title() == "Adjust run"
    assert not page.tab.elsewhere and not page.tab.complaints
    sizes = page.ask("[document.body.scrollWidth, document.body.scrollHeight, innerWidth, innerHeight]")
    assert sizes[0] <= sizes[2] and sizes[1] <= sizes[3]  # nothing to scroll on a laptop


def test_a_wrong_token_is_refused(page, browser):  # noqa: F811
    for address in (page.server.url, f"{page.server.url}?token=guess", f"{page.server.url}files/p1-10.jpg"):
        with tab(browser) as stranger:
            answer = stranger.page.goto(address)
            assert answer.status in (401, 403), address
            assert "adjust-views" not in stranger.page.content()


def test_the_keyboard_steps_through_frames_and_markers(page):
    page.at(START)
    keys = page.page.keyboard
    for key, frame in (("ArrowRight", START + 1), ("ArrowLeft", START), ("PageDown", START + 10)):
        keys.press(key)
        page.until(f"adjust.data.frame === {frame}")
    for key, frame in (("End", STOP - 1), ("ArrowRight", STOP - 1), ("Home", START), ("PageUp", START)):
        keys.press(key)
        page.until(f"adjust.data.frame === {frame} && adjust.wanted === {frame}")
    begun = page.ask("adjust.marker")
    keys.press("Tab")
    second = page.ask("adjust.marker")
    keys.press("Shift+Tab")
    assert begun == page.ask("adjust.marker") == "nose" and second == "l_eye"
    assert page.ask("document.querySelector('tr.chosen').dataset.marker") == "nose"
    assert not page.path.read_text(encoding="utf-8").count("after")  # looking changes nothing


def test_pictures_are_behind_the_skeleton(page):
    """The images' green grows with the frame; a view without pictures is blank."""
    page.ask("adjust.resetZoom()")

    def colour(view):
        return page.ask(
            f"(() => {{ const c = document.querySelectorAll('.adjust-view canvas')[{view}];"
            " const r = devicePixelRatio; const d = c.getContext('2d').getImageData(c.width / 2,"
            " c.height / 2 + 0.4 * c.width * 1080 / 1920, 1, 1).data; return [...d]; })()"
        )

    for frame in (START + 2, START + 9):
        page.at(frame)
        green = 20 * (frame - START)
        page.until(
            "(() => { const c = document.querySelectorAll('.adjust-view canvas')[1];"
            " const d = c.getContext('2d').getImageData(c.width / 2,"
            " c.height / 2 + 0.4 * c.width * 1080 / 1920, 1, 1).data;"
            f" return d[2] > 180 && Math.abs(d[1] - {green}) < 14; }})()"
        )
    assert max(colour(0)[:3]) < 80


def test_a_drag_is_saved_with_before_and_after(page):
    m = alone(page, START + 3)
    run = open_run(page.place / "run")
    other = page.where("cam3", m)
    x, y = page.drag("cam1", m, 30, -14)
    page.until("adjust.data.n_adjusted === 1")
    np.testing.assert_allclose(page.where("cam1", m), (x + 30, y - 14), atol=0.6)
    assert np.abs(np.subtract(page.where("cam3", m), other)).max() > 1  # the other views follow
    (entry,) = page.entries()
    assert (entry["frame"], entry["marker"], entry["view"]) == (START + 3, run.markers[m], "cam1")
    np.testing.assert_allclose(entry["before"], run.positions[3, m])
    camera = run.cameras["cam1"]
    pixel = camera.project(np.array([entry["after"]]))[0]
    np.testing.assert_allclose(pixel, entry["pins"]["cam1"], atol=1e-6)
    depths = camera.to_camera(np.array([entry["before"], entry["after"]]))[:, 2]
    assert depths[0] == pytest.approx(depths[1], abs=1e-9)
    row = page.page.locator("tr.chosen")
    moved = 100 * np.linalg.norm(np.subtract(entry["after"], entry["before"]))
    assert f"{moved:.1f}" in row.inner_text()


def test_undo_redo_and_reset(page):
    keys = page.page.keyboard
    before = page.entries()
    keys.press("Control+z")
    page.until("adjust.data.n_adjusted === 0")
    assert page.entries() == []
    page.page.locator(".adjust-redo").click()
    page.until("adjust.data.n_adjusted === 1")
    assert page.entries() == before
    keys.press("r")
    page.until("adjust.data.n_adjusted === 0")
    keys.press("Control+z")
    page.until("adjust.data.n_adjusted === 1")
    assert page.entries() == before


def test_depth_by_shift_and_by_the_wheel(page):
    m = alone(page, START + 5)
    x, y = page.drag("cam1", m, 0, -40, key="Shift")
    page.until("adjust.data.n_adjusted === 2")
    np.testing.assert_allclose(page.where("cam1", m), (x, y), atol=0.6)
    entry = next(e for e in page.entries() if e["frame"] == START + 5)
    away = np.linalg.norm(np.subtract(entry["after"], entry["before"]))
    assert away == pytest.approx(0.2, abs=0.02)  # 5 mm for each pixel of the screen
    page.page.mouse.move(x, y)
    page.page.mouse.wheel(0, -100)
    page.until(f"Math.abs(100 * {away} + 1 - 100 * adjust.data.moved[{m}]) < 0.05")
    page.page.mouse.move(x, y + 120)
    scale = page.ask("adjust.where('cam1', 1)[0] - adjust.where('cam1', 0)[0]")
    page.page.mouse.wheel(0, -100)  # beside it: zoom
    assert page.ask("adjust.where('cam1', 1)[0] - adjust.where('cam1', 0)[0]") != pytest.approx(scale)
    assert len(page.entries()) == 2


def test_the_3d_view_turns(page):
    canvas = page.page.locator("#adjust-space canvas")
    box = canvas.bounding_box()
    before = canvas.screenshot()
    mouse = page.page.mouse
    mouse.move(box["x"] + 100, box["y"] + 100)
    mouse.down()
    mouse.move(box["x"] + 170, box["y"] + 120)
    mouse.up()
    assert canvas.screenshot() != before


def test_frames_are_checked_and_jumped_to(page):
    page.at(START + 5)
    page.page.keyboard.press("c")
    page.until("adjust.data.checked && adjust.data.n_checked === 1")
    page.at(START)
    page.page.keyboard.press("n")  # the drags above made residuals that are large
    page.until(f"adjust.data.frame === {START + 3}")
    page.page.keyboard.press("c")
    page.until("adjust.data.n_checked === 2")
    assert json.loads(page.path.read_text(encoding="utf-8"))["checked"] == [START + 3, START + 5]


def test_one_view_alone(page):
    widths = "[...document.querySelectorAll('.adjust-view')].map((v) => v.clientWidth)"
    whole = page.ask(widths)
    page.page.keyboard.press("v")
    alone_ = page.ask(widths)
    assert alone_[0] > 1.9 * whole[0] and alone_[1:] == [0, 0]
    page.page.keyboard.press("v")
    assert page.ask(widths) == whole


def test_a_killed_server_has_lost_nothing_and_work_goes_on(page, browser):  # noqa: F811
    """Last in the file: SIGKILL right after a change was seen; then the page again, to its end."""
    m = alone(page, START + 7)
    page.drag("cam1", m, 15, 9)
    page.until("adjust.data.n_adjusted === 3")
    page.server.process.kill()
    page.server.process.wait()
    run = open_run(page.place / "run")
    document = read_adjustments(page.path, [run])
    assert set(document.entries) >= {(START + 7, run.markers[m])} and len(document.entries) == 3
    assert [p.name for p in page.place.glob(".*")] == []
    assert not page.tab.complaints
    with opened_page(browser, page.place) as again:
        assert again.ask("adjust.data.n_adjusted") == 3
        again.page.locator(".adjust-done").click()
        again.page.wait_for_selector("#farewell")
        assert again.server.process.wait(timeout=20) == 0
    table = (page.place / "run.adjustments.csv").read_text(encoding="utf-8").splitlines()
    assert sum(line.split(",")[6] == "1" for line in table[1:]) == 3
