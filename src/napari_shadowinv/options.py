"""Every choice of an inversion, in one validated model.

The same model is the keyword of `invert`, the CLI's ``--options`` file, the form
in a window, and is saved with each result: there is no second list of defaults.
"""

from __future__ import annotations

from typing import Any, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator

__all__ = ["MAX_DEFAULT_SITES", "InversionOptions"]

MAX_DEFAULT_SITES = 1_000_000


class InversionOptions(BaseModel):
    """Choices of an inversion; all have a default that suits most images.

    Raises
    ------
    pydantic.ValidationError
        (a `ValueError`) if a value is out of range or a name is unknown.

    Examples
    --------
    >>> InversionOptions(n_sites=10_000).tolerance
    0.001
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    n_sites: int | None = Field(
        default=None,
        ge=4,
        title="Sites",
        description=(
            "Number of sites spread over the source. Default: as many as pixels, "
            f"at most {MAX_DEFAULT_SITES:,}."
        ),
    )
    floor: float = Field(
        default=1e-3,
        gt=0,
        lt=1,
        title="Floor",
        description=(
            "Smallest intensity of the image, as a share of its mean: darker pixels are raised "
            "to it. It keeps the transport solvable; below 1e-3 it rarely converges."
        ),
    )
    tolerance: float = Field(
        default=1e-3,
        gt=0,
        lt=1,
        title="Tolerance",
        description="Largest relative flux error allowed in any cell when the solver ends.",
    )
    lloyd_iterations: int = Field(
        default=5,
        ge=0,
        le=1000,
        title="Lloyd iterations",
        description="Most steps of weighted Lloyd relaxation that even out the sites.",
    )
    lloyd_tolerance: float = Field(
        default=0.1,
        ge=0,
        title="Lloyd tolerance",
        description=(
            "Lloyd relaxation ends when the sites move by less than this (root mean square), "
            "in units of the mean spacing of the sites."
        ),
    )
    readout: Literal["dual", "centroid"] = Field(
        default="dual",
        title="Read-out",
        description=(
            "'dual': the potential is half the weight of each site. 'centroid': the paper's way, "
            "natural-neighbour interpolation of centroid displacements, then integration."
        ),
    )
    integration: Literal["mean", "y", "x"] = Field(
        default="mean",
        title="Integration",
        description=(
            "Of the centroid read-out only: integrate first along 'y' and then along x, first "
            "along 'x', or take the 'mean' of both."
        ),
    )
    solver: Literal["newton", "lbfgs", "quasi-newton"] = Field(
        default="newton",
        title="Solver",
        description=(
            "'newton': damped Newton steps. 'lbfgs': limited-memory BFGS, as in the paper; slow, "
            "for comparison. 'quasi-newton': BFGS with an n × n matrix, for few sites."
        ),
    )
    stages: Literal["multi", "single"] = Field(
        default="multi",
        title="Stages",
        description=(
            "'multi': solve with few sites first and carry the potential over to more. "
            "'single': all sites at once, from zero weights."
        ),
    )
    max_iterations: int = Field(
        default=300,
        ge=1,
        title="Iterations",
        description="Most solver steps on each level before it gives up and says so.",
    )
    negative: Literal["refuse", "clip"] = Field(
        default="refuse",
        title="Negative pixels",
        description=(
            "'refuse': an image with negative values is an error. 'clip': negative values "
            "(left over from background subtraction) become zero, and are counted in the report."
        ),
    )
    boundary: Literal["closed", "free"] = Field(
        default="closed",
        title="Boundary",
        description=(
            "'closed': no flux crosses the image's edge, as in the paper. 'free': flux may leave "
            "and enter, and the object's potential fades beyond the edge."
        ),
    )
    margin: int | None = Field(
        default=None,
        ge=2,
        title="Margin (px)",
        description=(
            "Of the free boundary: pixels beyond each edge that flux may come from; they get sites "
            "of their own. Default: a twentieth of the image's shorter side."
        ),
    )
    decay_length: float | None = Field(
        default=None,
        gt=0,
        title="Decay length (px)",
        description=(
            "Of the free boundary: distance over which the potential fades beyond the edge, of the "
            "order of the object's size there. Default: the margin."
        ),
    )
    flux: Literal["conserve", "known", "fit"] = Field(
        default="conserve",
        title="Flux",
        description=(
            "Of the free boundary: 'conserve': as much flux enters as leaves, so image and source "
            "may have any units. 'known': image and source have the same exposure and units. "
            "'fit': find the exposure for which the flux at the edge moves least."
        ),
    )
    caustic_jacobian: float = Field(
        default=0.2,
        ge=0,
        title="Caustic threshold",
        description=(
            "Pixels whose map has a Jacobian determinant below this are marked as caustics: "
            "there rays cross or nearly do, and the field is less certain."
        ),
    )
    seed: int = Field(
        default=0,
        ge=0,
        title="Seed",
        description="Seed of the random site positions; the same seed gives the same result.",
    )
    threads: int | None = Field(
        default=None,
        ge=1,
        title="Threads",
        description="Threads of the kernels. Default: all cores. Results do not depend on it.",
    )

    @model_validator(mode="after")
    def _boundary_fits_the_rest(self) -> Self:
        if self.boundary == "closed" and self.flux != "conserve":
            raise ValueError(
                f"flux is '{self.flux}' and boundary 'closed', expected 'conserve': where nothing "
                "crosses the edge the flux is that of the source; use boundary='free'"
            )
        if self.boundary == "free" and self.solver != "newton":
            raise ValueError(
                f"solver is '{self.solver}' and boundary 'free', expected solver='newton': the "
                "others know closed boundaries only"
            )
        return self

    @classmethod
    def paper(cls, **changes: Any) -> InversionOptions:
        """Make the choices of the paper: 50 Lloyd steps, L-BFGS in one stage, centroids.

        Parameters
        ----------
        **changes
            Options to set otherwise.

        Returns
        -------
        InversionOptions

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
