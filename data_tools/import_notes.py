"""What an import says of itself: ``import.json``, warnings, and the lines on the terminal."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from acino_fte.data_tools.clocks import DeviceClock
from acino_fte.data_tools.import_scan import Scan, StreamScan, damage_line
from acino_fte.data_tools.import_sync import Inputs, Timing
from acino_fte.data_tools.recording import Damage
from acino_fte.data_tools.sync import Synchronisation

FORMAT = "acino-fte/import/1"
_RUNS = 200  # of dropped frames that import.json lists
_ROUTES = {"imu": "turns, by the inertial sensor", "encoders": "turns, by the encoders", "none": "stands"}
_WAYS = {"stamps": "the camera's stamps", "pivot": "the pivot", "motion": "the motion of the rig"}


def made_by(command: str, files: dict[str, Path | None]) -> dict[str, Any]:
    """Program, command and files."""
    from acino_fte import __version__

    paths = {key: str(path.resolve()) if path is not None else None for key, path in files.items()}
    return {"format": FORMAT, "version": __version__, "command": command, **paths}


def recording_notes(scan: Scan, timing: Timing) -> dict[str, Any]:
    """Streams, damage and clocks of a recording."""
    damage = scan.damage
    return {
        "streams": [_stream(one) for one in scan.streams.values()],
        "damage": {
            "n_read": damage.n_read,
            "n_lost": damage.n_lost,
            "bytes_lost": damage.bytes_lost,
            "places": list(damage.places),
        },
        "notes": list(scan.notes),
        "clocks": {"lidar": _clock(timing.lidar), "imu": _clock(timing.imu)},
    }


def sequence_notes(frames: tuple[int, int], sync: Synchronisation) -> dict[str, Any]:
    """Synchronisation and frames of a sequence; `frames` are those of the source."""
    n = int(sync.place[-1]) + 1
    return {
        "synchronisation": {
            "method": sync.method,
            "sd_ms": sync.sd_ms,
            "fps": sync.fps,
            "origin_ns": sync.origin_ns,
            "first_frame_s": float(sync.frame_time[0]),
            "notes": list(sync.notes),
        },
        "frames": {
            "source": list(frames),
            "n_frames": n,
            "n_dropped": n - len(sync.place),
            "dropped": [[run.before, run.count] for run in sync.dropped[:_RUNS]],
            "place": sync.place.tolist(),
        },
    }


def _stream(stream: StreamScan) -> dict[str, Any]:
    return {
        "name": stream.name,
        "kind": stream.kind,
        "type": stream.type,
        "messages": len(stream) or stream.n_values,
        "rate": round(stream.rate, 4),
        "seconds": round(stream.duration, 6),
    }


def _clock(clock: DeviceClock) -> dict[str, Any]:
    return {
        "drift_ppm": 1e6 * clock.drift,
        "sd_ms": clock.sd_ms,
        "delay_ms": clock.delay_ms,
        "jumps": [str(jump) for jump in clock.jumps],
        "n_duplicates": clock.n_duplicates,
        "n_outliers": clock.n_outliers,
    }


def doubts(sync: Synchronisation, inputs: Inputs, resolution: tuple[int, int]) -> list[str]:
    """What the user should know of frames and pictures."""
    out = []
    if inputs.fps is not None and abs(sync.fps / inputs.fps - 1) > 2e-3:
        out.append(f"the frames were taken at {sync.fps:.4g} Hz, not at {inputs.fps:g}; the former is used")
    size = inputs.pictures.size if inputs.pictures is not None else None
    if size is not None and size != resolution:
        out.append(
            f"the pictures have {size[0]}×{size[1]} px, the calibration is of {resolution[0]}×"
            f"{resolution[1]}: keypoints must be in pixels of the calibration"
        )
    if 1e-3 * sync.sd_ms * sync.fps > 1:
        out.append(f"the synchronisation is known to {sync.sd_ms:.0f} ms only, more than a frame")
    return out


def next_steps(has_keypoints: bool, camera: str, video: str | None) -> list[str]:
    """What is still to be done before a run."""
    if has_keypoints:
        return []
    what = video or "the pictures"
    return [f"there are no keypoints: run a detector on {what} and put its table into dlc/{camera}.csv"]


def summary(content: dict[str, Any]) -> list[str]:
    """A few lines for the terminal: streams, damage, synchronisation, frames."""
    lines = [
        f"{one['name']}: {one['messages']} messages"
        + (f", {one['rate']:.1f} per second over {one['seconds']:.1f} s" if one["rate"] else "")
        for one in content["streams"]
        if one["kind"] != "other"
    ]
    sync, frames, lidar = content["synchronisation"], content["frames"], content["lidar"]
    lost = content["damage"]
    lines.append(
        damage_line(Damage(lost["n_read"], lost["n_lost"], lost["bytes_lost"], tuple(lost["places"])))
    )
    lines.append(
        f"synchronised by {_WAYS[sync['method']]}: ± {sync['sd_ms']:.2f} ms, {sync['fps']:.4f} frames/s"
    )
    lines += [f"  {note}" for note in sync["notes"]]
    dropped = f", {frames['n_dropped']} of them dropped by the camera" if frames["n_dropped"] else ""
    lines.append(f"{frames['n_frames']} frames{dropped}; {lidar['kept']} of {lidar['read']} lidar returns")
    lines.append(f"camera: {_ROUTES[content['motion']['route']]}")
    return lines
