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
        self.left_out: Counter[str] = Counter()  # files that are no shots, by their endings
        self.last_change = time.monotonic()  # of any file
        self._pattern, self._settle, self._is_ignored = pattern, settle, not existing
        self._kind: tuple[str, ...] = ()  # endings of the shots, if the pattern has none
        # Size and time of each shot's file, and when they were seen first.
        self._seen: dict[str, tuple[tuple[int, int], float]] = {}
        self._complete: set[str] = set()
        self._folder_id = _identity(folder)
        self._next_look = 0.0

    @property
    def is_quiet(self) -> bool:
        """Whether no file is waiting or being written."""
        return not self.waiting and len(self._complete) == len(self._seen)

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
            files = _stamps_in(self.folder)
        except OSError as error:
            raise self._folder_error(error) from None
        stamps = {name: stamp for name, stamp in files.items() if self.matches(name)}
        self.left_out = count_endings(files.keys() - stamps.keys())
        before, self._seen = self._seen, {}
        for name, stamp in stamps.items():
            earlier, since = before.get(name, (None, began))
            self._seen[name] = stamp, since if earlier == stamp else began
            if earlier != stamp:
                self._complete.discard(name)
                if self._is_ignored:
                    self._complete.add(name)
                else:
                    self.last_change = began
        self._complete &= stamps.keys()
        self._is_ignored = False
        self.waiting = [name for name in self.waiting if name in self._complete]
        settled = [name for name, (_, since) in self._seen.items() if began >= since + self._settle]
        ready = map(Path, set(settled) - self._complete)
        for name in map(str, in_counting_order(ready)):
            self._complete.add(name)
            self.waiting.append(name)
        # To look at very many files takes long, and must not take all the time.
        ended = time.monotonic()
        self._next_look = ended + max(self.poll_s, 5 * (ended - began))

    def look_again(self, name: str) -> None:
        """Let a file wait once more."""
        self._complete.discard(name)

    def check(self) -> None:
        """Raise an error if the folder no longer exists, or another is in its place."""
        try:
            if _identity(self.folder) != self._folder_id:
                raise FileNotFoundError(2, "it was removed, or moved")
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
