"""Files that arrive in a folder, found by looking into it again and again: `Arrivals`."""

from __future__ import annotations

import os
import time
from collections import Counter
from contextlib import suppress
from pathlib import Path

from napari_shadowinv._system.safety import resolved_path
from napari_shadowinv.errors import FileFormatError, InputError
from napari_shadowinv.io.files import in_counting_order
from napari_shadowinv.io.frames import count_endings, images_in, name_matches, spellings


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
    """Names of complete files that wait, in order of arrival.

    A file is complete once its size and time have not changed for `settle` seconds, and again
    after each later change. Files that become complete together are in counting order.
    """

    poll_s = 0.1  # between two looks into the folder

    def __init__(self, folder: Path, pattern: str, *, settle: float, existing: bool = True) -> None:
        self.folder = folder
        self.waiting: list[str] = []
        self.last_change = time.monotonic()  # of any file
        self._pattern, self._settle, self._is_ignored = pattern, settle, not existing
        self._kind: tuple[str, ...] = ()  # endings of the shots, if the pattern has none
        self._stamps: dict[str, tuple[int, int]] = {}  # size and time of each file
        self._settling: dict[str, float] = {}  # files that changed, and when that was seen
        self._others: set[str] = set()  # files that are no shots
        self._folder_id = _identity(folder)
        self._next_look = 0.0

    @property
    def is_quiet(self) -> bool:
        """Whether no file is waiting or being written."""
        return not (self.waiting or self._settling)

    @property
    def left_out(self) -> Counter[str]:
        """Numbers of files that are no shots, by their endings."""
        return count_endings(self._others)

    def matches(self, name: str) -> bool:
        """Return whether a name belongs to a shot."""
        if name.startswith(".") or not name_matches(name, self._pattern):
            return False
        has_ending = os.path.splitext(self._pattern)[1]
        return bool(has_ending) or os.path.splitext(name)[1].lower() in self._kind

    def look(self) -> None:
        """Look into the folder, unless that was done just now."""
        began = time.monotonic()
        if began < self._next_look:
            return
        self.check()
        try:
            if not self._kind and (images := images_in(self.folder)):
                self._kind = spellings(images[0].suffix)
            stamps = _stamps_in(self.folder)
        except OSError as error:
            raise self._folder_error(error) from None
        for name in self._stamps.keys() - stamps.keys():
            self._forget(name)
        for name, stamp in stamps.items():
            if self._stamps.get(name) != stamp:
                self._note_change(name, began)
        self._stamps, self._is_ignored = stamps, False
        ready = [name for name, since in self._settling.items() if began >= since + self._settle]
        for name in map(str, in_counting_order(map(Path, ready))):
            del self._settling[name]
            self.waiting.append(name)
        # To look at very many files takes long, and must not take all the time.
        ended = time.monotonic()
        self._next_look = ended + max(self.poll_s, 5 * (ended - began))

    def look_again(self, name: str) -> None:
        """Wait until a file no longer changes, such as one that changed while it was read."""
        self._forget(name)
        if name in self._stamps:
            self._settling[name] = time.monotonic()

    def check(self) -> None:
        """Raise an error if the folder no longer exists, or another is in its place."""
        try:
            if _identity(self.folder) != self._folder_id:
                raise FileNotFoundError(2, "it was removed, or moved")
        except OSError as error:
            raise self._folder_error(error) from None

    def _forget(self, name: str) -> None:
        self._settling.pop(name, None)
        self._others.discard(name)
        if name in self.waiting:
            self.waiting.remove(name)

    def _note_change(self, name: str, now: float) -> None:
        self._forget(name)
        if not self.matches(name):
            self._others.add(name)
        elif not self._is_ignored:
            self.last_change = self._settling[name] = now

    def _folder_error(self, error: OSError) -> FileFormatError:
        return FileFormatError(
            f"the folder {self.folder} can no longer be read ({error.strerror}): bring it back, "
            "then watch again to go on"
        )


def _identity(folder: Path) -> tuple[int, int]:
    status = folder.stat()
    return status.st_dev, status.st_ino


def _stamps_in(folder: Path) -> dict[str, tuple[int, int]]:
    """Return size and time of each file of a folder."""
    stamps = {}
    with os.scandir(folder) as entries:
        for entry in entries:
            if not entry.name.startswith(".") and entry.is_file():
                with suppress(OSError):  # removed meanwhile
                    status = os.stat(entry.path)  # the entry's own may be old on Windows
                    stamps[entry.name] = status.st_size, status.st_mtime_ns
    return stamps
