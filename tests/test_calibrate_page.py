"""The calibration page: its picks and their file without a browser, then the page in a real one."""

import json
import os
import re
import signal
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from browser import browser, served, tab  # noqa: F401
from calibrate_page_world import IMAGES, N_TARGETS, camera, cloud, picture, pixels, targets, write_world
from numpy.testing import assert_allclose, assert_array_equal
from typer.testing import CliRunner

from acino_fte.calibrate_page_clouds import read_cloud
from acino_fte.calibrate_page_files import read_picks, save_picks
from acino_fte.calibrate_page_model import PickBook, Picks
from acino_fte.data_tools.lidar_pairs import LidarPairs, read_lidar_pairs, write_lidar_pairs
from acino_fte.errors import InputError

cv2 = pytest.importorskip("cv2", reason="the extra 'lidar' is not installed")
pytest.importorskip("nicegui", reason="the extra 'lidar' is not installed")
from acino_fte.calibrate_page_input import check_placements, placement, read_placements  # noqa: E402
from acino_fte.calibrate_page_work import ENOUGH, Work  # noqa: E402

SCRIPT = str(Path(__file__).parents[1] / "scripts" / "calibrate_lidar.py")
A, B = IMAGES


def picked(book, count=N_TARGETS, image=A):
    """Pick the first targets of an image, as they are."""
    for pixel, xyz in list(zip(pixels(image).tolist(), targets(image).tolist(), strict=True))[:count]:
        book.pick(image, pixel=tuple(pixel))
        book.pick(image, xyz=tuple(xyz))
    return book


# -- picks -------------------------------------------------------------------------------------------------
def test_two_sides_make_a_pair():
    book = PickBook(IMAGES)
    assert book.pick(A, xyz=(5, 0, 0)) is None
    assert book.pick(A, xyz=(6, 0, 0)) is None  # moves the first
    assert book.pick(B, pixel=(3, 4)) is None  # another image has its own
    assert book.pick(A, pixel=(1, 2)) == 1
    assert book.pick(B, xyz=(7, 0, 0)) == 2
    assert (book.half(A), book.half(B)) == (None, None)
    pairs = book.lidar_pairs()
    assert pairs.image == (A, B)
    assert_array_equal(pairs.pixel, [[1, 2], [3, 4]])
    assert_array_equal(pairs.xyz, [[6, 0, 0], [7, 0, 0]])
    with pytest.raises(InputError, match="no image 'x'"):
        book.pick("x", pixel=(1, 1))


def test_pairs_are_dropped_deleted_and_picked_again():
    book = picked(PickBook(IMAGES), 3)
    before = book.pairs
    book.use(2, False)
    assert [pair.used for pair in book.pairs] == [True, False, True]
    assert_array_equal(book.lidar_pairs().used, [True, False, True])
    book.use(2, True)
    assert book.pairs == before
    book.redo_pair(2)
    assert book.pick(A, pixel=(11.0, 12.0)) == 2
    assert book.nudge(A, 0.25, -1)
    assert book.pairs[1] == replace(before[1], pixel=(11.25, 11.0))
    with pytest.raises(InputError, match="in the image 'near.png'"):
        book.pick(B, pixel=(1, 1))
    assert book.escape(A)
    assert book.pick(A, pixel=(50, 60)) is None  # a new pair again
    assert book.escape(A)
    assert not book.escape(A)
    book.delete(1)
    assert book.pairs == (replace(before[1], pixel=(11.25, 11.0)), before[2])
    with pytest.raises(InputError, match="There is no pair 3"):
        book.delete(3)


def test_every_change_can_be_undone_and_done_again():
    rng = np.random.default_rng(3)
    seen = [Picks()]
    book = PickBook(IMAGES, changed=seen.append)
    for _ in range(120):
        n, image = len(book.pairs), IMAGES[rng.integers(2)]
        number = int(rng.integers(1, n + 1)) if n else 0
        kind = rng.integers(8)
        if kind < 2:
            book.pick(image, pixel=tuple(rng.uniform(0, 400, 2)))
        elif kind < 4:
            book.pick(image, xyz=tuple(rng.uniform(1, 9, 3)))
        elif kind == 4:
            book.nudge(image, 0.5, 0)
        elif kind == 5 and n:
            book.use(number, bool(rng.integers(2)))
        elif kind == 6 and n > 3:
            book.delete(number)
        elif kind == 7:
            book.discard_half(image)
    assert len(seen) > 60
    states = seen.copy()
    for state in states[-2::-1]:
        assert book.undo()
        assert book.picks == state
    assert not book.undo()
    for state in states[1:]:
        assert book.redo()
        assert book.picks == state
    assert not book.redo()
    book.undo()
    book.pick(A, pixel=(1, 1))
    assert not book.can_redo  # a new change ends what could be done again


def test_a_change_that_cannot_be_kept_is_taken_back():
    def full(_):
        raise InputError("The disk is full.")

    book = picked(PickBook(IMAGES), 1)
    before = book.picks
    book.changed = full
    for change in (lambda: book.pick(A, pixel=(1, 1)), lambda: book.delete(1), book.undo):
        with pytest.raises(InputError, match="disk is full"):
            change()
        assert book.picks == before
    book.changed = None
    with pytest.raises(InputError, match="is pair 1 again"):
        picked(book, 1)
    assert book.pairs == before.pairs
    assert book.half(A).pixel == before.pairs[0].pixel  # the pick under way stays


# -- files -------------------------------------------------------------------------------------------------
def test_picks_come_back_from_disk_digit_for_digit(tmp_path):
    path = tmp_path / "new" / "pairs.csv"
    book = picked(PickBook(IMAGES, changed=lambda picks: save_picks(path, picks)), 2)
    book.use(1, False)
    book.pick(B, xyz=(1 / 3, 2, 3))
    assert read_picks(path, IMAGES) == book.picks
    assert read_lidar_pairs(path).used.tolist() == [False, True]
    assert not read_picks(path, [A]).half  # that image is not shown now
    book.pick(B, pixel=(9, 8))
    assert read_picks(path, IMAGES) == book.picks
    assert [file.name for file in path.parent.iterdir()] == ["pairs.csv"]
    assert read_picks(tmp_path / "none.csv", IMAGES) == Picks()


def test_broken_picks_are_said_and_kept(tmp_path):
    path = tmp_path / "pairs.csv"
    write_lidar_pairs(path, LidarPairs(pixels(A), targets(A)))
    assert {pair.image for pair in read_picks(path, [A]).pairs} == {A}  # no image named: the only one
    with pytest.raises(InputError, match="Pair 1 is of the image ''"):
        read_picks(path, IMAGES)
    beside = tmp_path / "pairs.picking.json"
    for text in ("", "{}", '{"format": "acino-fte/picking/1", "half": [{"image": "a", "pixel": [1]}]}'):
        beside.write_text(text)
        with pytest.raises(InputError, match="under way cannot be read") as caught:
            read_picks(path, [A])
        assert caught.value.file == str(beside)
    path.write_text("image,u,v,x,y,z\nnear.png,1,2,3,4\n")
    with pytest.raises(InputError, match=r"pair 1|Pair 1|'z'"):
        read_picks(path, [A])


# -- what is shown -----------------------------------------------------------------------------------------
def test_images_are_shown_as_they_are_and_deep_ones_stretched(tmp_path):
    cv2.imwrite(str(tmp_path / "a.png"), picture(A)[..., ::-1])
    xyz, intensity = cloud(A)
    one = placement(
        "a", tmp_path / "a.png", np.vstack([xyz, [[0, 0, 0], [np.nan, 1, 1]]]), np.r_[intensity, 1, 2]
    )
    assert one.picture == (tmp_path / "a.png").read_bytes()
    assert one.resolution == (640, 480)
    assert_array_equal(one.xyz, xyz)
    packed = np.frombuffer(one.packed(), "<f4")
    assert_array_equal(packed[: 3 * len(xyz)].reshape(-1, 3), xyz.astype("f4"))
    assert_array_equal(packed[3 * len(xyz) :], intensity.astype("f4"))
    deep = (np.arange(480 * 640).reshape(480, 640) // 80).astype(np.uint16)  # 12 bits
    cv2.imwrite(str(tmp_path / "deep.tif"), deep)
    for given in (tmp_path / "deep.tif", deep):
        shown = cv2.imdecode(
            np.frombuffer(placement("d", given, xyz).picture, np.uint8), cv2.IMREAD_GRAYSCALE
        )
        assert_allclose(shown, np.clip(deep / deep.max(), 0, 1) * 255, atol=2)
    assert_array_equal(decoded(placement("c", picture(A), xyz)), picture(A))


def decoded(one):
    return cv2.imdecode(np.frombuffer(one.picture, np.uint8), cv2.IMREAD_COLOR)[..., ::-1]


def test_inputs_that_do_not_fit_are_said(tmp_path):
    xyz = cloud(A)[0]
    one = placement("a", picture(A), xyz)
    with pytest.raises(InputError, match="one name"):
        check_placements([one, one])
    with pytest.raises(InputError, match="different sizes"):
        check_placements([one, replace(one, name="b", resolution=(10, 10))])
    with pytest.raises(InputError, match="is empty"):
        placement("a", picture(A), np.zeros((3, 3)))
    (tmp_path / "a.png").write_bytes(b"no image")
    with pytest.raises(InputError, match="no image"):
        placement("a", tmp_path / "a.png", xyz)
    with pytest.raises(InputError, match="needs its point cloud"):
        read_placements([tmp_path / "a.png"] * 3, [tmp_path / "c.npz"] * 2)
    outcome = CliRunner().invoke(_command(), [str(tmp_path / "none.png"), "--cloud", str(tmp_path / "c.npz")])
    assert outcome.exit_code == 2
    assert "There is no such point cloud" in outcome.stderr


def _command():
    import typer

    from acino_fte.cli_calibrate import calibrate_lidar

    app = typer.Typer()
    app.command()(calibrate_lidar)
    return app


def test_clouds_and_recordings_are_read(tmp_path):
    xyz, intensity = cloud(A)
    np.savez(tmp_path / "both.npz", xyz=xyz, intensity=intensity)
    np.save(tmp_path / "points.npy", xyz)
    points, values = read_cloud(tmp_path / "both.npz")
    assert_array_equal(points, xyz)
    assert_array_equal(values, intensity)
    assert_array_equal(read_cloud(tmp_path / "points.npy")[1], 0 * intensity)
    with pytest.raises(InputError):
        read_cloud(tmp_path / "none.bag")


def test_work_says_what_the_solution_is(tmp_path):
    from acino_fte.data_tools.lidar_solve import solve_lidar_camera

    saved = []
    places = [placement(name, picture(name), *cloud(name)) for name in IMAGES]
    work = Work(
        places, tmp_path / "pairs.csv", lambda p: solve_lidar_camera(p, (640, 480), camera()), saved.append
    )
    picked(work.book, ENOUGH - 1)
    assert not work.due
    with pytest.raises(InputError, match="no calibration to save yet"):
        work.save()
    picked(work.book, 3, B)
    assert work.due
    work.solve()
    assert (work.due, work.problem) == (False, "")
    assert max(row["error"] for row in work.rows()) < 0.01
    u, v = work.book.pairs[0].pixel
    work.book.redo_pair(1)
    work.book.pick(A, pixel=(u + 30, v))
    assert (work.current, work.due) == (None, True)
    assert work.rows()[0]["error"] == pytest.approx(30, abs=0.01)  # live, before it is solved
    marks = work.image_marks(A, chosen=1)
    assert_allclose(marks[0]["projected"], (u, v), atol=0.01)
    assert [mark["chosen"] for mark in marks] == [True] + (ENOUGH - 2) * [False]
    assert [mark["text"] for mark in work.cloud_marks(B)] == ["6", "7", "8"]
    work.save()  # solves what is due
    assert saved == [work.current]
    assert [row["outlier"] for row in work.rows()] == [True] + 7 * [False]
    _check_overlay(work)
    work._solve = lambda pairs: (_ for _ in ()).throw(InputError("All pairs lie on one line."))
    work.book.delete(1)
    work.solve()
    assert (work.current, work.due) == (None, False)
    assert "one line" in work.problem


def test_the_result_in_words(tmp_path):
    from acino_fte.calibrate_page_text import facts, step
    from acino_fte.data_tools.lidar_solve import solve_lidar_camera

    places = [placement(name, picture(name), *cloud(name)) for name in IMAGES]
    work = Work(places, tmp_path / "pairs.csv", partial(solve_lidar_camera, resolution=(640, 480)), print)
    assert step(work, A) == "Pair 1: click a place in the image, or in the cloud"
    picked(work.book, 4)
    assert facts(work)[0] == "4 pairs: 2 more until the first result"
    picked(work.book, 8, B)
    work.book.use(5, False)
    assert facts(work)[0] == "Solving …"
    work.solve()
    headline, lines, _ = facts(work)
    assert headline.startswith("RMSE 0.")
    assert "11 pairs · 1 dropped" in lines
    assert "focal length 900." in lines
    assert "±" in lines
    flat = [
        replace(pair, xyz=(20.0, *pair.xyz[1:])) for pair in work.book.pairs
    ]  # a board that faces the camera
    for pair in flat:
        book_pixel = camera().project(np.array(pair.xyz))
        work.book.pick(B, pixel=tuple(book_pixel.tolist()))
        work.book.pick(B, xyz=pair.xyz)
    for number in range(1, 13):
        work.book.use(number, False)
    work.solve()
    assert "cannot fix focal length and depth apart" in facts(work)[2]


def _check_overlay(work):
    packed, near, far = work.overlay(A)
    numbers = np.frombuffer(packed, "<f4")
    dots, distance = numbers[: 2 * len(numbers) // 3].reshape(-1, 2), numbers[2 * len(numbers) // 3 :]
    expected = camera().project(cloud(A)[0])
    inside = ((expected > -0.5) & (expected < [639.5, 479.5])).all(axis=1)
    assert len(dots) == inside.sum() > 100
    order = np.argsort(-np.linalg.norm(cloud(A)[0][inside], axis=1))
    assert_allclose(dots, expected[inside][order], atol=0.05)
    assert (np.diff(distance) <= 0).all()  # far ones first: near ones are drawn over them
    assert near < far


def test_saving_writes_the_report_beside_the_calibration(tmp_path, monkeypatch):
    from acino_fte import calibrate_page
    from acino_fte.data_tools import lidar_report
    from acino_fte.data_tools.lidar_camera import read_lidar_camera
    from acino_fte.data_tools.lidar_solve import solve_lidar_camera

    told = []
    monkeypatch.setattr(lidar_report, "write_calibration_report", lambda *given: told.append(given))
    pairs = LidarPairs(pixels(A), targets(A), A)
    calibration = solve_lidar_camera(pairs, (640, 480), camera())
    out, pictures, clouds = tmp_path / "new" / "c.json", {A: tmp_path / A}, {A: cloud(A)[0]}
    assert calibrate_page._save(out, pictures, clouds, calibration) == (out, out.parent / "c_report")
    assert told == [(out.parent / "c_report", {"c": calibration}, pictures, clouds)]
    assert read_lidar_camera(out).rmse_px < 0.01
    assert calibrate_page._save(out, None, clouds, calibration) == (out,)
    assert len(told) == 1


# -- the page in a browser ---------------------------------------------------------------------------------
READY = """() => [".image-view", ".cloud-view"].every(name => document.querySelector(name)?.view?.ready)"""
DRAWN = "() => new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))"
CLIENT = "([name, ...place]) => document.querySelector(name).view.to_client(...place)"


class Hand:
    """A hand on the page."""

    def __init__(self, page, out):
        self.page, self.out = page, out

    @property
    def pairs(self):
        return read_lidar_pairs(self.out / "lidar_camera_pairs.csv")

    def click(self, view, *place, **options):
        x, y = self.page.evaluate(CLIENT, [view, *map(float, place)])
        self.page.mouse.move(x, y)
        self.page.evaluate(
            "() => new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))"
        )
        self.page.mouse.click(x, y, **options)

    def pick(self, image, target):
        number = self.page.locator("tbody tr[data-pair]").count() + 1
        self.click(".image-view", *pixels(image)[target])
        self.page.get_by_text("now click the same place in the cloud").wait_for()
        self.click(".cloud-view", *targets(image)[target])
        self.row(number).wait_for()

    def row(self, number):
        return self.page.locator(f"tr[data-pair='{number}']")

    def button(self, name):
        self.page.get_by_role("button", name=name, exact=True).click()

    def rows(self, count):
        self.page.wait_for_function("n => document.querySelectorAll('tr[data-pair]').length == n", arg=count)

    def solved(self, text="RMSE"):
        self.page.locator(".verdict .big", has_text=text).wait_for()


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("calibrate")


@pytest.fixture(scope="module")
def command(folder):
    return [
        SCRIPT,
        *write_world(folder),
        "--no-browser",
        "--no-report",
        "-o",
        str(folder / "out" / "lidar_camera.json"),
    ]


@pytest.fixture(scope="module")
def opened(browser, command):  # noqa: F811
    """The page in a tab, and the process behind it."""
    with served(*command) as running, tab(browser) as one:
        one.page.goto(running.address)
        one.page.wait_for_function(READY)
        yield one, running


@pytest.fixture(scope="module")
def hand(opened, folder):
    return Hand(opened[0].page, folder / "out")


def test_pick_on_both_sides(hand):
    """Picks are where the cursor was, and on disk at once."""
    for target in range(3):
        hand.pick(A, target)
    assert_allclose(hand.pairs.pixel, pixels(A)[:3], atol=0.02)  # px
    assert_array_equal(hand.pairs.xyz, targets(A)[:3])
    assert hand.pairs.image == 3 * (A,)


def test_undo_and_redo(hand):
    hand.page.mouse.move(5, 300)
    hand.page.keyboard.press("Control+z")
    hand.page.get_by_text("Pair 3: now click the same place in the cloud").wait_for()
    assert len(hand.pairs) == 2
    assert json.loads((hand.out / "lidar_camera_pairs.picking.json").read_text())["half"][0]["image"] == A
    hand.button("Undo (Ctrl-Z)")
    hand.page.get_by_text("Pair 3: click a place").wait_for()
    hand.page.keyboard.press("Control+y")
    hand.page.keyboard.press("Control+Shift+z")
    hand.rows(3)
    assert_array_equal(hand.pairs.xyz, targets(A)[:3])
    hand.click(".image-view", 50, 50)
    hand.page.get_by_text("Pair 4: now click").wait_for()
    hand.page.keyboard.press("Escape")
    hand.page.get_by_text("Pair 4: click a place").wait_for()


def test_zoom_and_turn_keep_the_place_under_the_cursor(hand):
    """After zooming, moving and turning, what is picked is what is under the cursor."""
    page = hand.page
    x, y = np.round(
        page.evaluate(CLIENT, [".image-view", *pixels(A)[3].tolist()])
    ).tolist()  # wheels turn there
    u, v = page.evaluate("([x, y]) => document.querySelector('.image-view').view.pixel_at(x, y)", [x, y])
    page.mouse.move(x, y)
    page.mouse.wheel(0, -900)
    page.wait_for_function("document.querySelector('.image-view').view.scale > 3")
    assert_allclose(page.evaluate(CLIENT, [".image-view", u, v]), (x, y), atol=1e-6)
    drag(page, (x, y), (x + 40, y - 25))
    assert_allclose(page.evaluate(CLIENT, [".image-view", u, v]), (x + 40, y - 25), atol=1e-6)
    place = targets(A)[3].tolist()
    x, y = page.evaluate(CLIENT, [".cloud-view", *place])
    page.mouse.move(x, y)
    page.wait_for_function(
        "document.querySelector('.cloud-view .readout').textContent.includes('intensity 150')"
    )
    drag(page, (x, y), (x + 120, y + 60))  # turns about the target under the cursor
    assert_allclose(page.evaluate(CLIENT, [".cloud-view", *place]), (x, y), atol=0.01)
    other = targets(A)[4].tolist()
    assert page.evaluate("() => Math.abs(document.querySelector('.cloud-view').view.yaw)") > 0.3
    hand.pick(A, 3)
    assert_allclose(hand.pairs.pixel[3], pixels(A)[3], atol=0.02)
    assert_array_equal(hand.pairs.xyz[3], place)
    assert page.evaluate(CLIENT, [".cloud-view", *other]) != pytest.approx([x, y], abs=5)
    hand.button("Seen from the lidar")
    hand.button("Whole image")


def drag(page, start, end):
    page.mouse.move(*start)
    page.mouse.down()
    page.mouse.move((start[0] + end[0]) / 2, (start[1] + end[1]) / 2)
    page.mouse.move(*end)
    page.mouse.up()


def test_clips_hide_points_from_the_eye_and_the_pick(hand):
    page = hand.page
    count = "() => document.querySelector('.cloud-view').view.chosen.length"
    assert page.evaluate(count) == 3000 + N_TARGETS
    thumb = (
        page.locator(".cloud-view")
        .locator("xpath=..")
        .locator(".q-range")
        .nth(1)
        .locator("[tabindex='0']")
        .first
    )
    thumb.focus()
    page.keyboard.press("ArrowRight")
    page.wait_for_function(f"({count})() == {N_TARGETS}")  # the wall is the darkest there is
    page.keyboard.press("ArrowLeft")
    page.wait_for_function(f"({count})() == {3000 + N_TARGETS}")


def test_solves_by_itself_and_again_after_a_drop(hand):
    """A wrong pick stands out, is dropped, and the rest agrees; then it is picked again."""
    for target in range(4, 6):
        hand.pick(A, target)
    hand.page.get_by_role("button", name="Next image").click()
    hand.page.get_by_text(f"{B} · 640 × 480 px").wait_for()
    hand.page.wait_for_function(READY)
    for target in range(2):
        hand.pick(B, target)
    u, v = pixels(B)[2]
    hand.click(".image-view", u + 40, v + 25)
    hand.click(".cloud-view", *targets(B)[2])
    hand.row(9).get_by_text("outlier").wait_for()
    hand.button("Drop pair 9")
    hand.page.locator("tr.dropped[data-pair='9']").wait_for()
    hand.page.locator(".verdict .facts", has_text="1 dropped").wait_for()
    assert hand.pairs.used.tolist() == 8 * [True] + [False]
    assert shown_rmse(hand) < 0.1  # px
    hand.button("Pick again pair 9")
    hand.page.get_by_text("Pair 9 again").wait_for()
    hand.click(".image-view", u, v)
    hand.row(9).get_by_text(re.compile(r"^0\.0\d$")).first.wait_for()  # its error, live
    hand.page.keyboard.press("Escape")
    hand.button("Use pair 9")
    hand.page.locator(".verdict .facts", has_text="9 pairs").wait_for()
    assert hand.pairs.n_used == 9
    assert_allclose(hand.pairs.pixel[8], (u, v), atol=0.02)


def shown_rmse(hand):
    hand.solved()
    return float(hand.page.locator(".verdict .big").inner_text().split()[1])


def test_delete_with_the_keyboard(hand):
    hand.row(2).click()
    hand.page.locator("tr.chosen[data-pair='2']").wait_for()
    hand.page.get_by_text(f"{A} · 640").wait_for()  # its image is shown
    hand.page.keyboard.press("Delete")
    hand.rows(8)
    assert_array_equal(hand.pairs.xyz[1], targets(A)[2])
    hand.page.keyboard.press("Control+z")
    hand.rows(9)
    hand.solved()


def test_projected_cloud_over_the_image(hand):
    hand.page.get_by_role("switch", name="projected cloud").click()
    hand.page.wait_for_function("() => document.querySelector('.image-view').view.dots?.length > 300")
    dots = np.array(hand.page.evaluate("() => Array.from(document.querySelector('.image-view').view.dots)"))
    dots = dots[: 2 * len(dots) // 3].reshape(-1, 2)
    for place in pixels(A):
        assert np.linalg.norm(dots - place, axis=1).min() < 0.5  # px


def test_save_writes_the_calibration(hand, opened):
    from acino_fte.data_tools.lidar_camera import read_lidar_camera

    hand.solved()
    hand.button("Save")
    hand.page.locator(".q-notification", has_text="Saved:").wait_for()
    hand.solved("saved")
    read = read_lidar_camera(hand.out / "lidar_camera.json")
    assert read.n_pairs == 9
    held = np.r_[targets(A)[6:], targets(B)[3:]]  # nobody picked these
    assert np.linalg.norm(read.project(held) - camera().project(held), axis=1).max() < 0.5  # px
    assert (opened[0].elsewhere, opened[0].complaints) == ([], [])


def test_a_killed_process_loses_no_pick(browser, hand, opened, command):  # noqa: F811
    """kill -9, and the next session goes on: pairs, the one dropped, and the pick under way."""
    hand.button("Drop pair 4")
    hand.page.locator("tr.dropped[data-pair='4']").wait_for()
    hand.click(".image-view", 100, 120)
    hand.page.get_by_text("Pair 10: now click the same place in the cloud").wait_for()
    os.kill(opened[1].process.pid, signal.SIGKILL)
    opened[1].process.wait(10)
    before = (hand.out / "lidar_camera_pairs.csv").read_bytes()
    with served(*command) as running, tab(browser) as again:
        again.page.goto(running.address)
        again.page.wait_for_function(READY)
        new = Hand(again.page, hand.out)
        new.rows(9)
        again.page.get_by_text("Pair 10: now click the same place in the cloud").wait_for()
        assert again.page.locator("tr.dropped").get_attribute("data-pair") == "4"
        assert (hand.out / "lidar_camera_pairs.csv").read_bytes() == before
        new.solved()
        new.button("Done")
        again.page.get_by_role("button", name="End without").click()
        again.page.locator("#farewell", has_text="9 pairs").wait_for()
        assert running.process.wait(10) == 0
    assert not [path.name for path in hand.out.iterdir() if path.name.startswith(".")]
