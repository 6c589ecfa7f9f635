"""Where a soft map comes from: one frozen model per type of map."""

from __future__ import annotations

from typing import Annotated, Final, Literal

from pydantic import BeforeValidator, Field, ValidationInfo, field_validator
from pydantic_core import PydanticCustomError

from worker.fields import (
    Closed,
    DescriptorId,
    MatrixId,
    Positive,
    SoftMapId,
    TargetsId,
    Weight,
    as_tuple,
)

#: Most soft maps that one mixture mixes.
MAX_MIXED: Final = 1_000
#: How far the weights of a mixture may sum from 1: far above the rounding of a sum.
WEIGHT_TOLERANCE: Final = 1e-9


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
