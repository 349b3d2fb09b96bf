"""Files that arrive in a folder: `Arrivals` returns each once it is completely written.

`observing` subscribes to file-system events, or polls the folder where there are none.
"""

from __future__ import annotations

import os
import stat
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from napari_shadowinv._system.safety import resolved_path
from napari_shadowinv.errors import FileFormatError, InputError
from napari_shadowinv.io.files import in_counting_order
from napari_shadowinv.io.formats import RADIOGRAPH_SUFFIXES
from napari_shadowinv.io.frames import count_endings, images_in, name_matches, spellings
from napari_shadowinv.stack._shots import stamp

_POLL_S = 1.0  # between two looks at a folder without file-system events
_FOLDER_CHECK_S = 1.0  # between two checks that the folder still exists
# File systems on which other machines may write files without events on this one.
_NETWORK_FILE_SYSTEMS = {
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

    A file is complete once it was closed after writing, or moved here. Without such events it is
    complete once it has not changed for `settle` seconds. It is returned again after it has been
    written to again.
    """

    def __init__(
        self, folder: Path, pattern: str, *, settle: float = 1.0, existing: bool = True
    ) -> None:
        self.folder = folder
        self._pattern, self._settle, self._existing = pattern, settle, existing
        self._changed = threading.Condition()
        self._ready: dict[str, None] = {}  # in order
        self._settling: dict[str, tuple[Stamp, float]] = {}  # as last seen, and since when
        self._reports_closing = False
        self._kind: tuple[str, ...] = ()  # endings of the shots, if the pattern has none
        self._left_out: set[str] = set()  # names
        self._folder_id = _identity(folder)
        self._gone = self._woken = False
        self._checked = self.last_event = time.monotonic()  # `last_event`: of any file

    @property
    def is_quiet(self) -> bool:
        """Whether no file is waiting or being written."""
        return not (self._ready or self._settling)

    @property
    def waiting(self) -> int:
        """Number of complete files that were not returned yet."""
        return len(self._ready)

    def open(self, *, reports_closing: bool) -> None:
        """Add the existing files, once the folder is observed."""
        self._reports_closing = reports_closing
        try:
            with os.scandir(self.folder) as entries:
                every = [entry.name for entry in entries]
            images = images_in(self.folder)
            self._kind = spellings(images[0].suffix) if images else ()
            names = [Path(name) for name in every if self.matches(name)]
            for name in set(every).difference(map(str, names)):
                self._leave_out(name)
        except OSError as error:
            raise self._folder_error(error) from None
        now = time.time()
        for name in map(str, in_counting_order(names)) if self._existing else ():
            stamp_now = self._stamp(name)
            if stamp_now is None:
                continue
            age = now - stamp_now["mtime_ns"] / 1e9
            with self._changed:
                # A recent file may still be written, and its events began before the observer.
                if reports_closing and age > self._settle:
                    self._ready.setdefault(name)
                elif name not in self._ready:
                    self._settling[name] = (stamp_now, time.monotonic())

    def next_name(self, timeout: float) -> str | None:
        """Return the name of the next complete file; None at the timeout, or if woken."""
        end = time.monotonic() + timeout
        with self._changed:
            while True:
                self._check()
                if self._woken and timeout > 0:
                    self._woken = False
                    return None
                due = self._settle_some()
                if self._ready:
                    name = next(iter(self._ready))
                    del self._ready[name]
                    return name
                remaining = min(end, due) - time.monotonic()
                if time.monotonic() >= end:
                    return None
                self._changed.wait(max(remaining, 0.0))

    def wake(self) -> None:
        """End the wait for a file, or the next one."""
        with self._changed:
            self._woken = True
            self._changed.notify_all()

    def take_all(self) -> list[str]:
        """Return the names of all waiting files."""
        with self._changed:
            names, self._ready = list(self._ready), {}
            return names

    def peek(self, count: int) -> list[str]:
        """Return the names of the first waiting files, and keep them."""
        with self._changed:
            return list(self._ready)[:count]

    def put_back(self, name: str) -> None:
        """Wait until a file no longer changes, such as one that changed while it was read."""
        with self._changed:
            stamp_now = self._stamp(name)
            if stamp_now is not None:
                self._settling[name] = (stamp_now, time.monotonic())

    def matches(self, name: str) -> bool:
        """Return whether a name belongs to a shot."""
        if name.startswith("."):
            return False
        is_shot = name_matches(name, self._pattern)
        if is_shot and not os.path.splitext(self._pattern)[1]:
            kind = spellings(os.path.splitext(name)[1])
            if not self._kind and RADIOGRAPH_SUFFIXES.issuperset(kind):
                self._kind = kind
            is_shot = kind == self._kind
        return is_shot

    @property
    def left_out(self) -> Counter[str]:
        """Numbers of files that are no shots, by their endings."""
        with self._changed:
            return count_endings(self._left_out)

    def check(self) -> None:
        """Raise an error if the folder no longer exists."""
        with self._changed:
            self._checked = -1.0
            self._check()

    # Called by the observer, in its own thread

    def dispatch(self, event: Any) -> None:
        """Handle one event of `watchdog`."""
        kind = event.event_type
        source, target = (os.fsdecode(path or "") for path in (event.src_path, event.dest_path))
        with self._changed:
            if kind in ("deleted", "moved") and Path(source) == self.folder:
                self._gone = True
                self._changed.notify_all()
            elif event.is_directory:
                return
            elif kind == "moved":
                self._drop(source)
                self._on_name(target, self._on_complete)
            elif kind == "deleted":
                self._drop(source)
            elif kind == "closed":
                self._on_name(source, self._on_complete)
            elif kind in ("created", "modified"):
                self._on_name(source, self._on_writing)

    def _on_name(self, path: str, handle: Callable[[str], None]) -> None:
        folder, name = os.path.split(path)
        if Path(folder) == self.folder and self.matches(name):
            self.last_event = time.monotonic()
            handle(name)
            self._changed.notify_all()
        elif Path(folder) == self.folder:
            self._leave_out(name)

    def _leave_out(self, name: str) -> None:
        if not name.startswith(".") and self._stamp(name) is not None:
            self._left_out.add(name)

    def _on_complete(self, name: str) -> None:
        self._settling.pop(name, None)
        if self._stamp(name) is not None:
            self._ready.setdefault(name)

    def _on_writing(self, name: str) -> None:
        self._drop(name)
        # A file that was linked here is never closed.
        if not self._reports_closing or _is_link(self.folder / name):
            self.put_back(name)

    def _drop(self, path: str) -> None:
        name = os.path.basename(path)
        self._ready.pop(name, None)
        self._settling.pop(name, None)
        self._left_out.discard(name)

    # With the lock held

    def _settle_some(self) -> float:
        """Complete files that have not changed for long enough; return the next time to check."""
        now = time.monotonic()
        due = now + _FOLDER_CHECK_S
        for name, (earlier, since) in list(self._settling.items()):
            if now < since + self._settle:
                due = min(due, since + self._settle)
                continue
            del self._settling[name]
            stamp_now = self._stamp(name)
            if stamp_now == earlier:
                self._ready.setdefault(name)
            elif stamp_now is not None:
                self.last_event = now
                self._settling[name] = (stamp_now, now)
                due = min(due, now + self._settle)
        return due

    def _stamp(self, name: str) -> Stamp | None:
        """Return size and time of a file; None if it is no file, or was removed."""
        path = self.folder / name
        with suppress(OSError):
            return stamp(path) if stat.S_ISREG(path.stat().st_mode) else None
        return None

    def _check(self) -> None:
        now = time.monotonic()
        if now < self._checked + _FOLDER_CHECK_S and not self._gone:
            return
        self._checked = now
        try:
            if self._gone or _identity(self.folder) != self._folder_id:
                raise FileNotFoundError(2, "it was removed, or moved")
            os.scandir(self.folder).close()
        except OSError as error:
            raise self._folder_error(error) from None

    def _folder_error(self, error: OSError) -> FileFormatError:
        return FileFormatError(
            f"the folder {self.folder} can no longer be read ({error.strerror}): bring it back, "
            "then watch again to go on"
        )


def _identity(folder: Path) -> tuple[int, int]:
    status = folder.stat()
    return status.st_dev, status.st_ino


def _is_link(path: Path) -> bool:
    with suppress(OSError):
        return path.is_symlink() or path.stat().st_nlink > 1
    return False


@contextmanager
def observing(
    arrivals: Arrivals, *, polling: bool, on_note: Callable[[str], None]
) -> Iterator[None]:
    """Report a folder's changes to `arrivals` within a block, starting with existing files."""
    arrivals.check()
    share = _network_file_system(arrivals.folder)
    if share and not polling:
        on_note(
            f"{arrivals.folder} is on a network file system ({share}) without events for "
            "new files: it is polled once a second"
        )
    observer, reports_closing = None, False
    if not (share or polling):
        try:
            observer, reports_closing = _start_observer(arrivals)
        except OSError as error:
            on_note(
                f"the system cannot watch another folder ({error.strerror or error}): "
                f"{arrivals.folder} is polled once a second"
            )
    if observer is None:
        from watchdog.observers.polling import PollingObserver

        observer = _schedule(PollingObserver(timeout=_POLL_S), arrivals)
    try:
        arrivals.open(reports_closing=reports_closing)
        yield
    finally:
        _stop_observer(observer)


def _start_observer(arrivals: Arrivals) -> tuple[Any, bool]:
    """Start an observer of file-system events; return it and whether it reports closing."""
    from watchdog.observers import Observer

    observer_class: Any = Observer
    reports_closing = observer_class.__module__.endswith("inotify")
    # With full events, a file moved here from elsewhere differs from a created one.
    observer = observer_class(generate_full_events=True) if reports_closing else observer_class()
    return _schedule(observer, arrivals), reports_closing


def _schedule(observer: Any, arrivals: Arrivals) -> Any:
    from watchdog import events

    # No events of files opened and closed for reading, such as by this process.
    event_types = [
        *(events.FileCreatedEvent, events.FileModifiedEvent, events.FileClosedEvent),
        *(events.FileMovedEvent, events.FileDeletedEvent),
        *(events.DirDeletedEvent, events.DirMovedEvent),
    ]
    try:
        observer.schedule(arrivals, str(arrivals.folder), event_filter=event_types)
        observer.start()
    except BaseException:
        _stop_observer(observer)
        raise
    return observer


def _stop_observer(observer: Any) -> None:
    observer.stop()
    if observer.is_alive():
        observer.join()


def _network_file_system(folder: Path) -> str:
    """Return the kind of network file system of a folder; empty if it is not a known one."""
    try:
        lines = Path("/proc/self/mounts").read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        return ""
    best, kind = "", ""
    place = str(resolved_path(folder))
    for _, point, file_system, *_ in (line.split() for line in lines if line.count(" ") >= 3):
        mount = point.replace("\\040", " ")
        inside = place == mount or place.startswith(mount.rstrip("/") + "/")
        if inside and len(mount) >= len(best):
            best, kind = mount, file_system
    return kind if kind in _NETWORK_FILE_SYSTEMS else ""
