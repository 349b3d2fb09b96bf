"""Models of parameters: titles of their fields, and the words of their refusals."""

from __future__ import annotations

import pytest
from annotated_types import Ge, Gt, Le, Lt
from pydantic import Field

from napari_shadowinv._system.validation import CheckedModel, labels_of, validate
from napari_shadowinv.errors import InputError
from napari_shadowinv.options import FitOptions, Instrument, InversionOptions
from napari_shadowinv.preprocessing import STEPS


class Model(CheckedModel):
    step: int = 0
    most_sites: int = Field(default=1, description="Number of sites.")
    spacing: float = Field(default=1.0, title="Ray spacing (px)", description="Between rays.")


def test_a_described_field_has_its_name_as_its_title_unless_it_has_another():
    titles = {name: field.title for name, field in Model.model_fields.items()}
    assert titles == {"step": None, "most_sites": "Most sites", "spacing": "Ray spacing (px)"}


def test_titles_are_inherited():
    class Finer(Model):
        shares: int = Field(default=2, description="Parts of each.")

    assert Finer.model_fields["most_sites"].title == "Most sites"
    assert Finer.model_fields["spacing"].title == "Ray spacing (px)"
    assert Finer.model_fields["shares"].title == "Shares"


def is_refused(model, values):
    try:
        validate(model, values)
    except InputError:
        return True
    return False


@pytest.mark.parametrize("model", [InversionOptions, FitOptions, Instrument, *STEPS.values()])
def test_bounds_name_each_field_by_its_label(model):
    for key, field in model.model_fields.items():
        if not any(isinstance(bound, Ge | Gt | Le | Lt) for bound in field.metadata):
            continue
        bad = next(value for value in (-1, 10**9) if is_refused(model, {key: value}))
        with pytest.raises(InputError) as refused:
            validate(model, {key: bad}, names=labels_of(model))
        assert f"'{field.title}' is {bad}" in str(refused.value)
        assert f"'{key}'" not in str(refused.value)
