"""What a cut end, or a damaged file, explains: gaps that no event can tell of."""

from __future__ import annotations

import re
from collections.abc import Iterable

from acino_fte.rig.check_types import CUT, DAMAGED
from acino_fte.rig.check_walk import Findings

_CUT_NS = 2_000_000_000  # before the end of a recording that was cut short: what was still on its way
_SLACK_NS = 250_000_000  # about the ends of a segment
_FILE = re.compile(r"((?:messages|\w[^:/]*)-(\d+)\.(?:mcap|mkv|mp4|avi))\b")


def explain_damage(found: Findings) -> None:
    """Mark gaps at the end of a recording that was never closed, and those in segments with damaged files."""
    manifest = found.manifest
    if manifest is None or found.span is None:
        return
    end, cut = found.span[1], manifest.state != "closed"
    sound = found.damage.whole and manifest.state != "recovered"
    spans = _spans(found)
    for account in found.streams.values():
        last = account.last_ns if account.last_ns is not None else found.span[0]
        for gap in account.gaps:
            if gap.explained:
                continue
            behind = gap.start_ns > last or (account.kind == "image" and gap.end_ns > last)
            if cut and (gap.start_ns > end - _CUT_NS or (behind and not sound)):
                gap.explained = CUT
            elif any(gap.start_ns < high and gap.end_ns > low for low, high in spans):
                gap.explained = DAMAGED


def _spans(found: Findings) -> list[tuple[int, int]]:
    """From when to when the segments with damaged or missing files last, ns."""
    manifest = found.manifest
    if manifest is None or found.span is None:
        return []
    told = found.damage.places
    if manifest.state == "recovered":
        told = (*told, *manifest.notes)
    damaged = _indexes(told)
    first: dict[int, int] = {}
    last: dict[int, int] = {}
    for one in manifest.segments:
        if one.kind == "messages" and one.first_ns is not None and one.last_ns is not None:
            first[one.index], last[one.index] = one.first_ns, one.last_ns
    out = []
    for i in damaged:
        before, after = [n for n in last if n < i], [n for n in first if n > i]
        low = last[max(before)] if before else found.span[0]
        high = first[min(after)] if after else found.span[1]
        out.append((low - _SLACK_NS, high + _SLACK_NS))
    return out


def _indexes(sentences: Iterable[str]) -> set[int]:
    """Numbers of the segments whose files begin these sentences."""
    return {int(match[2]) for text in sentences if (match := _FILE.match(text))}
