"""Arguments and options that commands share, each with its name and help.

Those of steps, estimates of the source and options are made from the models: `takes_recipe` gives
them to a command, and `recipe_of` makes a recipe of those that were given. `takes_fit` and
`fit_recipe_of` do the same for a fit.
"""

from __future__ import annotations

import functools
import inspect
import re
from collections.abc import Callable, Collection, Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, get_args, get_origin

from pydantic import BaseModel
from pydantic.fields import FieldInfo
from typer import Argument, Option

from napari_shadowinv._system.validation import nearest, validated
from napari_shadowinv.errors import InputError
from napari_shadowinv.io.formats import IMAGE_TITLES
from napari_shadowinv.options import FitChoices, FitOptions, InversionOptions
from napari_shadowinv.preprocessing import ESTIMATES, FIT_STEPS, STEPS, Recipe, Step

_STEPS = "Steps before the inversion, in this order"
_ESTIMATES = "Source estimated from the image (docs/sources.md)"
_OPTIONS = "Options of the inversion"
_FIT_STEPS = "Steps before the fit, in this order"
_FIT_CHOICES = "What the fit finds and what is known"
_FIT_OPTIONS = "Options of the fit"

ImageFile = Annotated[
    Path, Argument(help=f"{IMAGE_TITLES}; with --variable, any HDF5 file.", show_default=False)
]
StoreFolder = Annotated[
    Path, Argument(help="name.shadowinv.zarr, from shadowinv batch.", show_default=False)
]
SourceFile = Annotated[
    Path | None, Option("--source", help="Image of the undisturbed beam. Default: uniform.")
]
MaskFile = Annotated[
    Path | None, Option("--mask", help="Image of the same size, 0 at unusable pixels.")
]
RecipeFile = Annotated[
    Path | None,
    Option(
        "--recipe",
        help="TOML file with everything that is done to a shot; flags override what it says.",
    ),
]
SaveRecipe = Annotated[
    Path | None,
    Option("--save-recipe", help="Write what was done as a TOML file for --recipe, or napari."),
]
SetupFile = Annotated[
    Path | None,
    Option("--setup", help="TOML file with the experimental geometry, for results in SI units."),
]
OptionsFile = Annotated[Path | None, Option("--options", help="TOML file with inversion options.")]
Channel = Annotated[
    str | None, Option(help="Channel of a colour image: red, green, blue, mean or an index from 0.")
]
Variable = Annotated[
    str | None,
    Option(
        "--variable",
        metavar="NAME",
        help="Name of the array in an HDF5 file, or in a MATLAB file with several images; of a "
        "CR-39 scan the tracks to count, such as 'diameter=4:12 contrast=:40 bin=300'.",
    ),
]
SourceVariable = Annotated[
    str | None,
    Option(
        metavar="NAME",
        help="Name of the array with the undisturbed beam, in the --source file or else in the "
        "image file.",
    ),
]
ChosenShots = Annotated[
    str | None,
    Option(
        "--shots",
        help="Shots to use, counted from 0: 3, 3:20, ::10 or 1,4,9. Default: all finished shots.",
    ),
]
ClipNegative = Annotated[
    bool, Option("--clip-negative", help="Set negative pixels to zero and count them.")
]
SourceMask = Annotated[
    Path | None,
    Option(
        help="Image of the same size, 0 where the object covers the beam.",
        rich_help_panel=_ESTIMATES,
    ),
]
Result = Annotated[
    Path | None,
    Option(
        help="Result file: .shadowinv (complete), .h5 (pradformat) or .csv (sites). Default: the "
        "image's name with .shadowinv, in the current folder."
    ),
]
Figure = Annotated[
    Path | None, Option(help="Figure file: .png, .pdf or .svg. Default: a PNG next to the result.")
]
Overwrite = Annotated[bool, Option("--overwrite", help="Replace existing files.")]
Quiet = Annotated[bool, Option("--quiet", "-q", help="Print errors only.")]
QuietInversion = Annotated[bool, Option("--quiet", "-q", help="Print errors and warnings only.")]


def _type_of(field: FieldInfo) -> tuple[Any, str | None]:
    """Type of a flag, and what stands for its value in the help."""
    annotation: Any = field.annotation
    kinds = [kind for kind in get_args(annotation) or (annotation,) if kind is not type(None)]
    if get_origin(annotation) is Literal:
        return str, "|".join(get_args(annotation))
    if kinds == [bool]:
        return bool, None
    if len(kinds) == 1 and kinds[0] in (int, float):
        unit = re.search(r"\((.*)\)$", field.title or "")
        return kinds[0], unit[1].upper() if unit else None
    return str, "FIRST:LAST" if kinds[0] is not str else None


def _flag(flag: str, field: FieldInfo, panel: str, told: str) -> tuple[str, inspect.Parameter]:
    kind, metavar = _type_of(field)
    extra = field.json_schema_extra
    if isinstance(extra, dict):
        metavar = str(extra.get("metavar", metavar or "")) or None
    option = Option(f"--{flag}", help=told, metavar=metavar, rich_help_panel=panel)
    name = flag.replace("-", "_")
    annotation = Annotated[kind | None, option]  # type: ignore[valid-type]
    keyword = inspect.Parameter.KEYWORD_ONLY
    return name, inspect.Parameter(name, keyword, default=None, annotation=annotation)


def _step_flag(step: type[Step], parameter: str) -> str:
    return step.name() if parameter == step.primary else f"{step.name()}-{parameter}"


Flags = list[tuple[str, inspect.Parameter]]


def _step_flags(steps: Iterable[type[Step]], panel: str) -> Flags:
    return [
        _flag(_step_flag(step, name), field, panel, _step_help(step, name, field))
        for step in steps
        for name, field in step.parameters().items()
    ]


def _option_flags(model: type[BaseModel], usual: str, without: Collection[str] = ()) -> Flags:
    """Flags of a model's fields, in the panel that a field asks for or the usual one."""
    flags = []
    for name, field in model.model_fields.items():
        if name in without:
            continue
        extra = field.json_schema_extra
        panel = extra.get("panel", usual) if isinstance(extra, dict) else usual
        flags.append(_flag(name.replace("_", "-"), field, str(panel), _with_default(field)))
    return flags


def _recipe_flags() -> Flags:
    flags = _step_flags(STEPS.values(), _STEPS)
    method = FieldInfo(annotation=str | None, title="Source")
    told = f"How to estimate the undisturbed beam: {', '.join(ESTIMATES)}."
    flags.append(_flag("source-from", method, _ESTIMATES, told))
    for name in dict.fromkeys(n for one in ESTIMATES.values() for n in one.parameters()):
        users = {key: one.parameters()[name] for key, one in _users(name).items()}
        told = " ".join(f"For {key}: {_lower(_with_default(one))}" for key, one in users.items())
        field = next(iter(users.values()))
        flags.append(_flag(f"source-{name.replace('_', '-')}", field, _ESTIMATES, told))
    return flags + _option_flags(InversionOptions, _OPTIONS)


def _fit_flags() -> Flags:
    return [
        *_step_flags(FIT_STEPS.values(), _FIT_STEPS),
        # The command's own --source and --gains say more than these.
        *_option_flags(FitChoices, _FIT_CHOICES, without=("beam", "gains", "options")),
        *_option_flags(FitOptions, _FIT_OPTIONS),
    ]


def _with_default(field: FieldInfo) -> str:
    told = str(field.description)
    shows_default = field.default is not None and field.default is not False
    return f"{told} Default: {_shown(field)}." if shows_default else told


def _users(parameter: str) -> dict[str, Any]:
    """Estimates that have a parameter."""
    return {key: one for key, one in ESTIMATES.items() if parameter in one.parameters()}


def _step_help(step: type[Step], name: str, field: FieldInfo) -> str:
    title = f"{step.title[:1].upper()}{step.title[1:]}"
    if not step.primary or name == step.primary:
        return f"{title}: {_lower(str(field.description))}"
    return f"For --{step.name()}: {_lower(str(field.description))} Default: {_shown(field)}."


def _shown(field: FieldInfo) -> str:
    return f"{field.default:g}" if isinstance(field.default, float) else str(field.default)


def _lower(text: str) -> str:
    return text if text[1:2].isupper() else text[:1].lower() + text[1:]


def takes_recipe(command: Callable[..., None]) -> Callable[..., None]:
    """Give a command, which takes `flags`, one for each parameter of a recipe."""
    return _with_flags(command, dict(_recipe_flags()))


def takes_fit(command: Callable[..., None]) -> Callable[..., None]:
    """Give a command, which takes `flags`, one for each step and option of a fit."""
    return _with_flags(command, dict(_fit_flags()))


def _with_flags(
    command: Callable[..., None], made: Mapping[str, inspect.Parameter]
) -> Callable[..., None]:
    signature = inspect.signature(command, eval_str=True)
    own = [one for one in signature.parameters.values() if one.name != "flags"]

    @functools.wraps(command)
    def with_flags(**given: Any) -> None:
        flags = {name: given.pop(name) for name in made}
        command(**given, flags={name: one for name, one in flags.items() if one is not None})

    parameters = [one.replace(kind=inspect.Parameter.KEYWORD_ONLY) for one in own]
    with_flags.__signature__ = signature.replace(  # type: ignore[attr-defined]
        parameters=[*parameters, *made.values()]
    )
    with_flags.__annotations__ = {}
    return with_flags


def recipe_of(
    flags: Mapping[str, Any], base: Recipe, options: Mapping[str, Any], where: str = "options"
) -> Recipe:
    """Put flags on top of a recipe; `options` are those of an options file, named `where`."""
    chosen = {**base.options.model_dump(exclude_unset=True), **options}
    chosen |= {name: flags[name] for name in InversionOptions.model_fields if name in flags}
    if "margin" in flags and chosen.get("boundary") != "free":
        raise InputError("received --margin: it needs --boundary free")
    steps, source = _steps(flags, base.steps), _estimate(flags, base)
    made = validated(InversionOptions, chosen, where)
    return base.model_copy(update={"steps": steps, "source": source, "options": made})


def fit_recipe_of(
    flags: Mapping[str, Any], base: Recipe, options: Mapping[str, Any], where: str = "options"
) -> Recipe:
    """Put flags of a fit on top of a recipe; `options` are those of a file, named `where`."""
    before = base.fit or FitChoices()
    chosen = {**before.options.model_dump(exclude_unset=True), **options}
    chosen |= {name: flags[name] for name in FitOptions.model_fields if name in flags}
    made = validated(FitOptions, chosen, where)
    own = {name: flags[name] for name in FitChoices.model_fields if name in flags}
    kept = before.model_dump(exclude_none=True, exclude={"options"})
    in_metres = ("source_size", "resolution")
    # A point spread is given in one way: that of the flags takes the place of the other.
    replaced = in_metres if "psf" in own else ("psf",) if own.keys() & set(in_metres) else ()
    kept = {name: value for name, value in kept.items() if name not in replaced}
    choices = validated(FitChoices, {**kept, **own, "options": made}, "fit")
    return base.model_copy(update={"steps": _steps(flags, base.steps), "fit": choices})


def _steps(flags: Mapping[str, Any], steps: tuple[Step, ...]) -> tuple[Step, ...]:
    """Steps of a recipe with those that flags ask for in place, or where they belong."""
    order = list(STEPS)
    found = list(steps)
    for key, step in STEPS.items():
        named = {name: _step_flag(step, name).replace("-", "_") for name in step.parameters()}
        given = {name: flags[flag] for name, flag in named.items() if flag in flags}
        if not given:
            continue
        there = next((i for i, one in enumerate(found) if isinstance(one, step)), None)
        if there is None and step.primary and step.primary not in given:
            flag = _step_flag(step, next(iter(given)))
            raise InputError(f"received --{flag}: it needs --{key}")
        before = {} if there is None else found[there].values()
        made = validated(step, {**before, **given}, f"--{key}")
        if there is None:
            later = [i for i, one in enumerate(found) if order.index(one.name()) > order.index(key)]
            found.insert(later[0] if later else len(found), made)
        else:
            found[there] = made
    return tuple(found)


def _estimate(flags: Mapping[str, Any], base: Recipe) -> Any:
    """Source that flags ask for, or that of the recipe with other parameters."""
    given = {
        name: flags[f"source_{name}"]
        for one in ESTIMATES.values()
        for name in one.parameters()
        if f"source_{name}" in flags
    }
    method = flags.get("source_from")
    if method is None and not given:
        return base.source
    if method is None:
        method = "" if base.estimate is None else base.estimate.name()
    elif method not in ESTIMATES:
        meant = nearest(method, list(ESTIMATES))
        hint = f"did you mean '{meant}'?" if meant else f"expected one of {', '.join(ESTIMATES)}"
        raise InputError(f"--source-from is '{method}': {hint}")
    for name in given:
        users = _users(name)
        if method not in users:
            wanted = " or ".join(f"--source-from {user}" for user in users)
            raise InputError(f"received --source-{name.replace('_', '-')}: it needs {wanted}")
    kept = base.estimate.values() if base.estimate and base.estimate.name() == method else {}
    return validated(ESTIMATES[method], {**kept, **given}, f"--source-from {method}")
