"""Text on the terminal: `plain` makes it harmless, `say` prints it.

Names and messages may come from files of others; a bracket in them is no markup, and an escape
sequence must not reach the terminal.
"""

from __future__ import annotations

import unicodedata
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.table import Table
    from rich.text import Text

# Controls, invisible marks of direction, halves of characters, and ends of lines.
_UNSEEN = {"Cc", "Cf", "Cs", "Zl", "Zp"}


def plain(text: object, style: str = "") -> Text:
    """Text to print as it is, without markup; what cannot be seen becomes a visible escape."""
    from rich.text import Text

    return Text("".join(map(_seen, str(text))), style=style)


def _seen(character: str) -> str:
    if unicodedata.category(character) in _UNSEEN:
        return character.encode("unicode_escape").decode()
    return character


def say(content: str | Table) -> None:
    """Print a sentence or a table."""
    from rich.console import Console

    is_sentence = isinstance(content, str)
    shown = plain(content) if isinstance(content, str) else content
    Console().print(shown, soft_wrap=is_sentence, highlight=False)


def say_on_stderr(text: str) -> None:
    """Print what went wrong, in one line."""
    from rich.console import Console

    line = plain(" ".join(text.split()), "bold red")
    Console(stderr=True).print(line, soft_wrap=True, highlight=False)
