"""One clear sentence for a parameter that is wrong."""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError

from napari_shadowinv.errors import InputError

Model = TypeVar("Model", bound=BaseModel)

# What pydantic calls a bound, and how it reads after "it must be".
_BOUNDS = {
    "greater_than": ("gt", "greater than"),
    "greater_than_equal": ("ge", "at least"),
    "less_than": ("lt", "less than"),
    "less_than_equal": ("le", "at most"),
}
_PYDANTIC_OPENING = "Input should be "


def validated(
    model_class: type[Model], mapping: Mapping[str, Any], where: str = "parameters"
) -> Model:
    """Make a model from a mapping, or raise an `InputError` that begins with `where`."""
    if not isinstance(mapping, Mapping):
        raise InputError(
            f"{where}: received {_shown(mapping)}, expected a table of keys and values"
        )
    try:
        return model_class.model_validate(mapping)
    except ValidationError as error:
        raise InputError(f"{where}: {_sentence(model_class, error)}") from error


def nearest(name: str, known: list[str]) -> str | None:
    """Return the known name that is spelled most like `name`, None if none is like it."""
    matches = difflib.get_close_matches(name, known, n=1, cutoff=0.6)
    return matches[0] if matches else None


def _sentence(model_class: type[BaseModel], error: ValidationError) -> str:
    details = error.errors(include_url=False)
    known = list(model_class.model_fields)
    meant = {
        nearest(str(detail["loc"][-1]), known)
        for detail in details
        if detail["type"] == "extra_forbidden"
    }
    return "; ".join(
        _clause(model_class, dict(detail), known)
        for detail in details
        if not (detail["type"] == "missing" and detail["loc"][-1] in meant)
    )


def _clause(model_class: type[BaseModel], detail: dict[str, Any], known: list[str]) -> str:
    name = ".".join(str(part) for part in detail["loc"])
    kind, context = detail["type"], detail.get("ctx", {})
    if kind == "extra_forbidden":
        match = nearest(name, known)
        hint = f", did you mean '{match}'?" if match else f"; known keys are {', '.join(known)}"
        return f"unknown key '{name}'{hint}"
    field = model_class.model_fields.get(name)
    title = _lower(field.title) if field is not None and field.title else "it"
    if kind == "missing":
        return f"'{name}' is missing, give the {title}"
    if not name:
        return str(context.get("error", detail["msg"]))
    received = f"'{name}' is {_shown(detail['input'])}"
    if kind in _BOUNDS:
        key, words = _BOUNDS[kind]
        return f"{received}: {title} must be {words} {context[key]:g}"
    message = str(context.get("error", detail["msg"]))
    if message.startswith(_PYDANTIC_OPENING):
        return f"{received}: {title} must be {message.removeprefix(_PYDANTIC_OPENING)}"
    return f"{received}: {_lower(message)}"


def _lower(text: str) -> str:
    """Make the first word fit inside a sentence, unless it is an abbreviation."""
    return text if text[1:2].isupper() else text[:1].lower() + text[1:]


def _shown(value: object, longest: int = 60) -> str:
    text = repr(value)
    return text if len(text) <= longest else f"{text[: longest - 1]}…"
