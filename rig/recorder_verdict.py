"""Whether a recording lost anything that nothing explains."""

from __future__ import annotations

from collections.abc import Sequence

from acino_fte.data_tools.rig_recording import Manifest
from acino_fte.rig.faults import Fault


def unexplained(manifest: Manifest, faults: Sequence[Fault] = ()) -> list[str]:
    """What was lost without a cause that is known, one sentence each; nothing after a good recording.

    Stalls and unplugged devices are events with a time and a length: they are no loss of the recorder's.
    Numbers that never came have no cause, unless it was the fault of a simulated rig.
    """
    found = []
    for stream in manifest.streams:
        if stream.dropped:
            found.append(f"{stream.name}: {stream.dropped} dropped, the recorder could not keep up")
        missing = stream.received - stream.written - stream.dropped
        if missing:
            found.append(f"{stream.name}: {missing} were received and not written")
    for event in manifest.events:
        at = (event.time_ns - manifest.started_ns) * 1e-9
        if event.kind == "error":
            found.append(f"{event.stream or 'recorder'}: error at {at:.1f} s: {event.detail}")
        induced = any(f.kind == "lost" and f.hits(event.stream) and abs(at - f.at_s) < 1.0 for f in faults)
        if event.kind == "lost" and event.count and not induced:
            found.append(f"{event.stream}: {event.count} lost at {at:.1f} s on the way from the device")
    return found
