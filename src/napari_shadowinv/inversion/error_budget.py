"""The errors of a field by their causes: `ErrorBudget`, of `ErrorEstimate`s."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping
from dataclasses import asdict, dataclass, field, replace
from typing import Any, ClassVar, NamedTuple

import numpy as np
from pydantic import ConfigDict

from napari_shadowinv._system.validation import schema_of
from napari_shadowinv._typing import FloatArray
from napari_shadowinv.cautions import Caution
from napari_shadowinv.facts import limit_text, percent, round_down, to_figures
from napari_shadowinv.instrument.effects import EFFECTS
from napari_shadowinv.inversion.error_bars import ErrorSamples
from napari_shadowinv.physics.edge import edge_doubt
from napari_shadowinv.physics.setup import Setup
from napari_shadowinv.physics.units import Condition, PeakError

SHARE_OF_NOISE = 0.2
"""Of the noise: smaller errors by the discretisation do not matter."""

_MAX_BEAM_AT_PEAK = 0.1  # of the displacement, without a warning
_MAX_BEAM_RMS = 0.25  # of the displacement, without a warning

_BEAM_BASES = {  # name of the part, and its basis in a text
    "assumed": ("beam assumed, {}", "assumed"),
    "reference": ("beam of another exposure, assumed {}", "another exposure, assumed"),
    "stated": ("beam stated, {}", "stated"),
    "seen": ("image and source differ by {}", "seen outside the object"),
    "filtered": ("filters, {} taken from the object", "taken from the object"),
    "outside": ("beam measured outside the object, {}", "measured outside the object"),
    "unknown": ("beam, unknown", "unknown"),
}

_UNMEASURED = "assumed", "reference"  # bases that are conditions of a result

_REDUCED_SHARE = 0.25  # of the wanted mean square, at least for parts that are to be reduced
_REMEDIES = {
    "discretisation": "more sites",
    "solver": "a smaller tolerance",
    "edge": "a larger field",
    "filters": "weaker filters",
    "masked pixels": "a smaller mask",
}


class ErrorEstimate(NamedTuple):
    """A standard error of the displacement, px."""

    rms: float  # length of the error, root mean square over the image
    at_peak: float  # of the largest displacement

    def times(self, factor: float) -> ErrorEstimate:
        """Return the error in another unit, or by a larger cause."""
        return ErrorEstimate(factor * self.rms, factor * self.at_peak)


@dataclass(frozen=True)
class ErrorBudget:
    """Error budget of an inversion, or of a fitted field: standard errors of its displacement, px.

    An inversion's does not include the effects of a blurred image or of crossing rays.

    Attributes
    ----------
    peak, rms : float
        Largest displacement inside the mask and its root mean square, px, for comparison.
    noise : ErrorEstimate
        Scatter by the noise of image and source.
    by_counts : ErrorEstimate or None
        Scatter by the same noise of all waves that the pixels show: the least of any inversion of
        one image with a known beam. Noise above it is of the method, below it of fewer sites.
    effects : dict of str to ErrorEstimate
        Effects of errors of the flux in the cells, by their causes in `FLUX_ERRORS`, and of the
        instrument's effects.
    discretisation : ErrorEstimate or None
        Change of an inversion by more sites; None if there was no coarser level to compare with.
    edge : ErrorEstimate or None
        Effect of an object beyond the image's edge, with the share of the other errors there.
    sides : tuple of str
        Sides of the image near which the edge matters most: 'top', 'bottom', 'left', 'right'.
    beam : ErrorEstimate or None
        Effect of a beam that differs from the source by `beam_variation`; None if the source is
        exact: stated so, or uniform and given, and no difference was seen.
    beam_sensitivity : ErrorEstimate or None
        Effect of a beam that differs from the source by 1 %; None if the beam was fitted.
    sensitivities : dict of str to ErrorEstimate
        Effects of the instrument of tested sizes, by their names with a size, such as
        "background, 5 %".
    sizes : dict of str to float
        Standard deviations of the instrument that `effects` stand for, by their names.
    beam_variation : float
        Relative r.m.s. difference of beam and source that `beam` stands for.
    beam_scale : float
        Length over which they differ, as a share of the image's shorter side.
    beam_basis : str
        Origin of that number: 'assumed' for an estimated source, 'reference' if it is assumed of a
        recorded source, which is of another exposure, 'stated' by the user, 'seen' as a
        difference of image and source outside the object, 'references' for a prior from them,
        'outside' for a source estimated from the image outside the object, with its variance,
        'filtered' for the share of an object that filters take, in an exact beam, 'unknown' for a
        fit without a source.
    noise_correlation : float
        Standard deviation of the Gaussian blur with the measured correlation of the noise, px; 0
        for white noise.
    noise_is_bound : bool
        Whether structure hides the noise: its error is then the largest that the image allows.
    assumed : tuple of str
        Names of effects, such as "registration, 0.2 px", whose sizes nobody stated or measured.
    sampled : ErrorEstimate or None
        Total error by samples of a fit, of which the parts are estimates; None if it is the sum of
        the parts in squares.
    per_pixel : ndarray, shape (2, H, W), or None
        Standard deviation of the displacement in every pixel, of a fit or if
        `Inversion.uncertainty` computed it.
    causes : tuple of str
        Errors in `per_pixel`, such as "noise" and "beam, 5 %".
    samples : ErrorSamples or None
        The samples that it is the deviation of; a file does not keep them.
    """

    __pydantic_config__: ClassVar = ConfigDict(arbitrary_types_allowed=True)

    peak: float
    rms: float
    noise: ErrorEstimate
    effects: dict[str, ErrorEstimate]
    by_counts: ErrorEstimate | None = None
    discretisation: ErrorEstimate | None = None
    edge: ErrorEstimate | None = None
    sides: tuple[str, ...] = ()
    beam: ErrorEstimate | None = None
    beam_sensitivity: ErrorEstimate | None = None
    sensitivities: dict[str, ErrorEstimate] = field(default_factory=dict)
    sizes: dict[str, float] = field(default_factory=dict)
    beam_variation: float = 0.0
    beam_scale: float = 0.25
    beam_basis: str = "stated"
    noise_correlation: float = 0.0
    noise_is_bound: bool = False
    assumed: tuple[str, ...] = ()
    sampled: ErrorEstimate | None = None
    per_pixel: FloatArray | None = field(default=None, compare=False)
    causes: tuple[str, ...] = ()
    samples: ErrorSamples | None = field(default=None, compare=False)

    def to_dict(self) -> dict[str, Any]:
        """Return all but the values of pixels, for JSON."""
        content = asdict(replace(self, per_pixel=None, causes=(), samples=None))
        for name in ("per_pixel", "causes", "samples"):
            del content[name]
        return content

    @staticmethod
    def from_dict(
        content: Mapping[str, Any], causes: Iterable[str], per_pixel: FloatArray | None
    ) -> ErrorBudget:
        """Return the budget of a dict by `to_dict`, with the values of pixels."""
        budget: ErrorBudget = schema_of(ErrorBudget).validate_python(content)
        return replace(budget, per_pixel=per_pixel, causes=tuple(map(str, causes)))

    @property
    def total(self) -> ErrorEstimate:
        """Error by all contributions."""
        if self.sampled is not None:
            return self.sampled
        parts = np.array(list(self.parts.values()))
        return root_of(*(parts**2).sum(axis=0))

    @property
    def of_peak(self) -> PeakError | None:
        """Total at the peak as a share of it, and its largest contribution; None without a peak.

        This is the error in every headline.
        """
        if not self.peak > 0:
            return None
        parts = self.parts
        cause = max(parts, key=lambda name: parts[name].at_peak)
        return PeakError(self.total.at_peak / self.peak, cause)

    @property
    def parts(self) -> dict[str, ErrorEstimate]:
        """Known errors by their causes, the largest first."""
        noise = "noise"
        if self.noise_correlation:
            limit = "at most, hidden by structure, " if self.noise_is_bound else ""
            noise = f"noise, {limit}correlated over {to_figures(self.noise_correlation)} px"
        parts = {noise: self.noise}
        if self.discretisation is not None:
            parts["discretisation"] = self.discretisation
        parts |= self.effects
        if self.beam is not None:
            parts[self._beam_name] = self.beam
        if self.edge is not None:
            # Other errors move the field at the edge, too: only what exceeds them is the object's.
            excess = np.array(self.edge) ** 2 - (np.array(list(parts.values())) ** 2).sum(axis=0)
            if excess[0] > 0:
                parts["edge"] = root_of(*np.maximum(excess, 0.0))
        return dict(sorted(parts.items(), key=lambda part: -part[1].rms))

    @property
    def shares(self) -> dict[str, float]:
        """The parts as shares of the displacement (r.m.s.), by their titles, the largest first."""
        rms = self.rms or math.nan
        return {self._title(name): error.rms / rms for name, error in self.parts.items()}

    @property
    def causes_of_parts(self) -> tuple[str, ...]:
        """The parts, the largest first, as `causes`."""
        parts = {name: error for name, error in self.parts.items() if error.rms > 0}
        return tuple(f"assumed {name}" if name in self.assumed else name for name in parts)

    @property
    def limiting(self) -> str:
        """Title of the largest part, such as "beam"."""
        return next(iter(self.shares))

    @property
    def _beam_name(self) -> str:
        return _BEAM_BASES[self.beam_basis][0].format(percent(self.beam_variation))

    @property
    def limited_by(self) -> str:
        """Largest part with its share of the displacement (r.m.s.), such as "beam 23 %"."""
        error = next(iter(self.parts.values()))
        return f"{self.limiting} {share_of(error.rms, self.rms)}"

    def _title(self, name: str) -> str:
        is_filtered = self.beam_basis == "filtered"
        return "beam" if name == self._beam_name and not is_filtered else name.partition(",")[0]

    @property
    def share(self) -> float:
        """Total as a share of the displacement (r.m.s.); infinite without a displacement."""
        return self.total.rms / self.rms if self.rms > 0 else math.inf

    @property
    def share_text(self) -> str:
        """Total as a share of the displacement (r.m.s.), such as "23 %"; else in px."""
        return share_of(self.total.rms, self.rms)

    @property
    def ranking(self) -> str:
        """The parts as shares of the displacement (r.m.s.), the largest first."""
        return ", ".join(map(self._part_text, self.parts))

    def _part_text(self, name: str) -> str:
        share = share_of(self.parts[name].rms, self.rms)
        if name == self._beam_name:
            size = f"{percent(self.beam_variation)} rms over {self._beam_length}"
            return f"{self._title(name)} {share} ({size}, {_BEAM_BASES[self.beam_basis][1]})"
        title, _, size = name.partition(", ")
        return f"{title} {share} ({size})" if size else f"{title} {share}"

    @property
    def _beam_length(self) -> str:
        lengths = {0.25: "a quarter", 0.5: "half"}
        return lengths.get(self.beam_scale, to_figures(self.beam_scale))

    @property
    def _assumed_parts(self) -> set[str]:
        """Names of the parts whose sizes nobody stated or measured."""
        is_assumed = self.beam is not None and self.beam_basis in _UNMEASURED
        return {*self.assumed, *[self._beam_name] * is_assumed}

    def _without(self, names: Collection[str]) -> ErrorBudget:
        parts, sampled = self.parts, self.sampled
        if sampled is not None:
            squares = np.array([parts[name] for name in names]).reshape(-1, 2) ** 2
            sampled = root_of(*np.maximum(np.array(sampled) ** 2 - squares.sum(axis=0), 0.0))
        effects = {name: each for name, each in self.effects.items() if name not in names}
        beam = None if self._beam_name in names else self.beam
        assumed = tuple(name for name in self.assumed if name not in names)
        return replace(self, beam=beam, effects=effects, assumed=assumed, sampled=sampled)

    def condition(self, share: float) -> Condition | None:
        """Return the condition on assumed parts for a total of at most a share of the displacement.

        Both are r.m.s. None if a total that small takes more than these parts.
        """
        if not self.rms > 0:
            return None
        of_beam: dict[str, tuple[str, float, ErrorEstimate]] = {}
        of_detector: dict[str, tuple[str, float, ErrorEstimate]] = {}
        effects = {each.key: each for each in EFFECTS}
        for name in sorted(self._assumed_parts):
            each, part = effects.get(name.partition(",")[0]), self.parts[name]
            if each is None:
                size = 100 * self.beam_variation
                if self.beam_sensitivity is not None:  # images of a fit exclude part of it
                    part = self.beam_sensitivity.times(size)
                of_beam[name] = "%", size, part
            elif each.key == "registration":
                of_beam[name] = each.unit, self.sizes[name], part
            else:
                unit = f"{each.unit} of {each.key}".strip()
                of_detector[name] = unit, each.factor * self.sizes[name], part
        is_shifted = any(unit == "px" for unit, _, _ in of_beam.values())
        is_reference = is_shifted or self.beam_basis == "reference"
        subjects = {
            "reference" if is_reference else "beam": of_beam,
            "detector": of_detector,
            "beam and detector": of_beam | of_detector,
        }
        for subject, assumed in subjects.items():
            rest = self._without(assumed).total
            sizes = [
                (unit, size, part.rms / self.rms, part.at_peak / self.peak)
                for unit, size, part in assumed.values()
            ]
            measured_shares = rest.rms / self.rms, rest.at_peak / self.peak
            condition = Condition.within(share, measured_shares, sizes, subject=subject)
            if condition:
                at_peak = self.total.at_peak / self.peak
                return condition._replace(peak_if_off=at_peak, field_if_off=self.share)
        return None

    @property
    def limit(self) -> str:
        """The largest part, with the total, such as "limited by beam (errors 4 %)"."""
        return limit_text(self.limiting, self.share_text)

    @property
    def reason(self) -> str:
        """The largest measured part, and the largest of all if that was assumed."""
        measured = self._without(self._assumed_parts)
        if measured.parts.get("edge") != self.parts.get("edge"):  # the beam explains some of it
            measured = self
        largest = next(iter(self.parts))
        if next(iter(measured.parts)) == largest:
            return measured.limit
        return f"{measured.limit} and {self._title(largest)} (assumed, {self.share_text})"

    def measure_next(self, share: float) -> str:
        """Return what has to be known better for a total of at most a share of the displacement.

        Both are r.m.s. The text has that total, as in "the beam known to 0.5 % for errors of 12 %";
        it is empty if the total is no larger.
        """
        if not self.rms > 0:
            return ""
        parts = self.parts
        # Smaller errors elsewhere do not reduce the edge's, which they hide.
        edge = 0.0 if self.edge is None else self.edge.rms**2
        wanted, rest = (share * self.rms) ** 2, self.total.rms**2
        if "edge" in parts:
            rest -= parts.pop("edge").rms ** 2
        squares = {name: error.rms**2 for name, error in parts.items()}
        large: list[str] = []
        for name, square in squares.items():
            if rest <= wanted * (1 - _REDUCED_SHARE if large else 1):
                break
            large.append(name)
            rest -= square
        statements = []
        for name in large:
            allowed = math.sqrt(max(wanted - rest, 0) / len(large) / squares[name])
            statement, reached = self._statement(name, min(allowed, 1.0))
            statements.append(statement)
            squares[name] *= reached**2
        if edge > wanted:
            statements.append(_REMEDIES["edge"])
            edge = wanted
        if not statements:
            return ""
        total = math.sqrt(max(sum(squares.values()), edge))
        *others, last = statements
        listed = f"{', '.join(others)} and {last}" if others else last
        return f"{listed} for errors of {share_of(total, self.rms)}"

    def _statement(self, name: str, factor: float) -> tuple[str, float]:
        """Return what reduces a part by a factor, in round numbers, and their factor."""
        title = self._title(name)
        if title == "noise":
            shots = math.ceil(factor**-2)
            return f"{shots:,} shots averaged", shots**-0.5
        if title in _REMEDIES:
            return _REMEDIES[title], factor
        is_beam = title == "beam" and self.beam_variation
        if not is_beam and name not in self.sizes:
            return f"{factor:.1g} times the {title} error", factor
        size = self.beam_variation if is_beam else self.sizes[name]
        effect = {each.key: each for each in EFFECTS}.get(title)
        unit, scale, power = "%", 100.0, 1.0
        if effect is not None:
            unit, scale, power = effect.unit, effect.factor, 2.0 if effect.is_even else 1.0
        rounded = round_down(scale * size * factor ** (1 / power))
        text = f"the {title} known to {to_figures(rounded)} {unit}".rstrip()
        return text, (rounded / scale / size) ** power

    def accuracy_caution(self, accuracy: float, why: str) -> Caution | None:
        """Warn if the discretisation error exceeds the accuracy and is not hidden by noise."""
        error = 0.0 if self.discretisation is None else self.discretisation.rms
        if not self.rms > 0 or not error > max(
            accuracy * self.rms, SHARE_OF_NOISE * self.noise.rms
        ):
            return None
        return Caution(
            "accuracy",
            f"the accuracy of {100 * accuracy:g} % is not reached: {why}, the discretisation "
            f"error is about {share_of(error, self.rms)} of the displacement; give a larger "
            "number of sites",
        )

    def times(self, factor: float) -> ErrorBudget:
        """Return the budget in another unit, without samples; 1 px is `factor` of it."""
        lengths: dict[str, Any] = {"peak": factor * self.peak, "rms": factor * self.rms}
        if self.per_pixel is not None:
            lengths |= {"per_pixel": factor * self.per_pixel, "samples": None}
        for name, value in vars(self).items():
            if isinstance(value, ErrorEstimate):
                lengths[name] = value.times(factor)
            elif name in ("effects", "sensitivities"):
                lengths[name] = {cause: error.times(factor) for cause, error in value.items()}
        return replace(self, **lengths)

    def in_field(self, setup: Setup | None, name: str, energy: float) -> ErrorBudget:
        """Return the budget of a field in SI units, which a relative error of the energy scales.

        The `name` is one of the setup's fields; without a setup it is the displacement.
        """
        share = 0.0 if setup is None else energy * abs(setup.sensitivity_to_beam(name))
        if setup is None or not share:
            return self
        cause = f"{setup.beam_quantity().noun}, {percent(energy)}"
        error = ErrorEstimate(self.rms, self.peak).times(share)
        sampled = self.sampled and root_of(*(np.array([self.sampled, error]) ** 2).sum(axis=0))
        effects, sizes = {**self.effects, cause: error}, {**self.sizes, cause: energy}
        return replace(self, effects=effects, sizes=sizes, sampled=sampled)

    def rows(self, subject: str = "displacement", *, rough: float = 0.5) -> list[tuple[str, str]]:
        """Describe the budget of a subject in words: names and texts.

        A total above `rough`, as a share of it, is said to be rough.
        """
        of_subject = f" of the {subject}" if self.rms > 0 else ""
        text = f"{self.share_text}{of_subject} (r.m.s.)"
        if self.sampled is None:
            text += "; crossing rays are not in it"
        if self.sampled is None and self.rms > 0 and self.share > rough:
            text += "; errors this large are rough, as they are not proportional to their causes"
        if self.sampled is None and self.discretisation is None:
            text += "; discretisation was not estimated, as only one level was solved"
        rows = [("errors", text), ("limited by", self.ranking)]
        # Parts of samples need not add up to their total.
        if self.sampled is None and (next_step := self.measure_next(self.share / 2)):
            rows.append(("measure next", next_step))
        if (by_percent := self.beam_sensitivity) is not None:
            basis = "exact" if self.beam is None else self._beam_name.removeprefix("beam ")
            by_beam = (
                f"{basis}; a source that differs from it by 1 % (r.m.s.) over {self._beam_length} "
                "of the image's shorter side moves the displacement by "
                f"{share_of(by_percent.rms, self.rms)} (r.m.s.), its peak by "
                f"{share_of(by_percent.at_peak, self.peak)}"
            )
            rows.append(("beam", by_beam))
        if self.sensitivities:
            effects = ", ".join(
                f"{share_of(error.rms, self.rms)} ({name})"
                for name, error in self.sensitivities.items()
            )
            rows.append(("sensitivity", f"the displacement would move by (r.m.s.): {effects}"))
        return rows

    def edge_caution(self, max_error: float) -> Caution | None:
        """Warn if an object beyond the edge may move the field by more than `max_error` of it."""
        edge = self.parts.get("edge")
        if edge is None or not self.rms > 0:
            return None
        elsewhere = math.sqrt(max(self.total.rms**2 - edge.rms**2, 0.0)) / self.rms
        text = edge_doubt(edge.rms / self.rms, elsewhere, max_error, self.sides)
        return Caution("edge", text) if text else None

    def beam_caution(self) -> Caution | None:
        """Warn if image and source differ outside the object so that the peak is uncertain."""
        if self.beam is None or self.beam_basis != "seen" or not self.peak > 0:
            return None
        at_peak, everywhere = self.beam.at_peak / self.peak, self.beam.rms / self.rms
        if not (at_peak > _MAX_BEAM_AT_PEAK or everywhere > _MAX_BEAM_RMS):
            return None
        return Caution(
            "beam",
            f"image and source differ by {percent(self.beam_variation)} (r.m.s.) where there is "
            f"no object: the field may be off by {share_of(self.beam.rms, self.rms)}, its peak "
            f"by {share_of(self.beam.at_peak, self.peak)}; use a source of the same exposure, "
            "or fit the beam",
        )


def per_pixel_of(errors: ErrorBudget | None) -> FloatArray | None:
    """Return the standard deviation of the displacement in every pixel, if it is known."""
    return None if errors is None else errors.per_pixel


def root_of(square: float, square_at_peak: float) -> ErrorEstimate:
    """Return an estimate from its mean square and its square at the peak."""
    return ErrorEstimate(math.sqrt(square), math.sqrt(square_at_peak))


def share_of(error: float, total: float) -> str:
    """Write an error of a displacement in per cent of it; without a displacement, in px."""
    return percent(error / total) if total > 0 else f"{to_figures(error)} px"
