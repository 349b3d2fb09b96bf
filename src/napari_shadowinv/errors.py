"""The errors that a user of the package can meet.

Each message is one sentence (or two) that names the received and the expected
value and the remedy. Everything the package raises for a user's mistake is an
`InputError` or a `FileFormatError`, so a caller needs to catch no more than
``(ValueError, OSError)``.
"""

from __future__ import annotations

from typing import Self


class _UserError(Exception):
    """Base of a user's mistakes; `option` is the one that resolves it, such as overwrite."""

    def __init__(self, *message: object, option: str = "") -> None:
        super().__init__(*message)
        self.option = option

    def about(self, name: object) -> Self:
        """Return the same error with the name of its file or shot in front."""
        return type(self)(f"{name}: {self}", option=self.option)


class InputError(_UserError, ValueError):
    """An argument, image or option that cannot be used."""


class FileFormatError(_UserError, OSError):
    """A file that is missing, damaged, or of another kind than its name says."""


class RunInterruptedError(_UserError, OSError):
    """A run that cannot go on, such as on a full disk; it can be resumed."""


class InversionCancelled(Exception):  # noqa: N818 - it is no error: the user asked for it
    """Raised by the core when `should_stop` returned true."""
