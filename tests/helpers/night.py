"""Small shots of an object that changes, with their source."""

from __future__ import annotations

from typing import Any

import numpy as np
from pydantic import BaseModel

from napari_shadowinv import InversionOptions, Recipe, Shot, synthetic_image
from napari_shadowinv.physics.phantoms import gaussian_blob
from napari_shadowinv.pipeline import RunOptions
from napari_shadowinv.preprocessing import Estimate

SHAPE = (24, 28)
OPTIONS = InversionOptions(n_sites=100)


def make_shots(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Shots of a blob that grows and wanders, and their source."""
    source = 100 + 10 * np.random.default_rng(0).random(SHAPE)
    blobs = [
        gaussian_blob(SHAPE, 2 + 3 * np.sin(0.7 * i) ** 2, 4.0, (10, 12 + i % 5))
        for i in range(count)
    ]
    return np.stack([synthetic_image(blob.displacement, source) for blob in blobs]), source


def grouped(
    images: Any, choices: dict[str, Any], model: type[BaseModel] = RunOptions
) -> tuple[Shot, dict[str, Any]]:
    """Group choices: shots with their source and masks, and arguments of `run_stack` and others."""
    fields = {name: name for name in ("options", "setup", "instrument")} | {"filters": "steps"}
    if isinstance(choices.get("source"), Estimate):
        fields["source"] = "source"
    parts = {fields[name]: value for name, value in choices.items() if name in fields}
    filled = {name: value for name, value in parts.items() if value is not None}
    of_all = ("source", "mask", "source_mask")
    shots = Shot(images, **{k: choices[k] for k in of_all if k in choices and k not in fields})
    names = set(model.model_fields)
    callbacks = {k: v for k, v in choices.items() if k not in {*names, *fields, *of_all}}
    options = model(**{name: choices[name] for name in names & choices.keys()})
    argument = "run" if model is RunOptions else "watch"
    return shots, {"recipe": Recipe(**filled), **callbacks, argument: options}
