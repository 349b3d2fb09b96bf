"""All kinds of products, and their descriptions in files and commands.

- by name: `PRODUCTS`; of a table of TOML: `product_from_dict`; of a line: `product_from_text`
- the words of a line: `product_syntax`

A module with another product is imported here, and nowhere else.
"""

from __future__ import annotations

import types
from collections.abc import Mapping
from typing import Annotated, Any, Union, get_args, get_origin

from napari_shadowinv._system.validation import suggestion, validate
from napari_shadowinv.analysis import (
    axisymmetric,
    contrast,
    currents,
    lines,
    maps,
    regions,
    spectra,
)
from napari_shadowinv.analysis.product import Product
from napari_shadowinv.errors import InputError
from napari_shadowinv.preprocessing.steps import choices_of

# Their products register themselves.
_MODULES = (lines, regions, currents, maps, contrast, axisymmetric, spectra)

PRODUCTS: dict[str, type[Product]] = choices_of(Product)
"""All kinds of products by their names."""


def product_from_dict(mapping: Mapping[str, Any], where: str = "product") -> Product:
    """Return the product of a mapping that names its kind; an `InputError` if it cannot be used.

    Examples
    --------
    >>> product_from_dict({"product": "profile", "path": [(0, 0), (0, 9)]}).title
    'profile along a line'
    """
    return validate(_kind(mapping.get("product"), where), mapping, where)


def product_from_text(text: str) -> Product:
    """Return the product that a line describes.

    Parameters
    ----------
    text : str
        Name of the product, points of its path, and other fields by their names; see
        `product_syntax`.

    Raises
    ------
    InputError
        If a name is unknown or a value cannot be used.

    Examples
    --------
    >>> product_from_text("profile 100,20 100,180 width=5").path
    ((100.0, 20.0), (100.0, 180.0))
    """
    name, *words = text.split() or [""]
    kind = _kind(name, "the product")
    values: dict[str, list[str]] = {}
    field = kind.primary
    for word in words:
        key, equals, first = word.partition("=")
        if equals:
            field, word = key.replace("-", "_"), first
            if field not in kind.parameters():
                names = kind.parameters()
                raise InputError(f"{name} has no {key!r}; {suggestion(field, names)}")
        elif not field:
            raise InputError(
                f"{name} begins with {word!r}, expected name=value: {product_syntax(kind)}"
            )
        values.setdefault(field, []).append(word)
    content = {key: _value(kind, key, words, name) for key, words in values.items()}
    return validate(kind, {"product": name, **content}, f"product {name!r}")


def product_syntax(kind: type[Product]) -> str:
    """Return the words that describe a product, such as ``profile Y,X Y,X … [width=N]``."""
    words = [kind.name()]
    for name, field in kind.parameters().items():
        extra = field.json_schema_extra
        if isinstance(extra, dict) and extra.get("hidden"):
            continue  # measured, not chosen
        value = str(extra.get("metavar", "N")) if isinstance(extra, dict) else "N"
        value = "TEXT" if name == "label" else value
        word = value if name == kind.primary else f"{name.replace('_', '-')}={value}"
        words.append(word if field.is_required() else f"[{word}]")
    return " ".join(words)


def _kind(name: Any, where: str) -> type[Product]:
    if name not in PRODUCTS:
        raise InputError(f"{where} is {name!r}; {suggestion(str(name), PRODUCTS)}")
    return PRODUCTS[name]


def _value(kind: type[Product], name: str, words: list[str], product: str) -> Any:
    """Return the value of a field: a text or number, a point, or several points."""
    depth = _depth(kind.model_fields[name].annotation)
    if depth == 0:
        return " ".join(words)
    try:
        points = [tuple(float(number) for number in word.split(",")) for word in words]
    except ValueError:
        raise InputError(
            f"{product}: {name} is {' '.join(words)!r}, expected points y,x in px, such as "
            "100,20 100,180"
        ) from None
    return points if depth > 1 or len(points) != 1 else points[0]


def _depth(annotation: Any) -> int:
    """Return how many levels of tuples an annotation has."""
    origin, parts = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        return _depth(parts[0])
    if origin in (Union, types.UnionType):
        return max(map(_depth, parts))
    return 1 + _depth(parts[0]) if origin is tuple else 0
