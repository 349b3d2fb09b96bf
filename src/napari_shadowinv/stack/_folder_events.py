"""Files that arrive in a folder: `Arrivals` hands out each once it is completely written.

`observing` asks the system to tell of changes, or looks itself where the system cannot tell.
"""

from __future__ import annotations

import fnmatch
import os
import stat
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from napari_shadowinv._system.safety import resolved_path
from napari_shadowinv.errors import FileFormatError, InputError
from napari_shadowinv.io.files import in_counting_order
from napari_shadowinv.stack._sources import stamp

_LOOK_EVERY = 1.0  # seconds between two looks at a folder of which the system tells nothing
_CHECK_EVERY = 1.0  # seconds between two looks whether the folder is still there
# File systems on which files may be written elsewhere, of which this system hears nothing.
_SHARES = {
    *("9p", "afs", "beegfs", "ceph", "cifs", "drvfs", "fuse.glusterfs", "fuse.sshfs", "gpfs"),
    *("lustre", "nfs", "nfs4", "prl_fs", "smb3", "smbfs", "vboxsf"),
}

Stamp = dict[str, int]


def checked_folder(folder: str | Path, pattern: str) -> Path:
    """Return the folder, absolute, if it and the pattern can be watched."""
    path = Path(folder)
    if not path.exists():
        raise InputError(f"{folder} does not exist: expected a folder to watch; create it first")
    if not path.is_dir():
        raise InputError(f"{folder} is a file: expected a folder to watch; give its folder")
    if not os.access(path, os.R_OK | os.X_OK):
        raise InputError(f"{folder} cannot be read: expected a folder to watch; allow reading it")
    if not pattern or set(pattern) & {"/", os.sep}:
        raise InputError(
            f"the pattern is '{pattern}': expected one for names, such as *.tif; folders inside "
            "the folder are not watched"
        )
    return resolved_path(path)


class Arrivals:
    """Names of complete files, in order of arrival; only names are kept.

    A file is complete once it was closed after writing, or moved here. Where the system does not
    tell that, and of files of which nothing was heard, once it has not changed for `settle`
    seconds. It is handed out again when it has been written to again.
    """

    def __init__(
        self, folder: Path, pattern: str, *, settle: float = 1.0, existing: bool = True
    ) -> None:
        self.folder = folder
        self._pattern, self._settle, self._existing = pattern, settle, existing
        self._changed = threading.Condition()
        self._ready: dict[str, None] = {}  # in order
        self._settling: dict[str, tuple[Stamp, float]] = {}  # as last seen, and since when
        self._tells_closing = False
        self._same = _identity(folder)
        self._gone = self._woken = False
        self._checked = self.heard = time.monotonic()  # `heard`: the last sign of a file

    @property
    def is_quiet(self) -> bool:
        """Whether no file waits, or may soon be complete."""
        return not (self._ready or self._settling)

    @property
    def waiting(self) -> int:
        """How many files are complete and were not handed out yet."""
        return len(self._ready)

    def open(self, *, tells_closing: bool) -> None:
        """Take in what is there, once the folder is observed."""
        self._tells_closing = tells_closing
        try:
            with os.scandir(self.folder) as entries:
                there = [Path(entry.name) for entry in entries if self._matches(entry.name)]
        except OSError as error:
            raise self._lost(error) from None
        now = time.time()
        for name in map(str, in_counting_order(there)) if self._existing else ():
            seen = self._stamp(name)
            if seen is None:
                continue
            age = now - seen["mtime_ns"] / 1e9
            with self._changed:
                # Who is writing it right now began before anyone listened.
                if tells_closing and age > self._settle:
                    self._ready.setdefault(name)
                elif name not in self._ready:
                    self._settling[name] = (seen, time.monotonic())

    def take(self, timeout: float) -> str | None:
        """Return the name of the next complete file; None without one for so long, or if woken."""
        end = time.monotonic() + timeout
        with self._changed:
            while True:
                self._check()
                if self._woken:
                    self._woken = False
                    return None
                due = self._settle_some()
                if self._ready:
                    name = next(iter(self._ready))
                    del self._ready[name]
                    return name
                left = min(end, due) - time.monotonic()
                if time.monotonic() >= end:
                    return None
                self._changed.wait(max(left, 0.0))

    def wake(self) -> None:
        """End the wait for a file, or the next one."""
        with self._changed:
            self._woken = True
            self._changed.notify_all()

    def peek(self, count: int) -> list[str]:
        """Return the names of the first files that wait, without handing them out."""
        with self._changed:
            return list(self._ready)[:count]

    def put_back(self, name: str) -> None:
        """Wait for a file again that changed while it was read."""
        with self._changed:
            self._settle_later(name)

    def check(self) -> None:
        """Raise an error if the folder is no longer there."""
        with self._changed:
            self._checked = -1.0
            self._check()

    # What the observer calls, in its own thread

    def dispatch(self, event: Any) -> None:
        """Take one event of `watchdog`."""
        kind = event.event_type
        source, target = (os.fsdecode(one or "") for one in (event.src_path, event.dest_path))
        with self._changed:
            if kind in ("deleted", "moved") and Path(source) == self.folder:
                self._gone = True
                self._changed.notify_all()
            elif event.is_directory:
                return
            elif kind == "moved":
                self._forget(source)
                self._on_name(target, self._complete)
            elif kind == "deleted":
                self._forget(source)
            elif kind == "closed":
                self._on_name(source, self._complete)
            elif kind in ("created", "modified"):
                self._on_name(source, self._being_written)

    def _on_name(self, path: str, what: Callable[[str], None]) -> None:
        folder, name = os.path.split(path)
        if Path(folder) == self.folder and self._matches(name):
            self.heard = time.monotonic()
            what(name)
            self._changed.notify_all()

    def _complete(self, name: str) -> None:
        self._settling.pop(name, None)
        if self._stamp(name) is not None:
            self._ready.setdefault(name)

    def _being_written(self, name: str) -> None:
        self._ready.pop(name, None)
        self._settling.pop(name, None)
        # Nobody will close what was only linked here.
        if not self._tells_closing or _is_link(self.folder / name):
            self._settle_later(name)

    def _forget(self, path: str) -> None:
        name = os.path.basename(path)
        self._ready.pop(name, None)
        self._settling.pop(name, None)

    # With the lock held

    def _settle_later(self, name: str) -> None:
        seen = self._stamp(name)
        if seen is not None:
            self._settling[name] = (seen, time.monotonic())

    def _settle_some(self) -> float:
        """Let files that have not changed for long enough be complete; return when to look next."""
        now = time.monotonic()
        due = now + _CHECK_EVERY
        for name, (seen, since) in list(self._settling.items()):
            if now < since + self._settle:
                due = min(due, since + self._settle)
                continue
            del self._settling[name]
            found = self._stamp(name)
            if found == seen:
                self._ready.setdefault(name)
            elif found is not None:
                self.heard = now
                self._settling[name] = (found, now)
                due = min(due, now + self._settle)
        return due

    def _matches(self, name: str) -> bool:
        return not name.startswith(".") and fnmatch.fnmatch(name, self._pattern)

    def _stamp(self, name: str) -> Stamp | None:
        """Size and time of a file; None of what is no file, or has gone."""
        path = self.folder / name
        with suppress(OSError):
            return stamp(path) if stat.S_ISREG(path.stat().st_mode) else None
        return None

    def _check(self) -> None:
        now = time.monotonic()
        if now < self._checked + _CHECK_EVERY and not self._gone:
            return
        self._checked = now
        try:
            if self._gone or _identity(self.folder) != self._same:
                raise FileNotFoundError(2, "it was removed, or moved")
            os.scandir(self.folder).close()
        except OSError as error:
            raise self._lost(error) from None

    def _lost(self, error: OSError) -> FileFormatError:
        return FileFormatError(
            f"the folder {self.folder} can no longer be read ({error.strerror}): bring it back, "
            "then watch again to go on"
        )


def _identity(folder: Path) -> tuple[int, int]:
    found = folder.stat()
    return found.st_dev, found.st_ino


def _is_link(path: Path) -> bool:
    with suppress(OSError):
        return path.is_symlink() or path.stat().st_nlink > 1
    return False


@contextmanager
def observing(
    arrivals: Arrivals, *, polling: bool, on_note: Callable[[str], None]
) -> Iterator[None]:
    """Let a folder's changes be told to `arrivals` in a block, and take in what is there."""
    arrivals.check()
    share = _share_of(arrivals.folder)
    if share and not polling:
        on_note(
            f"{arrivals.folder} is on a network file system ({share}), which does not tell of "
            "new files: it is looked at every second"
        )
    observer, tells_closing = None, False
    if not (share or polling):
        try:
            observer, tells_closing = _started(arrivals)
        except OSError as error:
            on_note(
                f"the system does not watch another folder ({error.strerror or error}): "
                f"{arrivals.folder} is looked at every second"
            )
    if observer is None:
        observer = _polling(arrivals)
    try:
        arrivals.open(tells_closing=tells_closing)
        yield
    finally:
        _end(observer)


def _started(arrivals: Arrivals) -> tuple[Any, bool]:
    """An observer that the system tells of changes, and whether it tells of files closed."""
    from watchdog.observers import Observer

    made: Any = Observer
    tells_closing = made.__module__.endswith("inotify")
    # In full, what is moved here from elsewhere differs from what is only created.
    observer = made(generate_full_events=True) if tells_closing else made()
    return _scheduled(observer, arrivals), tells_closing


def _polling(arrivals: Arrivals) -> Any:
    from watchdog.observers.polling import PollingObserver

    return _scheduled(PollingObserver(timeout=_LOOK_EVERY), arrivals)


def _scheduled(observer: Any, arrivals: Arrivals) -> Any:
    from watchdog import events

    # Not of files opened and closed by those who only read, such as this process.
    wanted = [
        *(events.FileCreatedEvent, events.FileModifiedEvent, events.FileClosedEvent),
        *(events.FileMovedEvent, events.FileDeletedEvent),
        *(events.DirDeletedEvent, events.DirMovedEvent),
    ]
    try:
        observer.schedule(arrivals, str(arrivals.folder), event_filter=wanted)
        observer.start()
    except BaseException:
        _end(observer)
        raise
    return observer


def _end(observer: Any) -> None:
    observer.stop()
    if observer.is_alive():
        observer.join()


def _share_of(folder: Path) -> str:
    """The kind of network file system on which a folder lies; empty if on none that is known."""
    try:
        lines = Path("/proc/self/mounts").read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        return ""
    best, kind = "", ""
    place = str(resolved_path(folder))
    for _, point, found, *_ in (line.split() for line in lines if line.count(" ") >= 3):
        mount = point.replace("\\040", " ")
        inside = place == mount or place.startswith(mount.rstrip("/") + "/")
        if inside and len(mount) >= len(best):
            best, kind = mount, found
    return kind if kind in _SHARES else ""
