"""What can be computed: one frozen model per kind, and the name its content gives it.

A spec holds its parents as ids; bodies with inline parents become such specs in ``worker.questions``.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping
from functools import cache
from typing import Annotated, Any, ClassVar, Final, Literal, get_args

import numpy as np
import numpy.typing as npt
from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    ValidationInfo,
    field_serializer,
    field_validator,
)
from pydantic_core import PydanticCustomError

from worker.fields import (
    MAX_INTEGER,
    BasisId,
    Count,
    DescriptorId,
    Eigenpairs,
    Fraction,
    Index,
    MatrixId,
    MeshId,
    Parent,
    Positive,
    SoftMapId,
    SpecError,
    TargetsId,
    Weight,
    as_tuple,
    one_as_tuple,
    validated,
)

#: Most soft maps that one mixture mixes.
MAX_MIXED: Final = 1_000
#: How far the weights of a mixture may sum from 1: far above the rounding of a sum.
WEIGHT_TOLERANCE: Final = 1e-9


class _Model(BaseModel):
    """Strict, frozen and closed: `true` is no integer, an unknown field is an error, NaN is refused."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)


class Spec(_Model):
    """One question.

    `version` is raised when the numbers of its kind change; a body may not ask for `private` kinds.
    """

    version: ClassVar[int]
    private: ClassVar[bool] = False
    kind: str


class Basis(Spec):
    """A partition of unity on a mesh (§4.2)."""

    version: ClassVar[int] = 1
    kind: Literal["basis"] = "basis"
    mesh: MeshId
    size: Count = 300
    method: Literal["poisson"] = "poisson"
    cutoff: Fraction = 0.1
    #: The first samples; a single one is written as the number alone.
    first: Annotated[tuple[Index, ...], Field(fail_fast=True), BeforeValidator(one_as_tuple)] = (0,)

    @field_validator("first")
    @classmethod
    def _first_samples(cls, first: tuple[int, ...], info: ValidationInfo) -> tuple[int, ...]:
        if not first or len(set(first)) < len(first):
            raise PydanticCustomError("first", "The first samples should be distinct, and at least one")
        if len(first) > info.data.get("size", MAX_INTEGER):
            raise PydanticCustomError("first", "There should be at most `size` first samples")
        return first

    @field_serializer("first")
    def _write_first(self, first: tuple[int, ...]) -> int | tuple[int, ...]:
        return first[0] if len(first) == 1 else first


class Spectrum(Spec):
    """The first eigenpairs of a mesh's Laplacian."""

    version: ClassVar[int] = 1
    kind: Literal["spectrum"] = "spectrum"
    mesh: MeshId
    eigenpairs: Eigenpairs = 200


class Descriptor(Spec):
    """HKS or WKS at every vertex; with a partner, on the scales that the two meshes share."""

    version: ClassVar[int] = 1
    kind: Literal["descriptor"] = "descriptor"
    mesh: MeshId
    type: Literal["wks", "hks"]
    count: Count = 100
    eigenpairs: Eigenpairs = 200
    partner: MeshId | None = None

    @field_validator("count")
    @classmethod
    def _enough_energies(cls, count: int, info: ValidationInfo) -> int:
        if info.data.get("type") == "wks" and count < 28:
            raise PydanticCustomError("count", "WKS needs at least 28 energies, or their range reverses")
        return count

    @field_validator("partner")
    @classmethod
    def _other_partner(cls, partner: str | None, info: ValidationInfo) -> str | None:
        # A mesh shares its scales with itself: the same question as without a partner.
        return None if partner == info.data.get("mesh") else partner


class Points(_Model):
    """A target vertex, or a face and barycentric coordinates, per source vertex."""

    type: Literal["points"] = "points"
    targets: TargetsId
    barycentric: MatrixId | None = None


class Descriptors(_Model):
    """Nearness of descriptors: ρ(x,y) ∝ exp(−‖f₀(x)−f(y)‖²/σ²)."""

    type: Literal["descriptors"] = "descriptors"
    source: DescriptorId
    target: DescriptorId
    sigma: Positive = 0.1


class NamedDescriptors(_Model):
    """Short for `Descriptors` with the named descriptor of either mesh; in bodies only."""

    type: Literal["descriptors"] = "descriptors"
    descriptor: Literal["wks", "hks"]
    sigma: Positive = 0.1


class Matrix(_Model):
    """The user's own coefficients."""

    type: Literal["matrix"] = "matrix"
    coefficients: MatrixId


class Uniform(_Model):
    """The map that sends every point everywhere."""

    type: Literal["uniform"] = "uniform"


class Mixture(_Model):
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


class SoftMap(Spec):
    """Coefficients C (n0, n) of a soft map between two bases (eq. 8)."""

    version: ClassVar[int] = 1
    kind: Literal["softmap"] = "softmap"
    source: BasisId
    target: BasisId
    map: Annotated[Points | Descriptors | Matrix | Uniform | Mixture, Field(discriminator="type")]


class NamedSoftMap(Spec):
    """A soft map with named descriptors, until the meshes of its bases are known; in bodies only."""

    version: ClassVar[int] = SoftMap.version
    kind: Literal["softmap"] = "softmap"
    source: BasisId
    target: BasisId
    map: NamedDescriptors


class _OfSoftMap(Spec):
    softmap: SoftMapId
    regularisation: Fraction = 1e-5


class Potential(_OfSoftMap):
    """Transportation potentials q of every source face (eq. 9)."""

    version: ClassVar[int] = 1
    kind: Literal["potential"] = "potential"


class Energy(_OfSoftMap):
    """Dirichlet and bijectivity energies, their densities and, if asked, gradients (eqs. 10–13, prop. 7)."""

    version: ClassVar[int] = 1
    kind: Literal["energy"] = "energy"
    gradient: bool = False


class _Block(_OfSoftMap):
    private: ClassVar[bool] = True
    start: Index
    stop: Index

    @field_validator("stop")
    @classmethod
    def _not_empty(cls, stop: int, info: ValidationInfo) -> int:
        if stop <= info.data.get("start", -1):
            raise PydanticCustomError("stop", "A block should hold at least one face")
        return stop


class PotentialBlock(_Block):
    """`Potential` of the source faces from `start` up to, not including, `stop`."""

    version: ClassVar[int] = Potential.version
    kind: Literal["potential_block"] = "potential_block"


class EnergyBlock(_Block):
    """The Dirichlet part of `Energy` on the source faces from `start` up to, not including, `stop`."""

    version: ClassVar[int] = Energy.version
    kind: Literal["energy_block"] = "energy_block"
    gradient: bool = False


#: Every kind that has a spec, public ones first.
KINDS: Final[Mapping[str, type[Spec]]] = {
    model.model_fields["kind"].default: model
    for model in (Basis, Spectrum, Descriptor, SoftMap, Potential, Energy, PotentialBlock, EnergyBlock)
}
#: Kinds that a body may ask for.
PUBLIC_KINDS: Final = tuple(kind for kind, model in KINDS.items() if not model.private)
#: Kinds that are uploaded, not computed.
UPLOADED_KINDS: Final = ("mesh", "array")


@cache
def parent_mark(model: type[BaseModel], field: str) -> tuple[Parent | None, bool]:
    """How a field holds parents: its mark, or None, and whether it holds a list of them."""
    info = model.model_fields[field]
    for mark in info.metadata:
        if isinstance(mark, Parent):
            return mark, False
    many = getattr(info.annotation, "__origin__", None) is tuple
    for argument in get_args(info.annotation):
        for mark in getattr(argument, "__metadata__", ()):
            if isinstance(mark, Parent):
                return mark, many
    return None, False


def references(spec: BaseModel, prefix: str = "") -> Iterator[tuple[str, str]]:
    """Ids that a spec holds, each after its path (a JSON pointer without the first slash: ``map/maps/0``)."""
    for field in type(spec).model_fields:
        value = getattr(spec, field)
        mark, many = parent_mark(type(spec), field)
        if isinstance(value, BaseModel):
            yield from references(value, f"{prefix}{field}/")
        elif mark and many:
            yield from ((f"{prefix}{field}/{k}", item) for k, item in enumerate(value))
        elif mark and value is not None:
            yield f"{prefix}{field}", value


def derived(spec: Spec) -> dict[str, Spec]:
    """Parents that are not fields but follow from them, by name: the spectra behind a descriptor."""
    if not isinstance(spec, Descriptor):
        return {}
    spectra: dict[str, Spec] = {"spectrum": Spectrum(mesh=spec.mesh, eigenpairs=spec.eigenpairs)}
    if spec.partner is not None:
        spectra["partner_spectrum"] = Spectrum(mesh=spec.partner, eigenpairs=spec.eigenpairs)
    return spectra


def parents(spec: Spec) -> dict[str, str]:
    """Ids of what a spec is made from, by path; derived parents included."""
    return dict(references(spec)) | {name: spec_id(parent) for name, parent in derived(spec).items()}


def dump(spec: Spec) -> dict[str, Any]:
    """Fields of a spec as JSON can write them, defaults written out; `load` reads them back."""
    return spec.model_dump(mode="json")


def load(fields: Mapping[str, Any]) -> Spec:
    """Read a spec whose parents are ids, private kinds included.

    Raises
    ------
    SpecError
        If it is none.
    """
    kind = fields.get("kind")
    if not isinstance(kind, str) or kind not in KINDS:
        raise SpecError(("/kind", f"Input should be one of {', '.join(KINDS)}"))
    return validated(KINDS[kind], fields, "")


def spec_id(spec: Spec) -> str:
    """Name of a question: its kind and 128 bits of sha256 over canonical JSON of kind, version and fields.

    Fields are written with their defaults, sorted by name, without blanks, numbers in the shortest form
    of their type. The same question has the same id for ever, until `version` says that its numbers changed.
    """
    fields = dump(spec)
    del fields["kind"]
    text = json.dumps(
        [spec.kind, spec.version, fields], sort_keys=True, separators=(",", ":"), allow_nan=False
    )
    return f"{spec.kind}-{hashlib.sha256(text.encode()).hexdigest()[:32]}"


def array_id(array: npt.NDArray[Any]) -> str:
    """Name of an array: sha256 over type tag, dtype, shape and the little-endian C-order bytes."""
    return _content_id("array", array)


def mesh_id(vertices: npt.NDArray[np.float64], faces: npt.NDArray[np.int64]) -> str:
    """Name of a mesh: sha256 over its decoded vertices and faces, in order."""
    return _content_id("mesh", np.asarray(vertices, dtype="<f8"), np.asarray(faces, dtype="<i8"))


def _content_id(kind: str, *arrays: npt.NDArray[Any]) -> str:
    digest = hashlib.sha256(kind.encode())
    for array in arrays:
        little = np.asarray(array, dtype=array.dtype.newbyteorder("<"), order="C")
        # The header tells how many bytes follow: no two contents are written alike.
        digest.update(f"\n{array.dtype.name} {list(array.shape)}\n".encode())
        digest.update(little.reshape(-1).view(np.uint8).data)
    return f"{kind}-{digest.hexdigest()[:32]}"


def versions_digest() -> str:
    """Eight hex digits that change when any kind's version does: old workers leave new tasks alone."""
    text = json.dumps({kind: model.version for kind, model in KINDS.items()}, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:8]
