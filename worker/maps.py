"""Where a soft map comes from: one frozen model per type of map."""

from __future__ import annotations

from typing import Annotated, Final, Literal

from pydantic import BeforeValidator, ConfigDict, Field, ValidationInfo, field_serializer, field_validator
from pydantic_core import PydanticCustomError

from worker.fields import (
    Closed,
    DescriptorId,
    Fraction,
    Index,
    MatrixId,
    Positive,
    SoftMapId,
    TargetsId,
    Weight,
    as_tuple,
    one_as_tuple,
)

#: Most soft maps that one mixture mixes.
MAX_MIXED: Final = 1_000
#: Most landmarks, linear constraints and iterations of one optimal map.
MAX_LANDMARKS: Final = 1_000
MAX_CONSTRAINTS: Final = 50
MAX_ITERATIONS: Final = 10_000
#: How far the weights of a mixture may sum from 1: far above the rounding of a sum.
WEIGHT_TOLERANCE: Final = 1e-9

Landmark = Annotated[tuple[Index, Index], BeforeValidator(as_tuple)]
Region = Annotated[
    tuple[Index, ...],
    Field(min_length=1, max_length=100_000, fail_fast=True),
    BeforeValidator(one_as_tuple),
]


class Points(Closed):
    """A target vertex, or a face and barycentric coordinates, per source vertex."""

    type: Literal["points"] = "points"
    targets: TargetsId
    barycentric: MatrixId | None = None


class Descriptors(Closed):
    """Nearness of descriptors: ρ(x,y) ∝ exp(−‖f₀(x)−f(y)‖²/σ²)."""

    type: Literal["descriptors"] = "descriptors"
    source: DescriptorId
    target: DescriptorId
    sigma: Positive = 0.1


class NamedDescriptors(Closed):
    """Short for `Descriptors` with the named descriptor of either mesh; in bodies only."""

    type: Literal["descriptors"] = "descriptors"
    descriptor: Literal["wks", "hks"]
    sigma: Positive = 0.1


class Matrix(Closed):
    """The user's own coefficients."""

    type: Literal["matrix"] = "matrix"
    coefficients: MatrixId


class Uniform(Closed):
    """The map that sends every point everywhere."""

    type: Literal["uniform"] = "uniform"


class Constraint(Closed):
    """Linear constraint: the mass of a source region spreads evenly over a target region.

    A region is a list of vertices, weighted by area; a single vertex is written as the number alone.
    """

    source: Region
    target: Region

    @field_serializer("source", "target")
    def _write_region(self, region: tuple[int, ...]) -> int | tuple[int, ...]:
        return region[0] if len(region) == 1 else region


class Optimal(Closed):
    """The map of least E_D + λ E_b under landmarks and constraints, proven to a tolerance (§5.3)."""

    model_config = ConfigDict(validate_default=True)

    type: Literal["optimal"] = "optimal"
    #: Pairs of a source and a target vertex.
    landmarks: Annotated[
        tuple[Landmark, ...],
        Field(max_length=MAX_LANDMARKS, fail_fast=True),
        BeforeValidator(as_tuple),
    ] = ()
    #: λ.
    bijectivity_weight: Weight = 1.0
    #: Gap over energy at which the map is good enough.
    tolerance: Annotated[float, Field(ge=1e-9, le=1)] = 1e-3
    max_iterations: Annotated[int, Field(ge=0, le=MAX_ITERATIONS)] = 500
    method: Literal["interior", "softmax"] = "interior"
    constraints: Annotated[
        tuple[Constraint, ...],
        Field(max_length=MAX_CONSTRAINTS, fail_fast=True),
        BeforeValidator(as_tuple),
    ] = ()
    #: A map between the same two meshes to start from, of any bases; else the uniform map.
    start: SoftMapId | None = None
    regularisation: Fraction = 1e-5
    #: Weight of a linear term that sharpens the map: ∫∫ ρ(x, y) ‖f₀(x) − f(y)‖² dy dx.
    attachment: Weight = 0.0
    #: Its f₀ and f; without them they are the geodesic distances to the landmarks.
    source: DescriptorId | None = None
    target: DescriptorId | None = None

    @field_validator("landmarks")
    @classmethod
    def _one_target_each(cls, landmarks: tuple[tuple[int, int], ...]) -> tuple[tuple[int, int], ...]:
        targets: dict[int, int] = {}
        for k, (v0, v) in enumerate(landmarks):
            if targets.setdefault(v0, v) != v:
                raise PydanticCustomError(
                    "landmarks", "Landmark {k} sends vertex {v0} to a second target", {"k": k, "v0": v0}
                )
        return landmarks

    @field_validator("constraints")
    @classmethod
    def _by_interior_points(
        cls, constraints: tuple[Constraint, ...], info: ValidationInfo
    ) -> tuple[Constraint, ...]:
        if constraints and info.data.get("method") == "softmax":
            raise PydanticCustomError("constraints", "Constraints need the method 'interior'")
        return constraints

    @field_validator("target")
    @classmethod
    def _attached_by_something(cls, target: str | None, info: ValidationInfo) -> str | None:
        attachment, source = info.data.get("attachment", 0.0), info.data.get("source", target)
        if (source is None) != (target is None):
            raise PydanticCustomError("target", "Descriptors come in pairs: of the source and of the target")
        if target is not None and not attachment:
            raise PydanticCustomError("target", "Descriptors need an attachment above 0")
        if target is None and attachment and not info.data.get("landmarks", True):
            raise PydanticCustomError("target", "An attachment needs landmarks or descriptors")
        return target


class Mixture(Closed):
    """A convex combination of soft maps on the same two bases (Fig. 4a)."""

    type: Literal["mixture"] = "mixture"
    maps: Annotated[
        tuple[SoftMapId, ...],
        Field(min_length=1, max_length=MAX_MIXED),
        BeforeValidator(as_tuple),
    ]
    weights: Annotated[
        tuple[Weight, ...],
        Field(max_length=MAX_MIXED),
        BeforeValidator(as_tuple),
    ]

    @field_validator("weights")
    @classmethod
    def _sum_to_one(cls, weights: tuple[float, ...], info: ValidationInfo) -> tuple[float, ...]:
        maps = info.data.get("maps", weights)
        if len(maps) != len(weights):
            raise PydanticCustomError(
                "weights", "There are {n} weights for {m} maps", {"n": len(weights), "m": len(maps)}
            )
        total = sum(weights)
        if not abs(total - 1) <= WEIGHT_TOLERANCE:
            raise PydanticCustomError(
                "weights", "Weights should sum to 1, these sum to {total}", {"total": total}
            )
        return weights
