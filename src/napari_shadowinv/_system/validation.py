"""Models of parameters: one clear sentence for a wrong one, and the paths in them."""

from __future__ import annotations

import difflib
import re
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar, cast

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

from napari_shadowinv.errors import InputError

Model = TypeVar("Model", bound=BaseModel)

# The model that has a wrong field, the names from the outermost model to it, pydantic's details.
_Mistake = tuple[type[BaseModel], list[str], dict[str, Any]]

# Name of a bound in pydantic: its key there, and its wording after "it must be".
_BOUNDS = {
    "greater_than": ("gt", "greater than"),
    "greater_than_equal": ("ge", "at least"),
    "less_than": ("lt", "less than"),
    "less_than_equal": ("le", "at most"),
}


class FieldError(InputError):
    """Wrong values of a model's fields; `labelled` calls fields without a name by their labels."""

    def __init__(
        self,
        model_class: type[BaseModel],
        error: ValidationError,
        where: str,
        names: Mapping[str, str] | None = None,
    ) -> None:
        self.mistakes = list(_mistakes_in(model_class, error))
        super().__init__(_error_sentence(self.mistakes, where, names or {}))
        labels = labels_of(model_class) | dict(names or {})
        self.labelled = _error_sentence(self.mistakes, where, labels)

    def about(self, name: object) -> InputError:  # type: ignore[override]
        return InputError(f"{name}: {self}")

    def __reduce__(self) -> tuple[Any, ...]:
        return InputError, self.args  # a worker's error is a sentence


def labels_of(model_class: type[BaseModel]) -> dict[str, str]:
    """Return the labels of a model's fields in quotes, by which windows call them."""
    fields = model_class.model_fields
    return {name: f"'{field.title}'" for name, field in fields.items() if field.title}


class CombinationError(ValueError):
    """Values of several fields that exclude each other.

    Its sentence has the keys of the fields in braces: "{flux} is 'known' and {boundary} is …".
    """

    def text(self, name_of: Callable[[str], str]) -> str:
        """Return the sentence with the names of the fields in place of their keys."""
        return re.sub(r"\{(\w+)\}", lambda key: name_of(key[1]), self.args[0])

    def __str__(self) -> str:
        return self.text(repr)


class CheckedModel(BaseModel):
    """Model that refuses a wrong value with an `InputError` of one sentence.

    It cannot be changed and has no other fields. A field that is described has its name as its
    title, unless it has another. `model_validate` raises pydantic's own error, which lists all
    mistakes; see `validate`.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", ser_json_inf_nan="strings")

    if not TYPE_CHECKING:  # the fields are the arguments

        def __init__(self, /, **values: Any) -> None:
            try:
                super().__init__(**values)
            except ValidationError as error:
                raise FieldError(type(self), error, type(self).__name__) from error

    @classmethod
    def __pydantic_init_subclass__(cls, **_: Any) -> None:
        for name, field in cls.model_fields.items():
            if field.description and field.title is None:
                field.title = name.replace("_", " ").capitalize()


# Fields that several models have.
Seed = Annotated[
    int,
    Field(
        ge=0,
        title="Random seed",
        description="Seed of all random choices; the same seed gives the same result.",
    ),
]
Threads = Annotated[
    int | None,
    Field(
        ge=1,
        title="Number of threads",
        description="Number of threads. Default: all cores. It does not affect the result.",
    ),
]


def as_model(model_class: type[Model], value: Any, name: str) -> Model:
    """Return a model as it is, the default one for None, or one made from a mapping."""
    if value is None or isinstance(value, Mapping):
        return validate(model_class, value or {}, name)
    check_instance(value, model_class, name)
    return cast("Model", value)


def check_instance(value: object, expected: type | tuple[type, ...], name: str) -> None:
    """Refuse a value that is neither None nor an instance of one of the classes."""
    if value is None or isinstance(value, expected):
        return
    classes = expected if isinstance(expected, tuple) else (expected,)
    titles = " or ".join(expected.__name__ for expected in classes)
    raise InputError(f"{name} is {_shorten(value)}, expected {titles}")


def validate(
    model_class: type[Model],
    mapping: Mapping[str, Any],
    where: str = "parameters",
    names: Mapping[str, str] | None = None,
) -> Model:
    """Make a model from a mapping, or raise an `InputError` that begins with `where`.

    It calls the fields by their keys, or by the names that a face has for them: flags, labels.
    """
    if isinstance(mapping, Mapping) and not all(isinstance(key, str) for key in mapping):
        raise InputError(f"{where}: received {_shorten(mapping)}, expected names as keys")
    try:
        return model_class.model_validate(mapping)
    except ValidationError as error:
        raise FieldError(model_class, error, where, names) from error


@cache
def schema_of(content_class: type) -> TypeAdapter[Any]:
    """Return pydantic's schema of a dataclass, to check what a file has of it."""
    return TypeAdapter(content_class)


def map_paths(model: Model, move: Callable[[Path], Path]) -> Model:
    """Return a model with each path in its fields, and the fields of these, replaced by `move`."""

    def moved(content: Any) -> Any:
        if isinstance(content, Path):
            return move(content)
        if isinstance(content, BaseModel):
            return map_paths(content, move)
        if isinstance(content, Mapping):
            return {name: moved(value) for name, value in content.items()}
        return tuple(map(moved, content)) if isinstance(content, tuple) else content

    changes = {name: place for name, value in model if (place := moved(value)) != value}
    return model.model_copy(update=changes)


def nearest(name: str, choices: Collection[str]) -> str | None:
    """Return the choice that is spelled most like `name`, None if none is similar."""
    lower = {choice.lower(): choice for choice in choices}
    matches = difflib.get_close_matches(name.lower(), lower, n=1, cutoff=0.6)
    return lower[matches[0]] if matches else None


def suggestion(name: str, choices: Collection[str]) -> str:
    """Ask whether the nearest choice is meant, or list all of them."""
    match = nearest(name, choices)
    return f"did you mean '{match}'?" if match else f"expected one of {', '.join(choices)}"


def _mistakes_in(model_class: type[BaseModel], error: ValidationError) -> Iterator[_Mistake]:
    """Yield the mistakes in a model, and those in the models inside of it."""
    for detail in error.errors(include_url=False):
        loc = detail["loc"]
        # Without tags of unions.
        path = [str(k) for k in loc if isinstance(k, int) or k in model_class.model_fields]
        inner = detail.get("ctx", {}).get("error")
        if isinstance(inner, FieldError):
            for model, names, each in inner.mistakes:
                yield model, [*path, *names], each
        else:
            is_last = not loc or isinstance(loc[-1], int) or loc[-1] in model_class.model_fields
            yield model_class, path if is_last else [*path, str(loc[-1])], dict(detail)


def _error_sentence(mistakes: Sequence[_Mistake], where: str, names: Mapping[str, str]) -> str:
    # A key that is missing may be the one that is misspelt.
    unknown = [mistake for mistake in mistakes if mistake[2]["type"] == "extra_forbidden"]
    text = "; ".join(_error_clause(mistake, names) for mistake in unknown or mistakes)
    return f"{where}: {text}" if where else text


def _error_clause(mistake: _Mistake, names: Mapping[str, str]) -> str:
    def name_of(*path: str) -> str:
        key = ".".join(path)
        return names.get(key, f"'{key}'")

    model, path, detail = mistake
    kind, context = detail["type"], detail.get("ctx", {})
    if isinstance(error := context.get("error"), CombinationError):
        return error.text(partial(name_of, *path))
    tag_key = context.get("discriminator", "").strip("'")
    if kind == "extra_forbidden":
        return f"unknown key {name_of(*path)}, {suggestion(path[-1], model.model_fields)}"
    if kind == "union_tag_not_found":
        return f"{name_of(*path)} has no '{tag_key}': give it, to say which"
    if kind.startswith("union_tag"):
        expected = [tag.strip("' ") for tag in context["expected_tags"].split(",")]
        hint = suggestion(str(context["tag"]), expected)
        return f"{name_of(*path, tag_key)} is '{context['tag']}', {hint}"
    message = str(context.get("error", detail["msg"]))
    if not path:
        return message
    name, field = name_of(*path), model.model_fields.get(path[-1])
    title = lower_first(field.title) if field is not None and field.title and not names else "it"
    if kind == "missing":
        return f"{name} is missing" + ("" if names else f", give the {title}")
    received = f"{name} is {_shorten(detail['input'])}"
    if kind in _BOUNDS:
        key, words = _BOUNDS[kind]
        return f"{received}: {title} must be {words} {context[key]:g}"
    if message.startswith(opening := "Input should be "):
        kinds = message.removeprefix(opening).partition(", unable to")[0]
        return f"{received}: {title} must be {kinds}"
    return f"{received}: {lower_first(message)}"


def lower_first(text: str) -> str:
    """Make the first word fit inside a sentence, unless it is an abbreviation."""
    return text if text[1:2].isupper() else text[:1].lower() + text[1:]


def _shorten(value: object, longest: int = 60) -> str:
    text = " ".join(repr(value).split())
    return text if len(text) <= longest else f"{text[: longest - 1]}…"
