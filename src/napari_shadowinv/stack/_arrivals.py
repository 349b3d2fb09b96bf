"""Files that arrive in a folder, found by looking into it again and again: `Arrivals`."""

from __future__ import annotations

import fnmatch
import os
import time
from collections import Counter
from contextlib import suppress
from pathlib import Path

from napari_shadowinv._system.safety import resolved_path
from napari_shadowinv.errors import FileFormatError, InputError
from napari_shadowinv.io.files import in_counting_order
from napari_shadowinv.io.frames import count_endings, images_in, spellings


class Arrivals:
    """Files of a folder that are complete.

    A file is complete once its size and time have not changed for `settle` seconds, and again
    after each later change.
    """

    def __init__(self, folder: str | Path, pattern: str, settle: float) -> None:
        if not os.path.isdir(folder):
            state = "is a file" if os.path.exists(folder) else "does not exist"
            raise InputError(f"{folder} {state}: expected a folder to watch; create it first")
        if not pattern or set(pattern) & {"/", os.sep}:
            raise InputError(
                f"the pattern is '{pattern}': expected one for names, such as *.tif; folders "
                "inside the folder are not watched"
            )
        self.folder = resolved_path(Path(folder))
        self.left_out: Counter[str] = Counter()  # files that are no shots, by their endings
        self.last_change = time.monotonic()  # of any file
        self._pattern, self._settle = pattern, settle
        self._kind: tuple[str, ...] = ()  # endings of the shots, if the pattern has none
        # Size and time of each shot's file, when they were seen first, whether it was complete.
        self._seen: dict[str, tuple[tuple[int, int], float, bool]] = {}

    def look(self) -> list[str]:
        """Return the files that have become complete since the last look, in counting order."""
        now = time.monotonic()
        try:
            if not self._kind and (images := images_in(self.folder)):
                self._kind = spellings(images[0].suffix)
            files = _stamps_in(self.folder)
        except OSError as error:
            raise FileFormatError(
                f"the folder {self.folder} cannot be read ({error.strerror}): bring it back, then "
                "watch again to go on"
            ) from None
        stamps = {name: stamp for name, stamp in files.items() if self._matches(name)}
        self.left_out = count_endings(files.keys() - stamps.keys())
        before, self._seen = self._seen, {}
        complete = list[Path]()
        for name, stamp in stamps.items():
            earlier, since, was_complete = before.get(name, (None, now, False))
            if earlier != stamp:
                since, was_complete, self.last_change = now, False, now
            is_complete = now >= since + self._settle
            self._seen[name] = stamp, since, is_complete
            if is_complete and not was_complete:
                complete.append(Path(name))
        return list(map(str, in_counting_order(complete)))

    def _matches(self, name: str) -> bool:
        """Return whether a name belongs to a shot."""
        if not fnmatch.fnmatch(name, self._pattern):
            return False
        has_ending = os.path.splitext(self._pattern)[1]
        return bool(has_ending) or os.path.splitext(name)[1].lower() in self._kind


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
