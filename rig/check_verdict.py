"""What a recording has to reach, and whether it does: requirement by requirement."""

from __future__ import annotations

from collections.abc import Iterable

from acino_fte.rig.check_types import (
    DAMAGED,
    CameraAccount,
    ClockJump,
    Requirement,
    StreamAccount,
    Verdict,
    length_text,
)
from acino_fte.rig.check_walk import Findings, LidarAccount

LOSS_WARN, LOSS_FAIL = 0.0, 0.01
"""Share of lost messages above which a stream is warned of, or fails."""
RATE_WARN, RATE_FAIL = 0.01, 0.05
JITTER_WARN = 0.25
"""Of a period."""
DRIFT_WARN_PPM = 200.0
"""Crystals keep 50 ppm, two of them 100."""
EXPOSED_WARN = 0.2
"""Share of white or black pixels."""
OVERLAP_WARN, OVERLAP_FAIL = 0.95, 0.5
_FEW = 0.01
_SHORTER = "expose shorter or close the aperture"
_LONGER = "take off the cap, expose longer or open the aperture"
_HEALTH = {
    "temperature": "shade the lidar, or warm it up before you record",
    "voltage": "check the lidar's supply and its cable",
    "window": "clean the lidar's window",
    "motor": "let the lidar rest; if it comes back, send it in",
    "system": "switch the lidar off and on; if it comes back, send it in",
    "": "see the lidar's manual before the next recording",
}
_CABLES = (
    "use the stretches without gaps; look at cable, power and USB port of this device, and at the speed of "
    "the disk (acino-fte doctor)"
)
_UNTIL_THEN = "the recorder was stopped by force there: what came before is sound"
_NETWORK = "give the lidar a network socket of its own, a sound cable and a larger receive buffer"


def requirements(found: Findings, unexplained: list[str]) -> list[Requirement]:
    """All lines of the verdict, in the order of what matters."""
    lines = [_readable(found)]
    if found.manifest is not None:
        lines += [_closed(found), *_ended(found), _explained(unexplained)]
    elif found.kind == "rig":
        lines.append(_closed(found))
    streams = [stream for stream in found.streams.values() if stream.kind != "image" or stream.count]
    streams = [stream for stream in streams if stream.kind != "other"]
    for stream in streams:
        lines.append(_loss(stream))
    for stream in streams:
        lines += _beat(stream)
    lines += _clocks(found, streams)
    for lidar in found.lidars.values():
        lines += _returns(lidar)
    lines += _warned(found)
    for camera in found.cameras.values():
        lines += _camera(camera, found)
    return lines + _overlap(found, streams)


def _limit(value: float, warn: float, fail: float) -> Verdict:
    return "fail" if value > fail else "warn" if value > warn else "pass"


def _readable(found: Findings) -> Requirement:
    damage = found.damage
    total = damage.n_read + damage.n_lost
    share = damage.n_lost / total if total else 1.0
    if not sum(stream.count for stream in found.streams.values()):
        return Requirement(
            "readable", "the files", "fail", "nothing can be read", "everything",
            "try acino-fte rig recover, and copy the recording again from the rig",
        )  # fmt: skip
    if damage.whole:
        return Requirement("readable", "the files", "pass", "everything", "everything")
    shown = "; ".join(damage.places[:2]) + ("; …" if len(damage.places) > 2 else "")
    recovered = found.manifest is not None and found.manifest.state == "recovered"
    return Requirement(
        "readable", "the files", "fail" if share > _FEW else "warn",
        f"{damage.n_lost} messages lost, {damage.bytes_lost} bytes skipped ({shown})", "everything",
        "this is the rescued copy: what can be read is all there is" if recovered and not damage.n_lost else
        "acino-fte rig recover makes a sound copy of what is left; copy it again if the original is better",
    )  # fmt: skip


def _closed(found: Findings) -> Requirement:
    if found.manifest is None:
        return Requirement(
            "closed", "the recording", "warn", "its manifest is lost, damaged or of another version",
            "closed",
            "what the recorder noted is not known; acino-fte rig recover makes a new manifest",
        )  # fmt: skip
    state = found.manifest.state
    if state == "recording":
        return Requirement(
            "closed", "the recording", "warn", "it was never closed", "closed",
            "the recorder was killed or lost its power: acino-fte rig recover closes it",
        )  # fmt: skip
    return Requirement("closed", "the recording", "pass", state, "closed or recovered")


def _ended(found: Findings) -> list[Requirement]:
    """What ended the recording, or one of its devices, too early."""
    events = found.manifest.events if found.manifest is not None else ()
    origin = found.span[0] if found.span else 0
    out = []
    for event in events:
        after = f"after {(event.time_ns - origin) * 1e-9:.1f} s"
        if event.kind == "disk_full":
            remedy = "copy recordings to another disk and remove them here before the next one"
            out.append(
                Requirement("ended", "the recording", "warn", f"the disk was full {after}", "on time", remedy)
            )
        elif event.kind == "error":
            told = f"{event.detail or 'an error'}, {after}"
            remedy = "what came until then is sound; acino-fte doctor looks for the reason"
            out.append(Requirement("error", event.stream or "the rig", "warn", told, "none", remedy))
    return out


def _explained(unexplained: list[str]) -> Requirement:
    if not unexplained:
        return Requirement("explained", "events and data", "pass", "they agree", "nothing unexplained")
    shown = "; ".join(unexplained[:2]) + ("; …" if len(unexplained) > 2 else "")
    return Requirement(
        "explained", "events and data", "fail", f"{len(unexplained)} unexplained: {shown}",
        "nothing unexplained",
        "check cables and disk, record a minute again and check that; tell the authors if it comes back",
    )  # fmt: skip


def _loss(stream: StreamAccount) -> Requirement:
    if not stream.count:
        return Requirement(
            "no loss", stream.name, "fail", "no messages at all", "0 lost",
            "is the device on and connected, and was the recorder not stopped at once?",
        )  # fmt: skip
    longest = max((gap.seconds for gap in stream.gaps), default=0.0)
    found = f"0 of {stream.expected} lost"
    if stream.lost:
        found = (
            f"{stream.lost} of {stream.expected} lost ({100 * stream.lost_share:.2g} %, "
            f"δ_loss = {stream.delta_loss:.5f}), longest gap {length_text(longest)}"
        )
    damaged = sum(gap.lost for gap in stream.gaps if gap.explained == DAMAGED)
    noted = sum(gap.lost for gap in stream.gaps if gap.explained) - stream.cut - damaged
    told = ("explained by events", noted), ("at the end that was cut off", stream.cut)
    found += "".join(f"; {n} {words}" for words, n in (*told, ("in damaged files", damaged)) if n)
    verdict = _limit((stream.lost - stream.cut) / max(stream.expected, 1), LOSS_WARN, LOSS_FAIL)
    remedy = _NETWORK if stream.unit == "packages" else _CABLES
    if stream.cut and verdict == "pass":
        verdict, remedy = "warn", _UNTIL_THEN
    elif damaged and stream.lost == damaged + stream.cut:
        remedy = "use the stretches without gaps; look for a better copy of the damaged files"
    limit = f"0 lost; at most {100 * LOSS_FAIL:.0f} %"
    return Requirement("no loss", stream.name, verdict, found, limit, remedy if verdict != "pass" else "")


def _beat(stream: StreamAccount) -> list[Requirement]:
    out = []
    if stream.expected_hz and stream.rate_hz and stream.kind != "image":
        off = abs(stream.rate_hz / stream.expected_hz - 1)
        verdict = _limit(off, RATE_WARN, RATE_FAIL)
        remedy = "set the rate of the device as rig.yaml says, or rig.yaml as the device"
        out.append(
            Requirement(
                "rate", stream.name, verdict, f"{stream.rate_hz:.2f} Hz",
                f"{stream.expected_hz:g} Hz ± {100 * RATE_WARN:.0f} %",
                remedy if verdict != "pass" else "",
            )
        )  # fmt: skip
    if stream.rate_hz and stream.jitter_ms:
        limit = 1e3 * JITTER_WARN / stream.rate_hz
        verdict = "warn" if stream.jitter_ms > limit else "pass"
        out.append(
            Requirement(
                "even", stream.name, verdict, f"jitter {stream.jitter_ms:.2f} ms", f"{limit:.2f} ms",
                "stamps scatter: have the device stamp its data, or expect coarser synchronisation"
                if verdict == "warn" else "",
            )
        )  # fmt: skip
    odd = stream.duplicates + stream.out_of_order
    if odd:
        share = odd / max(stream.count, 1)
        out.append(
            Requirement(
                "order", stream.name, _limit(share, 0.0, _FEW),
                f"{stream.duplicates} duplicates, {stream.out_of_order} out of order", "0",
                "the import puts them right; where they are many, look for two recorders of one device",
            )
        )  # fmt: skip
    return out


def _clocks(found: Findings, streams: list[StreamAccount]) -> list[Requirement]:
    out = []
    for stream in streams:
        if stream.drift_ppm is not None and stream.drift_sd_ppm is not None:
            sure = abs(stream.drift_ppm) - 3 * stream.drift_sd_ppm
            verdict: Verdict = "warn" if sure > DRIFT_WARN_PPM else "pass"
            out.append(
                Requirement(
                    "clock drift", stream.name, verdict,
                    f"{stream.drift_ppm:+z.1f} ± {stream.drift_sd_ppm:.1f} ppm",
                    f"± {DRIFT_WARN_PPM:.0f} ppm",
                    "the import corrects it; so much is no crystal: check what stamps the data"
                    if verdict == "warn" else "",
                )
            )  # fmt: skip
        own = [jump for jump in stream.jumps if jump.clock != "computer"]
        if own:
            sizes = ", ".join(f"{jump.seconds:+.3f} s" for jump in own[:3]) + (", …" if len(own) > 3 else "")
            verdict = "fail" if found.base == "device" else "warn"
            out.append(
                Requirement(
                    "clock jumps", stream.name, verdict, f"{sizes} ({len(own)} in all)", "none",
                    "nothing tells the time across the jump: use the parts before and after apart"
                    if verdict == "fail" else "the device began anew; the import takes the pieces apart",
                )
            )  # fmt: skip
    jumps = list(found.wall.jumps)
    if found.kind == "bag":
        jumps += _same(jump for stream in streams for jump in stream.jumps if jump.clock == "computer")
    if jumps:
        sizes = ", ".join(f"{jump.seconds:+.3f} s" for jump in jumps[:3])
        out.append(
            Requirement(
                "clock jumps", "the computer's clock", "warn", f"{sizes} ({len(jumps)} in all)", "none",
                "set the clock before you record, and switch off what sets it meanwhile"
                + ("; log times are not touched" if found.kind == "rig" else ""),
            )
        )  # fmt: skip
    elif found.wall.n:
        out.append(Requirement("clock jumps", "the computer's clock", "pass", "none", "none"))
    return out


def _same(jumps: Iterable[ClockJump]) -> list[ClockJump]:
    """Jumps of one clock that several streams show, once each."""
    out: list[ClockJump] = []
    for jump in sorted(jumps, key=lambda one: one.time_ns):
        if not any(abs(jump.time_ns - o.time_ns) < 1e9 and abs(jump.seconds - o.seconds) < 0.1 for o in out):
            out.append(jump)
    return out


def _returns(lidar: LidarAccount) -> list[Requirement]:
    out = []
    if lidar.n:
        remedy = "look at what stood before the lidar then (sky, something near), and at its network cable"
        out.append(
            Requirement(
                "returns", lidar.name, "warn" if lidar.n_thin else "pass",
                f"{lidar.n_thin} of {lidar.n} messages have less than half of the usual {lidar.returns:.0f}",
                "none",
                remedy if lidar.n_thin else "",
            )
        )  # fmt: skip
    if lidar.holes_judged:
        verdict: Verdict = "warn" if lidar.datagrams_lost else "pass"
        out.append(
            Requirement(
                "points", lidar.name, verdict, f"about {lidar.datagrams_lost} datagrams lost", "0",
                _NETWORK if lidar.datagrams_lost else "",
            )
        )  # fmt: skip
    return out


def _warned(found: Findings) -> list[Requirement]:
    if not found.health_told:
        return []
    names = [name for name, stream in found.streams.items() if stream.kind == "lidar"]
    out = []
    for name in names:
        mine = [warned for warned in found.warned if warned.stream == name]
        if not mine:
            out.append(Requirement("health", name, "pass", "no warnings", "no warnings"))
        for warned in mine:
            verdict: Verdict = "fail" if warned.level >= 2 else "warn"
            since = (warned.first_ns - (found.span[0] if found.span else 0)) * 1e-9
            packages = "1 package" if warned.count == 1 else f"{warned.count} packages"
            told = f"{warned.text}, in {packages} from {since:.2f} s on"
            remedy = next(text for word, text in _HEALTH.items() if word in warned.text)
            out.append(Requirement("health", name, verdict, told, "no warnings", remedy))
    return out


def _camera(camera: CameraAccount, found: Findings) -> list[Requirement]:
    out = []
    name = camera.name
    if camera.n:
        share = camera.n_glitches / camera.n
        out.append(
            Requirement(
                "encoders", name, _limit(share, 0.0, _FEW), f"{camera.n_glitches} jumps of the counts", "0",
                "look at the plugs and shields of the encoders; run a new reference before the next recording"
                if camera.n_glitches else "",
            )
        )  # fmt: skip
    if camera.lens:
        seconds = sum(end - start for start, end, *_ in camera.lens) * 1e-9
        out.append(
            Requirement(
                "lens", name, "warn", f"zoom or focus was away for {seconds:.1f} s", "never",
                "the calibration holds outside of these times only; calibrate again for them",
            )
        )  # fmt: skip
    if camera.n_without or camera.without_message:
        images = found.streams.get(f"{name.removesuffix('/info')}/image")
        missing = camera.n_without - (images.cut if images is not None else 0)
        recovered = found.manifest is not None and found.manifest.state == "recovered"
        verdict = _limit(missing / max(camera.n, 1), 0.0, _FEW)
        out.append(
            Requirement(
                "pictures", name, "warn" if verdict == "pass" else verdict,
                f"{camera.n_without} messages without a picture, "
                f"{camera.without_message} pictures without a message", "0",
                "the import takes those that have both" if recovered or not missing else
                "acino-fte rig recover may save what is in a damaged video",
            )
        )  # fmt: skip
    return out + _exposure(camera)


def _exposure(camera: CameraAccount) -> list[Requirement]:
    out = []
    if camera.pictures:
        worse = max(camera.over, camera.under)
        verdict: Verdict = "warn" if worse > EXPOSED_WARN else "pass"
        lost = camera.dark + camera.bright
        if lost > 0.5 * camera.pictures:
            verdict = "fail"
        elif lost and verdict == "pass":
            verdict = "warn"
        remedy = ""
        if verdict != "pass":
            shorter = camera.over >= camera.under and camera.bright >= camera.dark
            remedy = _SHORTER if shorter else _LONGER
        out.append(
            Requirement(
                "exposure", camera.name, verdict,
                f"{100 * camera.over:.0f} % white, {100 * camera.under:.0f} % black in {camera.pictures} "
                f"pictures; {camera.dark} all black, {camera.bright} all white",
                f"{100 * EXPOSED_WARN:.0f} %", remedy,
            )
        )  # fmt: skip
    if camera.n_exposures and camera.exposure_us:
        low, high = camera.exposure_us
        out.append(
            Requirement(
                "exposure time", camera.name, "warn",
                f"changed {camera.n_exposures} times, {low:g} to {high:g} µs",
                "constant", "switch off automatic exposure: the motion blur and the look change with it",
            )
        )  # fmt: skip
    return out


def _overlap(found: Findings, streams: list[StreamAccount]) -> list[Requirement]:
    mine = [stream for stream in streams if stream.first_ns is not None and stream.last_ns is not None]
    if found.span is None or len(mine) < 2:
        return []
    begin, end = found.span
    common = min(s.last_ns or 0 for s in mine) - max(s.first_ns or 0 for s in mine)
    share = max(common, 0) / max(end - begin, 1)
    verdict = _limit(1 - share, 1 - OVERLAP_WARN, 1 - OVERLAP_FAIL)
    late = max(mine, key=lambda s: s.first_ns or 0).name
    early = min(mine, key=lambda s: s.last_ns or 0).name
    remedy = f"{late} began last, {early} ended first: use the part that all have"
    if found.base == "device" and common < 0:
        verdict, remedy = "warn", "the streams are by clocks of their own; a pivot brings them together"
    return [
        Requirement(
            "overlap", "all streams", verdict,
            f"{max(common, 0) * 1e-9:.1f} s of {(end - begin) * 1e-9:.1f} s ({100 * share:.0f} %)",
            f"{100 * OVERLAP_WARN:.0f} %", remedy if verdict != "pass" else "",
        )
    ]  # fmt: skip
