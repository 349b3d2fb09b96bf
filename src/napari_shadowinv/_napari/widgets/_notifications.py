"""What the widgets tell the user: one sentence in napari's notifications, no traceback.

- tell: `tell_error`, `tell_warning`, `tell_info`; the sentence itself: `error_text`
- a method whose user's mistakes become notifications, and stay in its widget: `notify_errors`
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, TypeVar

from napari.utils.notifications import show_error, show_info, show_warning

from napari_shadowinv.errors import InputError

__all__ = ["MISTAKES", "error_text", "notify_errors", "tell_error", "tell_info", "tell_warning"]

Method = TypeVar("Method", bound=Callable[..., Any])

# A user's mistake, a file system that refuses, or no memory; all else is a fault of the
# program's, whose traceback somebody needs.
MISTAKES = (InputError, OSError, MemoryError)


def error_text(error: BaseException | str) -> str:
    """What is wrong and what to do; of a fault of the program's, at least its name."""
    text = str(error)
    if isinstance(error, MemoryError) and not text:
        text = "there is not enough memory for this"
    elif not isinstance(error, (str, *MISTAKES)):
        first = text.partition("\n")[0]
        text = f"internal error: {type(error).__name__}: {first} (see the notification)"
    return text[:1].upper() + text[1:]


def tell_error(error: BaseException | str) -> None:
    """Say what is wrong and what to do."""
    show_error(error_text(error))


def tell_warning(text: str) -> None:
    """Say what the user should know."""
    show_warning(text[:1].upper() + text[1:])


def tell_info(text: str) -> None:
    """Say that something was done."""
    show_info(text)


def notify_errors(method: Method) -> Method:
    """Turn a user's mistake within a widget's method into one notification.

    The widget, or the first around it that can, also shows it: with a method `show_problem`.
    """

    @functools.wraps(method)
    def told(*args: Any, **kwargs: Any) -> Any:
        try:
            return method(*args, **kwargs)
        except MISTAKES as error:
            tell_error(error)
            _show_within(args[0], error_text(error))
            return None

    return told  # type: ignore[return-value]


def _show_within(widget: Any, text: str) -> None:
    while widget is not None:
        show = getattr(widget, "show_problem", None)
        if show is not None:
            show(text)
            return
        widget = widget.parent()
