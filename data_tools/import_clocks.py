"""The clocks of lidar and inertial sensor: one, where they are in the same device."""

from __future__ import annotations

import numpy as np

from acino_fte.data_tools.clocks import DeviceClock
from acino_fte.data_tools.import_scan import StreamScan
from acino_fte.data_tools.sync import Stamps, clock_of

_ALIKE_NS = 100_000_000  # by which the two may differ as clocks of one device: what their delays do


def device_clocks(
    lidar: StreamScan, imu: StreamScan | None
) -> tuple[DeviceClock, DeviceClock, tuple[str, ...]]:
    """The clocks of the lidar and of the inertial sensor, and what is to be known of the former.

    An inertial sensor in the lidar has the lidar's clock and sends twenty times as many messages. Then both
    are fitted together: the shortest of all delays are found more surely, and are those of small messages.
    Where either clock jumps, the lidar's is fitted alone.
    """
    own, notes = clock_of(lidar.stamps)
    if imu is None:
        return own, own, notes
    mine, other = np.array(imu.device), np.array(lidar.device)
    if mine.min() > other.max() or other.min() > mine.max():
        return own, clock_of(imu.stamps)[0], notes
    if not (lidar.received and imu.received) or len(lidar.received) != len(other):
        return own, own, notes
    if len(imu.received) != len(mine) or own.jumps or len(own.pieces) > 1:
        return own, own, notes
    theirs, _ = clock_of(imu.stamps)
    if theirs.jumps:
        return own, own, notes
    middle = np.array([(int(max(mine.min(), other.min())) + int(min(mine.max(), other.max()))) // 2])
    if abs(int((own.to_computer_ns(middle) - theirs.to_computer_ns(middle))[0])) > _ALIKE_NS:
        return own, theirs, notes  # two devices whose clocks happen to show like times
    together = _together(lidar, imu)
    if together.sd_ms > own.sd_ms and not own.is_computers:
        return own, own, notes
    return together, together, notes


def _together(lidar: StreamScan, imu: StreamScan) -> DeviceClock:
    """One clock for the messages of both, in the order of their stamps."""
    device = np.concatenate([lidar.stamps.device_ns, imu.stamps.device_ns])
    received = np.array([*lidar.received, *imu.received], dtype=np.int64)
    order = np.lexsort((received, device))
    return clock_of(Stamps(device[order], received[order]))[0]
