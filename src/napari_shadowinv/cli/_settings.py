"""Keys of a recipe on the command line: `--set KEY=VALUE`, and `--step "NAME KEY=VALUE"`.

The models check the values; a wrong key is refused with the nearest right one.
"""

from __future__ import annotations

import shlex
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

from pydantic import BaseModel

from napari_shadowinv._system.validation import Model, nearest, suggestion, validate
from napari_shadowinv.errors import InputError
from napari_shadowinv.options import FitChoices, Instrument, InversionOptions
from napari_shadowinv.preprocessing import ESTIMATES, STEPS, Step
from napari_shadowinv.preprocessing.estimates import Estimate

Sections = Mapping[str, type[BaseModel]]

FILE_KEYS = ("mask", "source_mask")
INVERSION_SECTIONS: Sections = {"options": InversionOptions, "instrument": Instrument}
FIT_SECTIONS: Sections = {"fit": FitChoices, "instrument": Instrument}


def keys_of(sections: Sections) -> Iterator[str]:
    """Yield the keys of the values in sections, such as ``"fit.options.samples"``."""
    for section, model in sections.items():
        for name, each in model.model_fields.items():
            kind = each.annotation
            if isinstance(kind, type) and issubclass(kind, BaseModel):
                yield from keys_of({f"{section}.{name}": kind})
            else:
                yield f"{section}.{name}"


@dataclass(frozen=True)
class Settings:
    """Values by their keys, and the flags that some of them come from."""

    values: Mapping[str, Any]
    flags: Mapping[str, str] = field(default_factory=dict)

    def change(self, section: str, model: Model) -> Model:
        """Return a model with other values; an empty one stands for the default."""
        changes: dict[str, Any] = {}
        for name, each in type(model).model_fields.items():
            key = f"{section}.{name}"
            if key in self.values:
                changes[name] = self.values[key]
            elif any(other.startswith(f"{key}.") for other in self.values):
                before = getattr(model, name)
                changes[name] = self.change(key, each.get_default() if before is None else before)
        if not changes:
            return model
        before = _stated(model)
        values = {name: value for name, value in {**before, **changes}.items() if value != ""}
        names = {
            name: self.flags.get(key, key)
            for name in type(model).model_fields
            for key in [f"{section}.{name}"]
        }
        return validate(type(model), values, "", names)


def _stated(model: BaseModel) -> dict[str, Any]:
    """Return the values that are not defaults, from which a model can be made again."""
    if isinstance(model, Instrument):
        return model.stated
    return {name: getattr(model, name) for name in model.model_fields_set}


def settings_of(
    texts: Iterable[str],
    sections: Sections,
    flags: Mapping[str, tuple[str, Any]],
    names: Collection[str] = (),
) -> Settings:
    """Return the settings of flags, and of texts KEY=VALUE, which override them.

    A flag has a name and a value, None if it is not given, by the key that it sets; `names` are
    keys outside of the sections.
    """
    entered = {key: flag for key, flag in flags.items() if flag[1] is not None}
    values = {key: value for key, (_, value) in entered.items()}
    stated = {}
    keys = (*names, *keys_of(sections))
    for text in texts:
        key, equals, value = text.partition("=")
        key = key.strip()
        if not equals:
            raise InputError(f"--set is '{text}': expected KEY=VALUE, such as {keys[-1]}=…")
        if key not in keys:
            raise InputError(_unknown_key(key, keys))
        stated[key] = value.strip()
    return Settings(
        {**values, **stated},
        {key: flag for key, (flag, _) in entered.items() if key not in stated},
    )


def _unknown_key(key: str, keys: Collection[str]) -> str:
    # A key without its section, or with another one.
    alike = [name for name in keys if name.rpartition(".")[2] == key.rpartition(".")[2]]
    match = alike[0] if alike else nearest(key, keys)
    if match is None:
        sections = dict.fromkeys(name.rpartition(".")[0] + "." for name in keys if "." in name)
        return f"{key}: expected a key that begins with {', '.join(sections)}"
    return f"{key}: did you mean {match}?"


def completing(words: Iterable[str]) -> Callable[[str], list[str]]:
    """Return a function that completes words in a shell."""
    listed = [*words]
    return lambda incomplete: [word for word in listed if word.startswith(incomplete)]


def with_steps(steps: tuple[Step, ...], texts: Iterable[str]) -> tuple[Step, ...]:
    """Change steps, or insert new ones in the order of the list of steps.

    Texts are such as ``"hot-pixels 6"`` or ``"crop y=10:90"``.
    """
    result, order = list(steps), list(STEPS)
    for text in texts:
        kind, changes = parse_choice("--step", text, STEPS)
        index = next((i for i, step in enumerate(result) if isinstance(step, kind)), None)
        before = {} if index is None else result[index].values()
        step = validate(kind, {**before, **changes}, f"--step '{text}'")
        if index is None:
            rank = order.index(kind.name())
            later = [i for i, each in enumerate(result) if order.index(each.name()) > rank]
            result.insert(later[0] if later else len(result), step)
        else:
            result[index] = step
    return tuple(result)


def source_from(text: str, before: Estimate | None) -> Estimate:
    """Return the source of a text, such as ``"polynomial degree=3"``; the rest is as before."""
    method, changes = parse_choice("--source-from", text, ESTIMATES)
    values = before.values() if before is not None and before.name() == method.name() else {}
    source: Estimate = validate(method, {**values, **changes}, f"--source-from '{text}'")
    return source


def parse_choice(flag: str, text: str, choices: Mapping[str, Any]) -> tuple[Any, dict[str, str]]:
    """Return the choice that a text names, and its parameters; quotes keep a space in one."""
    if len(text) > 10_000:
        raise InputError(f"{flag} has {len(text):,} characters: expected a name and parameters")
    lexer = shlex.shlex(text, posix=True)
    lexer.whitespace_split, lexer.commenters, lexer.escape = True, "", ""
    try:
        name, *words = [*lexer] or [""]
    except ValueError:
        raise InputError(f"{flag} is '{text}': expected a second quotation mark") from None
    kind = choices.get(name)
    if kind is None:
        raise InputError(f"{flag} is '{text}': {suggestion(name, choices)}")
    values: dict[str, str] = {}
    for word in words:
        key, equals, value = word.partition("=")
        if not equals:
            key, value = getattr(kind, "primary", ""), word
        if not key or key in values:
            raise InputError(f"{flag} is '{text}': expected name=value instead of '{word}'")
        values[key.replace("-", "_")] = value
    return kind, values
