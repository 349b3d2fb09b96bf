"""Choices of an inversion, in one validated model: `InversionOptions`."""

from __future__ import annotations

from typing import Annotated, Any, Literal, Self

from pydantic import Field, model_validator

from napari_shadowinv._system.validation import CheckedModel, CombinationError, Seed, Threads

_Fraction = Annotated[float, Field(gt=0, lt=1)]
MaxError = Annotated[
    _Fraction,
    Field(
        title="Largest error",
        description="Largest total error, as a share of the field (r.m.s.), of a determined field.",
    ),
]
"""The largest error of a determined result, an option of inversions and fits."""

MAX_DEFAULT_SITES = 1_000_000

_MOVES_SITES: Any = {"moves_sites": True}
# For recipes and Python: a window has no row for it unless a recipe states it.
_RARE: Any = {"rare": True}


class InversionOptions(CheckedModel, allow_inf_nan=False):
    """Choices of an inversion; all have a default that suits most images.

    An `InputError` if a value is out of range or a name is unknown.

    Examples
    --------
    >>> InversionOptions(n_sites=10_000).tolerance
    0.001
    """

    n_sites: int | None = Field(
        default=None,
        ge=4,
        title="Sites",
        description=(
            "Number of sites over the source. Default: as many as the accuracy needs, at most one "
            f"per pixel and {MAX_DEFAULT_SITES:,}."
        ),
        json_schema_extra=_MOVES_SITES,
    )
    accuracy: _Fraction = Field(
        default=0.01,
        description="Target discretisation error of the displacement (relative r.m.s.). Sites are "
        "added until it is reached or falls below a fifth of the noise error; in the end a site "
        "in each pixel, with slopes of the brightness inside the pixels. Ignored with a "
        "number of sites, 'single' stages or a solver other than 'newton'.",
    )
    max_error: MaxError = 0.05
    floor: _Fraction = Field(
        default=1e-3,
        description="Minimum image intensity as a fraction of the mean: darker pixels are raised "
        "to it. This keeps the transport solvable; values below 1e-3 rarely converge.",
        json_schema_extra=_MOVES_SITES,
    )
    tolerance: _Fraction = Field(
        default=1e-3,
        description="Convergence criterion: maximum relative flux error of any cell.",
    )
    lloyd_iterations: int = Field(
        default=5,
        ge=0,
        le=1000,
        description="Maximum Lloyd iterations, which space the sites evenly.",
        json_schema_extra=_MOVES_SITES | _RARE,
    )
    lloyd_tolerance: float = Field(
        default=0.1,
        ge=0,
        description="Lloyd relaxation stops once the r.m.s. movement of the sites falls below this "
        "fraction of their mean spacing.",
        json_schema_extra=_MOVES_SITES | _RARE,
    )
    readout: Literal["dual", "centroid"] = Field(
        default="dual",
        title="Read-out",
        description="'dual': the potential is half the weight of each site. 'centroid': as in the "
        "paper, interpolation of the centroid displacements, then integration: the mean of both "
        "orders of the axes.",
        json_schema_extra=_RARE,
    )
    solver: Literal["newton", "lbfgs"] = Field(
        default="newton",
        description="'newton': damped Newton steps. 'lbfgs': limited-memory BFGS, as in the paper; "
        "slow, for comparison.",
        json_schema_extra=_RARE,
    )
    stages: Literal["multi", "single"] = Field(
        default="multi",
        description="'multi': solve with few sites first and interpolate the potential to "
        "successively more. 'single': all sites at once, starting from zero weights.",
        json_schema_extra=_RARE,
    )
    max_iterations: int = Field(
        default=300,
        ge=1,
        title="Iterations",
        description="Maximum solver iterations on each level.",
    )
    negative: Literal["refuse", "clip"] = Field(
        default="refuse",
        title="Negative pixels",
        description="'refuse': raise an error if the image has negative values. 'clip': set "
        "negative values (left by background subtraction) to zero and count them in the report.",
    )
    boundary: Literal["closed", "free"] = Field(
        default="closed",
        description="'closed': no flux crosses the image edge, as in the paper. 'free': flux may "
        "leave and enter, and the potential of the object decays beyond the edge.",
        json_schema_extra=_MOVES_SITES,
    )
    margin: int | None = Field(
        default=None,
        ge=2,
        title="Margin (px)",
        description="Free boundary only: width of the strip beyond each edge from which flux may "
        "enter; it has its own sites. Default: a twentieth of the image's shorter side.",
        json_schema_extra=_MOVES_SITES,
    )
    decay_length: float | None = Field(
        default=None,
        ge=0.01,
        le=1e6,
        title="Decay length (px)",
        description="Free boundary only: distance over which the potential decays beyond the edge; "
        "use roughly the size of the object there. Default: the margin.",
    )
    flux: Literal["conserve", "known"] = Field(
        default="conserve",
        description="Free boundary only. 'conserve': inflow equals outflow, so image and source "
        "may have different units. 'known': image and source have the same exposure and units.",
    )
    caustic_jacobian: float = Field(
        default=0.2,
        ge=0,
        title="Caustic threshold",
        description="Regions where the Jacobian determinant of the map is below this are marked as "
        "caustics: rays cross or nearly cross there, and the field is less certain. Specks that "
        "vanish when averaged over the site spacing count as noise.",
    )
    noise_level: float | None = Field(
        default=None,
        gt=0,
        description="Standard deviation of the noise of one pixel of the inverted image, in its "
        "units, for the error budget. Default: measured from the differences between neighbouring "
        "pixels.",
    )
    units_per_quantum: float | None = Field(
        default=None,
        gt=0,
        description="Image units per detected quantum, for the error budget: the noise is then "
        "Poisson noise.",
    )
    seed: Seed = Field(default=0, json_schema_extra=_MOVES_SITES | _RARE)
    threads: Threads = None

    @model_validator(mode="after")
    def _check_combination(self) -> Self:
        if self.boundary == "closed" and self.flux != "conserve":
            raise CombinationError(
                f"{{flux}} is '{self.flux}' and {{boundary}} is 'closed', expected 'conserve': a "
                "closed boundary conserves the source's flux; use a free one"
            )
        if self.boundary == "free" and self.solver != "newton":
            raise CombinationError(
                f"{{solver}} is '{self.solver}' and {{boundary}} is 'free', expected 'newton': the "
                "other solvers support closed boundaries only"
            )
        if self.noise_level is not None and self.units_per_quantum is not None:
            raise CombinationError(
                f"{{noise_level}} is {self.noise_level:g} and {{units_per_quantum}} is "
                f"{self.units_per_quantum:g}, expected one of them: units per quantum imply "
                "Poisson noise"
            )
        return self

    @property
    def is_adaptive(self) -> bool:
        """Whether the number of sites follows from the accuracy."""
        return self.n_sites is None and self.stages == "multi" and self.solver == "newton"

    def site_key(self) -> str:
        """Return the options that determine the positions of the sites, as text."""
        moving = {
            name
            for name, field in type(self).model_fields.items()
            if isinstance(extra := field.json_schema_extra, dict) and extra.get("moves_sites")
        }
        return self.model_dump_json(include=moving)

    @classmethod
    def paper(cls, **changes: Any) -> InversionOptions:
        """Make the choices of the paper: 50 Lloyd steps, L-BFGS in one stage, centroids.

        The changes are options to set otherwise.

        References
        ----------
        Kasim et al., arXiv:1607.04179, section III.

        Examples
        --------
        >>> InversionOptions.paper(n_sites=2000).solver
        'lbfgs'
        """
        choices: dict[str, Any] = {
            "lloyd_iterations": 50,
            "lloyd_tolerance": 0.0,
            "solver": "lbfgs",
            "stages": "single",
            "max_iterations": 10_000,
            "readout": "centroid",
        }
        return cls(**{**choices, **changes})
