"""What the recorder noted, against what the data show: each is to explain the other."""

from __future__ import annotations

from acino_fte.data_tools.rig_recording import Event
from acino_fte.rig.check_damage import explain_damage
from acino_fte.rig.check_types import Gap, StreamAccount
from acino_fte.rig.check_walk import Findings

_NEAR_NS = 750_000_000  # between an event and what it explains
_JUMP_S = 0.1  # of the size of a jump
_LENGTH_S = 0.35  # between two lengths of a silence
_ENDS_PERIODS, _ENDS_S = 5.0, 0.3  # silence at the start or the end that is told
_LOSSES = ("stall", "unplugged", "dropped", "lost", "error")


def of_stream(event: Event, stream: str) -> bool:
    """Whether an event is of a stream: its topic, or its device, or of the whole rig."""
    named, name = event.stream.strip("/"), stream.strip("/")
    return not named or named == name or named == name.partition("/")[0]


def add_ends(found: Findings) -> None:
    """Silence of a recorder's stream before its first message and after its last, as gaps."""
    if found.manifest is None or found.span is None:
        return
    begin, end = found.span
    if found.manifest.ended_ns is not None:
        end = max(end, found.manifest.ended_ns)
    for account in found.streams.values():
        hz = account.expected_hz or account.rate_hz
        if not hz or account.kind == "image":
            continue
        period = round(1e9 / hz)
        least = max(_ENDS_PERIODS * period, _ENDS_S * 1e9)
        first = account.first_ns if account.first_ns is not None else end
        last = account.last_ns if account.last_ns is not None else end
        ends = []
        if first - begin > least:
            ends.append((begin, first - begin))
        if end - last > least:
            ends.append((last + period, end - last - period))
        for start, length in ends:
            lost = max(round(length / period), 1)
            account.lost += lost
            account.gaps.append(Gap(account.name, start, length * 1e-9, lost))
        account.gaps.sort(key=lambda gap: gap.start_ns)


def compare_events(found: Findings) -> list[str]:
    """Mark what events explain; sentences on events without data, and on data without events.

    Nothing is said of a recording without a manifest.
    """
    manifest = found.manifest
    if manifest is None or found.span is None:
        return []
    said: list[str] = []
    for event in manifest.events:
        if not _behind(found, event):
            said += _event(found, event)
    explain_damage(found)
    origin = found.span[0]
    for account in found.streams.values():
        said += [
            f"{account.name}: {gap.lost} are missing for {gap.seconds:.2f} s from "
            f"{_at(gap.start_ns, origin)} on, and no event tells why"
            for gap in account.gaps
            if not gap.explained
        ]
        said += [
            f"{account.name}: its clock jumped by {jump.seconds:+.3f} s at "
            f"{_at(jump.time_ns, origin)}, and no event tells why"
            for jump in account.jumps
            if not jump.explained
        ]
    said += [
        f"the wall clock jumped by {jump.seconds:+.3f} s at {_at(jump.time_ns, origin)}, and no event "
        "tells of it"
        for jump in found.wall.jumps
        if not jump.explained
    ]
    return said + _lens(found) + _counts(found)


def _behind(found: Findings, event: Event) -> bool:
    """Whether a recording was cut short before an event shows in its data."""
    if found.manifest is None or found.manifest.state == "closed":
        return False
    ends = [s.last_ns or 0 for s in found.streams.values() if of_stream(event, s.name)]
    return max(ends, default=0) < event.time_ns + round(event.seconds * 1e9) + _NEAR_NS


def _event(found: Findings, event: Event) -> list[str]:
    origin = found.span[0] if found.span else 0
    name = f"{event.kind.replace('_', ' ')} at {_at(event.time_ns, origin)}"
    whose = f"{event.stream}: " if event.stream else ""
    if event.kind in _LOSSES:
        return _loss(found, event, name, whose)
    if event.kind == "clock_jump":
        near = [
            jump
            for jump in found.wall.jumps
            if abs(jump.seconds - event.seconds) < _JUMP_S
            and jump.after_ns - _NEAR_NS <= event.time_ns <= jump.time_ns + _NEAR_NS
        ]
        for jump in near:
            jump.explained = name
        return [] if near else [f"{name} by {event.seconds:+.3f} s: the stamps show no such jump"]
    if event.kind == "disk_full":
        last = max((account.last_ns or 0) for account in found.streams.values())
        if abs(last - event.time_ns) > 2e9:
            return [f"{name}: but the data go on until {_at(last, origin)}"]
    return []


def _loss(found: Findings, event: Event, name: str, whose: str) -> list[str]:
    """Mark the gaps and jumps that an event explains; say where they are not there or differ."""
    low, high = event.time_ns - _NEAR_NS, event.time_ns + round(event.seconds * 1e9) + _NEAR_NS
    gaps: list[Gap] = []
    for account in found.streams.values():
        if not of_stream(event, account.name):
            continue
        mine = [gap for gap in account.gaps if gap.start_ns <= high and gap.end_ns >= low]
        for gap in mine:
            gap.explained = gap.explained or name
        gaps += mine
        for jump in account.jumps:
            if event.kind in ("unplugged", "error") and low <= jump.time_ns <= high:
                jump.explained = name
    if not event.count:
        return []
    if not gaps:
        return [f"{whose}{name}, {event.count} missing: the data have no gap there"]
    if event.kind not in ("stall", "unplugged"):
        return []
    longest = max(gap.seconds for gap in gaps)
    slack = max(_LENGTH_S, 3 * _period(found.streams[gaps[0].stream]))
    longer_may_be = found.manifest is not None and found.manifest.state == "recovered"
    if event.seconds - longest > slack or (longest - event.seconds > slack and not longer_may_be):
        return [f"{whose}{name} of {event.seconds:.2f} s: the data show {longest:.2f} s"]
    return []


def _period(account: StreamAccount) -> float:
    return 1 / account.rate_hz if account.rate_hz else 0.0


def _lens(found: Findings) -> list[str]:
    """The lens as the encoders tell it, against the events of the first camera."""
    origin = found.span[0] if found.span else 0
    noted = found.manifest.events if found.manifest is not None else ()
    events = [event for event in noted if event.kind == "lens_moved" and not _behind(found, event)]
    moves = [(one[0], one[1], camera.name) for camera in found.cameras.values() for one in camera.lens]
    said = []
    for event in events:
        if not any(abs(start - event.time_ns) <= _NEAR_NS for start, _, _ in moves):
            said.append(f"lens moved at {_at(event.time_ns, origin)}: the encoders show no such move")
    for start, _, name in moves:
        if not any(event.kind == "lens_moved" and abs(start - event.time_ns) <= _NEAR_NS for event in noted):
            said.append(f"{name}: the lens moved at {_at(start, origin)}, and no event tells of it")
    return said


def _counts(found: Findings) -> list[str]:
    """What the manifest says was written, against what is there; only of a closed recording that is whole."""
    manifest, said = found.manifest, []
    if manifest is None or manifest.state != "closed" or not found.damage.whole:
        return []
    for stream in manifest.streams:
        name = f"/{stream.name}/image" if stream.kind == "image" else stream.name
        n = found.streams[name].count if name in found.streams else 0
        if n != stream.written:
            said.append(f"{name}: the manifest says {stream.written} were written, {n} are there")
    return said


def _at(time_ns: int, origin: int) -> str:
    return f"{(time_ns - origin) * 1e-9:.2f} s"
