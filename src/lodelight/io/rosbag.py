"""ROS bags opened and read as a stream: ROS 1, and ROS 2 as sqlite3 or MCAP, a file or a folder. No ROS is needed.

What the files are is told by their content. Everything a damaged file can make the parser raise becomes one
SourceError that says so.
"""

from __future__ import annotations

import contextlib
import sqlite3
from collections.abc import Generator, Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from lodelight.errors import LodelightError, SourceError

MAGICS = {b"#ROSBAG V": ".bag", b"\x89MCAP0\r\n": ".mcap", b"SQLite format 3\0": ".db3"}
STORAGE = (".mcap", ".db3")
Stream = Generator[tuple[str, int, Any], None, None]
UNSAFE = set("?#%")  # of file names, where a database is opened by an address


def kind_of(path: Path) -> str | None:
    """ "folder" (ROS 2, with or without `metadata.yaml`), ".bag", ".mcap" or ".db3"; None where it is no bag."""
    if path.is_dir():
        named = (path / "metadata.yaml").is_file() or any(file.suffix in STORAGE for file in path.iterdir())
        return "folder" if named and _storage(path) else None
    if not path.is_file():
        return None
    with path.open("rb") as file:
        head = file.read(16)
    kind = next((suffix for magic, suffix in MAGICS.items() if head.startswith(magic)), None)
    return None if kind == ".db3" and not _has_messages(path) else kind


def recognize(path: Path) -> bool:
    return kind_of(path) is not None


def short_type(msgtype: str) -> str:
    """`sensor_msgs/Image`, whichever ROS wrote it."""
    return msgtype.replace("/msg/", "/")


class Bag:
    """An open bag. Use as a context; every reading pass has its own, as a bag has one position.

    types : of each topic, as `sensor_msgs/Image`; counts : its messages
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.types: dict[str, str] = {}
        self.counts: dict[str, int] = {}
        self._stack = contextlib.ExitStack()

    def __enter__(self) -> Bag:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore

        try:
            with damage_told(self.path):
                paths = [self._named(file) for file in _files(self.path)]
                # Bags from before ROS 2 Iron hold no definitions of their messages; these have not changed since.
                known = get_typestore(Stores.ROS2_HUMBLE)
                self._reader = self._stack.enter_context(AnyReader(paths, default_typestore=known))
                for connection in self._reader.connections:
                    self.types[connection.topic] = short_type(connection.msgtype)
                    self.counts[connection.topic] = self.counts.get(connection.topic, 0) + connection.msgcount
        except BaseException:
            self._stack.close()
            raise
        return self

    def __exit__(self, *exc: object) -> None:
        with contextlib.suppress(Exception):
            self._stack.close()

    @property
    def end_ns(self) -> int:
        """When its last message was recorded, on the bag's clock."""
        return int(self._reader.end_time)

    @property
    def start_ns(self) -> int:
        return int(self._reader.start_time)

    def messages(self, topics: tuple[str, ...], from_ns: int | None = None) -> Stream:
        """(topic, bag's stamp, message) as they were recorded. Raises SourceError where the bag is damaged."""
        wanted = [connection for connection in self._reader.connections if connection.topic in topics]
        if not wanted:
            return
        stream = self._reader.messages(wanted, start=from_ns)
        while True:
            with damage_told(self.path):
                item = next(stream, None)
                if item is None:
                    return
                connection, t_ns, raw = item
                message = self._reader.deserialize(raw, connection.msgtype)
            yield connection.topic, t_ns, message

    def first(self, topic: str) -> Any:
        """The first message of a topic, None where it has none."""
        return next((message for _, _, message in self.messages((topic,))), None)

    def last(self, topic: str) -> Any:
        """The last message of a topic, found from the end without reading all."""
        back_ns = 1_000_000_000
        while True:
            begin = max(self.end_ns - back_ns, self.start_ns)
            found = None
            for _, _, message in self.messages((topic,), begin):
                found = message
            if found is not None or begin <= self.start_ns:
                return found
            back_ns *= 8

    def _named(self, path: Path) -> Path:
        """The file under a name that ends as its content asks, which is how the parser tells them apart."""
        kind = kind_of(path)
        if kind == "folder" or kind is None or (path.suffix == kind and not UNSAFE & set(str(path))):
            return path
        folder = self._stack.enter_context(TemporaryDirectory(prefix="bag"))
        link = Path(folder) / f"bag{kind}"
        try:
            link.symlink_to(path.resolve())
        except OSError:
            raise SourceError(f"{path} is a bag of another kind than its name says; rename it to *{kind}") from None
        return link


@contextlib.contextmanager
def damage_told(path: Path) -> Iterator[None]:
    """Whatever a parser says of a damaged bag, as one SourceError."""
    try:
        yield
    except (LodelightError, GeneratorExit, PermissionError):
        raise
    except Exception as error:  # parsers let out whatever the bytes led them to
        raise SourceError(f"{path} {_diagnosis(path, error)}") from None


def _diagnosis(path: Path, error: Exception) -> str:
    text = " ".join(str(part) for part in error.args) or type(error).__name__
    if "not indexed" in text or "index looks damaged" in text:
        return 'has no index: it was cut short or never closed; run "rosbag reindex" on it'
    if "no type definitions" in text:
        return "does not say what its messages are; convert it with a newer ros2 bag"
    if path.is_file() and path.stat().st_size < 64:
        return "is cut short: there is nothing in it"
    if path.is_dir() and "metadata" in text:
        return f'is no whole ROS 2 bag ({text}); run "ros2 bag reindex" on it'
    return f"cannot be read: it is cut short or damaged ({text}); record or copy it again"


def _files(path: Path) -> list[Path]:
    """What to open of a bag: the folder where its list is there, else its storage files in order."""
    if not path.is_dir() or (path / "metadata.yaml").is_file():
        return [path]
    return _storage(path)


def _storage(folder: Path) -> list[Path]:
    return sorted(file for file in folder.iterdir() if file.suffix in STORAGE or ".mcap." in file.name)


def _has_messages(path: Path) -> bool:
    """Whether a database is a bag; one too damaged to say is, by its name, so that the reader says why."""
    try:
        with contextlib.closing(sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro&immutable=1", uri=True)) as db:
            names = {row[0] for row in db.execute("SELECT name FROM sqlite_master WHERE type='table'")}
        return {"messages", "topics"} <= names
    except sqlite3.Error:
        return path.suffix == ".db3"


def stamp_ns(message: Any) -> int:
    """A message's own stamp."""
    stamp = message.header.stamp
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)
