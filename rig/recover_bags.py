"""What the rescues of bags share: counts by an index, the account, and messages whose channel is lost."""

from __future__ import annotations

from acino_fte.data_tools.bags_window import FileWalk
from acino_fte.rig.recover_types import Noted, Salvaged, Tally, elsewhere

UNKNOWN = "recovered/msg/Unknown"
"""Type of messages whose own is lost."""
_MOST_CHANNELS = 1000
_EARLIEST_NS = 10**18  # 2001


def by_topic(walk: FileWalk) -> dict[str, int]:
    """Counts by topic of a sound index."""
    out = dict.fromkeys((channel.topic for channel in walk.channels.values()), 0)
    for number, count in walk.counts.items():
        if number in walk.channels:
            out[walk.channels[number].topic] += count
    return out


def salvaged(form: str, losses: Noted, tally: Tally, said: dict[str, int] | None, indexed: bool) -> Salvaged:
    """The account of a walk; `said`: counts by topic, `indexed`: whether the file's own index is sound."""
    streams = tally.streams(said)
    damage = losses.damage()
    lost = sum(stream.lost for stream in streams)
    return Salvaged(
        form,
        indexed and damage.whole and not lost,
        streams,
        elsewhere(losses, streams),
        damage.bytes_lost,
        tuple(sentence(place) for place in damage.places),
    )


def sentence(place: str) -> str:
    """A place of damage as a sentence."""
    return place[:1].upper() + place[1:] + ("" if place.endswith(".") else ".")


def plausible(number: int, stamp_ns: int) -> bool:
    """Whether a message of an unknown channel can be one: few channels, and a time of this century."""
    return number < _MOST_CHANNELS and _EARLIEST_NS < stamp_ns < 4 * _EARLIEST_NS
