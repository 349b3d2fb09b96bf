"""Pages of the reference that are written when the site is built, so that they are never stale.

- every parameter of a recipe's steps and sources, of setups and options, from the pydantic models
- every command with its options, from the command-line program
- the public names, from each module's ``__all__``
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from enum import Enum
from importlib import import_module
from inspect import cleandoc, isclass, signature
from pathlib import Path
from typing import Any, Literal, get_args, get_origin

from pydantic import BaseModel
from pydantic.fields import FieldInfo
from rich.text import Text
from sphinx.application import Sphinx
from sphinx.config import Config

from napari_shadowinv.preprocessing import Choice

FOLDER = Path(__file__).parents[1] / "reference"

_SHAPES: dict[Any, str] = {Path: "PATH", int: "INTEGER", float: "NUMBER", str: "TEXT"}

TASKS: dict[str, tuple[str, ...]] = {
    "Invert one image": ("invert", "InversionOptions", "Inversion"),
    "Apply a recipe to a file": ("read", "Shot", "Recipe", "run", "write"),
    "Repeat a result from its provenance": ("rerun",),
    "Describe the experiment, for SI units and errors": (
        "ProtonSetup",
        "OpticalSetup",
        "Instrument",
    ),
    "Measure currents, profiles and maps of a result": ("analyse",),
    "Fit one or several images, also where rays cross": ("fit", "FitOptions", "Fit"),
    "Invert many shots": ("run_stack",),
    "Predict an image, or compare with linear theory": (
        "synthetic_image",
        "predict_image",
        "poisson_invert",
    ),
    "Plan an experiment": ("plan_experiment",),
    "Trace particles through a 3-D field": ("trace",),
    "Show a result in napari": ("add_to_viewer",),
    "Handle errors": ("InputError", "FileFormatError"),
}
MODULES = {
    "inversion": "Inversions, their sites and errors",
    "options": "Options, and how well the instrument is known",
    "analysis": "Products of a result",
    "preprocessing": "Recipes, steps, filters and source estimates",
    "film": "Films, CR-39 and image plates",
    "pipeline": "From a recipe and a shot to a result",
    "stack": "Many shots",
    "physics": "Setups, images and traced particles",
    "physics.phantoms": "Test objects",
    "io": "Files",
}


def setup(app: Sphinx) -> dict[str, Any]:
    """Write the pages before Sphinx looks for pages."""
    app.connect("config-inited", write_pages)
    return {"parallel_read_safe": True, "parallel_write_safe": True}


def write_pages(app: Sphinx, config: Config) -> None:
    """Write what has changed, and forget the pages of names that are gone."""
    for name, text in (
        ("parameters.md", parameters_page()),
        ("command.md", command_page()),
        ("api.md", api_page()),
    ):
        path = FOLDER / name
        # An unchanged page is not read again.
        if not path.exists() or path.read_text(encoding="utf-8") != text:
            path.write_text(text, encoding="utf-8")
    for page in (FOLDER / "api").glob("*.rst"):
        module, _, name = page.stem.rpartition(".")
        known = {"napari_shadowinv", *(f"napari_shadowinv.{room}" for room in MODULES)}
        if module not in known or name not in public_names(module):
            page.unlink()


# Parameters


def parameters_page() -> str:
    from napari_shadowinv import FitOptions, InversionOptions
    from napari_shadowinv.options import FitChoices
    from napari_shadowinv.physics.setup import SETUPS
    from napari_shadowinv.pipeline import RunOptions, WatchOptions
    from napari_shadowinv.preprocessing import ESTIMATES, STEPS, MeasuredSource

    sources = [MeasuredSource, *ESTIMATES.values()]
    parts = [
        "# Parameters",
        "The same parameters appear in napari's forms, in TOML files and in Python. "
        "Lengths in px are pixels of the image that a step receives, after any binning before it.",
        "## Steps",
        "What is done to the image first. In a recipe `[[steps]]`, in any order; the "
        "command applies steps in the order below. See [](../recipes.md) and [](../filters.md).",
        *(choice_section(model) for model in STEPS.values()),
        "## Sources",
        "The undisturbed beam. In a recipe `[source]`; see [](../sources.md).",
        *(choice_section(model) for model in sources),
        "## Setups",
        "The geometry of the experiment. In napari under *Setup*; on the command line "
        "`--setup setup.toml`.",
        *(
            section(model, model.beam, f'`kind = "{kind}"`', "napari_shadowinv")
            for kind, model in SETUPS.items()
        ),
        "## Inversion options",
        "In napari under *Options*; on the command line `--set options.…`; in Python the "
        "arguments of "
        "{py:class}`~napari_shadowinv.InversionOptions`.",
        table_of(InversionOptions.model_fields),
        "## Run options",
        "Of many shots; `shadowinv batch --set run.…`, in Python the arguments of "
        "{py:class}`~napari_shadowinv.pipeline.RunOptions`. See [](../batch.md).",
        table_of(RunOptions.model_fields),
        "## Watch options",
        "Of a watched folder; `shadowinv watch --set run.…`, in Python the arguments of "
        "{py:class}`~napari_shadowinv.pipeline.WatchOptions`.",
        table_of(WatchOptions.model_fields),
        "## Fit choices",
        "What a fit finds and what is known. In a recipe `[fit]`; on the command line "
        "`--set fit.…`. See [](../fit.md).",
        table_of({k: one for k, one in FitChoices.model_fields.items() if k != "options"}),
        "## Fit options",
        "On the command line `--set fit.options.…`; in Python the arguments of "
        "{py:class}`~napari_shadowinv.FitOptions`.",
        table_of(FitOptions.model_fields),
    ]
    return "\n\n".join(parts) + "\n"


def choice_section(model: type[Choice]) -> str:
    named = f'`{model.key} = "{model.name()}"`'
    return section(model, model.title, named, "napari_shadowinv.preprocessing")


def section(model: type[BaseModel], title: str, named: str, module: str) -> str:
    summary = cleandoc(model.__doc__ or "").split("\n\n")[0]
    says = f"In files {named}; in Python {{py:class}}`~{module}.{model.__name__}`."
    fields = model.parameters() if issubclass(model, Choice) else model.model_fields
    table = table_of(fields) if fields else "No parameters."
    return f"### {title[:1].upper()}{title[1:]}\n\n{summary} {says}\n\n{table}"


def table_of(fields: Mapping[str, FieldInfo]) -> str:
    rows = [
        "| field | in files and Python | unit | default | range | meaning |",
        "|---|---|---|---|---|---|",
    ]
    for name, field in fields.items():
        title, unit = title_and_unit(field.title or name)
        cells = (
            title,
            f"`{name}`",
            unit,
            default_of(field),
            range_of(field),
            field.description or "",
        )
        rows.append("| " + " | ".join(escaped(cell) for cell in cells) + " |")
    return "\n".join(rows)


def title_and_unit(title: str) -> tuple[str, str]:
    match = re.fullmatch(r"(.*\S)\s*\(([^()]+)\)", title)
    return (match[1], match[2]) if match else (title, "")


def default_of(field: FieldInfo) -> str:
    if field.is_required():
        return "*required*"
    default = field.get_default(call_default_factory=True)
    if isinstance(default, tuple):
        default = ":".join("" if end is None else str(end) for end in default)
    return "–" if default is None else f"`{default}`"


def range_of(field: FieldInfo) -> str:
    choices = literal_values(field.annotation)
    if choices:
        return ", ".join(f"`{choice}`" for choice in choices)
    signs = {"gt": ">", "ge": "≥", "lt": "<", "le": "≤"}
    limits = []
    for limit in field.metadata:
        limits += [
            f"{sign} {getattr(limit, kind)}" for kind, sign in signs.items() if hasattr(limit, kind)
        ]
    return ", ".join(limits)


def literal_values(annotation: Any) -> list[str]:
    if get_origin(annotation) is Literal:
        return [str(value) for value in get_args(annotation)]
    return [value for part in get_args(annotation) for value in literal_values(part)]


def escaped(text: str) -> str:
    return text.replace("|", r"\|").replace("\n", " ")


# The command


def command_page() -> str:
    from typer.main import get_command

    from napari_shadowinv.cli import app

    group: Any = get_command(app)
    parts = [
        "# The command `shadowinv`",
        plain(group.help)
        + " `shadowinv COMMAND --help` shows what is below in the terminal, and `--set` takes "
        "the keys of [](parameters.md).",
        *(command_section(name, command) for name, command in group.commands.items()),
    ]
    return "\n\n".join(parts) + "\n"


def command_section(name: str, command: Any) -> str:
    kinds = {name: each.annotation for name, each in signature(command.callback).parameters.items()}
    arguments = [one for one in command.params if one.param_type_name == "argument"]
    options = [one for one in command.params if one.param_type_name == "option"]
    usage = " ".join(["shadowinv", name, "[OPTIONS]", *(one.name.upper() for one in arguments)])
    parts = [f"## shadowinv {name}", f"    {usage}", plain(command.help)]
    if arguments:
        parts.append(definitions([(f"`{one.name.upper()}`", one) for one in arguments]))
    listed = [(flags(option, kinds.get(option.name)), option) for option in options]
    parts += ["**Options**", definitions(listed)]
    if command.epilog:
        parts.append(plain(command.epilog))
    return "\n\n".join(parts)


def definitions(members: list[tuple[str, Any]]) -> str:
    return "\n\n".join(f"{term}\n: {meaning(one)}" for term, one in members)


def meaning(parameter: Any) -> str:
    text = plain(parameter.help) or "–"
    default = getattr(parameter.default, "value", parameter.default)
    is_shown = isinstance(default, str | int | float) and default is not False and default != ""
    if is_shown and "efault" not in text:
        text += f" Default: `{default}`."
    return text


def flags(option: Any, kind: Any) -> str:
    names = ", ".join(f"`{name}`" for name in [*option.opts, *option.secondary_opts])
    return names if option.is_flag else f"{names} `{option.metavar or shape_of(kind)}`"


def shape_of(kind: Any) -> str:
    """What is to be typed for a value of some type."""
    for part in (kind, *get_args(kind)):
        if isclass(part) and issubclass(part, Enum):
            return "|".join(str(choice.value) for choice in part)
        if part in _SHAPES:
            return _SHAPES[part]
    return "|".join(literal_values(kind)) or "VALUE"


def plain(text: str | None) -> str:
    """The words without rich's markup, a paragraph to a line, safe in Markdown."""
    paragraphs = cleandoc(text or "").split("\n\n")
    words = [" ".join(Text.from_markup(part).plain.split()) for part in paragraphs]
    return "\n\n".join(re.sub(r"([*_<>\[\]|])", r"\\\1", part) for part in words)


# Public names


def api_page() -> str:
    parts = [
        "# Python",
        "Arrays are `[y, x]`, vectors in axis order (y, x), a pixel's centre is at its integer "
        "index; lengths are object-plane pixels unless a name or a unit says otherwise.",
        "## napari_shadowinv",
    ]
    for task, names in TASKS.items():
        parts += [f"### {task}", summary("napari_shadowinv", names)]
    for name, title in MODULES.items():
        module = f"napari_shadowinv.{name}"
        parts += [f"## {module}", f"{title}.", summary(module)]
    return "\n\n".join(parts) + "\n"


def public_names(module: str) -> list[str]:
    """Classes and functions for users that have no page elsewhere."""
    names = list(import_module("napari_shadowinv").__all__)
    if module == "napari_shadowinv":
        return names
    found = import_module(module)
    return [
        name
        for name in found.__all__
        if callable(getattr(found, name)) and name not in names and not name.startswith("checked_")
    ]


def summary(module: str, names: Sequence[str] | None = None) -> str:
    """Table of the names of a module, of all that are public by default."""
    lines = "\n".join(f"   {name}" for name in names or public_names(module))
    return (
        f"```{{eval-rst}}\n.. currentmodule:: {module}\n\n"
        f".. autosummary::\n   :toctree: api\n   :nosignatures:\n\n{lines}\n```"
    )
