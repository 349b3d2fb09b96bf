"""Electric and magnetic fields on a 3-D grid, as `napari_shadowinv.trace` takes them.

- a field from arrays: `FieldGrid`; from a labelled dataset, or a grid of PlasmaPy: `field_grid`
- turn it into the beam's frame: `FieldGrid.turned`; put its middle on the object: `centred`

The frame is the experiment's: x to the right, y down, z along the beam, with the origin in the
middle of the object plane. Arrays are ``[z, y, x]``, vectors lie along the first axis in the order
(z, y, x). Values belong to the nodes of the grid; between them the field is trilinear, and outside
the outermost nodes it is zero.
"""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from napari_shadowinv._system.safety import check_memory
from napari_shadowinv._typing import AnyArray, FloatArray
from napari_shadowinv.errors import InputError
from napari_shadowinv.physics.arrays import METRES, check_finite

AXES = ("z", "y", "x")

_TESLAS = {"T": 1.0, "mT": 1e-3, "kT": 1e3, "G": 1e-4, "kG": 0.1, "MG": 100.0}
_TESLAS |= {"tesla": 1.0, "gauss": 1e-4, "Gauss": 1e-4, "Tesla": 1.0}
_VOLTS = {"V": 1.0, "kV": 1e3, "MV": 1e6, "GV": 1e9, "TV": 1e12, "volt": 1.0, "Volt": 1.0}
_FIELDS = {"B": "magnetic field", "E": "electric field"}
COMPONENT = re.compile(r"([BE])_?([xyz])", re.IGNORECASE)
_PLASMAPY_AXES = ("ax0", "ax1", "ax2")
_DIRECTION = re.compile(r"([+-]?)([xyz])")
_LARGEST = float(np.finfo(np.float32).max)


@dataclass(frozen=True, eq=False)
class FieldGrid:
    """Fields on the nodes of an evenly spaced grid.

    Attributes
    ----------
    magnetic, electric : ndarray of float32 or float64, shape (3, Z, Y, X), or None
        B in T and E in V/m, components in the order (z, y, x). At least one of them.
    spacing : tuple of float
        Distance of the nodes in m along (z, y, x).
    centre : tuple of float, default (0, 0, 0)
        Place of the grid's middle in m along (z, y, x), from the middle of the object plane.

    Raises
    ------
    InputError
        If a shape does not fit, a value is not finite or beyond single precision, or a length is
        not positive.

    Examples
    --------
    A uniform field of 10 T to the right, in a cube of 1 mm around the object:

    >>> import numpy as np
    >>> magnetic = np.zeros((3, 11, 11, 11))
    >>> magnetic[2] = 10.0
    >>> FieldGrid(magnetic, spacing=(1e-4, 1e-4, 1e-4)).extent[0]
    (-0.0005, 0.0005)
    """

    magnetic: AnyArray | None = None
    electric: AnyArray | None = None
    spacing: Sequence[float] = dataclasses.field(kw_only=True)
    centre: Sequence[float] = dataclasses.field(default=(0.0, 0.0, 0.0), kw_only=True)

    def __post_init__(self) -> None:
        arrays = {name: getattr(self, name) for name in ("magnetic", "electric")}
        if all(array is None for array in arrays.values()):
            raise InputError("the grid has no field: expected a magnetic or an electric one")
        for name, array in arrays.items():
            if array is not None:
                object.__setattr__(self, name, _checked_field(array, f"{name} field"))
        if self.magnetic is not None and self.electric is not None:
            shapes = self.magnetic.shape, self.electric.shape
            if shapes[0] != shapes[1]:
                raise InputError(
                    f"the magnetic field has shape {shapes[0]}, the electric field {shapes[1]}: "
                    "they must match"
                )
        for name in ("spacing", "centre"):
            values = tuple(map(float, np.ravel(getattr(self, name))))
            if len(values) != 3 or not np.isfinite(values).all():
                raise InputError(f"{name} is {values}: expected three lengths (z, y, x) in m")
            object.__setattr__(self, name, values)
        if min(self.spacing) <= 0:
            raise InputError(f"spacing is {self.spacing}: expected positive lengths (z, y, x) in m")

    @property
    def shape(self) -> tuple[int, int, int]:
        """Number of nodes along (z, y, x)."""
        field: Any = self.electric if self.magnetic is None else self.magnetic
        depth, height, width = field.shape[1:]
        return depth, height, width

    @property
    def extent(self) -> tuple[tuple[float, float], ...]:
        """Places of the first and last nodes in m along (z, y, x)."""
        halves = [(n - 1) / 2 * d for n, d in zip(self.shape, self.spacing, strict=True)]
        return tuple((c - h, c + h) for c, h in zip(self.centre, halves, strict=True))

    @property
    def length(self) -> float:
        """Length along the beam in m."""
        return (self.shape[0] - 1) * self.spacing[0]

    def peak(self, name: str) -> float:
        """Return the largest magnitude of the field ``"magnetic"`` or ``"electric"``."""
        array = getattr(self, name)
        return 0.0 if array is None else float(np.sqrt(_squared(array).max()))

    @property
    def edge_share(self) -> float:
        """Largest field on the faces of the grid over the largest field in it."""
        shares = [0.0]
        for array in (self.magnetic, self.electric):
            if array is not None and (squared := _squared(array)).max() > 0:
                faces = [squared.take(end, axis=axis).max() for axis in range(3) for end in (0, -1)]
                shares.append(math.sqrt(max(faces) / squared.max()))
        return max(shares)

    def centred(self) -> FieldGrid:
        """Return the same field with its middle on the middle of the object plane."""
        return dataclasses.replace(self, centre=(0.0, 0.0, 0.0))

    def turned(self, beam: str = "z", right: str = "x") -> FieldGrid:
        """Return the field in the frame of a beam along another axis of the grid.

        Parameters
        ----------
        beam, right : str
            Axes of the grid that become the beam's direction and the image's right, such as "y"
            or "-z". The third axis follows, as the frame is right-handed.

        Raises
        ------
        InputError
            If a direction is not an axis, or both are the same axis.

        Examples
        --------
        >>> import numpy as np
        >>> field = FieldGrid(np.zeros((3, 4, 5, 6)), spacing=(1.0, 1.0, 1.0))
        >>> field.turned(beam="x", right="y").shape  # down is the grid's z
        (6, 4, 5)
        """
        along, across = _direction("beam", beam), _direction("right", right)
        if along[0] == across[0]:
            raise InputError(
                f"beam is {beam!r} and right {right!r}: expected two different axes of x, y and z"
            )
        down = _cross(along, across)
        axes, signs = zip(along, down, across, strict=True)
        turned = {
            name: None if array is None else _turn(np.asarray(array), axes, signs)
            for name, array in (("magnetic", self.magnetic), ("electric", self.electric))
        }
        return FieldGrid(
            **turned,
            spacing=[self.spacing[axis] for axis in axes],
            centre=[sign * self.centre[axis] for axis, sign in zip(axes, signs, strict=True)],
        )


def field_grid(field: Any) -> FieldGrid:
    """Return the field of a labelled dataset or of a grid of PlasmaPy.

    Parameters
    ----------
    field : FieldGrid, xarray.Dataset, or grid of PlasmaPy
        A dataset has the variables ``Bx``, ``By`` and ``Bz``, or ``Ex``, ``Ey`` and ``Ez``, or all
        of them, and the coordinates ``x``, ``y`` and ``z``, in any order and evenly spaced, each
        with an attribute ``units`` such as "T", "kG", "V/m", "um". Other variables are ignored.

    Returns
    -------
    FieldGrid
        In T, V/m and m.

    Raises
    ------
    InputError
        If a component, a coordinate or a unit is missing or unknown, or the spacing is uneven.
    """
    if isinstance(field, FieldGrid):
        return field
    field = getattr(field, "ds", field)  # of a grid of PlasmaPy
    if not all(hasattr(field, name) for name in ("data_vars", "coords", "dims")):
        raise InputError(
            f"the field is of type {type(field).__name__}: expected a FieldGrid, a dataset of "
            "xarray with Bx, By, Bz or Ex, Ey, Ez, or a grid of PlasmaPy"
        )
    dims = [str(dim) for dim in field.dims]
    if set(_PLASMAPY_AXES) <= set(dims):
        field = _name_axes(field)
    places = [_checked_places(field, axis) for axis in AXES]
    # Six components, twice in single precision.
    check_memory([len(at) for _, _, at in places], 48, "a field")
    names: dict[tuple[str, str], str] = {}
    for variable in map(str, field.data_vars):
        if match := COMPONENT.fullmatch(variable):
            names[match[1].upper(), match[2].lower()] = variable
    arrays: dict[str, FloatArray] = {}
    for symbol, title in _FIELDS.items():
        present = [axis for axis in AXES if (symbol, axis) in names]
        if present and len(present) < len(AXES):
            missing = next(axis for axis in AXES if axis not in present)
            raise InputError(
                f"the dataset has {', '.join(names[symbol, axis] for axis in present)} but no "
                f"{symbol}{missing}: expected all components of the {title}; add it, as zeros if "
                "it vanishes"
            )
        if present:
            components = [_component(field, names[symbol, axis], places) for axis in AXES]
            arrays[symbol] = np.stack(components)
    if not arrays:
        content = ", ".join(map(str, field.data_vars)) or "none"
        raise InputError(
            f"the dataset has the variables {content}: expected Bx, By, Bz or Ex, Ey, Ez"
        )
    return FieldGrid(
        arrays.get("B"),
        arrays.get("E"),
        spacing=[step for step, _, _ in places],
        centre=[centre for _, centre, _ in places],
    )


def unit_factor(symbol: str, text: str, name: str) -> float:
    """Return the factor to T or V/m of the unit of a variable, or raise an `InputError`."""
    plain = re.sub(r"[\s*·^]+|\*\*", " ", text).strip()
    if symbol == "B":
        factor = _TESLAS.get(plain)
        expected = "T, mT, kT, G, kG or MG"
    else:
        match = re.fullmatch(r"(\w+) ?(?:/ ?(\w+?)|(\w+?) ?(?:-1|⁻¹))", plain)
        volts, metres = (match[1], match[2] or match[3]) if match else ("", "")
        factor = None
        if volts in _VOLTS and metres in METRES:
            factor = _VOLTS[volts] / METRES[metres]
        expected = "V/m, or V or m with a prefix"
    if factor is None:
        received = f"the unit {text!r}" if text else "no unit"
        raise InputError(f"{name} has {received}: expected {expected}, in its attribute 'units'")
    return factor


def _squared(array: Any) -> FloatArray:
    return np.asarray(sum(np.square(component, dtype=np.float64) for component in array))


def _checked_field(array: ArrayLike, name: str) -> AnyArray:
    values = np.asarray(array)
    if values.dtype.kind not in "buif":
        raise InputError(f"the {name} has values of type {values.dtype}, expected real numbers")
    if values.ndim != 4 or values.shape[0] != 3 or min(values.shape[1:]) < 2:
        raise InputError(
            f"the {name} has shape {values.shape}: expected (3, depth, height, width), its "
            f"components in the order (z, y, x), with at least 2 nodes each way"
        )
    if values.dtype.kind != "f":
        values = values.astype(np.float64)
    check_finite(f"the {name}", values)
    largest = max(abs(float(values.max())), abs(float(values.min())))
    if largest > _LARGEST:
        raise InputError(
            f"the {name} reaches {largest:.3g} in SI units: expected at most {_LARGEST:.1e}; check "
            "its unit"
        )
    return values


def _direction(name: str, text: str) -> tuple[int, int]:
    """Return the place of an axis in (z, y, x) and its sign."""
    match = _DIRECTION.fullmatch(str(text).strip().lower())
    if match is None:
        raise InputError(f"{name} is {text!r}: expected x, y or z, or one of them with a minus")
    return AXES.index(match[2]), -1 if match[1] == "-" else 1


def _cross(first: tuple[int, int], second: tuple[int, int]) -> tuple[int, int]:
    """Return the axis first × second; axes count z, y, x, so odd permutations are positive."""
    third = 3 - first[0] - second[0]
    is_even = (second[0] - first[0]) % 3 == 1
    return third, first[1] * second[1] * (-1 if is_even else 1)


def _turn(array: AnyArray, axes: Sequence[int], signs: Sequence[int]) -> AnyArray:
    """Return components and axes in a new order, reversed where a sign is negative."""
    turned = array[list(axes)].transpose(0, *(axis + 1 for axis in axes))
    flips = tuple(slice(None, None, sign) for sign in signs)
    factors = np.asarray(signs, dtype=array.dtype)[:, None, None, None]
    return np.ascontiguousarray(turned[(slice(None), *flips)] * factors)


def _name_axes(dataset: Any) -> Any:
    units = dataset.attrs.get("axis_units", [""] * 3)
    renamed = dataset.rename(dict(zip(_PLASMAPY_AXES, reversed(AXES), strict=True)))
    for axis, unit in zip(reversed(AXES), units, strict=True):
        if axis in renamed.coords:
            renamed[axis].attrs["units"] = str(unit)
    return renamed


def _checked_places(dataset: Any, axis: str) -> tuple[float, float, FloatArray]:
    """Return spacing and middle of a coordinate in m, and its values in increasing order."""
    if axis not in dataset.coords or dataset.coords[axis].ndim != 1:
        raise InputError(
            f"the dataset has no coordinate {axis!r} along an axis: expected x, y and z of the "
            "nodes, with units"
        )
    coordinate = dataset.coords[axis]
    text = _unit_text(coordinate.attrs)
    if text not in METRES:
        received = f"the unit {text!r}" if text else "no unit"
        raise InputError(
            f"the coordinate {axis!r} has {received}: expected m, cm, mm, um or nm, in its "
            "attribute 'units'"
        )
    places = np.asarray(coordinate.values, dtype=np.float64) * METRES[text]
    if len(places) < 2 or not np.isfinite(places).all():
        raise InputError(
            f"the coordinate {axis!r} has {len(places)} values: expected at least 2 finite ones"
        )
    steps = np.diff(places)
    mean = float(steps.mean())
    if mean == 0 or np.abs(steps - mean).max() > 1e-4 * abs(mean):  # beyond rounding
        raise InputError(
            f"the coordinate {axis!r} is not evenly spaced: expected nodes at one distance; "
            "resample the field"
        )
    return abs(mean), float(places[0] + places[-1]) / 2, places


def _component(dataset: Any, name: str, places: Sequence[tuple[float, float, FloatArray]]) -> Any:
    """Return a component as an array [z, y, x] in SI units."""
    variable = dataset[name]
    if {str(dim) for dim in variable.dims} != set(AXES):
        raise InputError(
            f"{name} has the dimensions {', '.join(map(str, variable.dims))}: expected x, y and z; "
            "select one of what is too many, such as one time"
        )
    values = np.asarray(variable.transpose(*AXES).values)
    if values.dtype.kind not in "buif":
        raise InputError(f"{name} has values of type {values.dtype}, expected real numbers")
    factor = unit_factor(name[0].upper(), _unit_text(variable.attrs), name)
    flips = tuple(slice(None, None, -1 if at[0] > at[-1] else 1) for _, _, at in places)
    return values[flips] if factor == 1.0 else values[flips] * np.float64(factor)


def _unit_text(attributes: Mapping[Any, Any]) -> str:
    return str(attributes.get("units", attributes.get("unit", ""))).strip()
