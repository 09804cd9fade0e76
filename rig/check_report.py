"""A check as JSON, and as a page of one sheet that opens anywhere."""

from __future__ import annotations

import base64
import json
import re
from datetime import UTC, datetime
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from acino_fte.data_tools.page_parts import table
from acino_fte.data_tools.whole_text import write_text_whole
from acino_fte.rig.check import Check
from acino_fte.rig.check_types import CameraAccount, ClockJump, Gap, Requirement, StreamAccount, length_text

FORMAT = "acino-fte/rig-check/1"
JSON, PAGE, PICTURE = "check.json", "check.html", "timeline.png"
COLOURS = {"pass": "#00674c", "warn": "#8a5a00", "fail": "#a33600"}
WORDS = {"pass": "PASS", "warn": "WARNING", "fail": "FAIL"}
_GAPS = 30  # that the page tells one by one

_HTML = """<!DOCTYPE html>
<html lang="en"><head><meta charset="utf-8"><title>@title@</title>
<meta http-equiv="Content-Security-Policy" content="default-src 'none'; img-src data:;
 style-src 'unsafe-inline'">
<style>
body { margin: 0; font: 14px/1.4 system-ui, "Segoe UI", "DejaVu Sans", sans-serif; color: #1b1b1b; }
header { background: @colour@; color: #fff; padding: .9rem max(1rem, calc(50vw - 36rem)); }
h1 { margin: 0; font-size: 1.3rem; overflow-wrap: anywhere; } header p { margin: .2rem 0 0; }
main { max-width: 72rem; margin: 0 auto; padding: .5rem 1rem 2rem; }
h2 { font-size: 1.05rem; margin: 1.2rem 0 .4rem; border-bottom: 1px solid #d8d8d8; }
table { border-collapse: collapse; font-size: .85rem; font-variant-numeric: tabular-nums; width: 100%; }
th, td { padding: .15rem .5rem; text-align: left; border-bottom: 1px solid #eee; vertical-align: top;
  overflow-wrap: anywhere; }
img { max-width: 100%; display: block; } .soft { color: #666; font-size: .85rem; }
ul { margin: .3rem 0; padding-left: 1.2rem; }
table.verdict td:nth-child(-n+3) { white-space: nowrap; overflow-wrap: normal; }
table.verdict td:nth-child(5) { overflow-wrap: normal; }
tr.fail td:first-child { color: #a33600; font-weight: 700; }
tr.warn td:first-child { color: #8a5a00; font-weight: 700; }
tr.pass td:first-child { color: #00674c; }
@media print { header { color: #000; background: none; border-bottom: 3px solid @colour@; } }
</style></head><body>
<header><h1>@title@</h1><p>@status@</p></header><main>
@body@
</main></body></html>
"""


def to_json(check: Check) -> dict[str, Any]:
    """A check as plain values. Times are ns since 1970 and s since the recording began."""
    found = check.found
    span = found.span
    origin = span[0] if span else 0
    return {
        "format": FORMAT,
        "recording": str(found.path),
        "kind": found.kind,
        "clock": found.base,
        "verdict": check.verdict,
        "begin_ns": span[0] if span else None,
        "end_ns": span[1] if span else None,
        "seconds": (span[1] - span[0]) * 1e-9 if span else 0.0,
        "requirements": [vars(requirement) for requirement in check.requirements],
        "streams": [_stream(stream, origin) for stream in found.streams.values()],
        "cameras": [_camera(camera, origin) for camera in found.cameras.values()],
        "lidars": [
            {
                "name": lidar.name,
                "messages": lidar.n,
                "usual_returns": lidar.returns,
                "thin": lidar.n_thin,
                "datagrams_lost": lidar.datagrams_lost if lidar.holes_judged else None,
            }
            for lidar in found.lidars.values()
        ],
        "lidar_warnings": [vars(warned) for warned in found.warned],
        "wall_clock": {
            "jumps": [_jump(jump, origin) for jump in found.wall.jumps],
            "slew_ppm": found.wall.slew_ppm,
        },
        "events": [vars(event) for event in found.manifest.events] if found.manifest else None,
        "unexplained": list(check.unexplained),
        "damage": {
            "read": found.damage.n_read,
            "lost": found.damage.n_lost,
            "bytes": found.damage.bytes_lost,
            "places": list(found.damage.places),
        },
        "notes": list(found.notes),
    }


def _gap(gap: Gap, origin: int) -> dict[str, Any]:
    since = (gap.start_ns - origin) * 1e-9
    return {"time_s": since, "time_ns": gap.start_ns, "seconds": gap.seconds, "lost": gap.lost,
            "explained": gap.explained}  # fmt: skip


def _jump(jump: ClockJump, origin: int) -> dict[str, Any]:
    since = (jump.time_ns - origin) * 1e-9
    return {"clock": jump.clock, "time_s": since, "time_ns": jump.time_ns, "seconds": jump.seconds,
            "explained": jump.explained}  # fmt: skip


def _stream(stream: StreamAccount, origin: int) -> dict[str, Any]:
    plain = ("name", "kind", "unit", "count", "first_ns", "last_ns", "expected_hz", "rate_hz", "jitter_ms")
    more = ("worst_step_ms", "lost", "duplicates", "out_of_order", "drift_ppm", "drift_sd_ppm", "delay_ms")
    return {
        **{key: getattr(stream, key) for key in (*plain, *more)},
        "seconds": stream.seconds,
        "expected": stream.expected,
        "delta_loss": stream.delta_loss,
        "longest_whole_s": stream.longest_whole_s,
        "gaps": [_gap(gap, origin) for gap in stream.gaps],
        "more_gaps": stream.more_gaps,
        "jumps": [_jump(jump, origin) for jump in stream.jumps],
    }


def _camera(camera: CameraAccount, origin: int) -> dict[str, Any]:
    names = ("time_s", "encoder", "counts")
    return {
        "name": camera.name,
        "messages": camera.n,
        "glitches": [
            dict(zip(names, ((t - origin) * 1e-9, *rest), strict=True)) for t, *rest in camera.glitches
        ],
        "n_glitches": camera.n_glitches,
        "lens_away": [
            {"time_s": (a - origin) * 1e-9, "seconds": (b - a) * 1e-9, "encoder": place, "counts": far}
            for a, b, place, far in camera.lens
        ],
        "exposure_us": camera.exposure_us,
        "exposure_changes": [
            {"time_s": (t - origin) * 1e-9, "before_us": a, "after_us": b} for t, a, b in camera.exposures
        ],
        "n_exposure_changes": camera.n_exposures,
        "pictures_looked_at": camera.pictures,
        "white_share": camera.over,
        "black_share": camera.under,
        "all_black": camera.dark,
        "all_white": camera.bright,
        "without_picture": camera.n_without,
        "without_message": camera.without_message,
    }


def json_text(check: Check) -> str:
    """The check as text of JSON."""
    return json.dumps(to_json(check), indent=1, ensure_ascii=False, allow_nan=False, default=_plain) + "\n"


def _plain(value: Any) -> Any:
    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(type(value).__name__)


def summary(check: Check) -> str:
    """One line: verdict, length, when, and how much of it was lost."""
    found = check.found
    if found.span is None:
        return f"{WORDS[check.verdict]}: there is nothing in it"
    begin, end = found.span
    when = ""
    if begin > 10**18:
        when = f" from {datetime.fromtimestamp(begin * 1e-9, UTC):%Y-%m-%d %H:%M:%S} UTC"
    filled = [stream for stream in found.streams.values() if stream.count]
    lost = sum(stream.lost for stream in filled)
    n_bad = sum(requirement.verdict == "fail" for requirement in check.requirements)
    n_odd = sum(requirement.verdict == "warn" for requirement in check.requirements)
    odd = "1 warning" if n_odd == 1 else f"{n_odd} warnings"
    told = [text for n, text in ((n_bad, f"{n_bad} failed"), (n_odd, odd)) if n]
    streams = "1 stream" if len(filled) == 1 else f"{len(filled)} streams"
    return f"{WORDS[check.verdict]}: {(end - begin) * 1e-9:.1f} s{when}, {streams}, {lost} lost" + (
        f"; {', '.join(told)}" if told else ""
    )


STREAM_HEAD = ("stream", "count", "Hz", "lost", "δ_loss", "longest gap", "jitter", "drift")


def stream_row(stream: StreamAccount) -> tuple[str, ...]:
    """What a table tells of a stream."""
    longest = max((gap.seconds for gap in stream.gaps), default=0.0)
    drift = "–" if stream.drift_ppm is None else f"{stream.drift_ppm:+z.1f} ppm"
    return (
        stream.name,
        str(stream.count),
        f"{stream.rate_hz:.2f}" if stream.rate_hz else "–",
        str(stream.lost),
        f"{stream.delta_loss:.5f}",
        length_text(longest) if longest else "–",
        f"{stream.jitter_ms:.2f} ms" if stream.rate_hz and stream.kind != "image" else "–",
        drift,
    )


def page(check: Check, picture: bytes) -> str:
    """The page, with the picture of the timeline inside."""
    found = check.found
    origin = found.span[0] if found.span else 0
    gaps = sorted((g for s in found.streams.values() for g in s.gaps), key=lambda gap: -gap.lost)
    image = base64.b64encode(picture).decode("ascii")
    streams = [stream_row(stream) for stream in found.streams.values()]
    parts = [
        f'<img alt="Timeline of the recording" src="data:image/png;base64,{image}">',
        "<h2>Requirements</h2>",
        _requirements(check.requirements),
        "<h2>Streams</h2>",
        table(STREAM_HEAD, streams),
    ]
    if gaps:
        rows = [
            (gap.stream, f"{(gap.start_ns - origin) * 1e-9:.3f} s", f"{gap.seconds:.3f} s", str(gap.lost),
             gap.explained or "–")
            for gap in gaps[:_GAPS]
        ]  # fmt: skip
        more = f" (the {_GAPS} greatest of {len(gaps)})" if len(gaps) > _GAPS else ""
        head = ("stream", "begins after", "length", "lost", "event that explains it")
        parts += [f"<h2>Gaps{more}</h2>", table(head, rows)]
    parts += _listed("Unexplained", check.unexplained) + _listed("Damage", found.damage.places)
    parts += _listed("Notes", found.notes)
    parts.append(
        '<p class="soft">Times are seconds since the recording began, by the clock of the '
        f"{found.base}. δ_loss is expected / recorded. Written by acino-fte rig check.</p>"
    )
    fields = {
        "title": escape(found.path.resolve().name),
        "status": escape(summary(check)),
        "colour": COLOURS[check.verdict],
        "body": "\n".join(parts),
    }
    return re.sub(r"@(title|status|colour|body)@", lambda match: fields[match[1]], _HTML)


def _requirements(requirements: tuple[Requirement, ...]) -> str:
    order = sorted(requirements, key=lambda one: ("fail", "warn", "pass").index(one.verdict))
    rows = "".join(
        f'<tr class="{one.verdict}"><td>{WORDS[one.verdict]}</td>'
        + "".join(f"<td>{escape(t)}</td>" for t in (one.name, one.subject, one.found, one.limit, one.remedy))
        + "</tr>"
        for one in order
    )
    head = "".join(f"<th>{t}</th>" for t in ("", "what", "of", "found", "limit", "what to do"))
    return f"<table class='verdict'><thead><tr>{head}</tr></thead><tbody>{rows}</tbody></table>"


def _listed(title: str, texts: tuple[str, ...] | list[str]) -> list[str]:
    items = "".join(f"<li>{escape(text)}</li>" for text in texts[:_GAPS])
    return [f"<h2>{title}</h2><ul>{items}</ul>"] if items else []


def write_files(check: Check, folder: Path) -> None:
    """Write ``check.json``, ``check.html`` and ``timeline.png`` into a folder that exists."""
    from acino_fte.rig.check_figure import timeline_png

    picture = timeline_png(check)
    (folder / PICTURE).write_bytes(picture)
    write_text_whole(folder / PAGE, page(check, picture))
    write_text_whole(folder / JSON, json_text(check))
