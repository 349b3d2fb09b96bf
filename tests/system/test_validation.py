"""Models of parameters: titles of their fields."""

from __future__ import annotations

from pydantic import Field

from napari_shadowinv._system.validation import CheckedModel


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
