"""Draws the pictures of docs/rig.md: the rig as a diagram, and the operator's card to print.

``python docs/rig_pictures.py`` writes rig_system.png, rig_operator_card.png and .pdf into docs/images.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

IMAGES = Path(__file__).resolve().parent / "images"
BLUE, ORANGE, GREEN, RED, GREY = "#0072B2", "#E69F00", "#009E73", "#D55E00", "#555555"

_MICROCONTROLLER = "counts the encoders,\ndrives the rings,\nstops them when\ncommands stop"
_COMMANDS = ("doctor", "rig plan", "rig drive", "rig record", "rig check", "rig recover")
_COMPUTER = "Jetson Xavier AGX class\n1 TB NVMe\n\n" + "\n".join(f"acino-fte {name}" for name in _COMMANDS)
# (left, bottom, width, height, title, lines)
BOXES = [
    (0.2, 6.2, 2.9, 1.4, "Camera", "2048 × 1088, 60 fps\nlens 5–150 mm"),
    (0.2, 4.3, 2.9, 1.4, "Lidar + inertial sensor", "10 frames/s, 24 000 points\n200 samples/s"),
    (0.2, 2.0, 2.9, 1.6, "Zoom and focus rings", "2 gearmotors, 12 V\n4741.44 counts a turn"),
    (0.2, -0.1, 2.9, 1.4, "Pan and tilt", "turned by hand\n2 encoders, 4000 a turn"),
    (0.2, -1.8, 2.9, 1.2, "Joystick", "2 × 10 kΩ"),
    (4.6, 2.75, 1.9, 1.15, "H-bridges", "2 × DRV8801"),
    (7.4, 1.7, 2.2, 2.2, "Microcontroller", _MICROCONTROLLER),
    (5.6, -1.8, 2.2, 1.2, "Converter", "analogue to digital"),
    (10.9, -1.8, 2.5, 9.4, "Computer", _COMPUTER),
]
DATA, LOGIC, POWER = BLUE, GREEN, ORANGE
# from, to, colour, words, and where they stand if not above the middle of the line
LINES = [
    ((3.1, 6.9), (10.9, 6.9), DATA, "USB 3: pictures", None),
    ((3.1, 5.0), (10.9, 5.0), DATA, "Ethernet: points, inertial samples", None),
    ((9.6, 2.8), (10.9, 2.8), DATA, "USB serial\n115200 8N1", (10.25, 2.95)),
    ((4.6, 3.3), (3.1, 3.3), POWER, "12 V", None),
    ((7.4, 3.3), (6.5, 3.3), LOGIC, "PHASE,\nENABLE", (6.95, 3.4)),
    ((3.1, 2.3), (7.4, 2.3), LOGIC, "A, B of each ring", (5.2, 1.85)),
    ((3.1, 0.6), (10.9, 0.6), LOGIC, "A, B of each axis, to its GPIO", None),
    ((3.1, -1.2), (5.6, -1.2), LOGIC, "two voltages", None),
    ((7.8, -1.2), (10.9, -1.2), DATA, "I²C or SPI", None),
]


def draw_system() -> Any:
    """The devices, and what runs between them."""
    from matplotlib.figure import Figure
    from matplotlib.patches import FancyBboxPatch

    figure = Figure(figsize=(10.5, 7.4), dpi=110)
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set(xlim=(-0.1, 13.6), ylim=(-2.7, 7.9))
    axes.axis("off")
    for left, bottom, width, height, title, lines in BOXES:
        shape = "round,pad=0.0,rounding_size=0.12"
        axes.add_patch(
            FancyBboxPatch((left, bottom), width, height, boxstyle=shape, fc="#f4f6f8", ec="#333333")
        )
        middle = left + width / 2
        axes.text(middle, bottom + height - 0.14, title, ha="center", va="top", fontsize=11, weight="bold")
        axes.text(middle, bottom + height - 0.6, lines, ha="center", va="top", fontsize=9.5, linespacing=1.35)
    for start, end, colour, words, place in LINES:
        style = "<|-|>" if words.startswith("USB serial") else "-|>"
        axes.annotate("", end, start, arrowprops={"arrowstyle": style, "color": colour, "lw": 2.0})
        x, y = place or ((start[0] + end[0]) / 2, (start[1] + end[1]) / 2 + 0.1)
        axes.text(x, y, words, ha="center", va="bottom", fontsize=9.5, color=colour)
    for k, (colour, words) in enumerate(((DATA, "data"), (LOGIC, "logic"), (POWER, "power to motors"))):
        axes.plot([0.3 + 2.0 * k, 0.9 + 2.0 * k], [-2.35, -2.35], color=colour, lw=2.5)
        axes.text(1.0 + 2.0 * k, -2.35, words, va="center", fontsize=9.5)
    return figure


TITLE = "Rig: operator's card"
TASK, SCREEN = "task", "screen"  # with a box to tick; with words that are on the screen
CARD = [
    (
        "BEFORE",
        BLUE,
        [
            (TASK, "Evening", "charge; make room on the disk; let the computer set its clock", ""),
            (TASK, "Distance", "what are pictures worth there, and with which lens?", "acino-fte rig plan"),
            (TASK, "Car", "plugs in, lens cap off. Wait for “rig: ready”", "acino-fte doctor --for rig"),
            (TASK, "Lens", "zoom and focus, in a second window that stays open", "acino-fte rig drive"),
            (TASK, "Trial", "twelve seconds", "acino-fte rig record --minutes 0.2"),
            (TASK, "", "and look at them; FOLDER is the name that it gave", "acino-fte rig check FOLDER"),
        ],
    ),
    (
        "DURING",
        GREEN,
        [
            (TASK, "Start", "engine off. Early rather than late", "acino-fte rig record"),
            (TASK, "Rest", "hands off for 5 s, then knock on the rig once", ""),
            (TASK, "Follow", "turn gently; the whole animal in the picture", ""),
            (SCREEN, "SILENT: …", "push that plug in. The others go on recording", ""),
            (SCREEN, "LENS MOVED", "zoom or focus left its place: turn it back when there is time", ""),
            (SCREEN, "dropped 12", "not 0: the computer is too slow. Close other programs", ""),
            (SCREEN, "… min left", "the disk. At 0 the recording is closed by itself, whole", ""),
            (TASK, "Stop", "Ctrl-C once; wait for “written to”. Only then power off", ""),
        ],
    ),
    (
        "AFTER",
        RED,
        [
            (TASK, "At once", "is it whole? If not, record again", "acino-fte rig check FOLDER"),
            (TASK, "No power?", "a readable copy; the original stays", "acino-fte rig recover FOLDER"),
            (TASK, "Notes", "place, time, animal, distance, zoom, light, wind", ""),
            (TASK, "Copies", "two, on two disks; check one of them", ""),
            (TASK, "New zoom?", "a board or posts at two distances: the next calibration", ""),
        ],
    ),
]  # fmt: skip


def draw_card() -> Any:
    """One page, A4 upright."""
    from matplotlib.figure import Figure
    from matplotlib.patches import Rectangle

    figure = Figure(figsize=(8.27, 11.69), dpi=110)
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set(xlim=(0, 210), ylim=(297, 0))
    axes.axis("off")
    axes.text(14, 19, TITLE, fontsize=24, weight="bold", va="center")
    y = 29.0
    for heading, colour, rows in CARD:
        axes.add_patch(Rectangle((14, y), 182, 9.5, color=colour))
        axes.text(18, y + 5.0, heading, fontsize=15, weight="bold", color="white", va="center")
        y += 15.2
        for kind, what, how, command in rows:
            if kind == TASK:
                axes.add_patch(Rectangle((14, y - 2.4), 4.2, 4.2, fill=False, ec=colour, lw=1.4))
            family = "monospace" if kind == SCREEN else "sans-serif"
            axes.text(21, y, what, fontsize=11, weight="bold", va="center", family=family)
            axes.text(50, y, how, fontsize=11.5, va="center")
            if command:
                y += 6.0
                axes.text(50, y, command, fontsize=11.5, va="center", family="monospace", color=colour)
            y += 7.9
        y += 3.6
    foot = "Ctrl-C twice leaves at once, for when the car must go: acino-fte rig recover reads what is there."
    axes.text(14, 288, foot, fontsize=10, color=GREY, va="center")
    return figure


def main() -> None:
    """Write the pictures."""
    import matplotlib as mpl

    mpl.rcParams["pdf.fonttype"] = 42
    draw_system().savefig(IMAGES / "rig_system.png")
    card = draw_card()
    card.savefig(IMAGES / "rig_operator_card.png")
    card.savefig(IMAGES / "rig_operator_card.pdf", metadata={"CreationDate": None})


if __name__ == "__main__":
    main()
