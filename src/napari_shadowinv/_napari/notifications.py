"""Messages to napari's user: a sentence for a user's error instead of a traceback."""

from __future__ import annotations

import functools
import re
import sys
from collections.abc import Callable
from typing import Any, TypeVar

from napari_shadowinv.errors import InputError

USER_ERRORS = (InputError, OSError, MemoryError)
"""Errors that a user can resolve; all others are bugs, whose traceback is needed."""

ReturnValue = TypeVar("ReturnValue")

# Hints for the command line or Python, and names of options elsewhere.
_HINT = re.compile(r"\s*\([^()]*(?:--[a-z]|\b[a-z_]+=)[^()]*\)")
_OPTION = re.compile(r"--([a-z][a-z-]*)|\b([a-z]+(?:_[a-z]+)+)\b")


def window_text(text: str) -> str:
    """Replace flags and keys of options by their labels in the forms, and remove hints on them."""

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
    """Whether the call comes from a menu, a dialog or napari's console, not from a script."""
    if "qtpy" not in sys.modules:
        return False
    from qtpy.QtCore import QThread

    thread = QThread.currentThread()
    return thread is not None and thread.loopLevel() > 0


def notify_errors(
    otherwise: Callable[[], ReturnValue],
) -> Callable[..., Callable[..., ReturnValue]]:
    """Show a user's error in a window as a notification, and return `otherwise()`."""

    def decorate(function: Callable[..., ReturnValue]) -> Callable[..., ReturnValue]:
        @functools.wraps(function)
        def guarded(*args: Any, **kwargs: Any) -> ReturnValue:
            try:
                return function(*args, **kwargs)
            except USER_ERRORS as error:
                if not in_event_loop():
                    raise
                show_user_error(error)
                return otherwise()

        return guarded

    return decorate


def show_user_error(error: BaseException) -> None:
    """Show a user's error as a notification."""
    from napari.utils.notifications import show_error

    text = window_text(str(error)) or "there is not enough memory for this"
    show_error(text[:1].upper() + text[1:])


def show_caution(text: str) -> None:
    """Show a warning as a notification."""
    from napari.utils.notifications import show_warning

    show_warning(window_text(text))
