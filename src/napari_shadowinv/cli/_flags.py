"""Arguments and flags that commands share, each with its name and help.

The flags of steps, source estimates and options follow from the models: `takes_recipe` adds them
to a command, and `recipe_of` overrides a recipe with their values. `takes_fit` and
`fit_recipe_of` do the same for a fit. Help shows examples first and the common flags on one
screen, all of them with --help-all.
"""

from __future__ import annotations

import functools
import inspect
import re
import shutil
import textwrap
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any, Literal, get_args, get_origin

from pydantic import BaseModel
from pydantic.fields import FieldInfo
from typer import Argument, Option
from typer.core import TyperCommand, TyperGroup

from napari_shadowinv._system.validation import Model, lower_first, suggestion, validate
from napari_shadowinv.errors import InputError
from napari_shadowinv.io.formats import IMAGE_TITLES
from napari_shadowinv.options import FitChoices, FitOptions, Instrument, InversionOptions
from napari_shadowinv.physics.trace_options import GridView, SizedView, TraceOptions
from napari_shadowinv.pipeline.experiment_options import ExperimentOptions
from napari_shadowinv.preprocessing import ESTIMATES, FIT_STEPS, STEPS, Recipe, Step

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
    if default is None or callable(default) or isinstance(default, bool) or "Default:" in text:
        return text
    return f"{text} Default: {default}."


def _first_sentence(text: str | None) -> str:
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
        lines = _wrap(text, width - len(indent)) or [""]
        if len(name) < _NAME_COLUMNS:
            yield f"  {name:<{_NAME_COLUMNS}}{lines.pop(0)}".rstrip()
        else:
            yield f"  {name}"
        yield from (f"{indent}{line}" for line in lines)


_STEPS = "Steps before the inversion, in this order"
_ESTIMATES = "Source estimated from the image (docs/sources.md)"
_INSTRUMENT = "How well the instrument is known (docs/uncertainty.md)"
_OPTIONS = "Options of the inversion"
_FIT_STEPS = "Steps before the fit, in this order"
_FIT_CHOICES = "Unknowns and data of the fit"
_FIT_OPTIONS = "Options of the fit"
_TRACE = "A 3-D field (docs/tracing.md)"

# Help of flags, where it is longer than a line.
_HELP = {
    "recipe": "TOML file with all steps, files and options; flags override it.",
    "save_recipe": "Write all steps, files and options to a TOML file for --recipe.",
    "setup": "TOML file with the experimental geometry, for results in SI units.",
    "channel": "Channel of a colour image: red, green, blue, mean or an index from 0.",
    "variable": "Name of the array in an HDF5 file, or in a MATLAB file with several images; for a "
    "CR-39 scan, the tracks to count, such as 'diameter=4:12 contrast=:40 bin=300'.",
    "shots": "Shots to use, counted from 0: 3, 3:20, ::10 or 1,4,9. Default: all finished shots.",
    "source_mask": "Image of the same size, 0 where the object covers the beam.",
    "figure": "Figure file: .png, .pdf or .svg. Default: a PNG next to the result.",
}

argument = partial(Argument, show_default=False)

ImageFile = Annotated[Path, argument(help=f"{IMAGE_TITLES}; run.h5::/name for an array.")]
StoreFolder = Annotated[Path, argument(help="name.shadowinv.zarr, from shadowinv batch.")]
SourceFile = Annotated[Path | None, Option(help="Image of the undisturbed beam. Default: uniform.")]
MaskFile = Annotated[Path | None, Option(help="Image of the same size, 0 at unusable pixels.")]
RecipeFile = Annotated[Path | None, Option(help=_HELP["recipe"])]
SaveRecipe = Annotated[Path | None, Option(help=_HELP["save_recipe"])]
SetupFile = Annotated[Path | None, Option(help=_HELP["setup"])]
OptionsFile = Annotated[Path | None, Option(help="TOML file with inversion options.")]
Channel = Annotated[str | None, Option(help=_HELP["channel"])]
Variable = Annotated[str | None, Option(metavar="NAME", help=_HELP["variable"])]
ChosenShots = Annotated[str | None, Option(help=_HELP["shots"])]
ClipNegative = Annotated[
    bool, Option("--clip-negative", help="Set negative pixels to zero and count them.")
]
SourceMask = Annotated[Path | None, Option(help=_HELP["source_mask"], rich_help_panel=_ESTIMATES)]
Figure = Annotated[Path | None, Option(help=_HELP["figure"])]
Overwrite = Annotated[bool, Option("--overwrite", help="Replace existing files.")]
Quiet = Annotated[bool, Option("--quiet", "-q", help="Print errors only.")]
QuietInversion = Annotated[bool, Option("--quiet", "-q", help="Print errors and warnings only.")]


Flags = dict[str, inspect.Parameter]


def _type_of(field: FieldInfo) -> tuple[Any, str | None]:
    """Return the type of a flag, and the placeholder for its value in the help."""
    annotation: Any = field.annotation
    kinds = [kind for kind in get_args(annotation) or (annotation,) if kind is not type(None)]
    choices = next((kind for kind in (annotation, *kinds) if get_origin(kind) is Literal), None)
    if choices is not None:
        return str, "|".join(get_args(choices))
    if kinds == [bool]:
        return bool, None
    if len(kinds) == 1 and kinds[0] in (int, float):
        unit = re.search(r"\((.*)\)$", field.title or "")
        return kinds[0], unit[1].upper() if unit else None
    return str, "FIRST:LAST" if kinds[0] is not str else None


def _extra(field: FieldInfo, key: str, default: str | None) -> Any:
    """Return an entry that a field has for its flag."""
    extra = field.json_schema_extra
    return extra.get(key, default) if isinstance(extra, dict) else default


def _flag(
    flag: str, field: FieldInfo, panel: str | None, text: str
) -> tuple[str, inspect.Parameter]:
    kind, metavar = _type_of(field)
    metavar = _extra(field, "metavar", metavar) or None
    name = f"--{flag}/--no-{flag}" if kind is bool and field.default else f"--{flag}"
    option = Option(name, help=text, metavar=metavar, rich_help_panel=panel)
    name = flag.replace("-", "_")
    annotation = Annotated[kind | None, option]  # type: ignore[valid-type]
    keyword = inspect.Parameter.KEYWORD_ONLY
    return name, inspect.Parameter(name, keyword, default=None, annotation=annotation)


def _step_flag(step: type[Step], parameter: str) -> str:
    return step.name() if parameter == step.primary else f"{step.name()}-{parameter}"


def _estimate_flag(parameter: str) -> str:
    return f"source-{_option_flag(parameter)}"


def _option_flag(name: str) -> str:
    return name.replace("_", "-")


def flag_names(model: type[BaseModel]) -> dict[str, str]:
    """Return the flags of a model's fields, by which errors call them."""
    flag: Callable[[str], str] = _option_flag
    if issubclass(model, Step):
        flag = partial(_step_flag, model)
    elif model in ESTIMATES.values():
        flag = _estimate_flag
    return {name: f"--{flag(name)}" for name in model.model_fields}


def _step_flags(steps: Iterable[type[Step]], panel: str) -> Flags:
    return dict(
        _flag(_step_flag(step, name), field, panel, _step_help(step, name, field))
        for step in steps
        for name, field in step.parameters().items()
    )


def _option_flags(
    model: type[BaseModel], default_panel: str | None, without: Collection[str] = ()
) -> Flags:
    """Return the flags of a model's fields; a field may name its own panel."""
    return dict(
        _flag(_option_flag(name), field, _extra(field, "panel", default_panel), _field_help(field))
        for name, field in model.model_fields.items()
        if name not in without
    )


def _estimate_flags() -> Flags:
    method = FieldInfo(annotation=str | None, title="Source")
    text = f"How to estimate the undisturbed beam: {', '.join(ESTIMATES)}."
    flags = [_flag("source-from", method, _ESTIMATES, text)]
    for name in dict.fromkeys(n for method in ESTIMATES.values() for n in method.parameters()):
        fields = {key: method.parameters()[name] for key, method in _estimates_with(name).items()}
        text = " ".join(f"For {key}: {lower_first(_field_help(f))}" for key, f in fields.items())
        field = next(iter(fields.values()))
        flags.append(_flag(_estimate_flag(name), field, _ESTIMATES, text))
    return dict(flags)


def _field_help(field: FieldInfo) -> str:
    text = str(field.description)
    shows_default = field.default is not None and field.default is not False
    return f"{text} Default: {_default_text(field)}." if shows_default else text


def _estimates_with(parameter: str) -> dict[str, Any]:
    return {key: method for key, method in ESTIMATES.items() if parameter in method.parameters()}


def _step_help(step: type[Step], name: str, field: FieldInfo) -> str:
    title = f"{step.title[:1].upper()}{step.title[1:]}"
    text = lower_first(str(field.description))
    if not step.primary or name == step.primary:
        return f"{title}: {text}"
    return f"For --{step.name()}: {text} Default: {_default_text(field)}."


def _default_text(field: FieldInfo) -> str:
    return f"{field.default:g}" if isinstance(field.default, float) else str(field.default)


def takes_run(
    model: type[BaseModel], inputs: Callable[..., dict[str, Any]]
) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Add flags of a run and a recipe, and the parameters of `inputs`, to a command.

    The command receives the choices of the run as `run`, a `model`, and what `inputs` returns.
    """
    shared = _command_parameters(inputs)

    def decorate(command: Callable[..., None]) -> Callable[..., None]:
        @functools.wraps(command)
        def with_inputs(*, flags: dict[str, Any], **arguments: Any) -> None:
            run = choices_of(model, flags)
            flags = {key: value for key, value in flags.items() if key not in model.model_fields}
            files = {parameter.name: arguments.pop(parameter.name) for parameter in shared}
            command(**arguments, run=run, **inputs(**files, run=run, flags=flags))

        with_inputs.__signature__ = inspect.Signature(  # type: ignore[attr-defined]
            [*_command_parameters(command), *shared]
        )
        return _with_flags(with_inputs, _option_flags(model, None) | _RECIPE_FLAGS)

    return decorate


def _with_flags(command: Callable[..., None], additions: Flags) -> Callable[..., None]:
    """Add flags to a command with the argument `flags`."""

    @functools.wraps(command)
    def with_flags(**arguments: Any) -> None:
        flags = {name: arguments.pop(name) for name in additions}
        command(**arguments, flags={name: x for name, x in flags.items() if x is not None})

    with_flags.__signature__ = inspect.Signature(  # type: ignore[attr-defined]
        [*_command_parameters(command), *additions.values()]
    )
    with_flags.__annotations__ = {}
    return with_flags


def _command_parameters(command: Callable[..., Any]) -> list[inspect.Parameter]:
    """Return the parameters of a command that are arguments and flags, as keywords."""
    return [
        parameter.replace(kind=inspect.Parameter.KEYWORD_ONLY)
        for parameter in inspect.signature(command, eval_str=True).parameters.values()
        if get_origin(parameter.annotation) is Annotated
    ]


_INSTRUMENT_FLAGS = _option_flags(Instrument, _INSTRUMENT)
_RECIPE_FLAGS = (
    _step_flags(STEPS.values(), _STEPS)
    | _estimate_flags()
    | _INSTRUMENT_FLAGS
    | _option_flags(InversionOptions, _OPTIONS)
)
_FIT_FLAGS = (
    _step_flags(FIT_STEPS.values(), _FIT_STEPS)
    # The command has its own --source and --brightness.
    | _option_flags(FitChoices, _FIT_CHOICES, without=("beam", "brightness", "options"))
    | _INSTRUMENT_FLAGS
    | _option_flags(FitOptions, _FIT_OPTIONS)
)
_TRACE_FLAGS = _option_flags(SizedView, _TRACE)
_TRACE_FLAGS |= _option_flags(TraceOptions, _TRACE, ["keep_particles"])  # an image holds none
_PLAN_FLAGS = (
    _option_flags(ExperimentOptions, None) | _option_flags(GridView, _TRACE) | _INSTRUMENT_FLAGS
)
takes_recipe = partial(_with_flags, additions=_RECIPE_FLAGS)
takes_fit = partial(_with_flags, additions=_FIT_FLAGS)
takes_trace = partial(_with_flags, additions=_TRACE_FLAGS)
takes_plan = partial(_with_flags, additions=_PLAN_FLAGS)


def recipe_of(flags: Mapping[str, Any], base: Recipe, options: Path | None = None) -> Recipe:
    """Override a recipe with an options file and with flags."""
    before = base.options.model_dump(exclude_unset=True)
    inversion_options = choices_of(InversionOptions, flags, before, options)
    if "margin" in flags and inversion_options.boundary != "free":
        raise InputError("received --margin: it needs --boundary free")
    changes = {
        "steps": _steps(flags, base.steps),
        "source": _estimate(flags, base),
        "instrument": choices_of(Instrument, flags, base.instrument.stated),
        "options": inversion_options,
    }
    return base.model_copy(update=changes)


def fit_recipe_of(flags: Mapping[str, Any], base: Recipe, options: Path | None = None) -> Recipe:
    """Override a recipe with an options file and with flags of a fit."""
    before = base.fit or FitChoices()
    stated = before.options.model_dump(exclude_unset=True)
    fit_options = choices_of(FitOptions, flags, stated, options)
    changes = {name: flags[name] for name in FitChoices.model_fields if name in flags}
    values = before.model_dump(exclude_none=True, exclude={"options"})
    # A point spread in px replaces one in m, and the other way round.
    in_metres = {"source_size", "resolution"}
    replaced = in_metres if "psf" in changes else {"psf"} if changes.keys() & in_metres else set()
    values = {name: value for name, value in values.items() if name not in replaced}
    choices = validate(
        FitChoices, {**values, **changes, "options": fit_options}, "", flag_names(FitChoices)
    )
    changes = {
        "steps": _steps(flags, base.steps),
        "instrument": choices_of(Instrument, flags, base.instrument.stated),
        "fit": choices,
    }
    return base.model_copy(update=changes)


def choices_of(
    model: type[Model],
    flags: Mapping[str, Any],
    before: Mapping[str, Any] = MappingProxyType({}),
    file: Path | None = None,
) -> Model:
    """Override the values of a model with a file of them, and with flags."""
    from napari_shadowinv.io import read_toml

    content = {} if file is None else read_toml(file)
    chosen = {name: flags[name] for name in model.model_fields if name in flags}
    of_file = content.keys() - chosen.keys()
    names = flag_names(model) | {name: f"'{name}' in {file}" for name in of_file}
    return validate(model, {**before, **content, **chosen}, "", names)


def _steps(flags: Mapping[str, Any], steps: tuple[Step, ...]) -> tuple[Step, ...]:
    """Change the steps of a recipe as flags say, and insert new ones in the standard order."""
    order = list(STEPS)
    result = list(steps)
    for key, kind in STEPS.items():
        names = {name: _step_flag(kind, name).replace("-", "_") for name in kind.parameters()}
        changes = {name: flags[flag] for name, flag in names.items() if flag in flags}
        if not changes:
            continue
        index = next((i for i, step in enumerate(result) if isinstance(step, kind)), None)
        if index is None and kind.primary and kind.primary not in changes:
            flag = _step_flag(kind, next(iter(changes)))
            raise InputError(f"received --{flag}: it needs --{key}")
        before = {} if index is None else result[index].values()
        step = validate(kind, {**before, **changes}, "", flag_names(kind))
        if index is None:
            later = [i for i, s in enumerate(result) if order.index(s.name()) > order.index(key)]
            result.insert(later[0] if later else len(result), step)
        else:
            result[index] = step
    return tuple(result)


def _estimate(flags: Mapping[str, Any], base: Recipe) -> Any:
    """Return the source that flags ask for, or the recipe's with other parameters."""
    changes = {
        name: flags[f"source_{name}"]
        for estimate in ESTIMATES.values()
        for name in estimate.parameters()
        if f"source_{name}" in flags
    }
    method = flags.get("source_from")
    if method is None and not changes:
        return base.source
    if method is None:
        method = "" if base.estimate is None else base.estimate.name()
    elif method not in ESTIMATES:
        raise InputError(f"--source-from is '{method}': {suggestion(method, ESTIMATES)}")
    for name in changes:
        methods = _estimates_with(name)
        if method not in methods:
            choices = " or ".join(f"--source-from {key}" for key in methods)
            raise InputError(f"received --{_estimate_flag(name)}: it needs {choices}")
    before = base.estimate.values() if base.estimate and base.estimate.name() == method else {}
    estimate = ESTIMATES[method]
    return validate(estimate, {**before, **changes}, "", flag_names(estimate))
