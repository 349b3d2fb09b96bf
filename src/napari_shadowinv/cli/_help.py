"""Help of the commands: examples first, the common flags on one screen, all with --help-all."""

from __future__ import annotations

import re
import shutil
import textwrap
from collections.abc import Iterable, Iterator
from typing import Any

from typer.core import TyperCommand, TyperGroup

HELP_NAMES = ("-h", "--help", "--help-all")

_MIN_COLUMNS, _MAX_COLUMNS = 60, 100
_NAME_COLUMNS = 24  # longer flags have a line of their own
_SHORT_EXAMPLES = 3
_KINDS = {"path": "FILE", "str": "TEXT", "text": "TEXT", "int": "N", "integer": "N"}
_KINDS |= {"integer range": "N", "float": "X", "float range": "X", "bool": "", "boolean": ""}
_SHOW_HELP = "Show this page; --help-all shows all flags."


class HelpfulCommand(TyperCommand):
    """Command with a short page of help, and a complete one."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        ctx.meta["help-all"] = "--help-all" in args
        return list(super().parse_args(ctx, args))

    def format_help(self, ctx: Any, formatter: Any) -> None:
        is_complete = bool(ctx.meta.get("help-all"))
        formatter.write("\n".join(_command_lines(self, ctx, is_complete)) + "\n")


class HelpfulGroup(TyperGroup):
    """Program with a list of its commands."""

    def format_help(self, ctx: Any, formatter: Any) -> None:
        width = _columns()
        lines = [f"Usage: {ctx.command_path} COMMAND", "", *_wrap(self.help, width)]
        commands = {name: self.get_command(ctx, name) for name in self.list_commands(ctx)}
        rows = [(name, _first_sentence(c.help)) for name, c in commands.items() if c]
        lines += ["", "Commands", *_table(rows, width)]
        lines += ["", "Options", *_table(_rows(self.get_params(ctx), ctx), width)]
        lines += ["", *_wrap(f"Help on a command: {ctx.command_path} COMMAND -h", width)]
        formatter.write("\n".join(lines) + "\n")


def _command_lines(command: Any, ctx: Any, is_complete: bool) -> Iterator[str]:
    """Yield the help of a command: the common flags, or all of it."""
    width = _columns()
    sections = _sections(command.epilog)
    arguments, panels = _by_panel(command.get_params(ctx))
    names = " ".join(map(_argument_name, arguments))
    yield f"Usage: {ctx.command_path} [OPTIONS] {names}".rstrip()
    yield ""
    summary, *details = (command.help or "").split("\n\n")
    for text in (summary, *(details if is_complete else ())):
        yield from _wrap(text, width)
    examples = sections.pop("Examples", [])
    positional, common = _rows(arguments, ctx), _rows(panels.pop("", []), ctx)
    if not is_complete:
        examples = [line for line in examples if len(line) <= width - 2][:_SHORT_EXAMPLES]
        text_width = width - _NAME_COLUMNS - 2
        positional = [(name, _shorten(text, 2 * text_width)) for name, text in positional]
        common = [(name, _shorten(text, text_width)) for name, text in common]
    if examples:
        yield from ("", "Examples", *(f"  {line}" for line in examples))
    if positional:
        yield from ("", *_table(positional, width))
    yield from ("", "Options", *_table(common, width))
    if not is_complete:
        hidden = [f"{_strip_remark(title)} ({len(flags)} flags)" for title, flags in panels.items()]
        hidden += [_strip_remark(title) for title in sections]
        if hidden:
            yield from ("", *_wrap(f"--help-all also shows: {'; '.join(hidden)}", width))
        return
    for title, flags in panels.items():
        yield from ("", title, *_table(_rows(flags, ctx), width))
    for title, lines in sections.items():
        yield from ("", title, *(f"  {line}".rstrip() for line in lines))


def _columns() -> int:
    return min(max(shutil.get_terminal_size().columns, _MIN_COLUMNS), _MAX_COLUMNS)


def _sections(epilog: str | None) -> dict[str, list[str]]:
    """Split an epilog into its sections; a title is in bold."""
    sections: dict[str, list[str]] = {}
    lines: list[str] = []
    for line in (epilog or "").replace("\\[", "[").strip().splitlines():
        title = re.match(r"\[bold\](.*?)\[/bold\](.*)", line)
        if title:
            lines = sections.setdefault(title[1] + title[2], [])
        else:
            lines.append(line)
    for lines in sections.values():
        while lines and not lines[-1]:
            lines.pop()
    return sections


def _by_panel(parameters: Iterable[Any]) -> tuple[list[Any], dict[str, list[Any]]]:
    """Return the arguments, and the flags by panel; the common flags have no panel."""
    arguments: list[Any] = []
    panels: dict[str, list[Any]] = {"": []}
    for parameter in parameters:
        if getattr(parameter, "hidden", False):
            continue
        if parameter.param_type_name == "argument":
            arguments.append(parameter)
        else:
            title = getattr(parameter, "rich_help_panel", None) or ""
            panels.setdefault(title, []).append(parameter)
    return arguments, panels


def _strip_remark(title: str) -> str:
    """Remove a remark in brackets from a title."""
    return re.sub(r" \(.*\)", "", title).strip()


def _rows(parameters: Iterable[Any], ctx: Any) -> list[tuple[str, str]]:
    rows = []
    for parameter in parameters:
        if parameter.param_type_name == "argument":
            name, text = _argument_name(parameter).strip("[]"), parameter.help or ""
        elif set(parameter.opts) & set(HELP_NAMES):
            name, text = "-h, --help", _SHOW_HELP
        else:
            flags = sorted((*parameter.opts, *parameter.secondary_opts), key=len)
            name = f"{', '.join(flags)} {_kind(parameter, ctx)}".rstrip()
            text = _with_default(parameter)
        rows.append((name, text))
    return rows


def _argument_name(argument: Any) -> str:
    name = (argument.metavar or argument.name or "").upper().strip("[]")
    name += "..." if argument.nargs == -1 and not name.endswith("...") else ""
    return name if argument.required else f"[{name}]"


def _kind(option: Any, ctx: Any) -> str:
    """Return the placeholder for the value of a flag; a switch has none."""
    if getattr(option, "is_flag", False) or getattr(option, "is_bool_flag", False):
        return ""
    if option.metavar:
        return str(option.metavar)
    kind = getattr(option, "type", None)
    name = getattr(kind, "name", "") or _annotation_name(option)
    return _KINDS.get(str(name).lower(), str(name).upper())


def _annotation_name(option: Any) -> str:
    descriptor = getattr(option, "type_descriptor", None)
    return str(getattr(getattr(descriptor, "annotation", None), "__name__", "text"))


def _with_default(option: Any) -> str:
    """Return the help of a flag, and its default if the text does not contain it."""
    text = option.help or ""
    default = option.default
    is_switch = isinstance(default, bool)
    if default is None or callable(default) or is_switch or "Default:" in text:
        return text
    return f"{text} Default: {default}."


def _first_sentence(text: str | None) -> str:
    """Return the first sentence of a text."""
    plain = " ".join((text or "").split())
    end = re.search(r"(?<=[a-z0-9)%'])[.](?= [A-Z])", plain)
    return plain if end is None else plain[: end.end()]


def _shorten(text: str, length: int) -> str:
    """Cut a text at the end of a clause, or else of a word."""
    sentence = _first_sentence(text)
    if len(sentence) <= length:
        return sentence
    clauses = [match.start() for match in re.finditer(r"[;:] | \(", sentence[: length - 2])]
    if clauses and clauses[-1] > length / 4:
        return f"{sentence[: clauses[-1]]} …"
    return textwrap.shorten(sentence, length, placeholder=" …")


def _wrap(text: str | None, width: int) -> list[str]:
    return textwrap.wrap(" ".join((text or "").split()), width, break_long_words=False)


def _table(rows: Iterable[tuple[str, str]], width: int) -> Iterator[str]:
    """Lay out names and texts side by side, the text below a name that is too long."""
    for name, text in rows:
        indent = " " * (_NAME_COLUMNS + 2)
        lines = textwrap.wrap(
            " ".join(text.split()), width - len(indent), break_long_words=False
        ) or [""]
        if len(name) < _NAME_COLUMNS:
            yield f"  {name:<{_NAME_COLUMNS}}{lines.pop(0)}".rstrip()
        else:
            yield f"  {name}"
        yield from (f"{indent}{line}" for line in lines)
