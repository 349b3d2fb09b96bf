"""The store of a run: contents of a new one, checks and order of one to be continued."""

from __future__ import annotations

import json
from itertools import pairwise
from textwrap import shorten
from typing import Any

import numpy as np

from napari_shadowinv import __version__
from napari_shadowinv._typing import BoolArray
from napari_shadowinv.errors import InputError
from napari_shadowinv.io.store import DONE, StackStore, check_files
from napari_shadowinv.io.store_writing import Contents, ShotWriter, Variable, grow_store, summarise
from napari_shadowinv.stack import _plan
from napari_shadowinv.stack._plan import dtype_of
from napari_shadowinv.stack._shots import CHAINED, Stack
from napari_shadowinv.stack._sources import checksum

_CHOSEN_SITES = "chosen_sites"  # attribute: number of sites from the accuracy and the first shots
_APPENDED = "appended_at"  # attribute: numbers of the first shots appended by later runs
NUMBERED_AS_ARRIVED = {
    "order": "as they arrived"
}  # attribute: the order does not follow from the names
_ALTERNATIVES = "use the same, overwrite the store, or choose another name"


def contents_of(stack: Stack, dtype: np.dtype[Any]) -> Contents:
    identity = {name: value for name, value in _identity(stack, dtype).items() if value}
    attributes: dict[str, Any] = {**_plan.attributes_of(stack), **identity}
    if stack.as_arrived:
        attributes |= NUMBERED_AS_ARRIVED
    if stack.sites_chosen:
        attributes[_CHOSEN_SITES] = stack.recipe.options.n_sites
    return Contents(stack.sizes, _variables(stack, dtype), _coordinates(stack), attributes)


def _coordinates(stack: Stack) -> dict[str, Variable]:
    return {
        name: _stored_coordinate(values) for name, values in _plan.coordinates_of(stack).items()
    }


def _stored_coordinate(coordinate: Any) -> Variable:
    if isinstance(coordinate, tuple):
        dim, values, attributes = coordinate
        dims: tuple[str, ...] = (dim,)
    else:
        dims, values, attributes = coordinate.dims, coordinate.values, dict(coordinate.attrs)
    values = np.asarray(values)
    if values.dtype.kind in "UO":
        return Variable(dims, str, attributes, values.astype(object))
    if values.dtype.kind in "mM":
        # As numbers, because Zarr has no times; the units say which.
        attributes = {**attributes, "units": "ns since 1970-01-01"}
        numbers = values.astype("datetime64[ns]").astype("int64")
        return Variable(dims, np.dtype("int64"), attributes, numbers)
    return Variable(dims, values.dtype, attributes, values)


def _variables(stack: Stack, dtype: np.dtype[Any]) -> dict[str, Variable]:
    variables: dict[str, Variable] = {}
    for name, (dims, labels) in stack.labels.items():
        if name not in stack.variables:
            continue
        exact = dtype_of(name).kind != "f" or "site" in dims
        stored = dtype_of(name) if exact else dtype
        if stack.beam is not None and stack.is_shared(name):
            values = np.asarray(_plan.values_of_beam(stack.beam, stack.recipe.options)[name])
            variables[name] = Variable(dims, stored, labels, values)
        else:
            variables[name] = Variable(("shot", *dims), stored, labels, None)
    return variables


def _identity(stack: Stack, dtype: np.dtype[Any], shots: int | None = None) -> dict[str, str]:
    """Return the attributes that must agree for a store with `shots` shots to be continued."""
    height, width = stack.shape
    recipe, shot = stack.recipe, stack.inputs.shot
    steps = [step.model_dump(mode="json") for step in recipe.steps]
    return {
        "fit": stack.fit_text,
        "options": stack.options_text,
        **stack.setup_texts,
        "source_image": stack.source_text(shots),
        "mask_image": _mask_text(shot.mask) or "none",
        "steps": json.dumps(steps) if steps else "",
        "source_mask_image": _mask_text(shot.source_mask),
        "image_size": f"{width} × {height} px",
        "stored": f"{', '.join(stack.variables)} as {dtype}",
        "reader": stack.reader,
        "warm_start": stack.warm_start_text,
    }


def _mask_text(mask: BoolArray | None) -> str:
    return "" if mask is None else f"sha256 {checksum(mask)}"


def resume(store: StackStore, stack: Stack, dtype: np.dtype[Any]) -> Stack:
    """Return the stack in the order of its store, new shots last; an `InputError` if it differs."""
    if store.attributes.get("warm_start") == CHAINED and not stack.as_arrived:
        raise InputError(
            f"{store.path} was written by watching a folder, where each shot starts from the one "
            "before: continue with shadowinv watch, overwrite the store, or choose another name"
        )
    stack = stack.reordered(_order(store, stack.shots.names))
    stack = match_store(store, stack, dtype)
    for index in np.flatnonzero(store.statuses() == DONE):
        changed = stack.changed(int(index), store.report(int(index)))
        if changed:
            raise InputError(
                f"{changed} has changed since it was inverted into {store.path}: overwrite the "
                "store or choose another name"
            )
    return stack


def reopen_damaged(store: StackStore) -> StackStore:
    """Read all of a store, mark its damaged shots as pending, and return it as it is now.

    Raises
    ------
    FileFormatError
        If there is damage that cannot be repaired from the shots.
    """
    damage = StackStore(store.path, every_byte=True).damage
    for index in damage.shots:
        ShotWriter.of(store).reopen(index)
    if not (damage.shots or damage.files):
        return store
    store = StackStore(store.path)
    if damage.files:
        summarise(store)
        check_files(store := StackStore(store.path, every_byte=True))
    return store


def match_store(store: StackStore, stack: Stack, dtype: np.dtype[Any]) -> Stack:
    """Return the stack with the store's number of sites; an `InputError` if they do not match."""
    if stack.chooses_sites and _CHOSEN_SITES in store.attributes:
        stack = stack.with_sites(int(store.attributes[_CHOSEN_SITES]))
    identity = _identity(stack, dtype, len(store.names))
    for name, value in {**identity, "package_version": __version__}.items():
        before = str(store.attributes.get(name, ""))
        if before != value:
            article = "" if name.endswith("s") else "a "
            raise InputError(
                f"{store.path} was started with {article}different {name.replace('_', ' ')} "
                f"({_difference(before, value)}): {_ALTERNATIVES}"
            )
    return stack


def _order(store: StackStore, names: tuple[str, ...]) -> list[int]:
    """Return the positions of the store's shots among `names`, then of the new ones."""
    # A shot keeps its number for good, so new ones go to the end wherever their names sort.
    count = len(store.names)
    if names[:count] == store.names:
        return list(range(len(names)))
    places = {name: place for place, name in enumerate(names)}
    lost = [name for name in store.names if name not in places]
    if lost or len(places) < len(names):
        missing = (
            f"{count} there, {len(names)} given, without {lost[0]}" if lost else "different order"
        )
        raise InputError(
            f"{store.path} was started with different shots ({missing}): {_ALTERNATIVES}"
        )
    known_places = [places[name] for name in store.names]
    if NUMBERED_AS_ARRIVED.items() <= store.attributes.items():
        return [*known_places, *sorted(set(range(len(names))) - set(known_places))]
    # Shots of a run keep their order; names of later runs may sort before them.
    ends = [0, *store.attributes.get(_APPENDED, []), count]
    for first, last in pairwise(ends):
        for index in range(first + 1, last):
            if known_places[index] < known_places[index - 1]:
                raise InputError(
                    f"{store.path} was started with the shots in a different order "
                    f"({store.names[index - 1]} before {store.names[index]}): {_ALTERNATIVES}"
                )
    return [*known_places, *sorted(set(range(len(names))) - set(known_places))]


def _difference(before: str, now: str) -> str:
    try:
        old, new = json.loads(before), json.loads(now)
        names = [name for name in {**old, **new} if old.get(name) != new.get(name)]
        return ", ".join(f"{name}: {old.get(name)} there, {new.get(name)} now" for name in names)
    except (ValueError, AttributeError, TypeError):
        return f"{shorten(before or 'none', 80)} there, {shorten(now or 'none', 80)} now"


def append_shots(store: StackStore, stack: Stack, dtype: np.dtype[Any]) -> StackStore:
    """Append shots that arrived since the last run, as pending, to the store."""
    coordinates = {
        name: np.asarray(coordinate.values)[len(store.names) :]
        for name, coordinate in _coordinates(stack).items()
        if coordinate.along_shots
    }
    begins = [*store.attributes.get(_APPENDED, []), len(store.names)]
    source = _identity(stack, dtype)["source_image"]
    attributes = {"source_image": source, _APPENDED: begins}
    grow_store(store.path, coordinates, attributes)
    return StackStore(store.path)
