"""Rescue of rosbag2's SQLite files after a loss of power: every whole row into a new database."""

from __future__ import annotations

import shutil
import sqlite3
import tempfile
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from typing import Any

from acino_fte.data_tools.bags_serial import LAYOUTS
from acino_fte.data_tools.bags_sqlite import BROKEN, Pages, SqliteWalk, is_message, page_size
from acino_fte.data_tools.bags_window import ZSTD, Channel, Losses, Messages, RawMessage
from acino_fte.rig.recover_bags import UNKNOWN, by_topic, sentence
from acino_fte.rig.recover_types import Noted, Salvaged, Tally, elsewhere

_JOURNAL_HEAD = b"\xd9\xd5\x05\xf9\x20\xa1\x63\xd7"  # of a rollback journal that is still to be used
_PAGE = 4096  # bytes, of SQLite where nothing else is said
_MOST_TOPICS = 1000
_BATCH = 500
_TABLES = """
CREATE TABLE schema(schema_version INTEGER PRIMARY KEY, ros_distro TEXT NOT NULL);
CREATE TABLE metadata(id INTEGER PRIMARY KEY, metadata_version INTEGER NOT NULL, metadata TEXT NOT NULL);
CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT NOT NULL, type TEXT NOT NULL,
  serialization_format TEXT NOT NULL, offered_qos_profiles TEXT NOT NULL,
  type_description_hash TEXT NOT NULL);
CREATE TABLE message_definitions(id INTEGER PRIMARY KEY, topic_type TEXT NOT NULL, encoding TEXT NOT NULL,
  encoded_message_definition TEXT NOT NULL, type_description_hash TEXT NOT NULL);
CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER NOT NULL, timestamp INTEGER NOT NULL,
  data BLOB NOT NULL);
CREATE INDEX timestamp_idx ON messages (timestamp ASC);
INSERT INTO schema(schema_version, ros_distro) VALUES (4, 'unknown');
"""


class _Rows(SqliteWalk):
    """A walk that gives messages as they are stored, and all that the table of topics has."""

    def __init__(self, path: Path, losses: Losses) -> None:
        super().__init__(path, losses)
        self.more: dict[int, tuple[str, str]] = {}  # quality of service and hash by topic
        self.forms: dict[int, str] = {}
        self.packed = False
        self.numbers: set[int] = set()

    def _topic(self, number: int, strings: Any, texts: dict[str, Any]) -> None:
        super()._topic(number, strings, texts)
        self.forms[number] = strings[2] if isinstance(strings[2], str) else "cdr"

    def _topics(self, connection: sqlite3.Connection) -> None:
        super()._topics(connection)
        known = {row[1] for row in connection.execute("PRAGMA table_info(topics)")}
        columns = [
            name if name in known else "''" for name in ("offered_qos_profiles", "type_description_hash")
        ]
        select = f"SELECT id, {', '.join(columns)} FROM topics"  # noqa: S608 - two known names
        self.more = {row[0]: (str(row[1] or ""), str(row[2] or "")) for row in connection.execute(select)}

    def _find_topics(self, pages: Pages) -> None:
        super()._find_topics(pages)
        quiet = Losses()
        for page in range(1, min(pages.count, 64) + 1):
            for number, row in pages.rows(page, quiet):
                channel = self.channels.get(number)
                if channel is not None and len(row) >= 5 and row[1] == channel.topic:
                    texts = [value if isinstance(value, str) else "" for value in [*row[4:6], ""]]
                    self.more.setdefault(number, (texts[0], texts[1]))

    def _message(self, topic: Any, stamp: Any, data: Any) -> Messages:
        if topic not in self.channels and isinstance(topic, int) and 0 < topic < _MOST_TOPICS:
            self.losses.note(f"the topic {topic} is not told of: its name and type are lost")
            self.channels[topic] = Channel(
                f"/recovered/topic_{topic}", UNKNOWN, "", "ros2msg", LAYOUTS["cdr"], 2
            )
        channel = self.channels.get(topic)
        if channel is None or not isinstance(stamp, int) or not isinstance(data, bytes):
            self.losses.note(f"a message is of the unknown topic {topic}", 1)
            return
        self.losses.read += 1
        self.packed = self.packed or data[:4] == ZSTD
        yield RawMessage(channel, stamp, data)

    def _pages(self) -> Messages:
        """Messages of all leaves after the row that SQLite gave last, each row once."""
        with self.path.open("rb") as file:
            head = file.read(100)
            size = page_size(head)
            if not size:
                self.losses.note("the head of the database is damaged: it is read as rosbag2 writes it")
            pages = Pages(file, size or _PAGE, size - head[20] if size else _PAGE, self._log)
            try:
                self._find_topics(pages)
                leaves = ((pages.first_row(page), page) for page in range(1, pages.count + 1))
                for _, page in sorted(leaf for leaf in leaves if leaf[0] is not None):
                    for number, row in pages.rows(page, self.losses):
                        if is_message(row) and number > self._last and number not in self.numbers:
                            self.numbers.add(number)
                            yield from self._message(row[1], row[2], row[3])
                missing = pages.said - pages.count
                if missing > 0:
                    self.losses.note(f"{missing} pages are cut off", 0, missing * size)
            finally:
                pages.close()

    def holes(self) -> int:
        """Rows that are missing between others, by their numbers."""
        if not self.numbers:
            return 0
        first = self._last + 1 if self._last else min(self.numbers)
        span = max(self.numbers) - first + 1
        return span - len(self.numbers) if span < 10 * len(self.numbers) + 1000 else 0


def salvage_sqlite(source: Path, target: Path | None) -> Salvaged:
    """Copy every whole message of a database of rosbag2, with the log or the journal that lies beside it.

    Parameters
    ----------
    source : Path
        A journal (``-journal``) is used on a temporary copy; a log (``-wal``) is read where it is.
    target : Path, optional
        The new database; without it the messages are only counted.
    """
    losses, tally, notes = Noted(), Tally(), list[str]()
    with _rolled_back(source, target, notes) as path:
        walk = _Rows(path, losses)
        logged = walk._logged()
        if logged:
            notes.append("A write-ahead log lay beside it: what it holds was merged into the copy.")
        sound = walk.overview()
        said = by_topic(walk) if sound else None
        for channel in walk.channels.values():
            tally.name(channel.topic, channel.type)
        if target is None:
            _count(walk, tally, losses)
        else:
            _write(walk, target, tally, losses)
        losses.lost = max(losses.lost, walk.holes())
    streams = tally.streams(said)
    damage = losses.damage()
    whole = sound and damage.whole and not notes and not any(stream.lost for stream in streams)
    return Salvaged(
        "ROS 2 bag (SQLite)",
        whole,
        streams,
        elsewhere(losses, streams),
        damage.bytes_lost,
        (*notes, *(sentence(place) for place in damage.places)),
        {channel.topic: _about(walk, number) for number, channel in walk.channels.items()},
    )


def sqlite_is_sound(source: Path) -> bool:
    """Whether SQLite finds all pages in order, also those that no message needs."""
    uri = source.resolve().as_uri() + "?mode=ro&immutable=1"
    try:
        with closing(sqlite3.connect(uri, uri=True)) as database:
            return bool(database.execute("PRAGMA quick_check(1)").fetchone() == ("ok",))
    except BROKEN:
        return False


def _count(walk: _Rows, tally: Tally, losses: Noted) -> None:
    for message in walk.messages(payloads=False):
        tally.add(message.channel.topic, message.channel.type, message.received_ns, losses.n_notes)


def _about(walk: _Rows, number: int) -> dict[str, str]:
    """What metadata.yaml says of a topic."""
    channel, more = walk.channels[number], walk.more.get(number, ("", ""))
    return {
        "name": channel.topic,
        "type": channel.type,
        "serialization_format": walk.forms.get(number, "cdr"),
        "offered_qos_profiles": more[0],
        "type_description_hash": more[1],
        **({"compressed": "message"} if walk.packed else {}),
    }


@contextmanager
def _rolled_back(source: Path, target: Path | None, notes: list[str]) -> Iterator[Path]:
    """The database, without the half of a transaction that a journal beside it tells of."""
    journal = source.with_name(source.name + "-journal")
    if not _is_hot(journal):
        yield source
        return
    with tempfile.TemporaryDirectory(prefix=".acino-fte-", dir=target.parent if target else None) as folder:
        copy = Path(folder) / source.name
        shutil.copyfile(source, copy)
        shutil.copyfile(journal, copy.with_name(journal.name))
        with suppress(*BROKEN), closing(sqlite3.connect(copy)) as connection:
            connection.execute("SELECT count(*) FROM sqlite_master").fetchall()  # SQLite takes the journal
        notes.append("A journal lay beside it: the writing that it interrupted was undone in the copy.")
        yield copy


def _is_hot(journal: Path) -> bool:
    if not journal.is_file():
        return False
    with journal.open("rb") as file:
        return file.read(8) == _JOURNAL_HEAD


def _write(walk: _Rows, target: Path, tally: Tally, losses: Noted) -> None:
    """Write the messages, then the topics, which a damaged file tells of on the way."""
    with closing(sqlite3.connect(target)) as database:
        database.execute("PRAGMA journal_mode=OFF")
        database.execute("PRAGMA synchronous=OFF")  # the file is thrown away where this fails
        database.executescript(_TABLES)
        numbers: dict[int, int] = {}
        rows: list[tuple[int, int, bytes]] = []
        insert = "INSERT INTO messages(topic_id, timestamp, data) VALUES(?, ?, ?)"
        for message in walk.messages():
            key = id(message.channel)
            if key not in numbers:
                numbers[key] = next(n for n, known in walk.channels.items() if known is message.channel)
            tally.add(message.channel.topic, message.channel.type, message.received_ns, losses.n_notes)
            rows.append((numbers[key], message.received_ns, message.data))
            if len(rows) >= _BATCH:
                database.executemany(insert, rows)
                rows.clear()
        database.executemany(insert, rows)
        definitions: dict[str, tuple[str, str]] = {}
        for number, channel in walk.channels.items():
            about = _about(walk, number)
            database.execute(
                "INSERT INTO topics VALUES(?, ?, ?, ?, ?, ?)",
                (
                    number,
                    channel.topic,
                    channel.type,
                    about["serialization_format"],
                    about["offered_qos_profiles"],
                    about["type_description_hash"],
                ),
            )
            if channel.definition:
                definitions[channel.type] = (channel.encoding, channel.definition)
        for kind, (encoding, text) in definitions.items():
            database.execute(
                "INSERT INTO message_definitions(topic_type, encoding, encoded_message_definition, "
                "type_description_hash) VALUES(?, ?, ?, '')",
                (kind, encoding, text),
            )
        database.commit()
