"""What napari's user is told: one sentence for a mistake, not a traceback."""

from __future__ import annotations

import functools
import re
import sys
from collections.abc import Callable
from typing import Any, TypeVar

from napari_shadowinv.errors import InputError

MISTAKES = (InputError, OSError, MemoryError)
"""What a user can mend; all else is a fault of the program, whose traceback is needed."""

Answer = TypeVar("Answer")

# Hints for the command line or for Python, and names of options outside such hints.
_HINT = re.compile(r"\s*\([^()]*(?:--[a-z]|\b[a-z_]+=)[^()]*\)")
_OPTION = re.compile(r"--([a-z][a-z-]*)|\b([a-z]+(?:_[a-z]+)+)\b")


def window_text(text: str) -> str:
    """Replace flags and keys of options by the labels of the forms, and leave out hints on them."""

    def label(match: re.Match[str]) -> str:
        key = (match[1] or match[2]).replace("-", "_")
        return f"'{_labels()[key]}'" if key in _labels() else match[0]

    return _OPTION.sub(label, _HINT.sub("", text))


@functools.cache
def _labels() -> dict[str, str]:
    from napari_shadowinv.options import FitChoices, FitOptions, InversionOptions

    return {
        name: str(field.title).partition(" (")[0]
        for model in (FitChoices, FitOptions, InversionOptions)
        for name, field in model.model_fields.items()
        if field.title
    }


def in_event_loop() -> bool:
    """Whether the call comes from a menu, a dialog, napari's console, and not from a script."""
    if "qtpy" not in sys.modules:
        return False
    from qtpy.QtCore import QThread

    thread = QThread.currentThread()
    return thread is not None and thread.loopLevel() > 0


def notify_errors(otherwise: Callable[[], Answer]) -> Callable[..., Callable[..., Answer]]:
    """Turn a user's mistake, in a window, into one notification; `otherwise` makes the answer."""

    def decorate(function: Callable[..., Answer]) -> Callable[..., Answer]:
        @functools.wraps(function)
        def guarded(*args: Any, **kwargs: Any) -> Answer:
            try:
                return function(*args, **kwargs)
            except MISTAKES as error:
                if not in_event_loop():
                    raise
                show_mistake(error)
                return otherwise()

        return guarded

    return decorate


def show_mistake(error: BaseException) -> None:
    """Show a mistake as one notification."""
    from napari.utils.notifications import show_error

    text = window_text(str(error)) or "there is not enough memory for this"
    show_error(text[:1].upper() + text[1:])


def show_caution(text: str) -> None:
    """Show what the user should know before trusting a file."""
    from napari.utils.notifications import show_warning

    show_warning(window_text(text))
