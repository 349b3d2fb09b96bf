"""What the widgets tell the user: one sentence in napari's notifications, no traceback.

- tell: `tell_error`, `tell_warning`, `tell_info`
- a method whose user's mistakes become notifications: `reporting`
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, TypeVar

from napari.utils.notifications import show_error, show_info, show_warning

from napari_shadowinv.errors import InputError

__all__ = ["MISTAKES", "reporting", "tell_error", "tell_info", "tell_warning"]

Method = TypeVar("Method", bound=Callable[..., Any])

# A user's mistake, a file system that refuses, or no memory; all else is a fault of the
# program's, whose traceback somebody needs.
MISTAKES = (InputError, OSError, MemoryError)


def tell_error(error: BaseException | str) -> None:
    """Say what is wrong and what to do."""
    text = str(error) or "there is not enough memory for this"
    show_error(text[:1].upper() + text[1:])


def tell_warning(text: str) -> None:
    """Say what the user should know."""
    show_warning(text[:1].upper() + text[1:])


def tell_info(text: str) -> None:
    """Say that something was done."""
    show_info(text)


def reporting(method: Method) -> Method:
    """Turn a user's mistake within a method into one notification."""

    @functools.wraps(method)
    def told(*args: Any, **kwargs: Any) -> Any:
        try:
            return method(*args, **kwargs)
        except MISTAKES as error:
            tell_error(error)
            return None

    return told  # type: ignore[return-value]
