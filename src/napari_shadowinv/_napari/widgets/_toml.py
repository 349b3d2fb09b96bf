"""Parameters as TOML files, the ones that the command line reads.

- write and read values: `dump_toml`, `load_toml`
- two buttons that do so: `TomlButtons`
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from qtpy.QtWidgets import QFileDialog, QHBoxLayout, QPushButton, QWidget

from napari_shadowinv._napari.widgets._notifications import notify_errors
from napari_shadowinv.errors import InputError

__all__ = ["TomlButtons", "dump_toml", "load_toml"]

_FILTER = "TOML (*.toml)"


def dump_toml(values: dict[str, object], path: str | Path) -> Path:
    """Write values as a TOML file, whole or not at all.

    Parameters
    ----------
    values : dict
        Names and numbers, texts or yes/no.
    path : str or Path
        The file; replaced if it exists, for the dialog has asked. Without a suffix it gets
        ``.toml``, which the dialog has not asked about: then an existing file is refused.

    Returns
    -------
    Path
        The file that was written.
    """
    import tomli_w

    from napari_shadowinv.io import replacing

    named = Path(path)
    path = named if named.suffix else named.with_suffix(".toml")
    with replacing(path, overwrite=path == named) as unfinished:
        unfinished.write_text(tomli_w.dumps(values), encoding="utf-8")
    return path


def load_toml(path: str | Path) -> dict[str, object]:
    """Read a TOML file; see `napari_shadowinv.io.read_toml`."""
    from napari_shadowinv.io import read_toml

    return read_toml(path)


class TomlButtons(QWidget):
    """Load… and Save… beside each other.

    Parameters
    ----------
    what : str
        What is saved, for the dialogs' titles and the proposed file's name.
    values : callable
        Returns what is to be saved; raises `InputError` if there is nothing to save.
    take : callable
        Receives what was loaded; raises `InputError` if it cannot be used.
    """

    def __init__(
        self,
        what: str,
        values: Callable[[], dict[str, object]],
        take: Callable[[dict[str, object], str], None],
    ) -> None:
        super().__init__()
        self._what, self._values, self._take = what, values, take
        row = QHBoxLayout(self)
        row.setContentsMargins(0, 0, 0, 0)
        self.load_button = QPushButton("Load…")
        self.save_button = QPushButton("Save…")
        self.load_button.setToolTip(f"Read {what} from a TOML file.")
        self.save_button.setToolTip(
            f"Write {what} to a TOML file, to reuse here or on the command line."
        )
        for button in (self.load_button, self.save_button):
            row.addWidget(button)
        row.addStretch(1)
        self.load_button.clicked.connect(lambda: self._load())
        self.save_button.clicked.connect(lambda: self._save())

    @notify_errors
    def _load(self) -> None:
        path, _ = QFileDialog.getOpenFileName(self, f"Load {self._what}", "", _FILTER)
        if path:
            self._take(load_toml(path), path)

    @notify_errors
    def _save(self) -> None:
        values = self._values()
        if not values:
            raise InputError(f"there is no {self._what} to save: choose one first")
        path, _ = QFileDialog.getSaveFileName(
            self, f"Save {self._what}", f"{self._what}.toml", _FILTER
        )
        if path:
            dump_toml(values, path)
