"""What can be computed: one frozen model per kind of question.

A spec holds its parents as ids; bodies with inline parents become such specs in ``worker.questions``.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Final, Literal

from pydantic import (
    BeforeValidator,
    Discriminator,
    Field,
    Tag,
    ValidationInfo,
    field_serializer,
    field_validator,
)
from pydantic_core import PydanticCustomError

from worker.fields import (
    MAX_INTEGER,
    BasisId,
    Closed,
    Component,
    Count,
    Eigenpairs,
    Fraction,
    Index,
    MeshId,
    Sharpness,
    SoftMapId,
    as_three,
    as_tuple,
    one_as_tuple,
    one_or_many,
)
from worker.maps import Descriptors, Matrix, Mixture, NamedDescriptors, Optimal, Points, Uniform

#: Most faces of one question about momentum, and most vertices that one path may pass.
MAX_MOTIONS: Final = 1_000
MAX_STOPS: Final = 10_000


class Spec(Closed):
    """One question.

    `version` is raised when the numbers of its kind change; a body may not ask for `private` kinds.
    """

    version: ClassVar[int]
    private: ClassVar[bool] = False
    kind: str


class Basis(Spec):
    """A partition of unity on a mesh (§4.2): what both methods ask for."""

    version: ClassVar[int] = 1
    kind: Literal["basis"] = "basis"
    mesh: MeshId
    size: Count = 300
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


class PoissonBasis(Basis):
    """Solutions of Δf = −1 on one-rings of farthest-point cells, cut and normalised (§4.2)."""

    method: Literal["poisson"] = "poisson"
    cutoff: Fraction = 0.1


class MaxentBasis(Basis):
    """Weights of local maximum entropy around farthest-point samples: exact on linear functions."""

    method: Literal["maxent"] = "maxent"
    sharpness: Sharpness = 3.0


#: Bases by method.
BASES: Final[Mapping[str, type[Basis]]] = {"maxent": MaxentBasis, "poisson": PoissonBasis}


def with_method(fields: Mapping[str, Any]) -> dict[str, Any]:
    """Fields of a basis with the method that they mean: maxent, or poisson where there is only a cutoff.

    Parameters
    ----------
    fields : mapping

    Returns
    -------
    dict
        A ``method`` that was named stands as it is; nothing is checked here.

    Raises
    ------
    KeyError
        Never here.
    """
    own = PoissonBasis.model_fields.keys() - MaxentBasis.model_fields.keys()
    meant = "poisson" if own & fields.keys() and "sharpness" not in fields else "maxent"
    return {"method": meant, **fields}


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


class SoftMap(Spec):
    """Coefficients C (n0, n) of a soft map between two bases (eq. 8)."""

    version: ClassVar[int] = 1
    kind: Literal["softmap"] = "softmap"
    source: BasisId
    target: BasisId
    map: Annotated[Points | Descriptors | Matrix | Uniform | Mixture | Optimal, Field(discriminator="type")]


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


Vector = Annotated[tuple[Component, Component, Component], BeforeValidator(as_three)]


def _vectors(value: object) -> str:
    """Tell a list of vectors from one, whose items are no lists."""
    inner = value[0] if isinstance(value, list | tuple) and value else None
    return "many" if isinstance(inner, list | tuple) else "one"


class Momentum(_OfSoftMap):
    """Velocity and momentum of the mass, as the source point moves in one face or in several (§3.7)."""

    version: ClassVar[int] = 1
    kind: Literal["momentum"] = "momentum"
    face: Annotated[
        Annotated[Index, Tag("one")]
        | Annotated[
            tuple[Index, ...],
            Field(min_length=1, max_length=MAX_MOTIONS, fail_fast=True),
            BeforeValidator(as_tuple),
            Tag("many"),
        ],
        Discriminator(one_or_many),
    ]
    #: In the units of the uploaded source; one for each face.
    direction: Annotated[
        Annotated[Vector, Tag("one")]
        | Annotated[tuple[Vector, ...], Field(fail_fast=True), BeforeValidator(as_tuple), Tag("many")],
        Discriminator(_vectors),
    ]

    @field_validator("direction")
    @classmethod
    def _one_for_each_face(cls, direction: Any, info: ValidationInfo) -> Any:
        face = info.data.get("face")
        many = isinstance(direction[0], tuple)
        if isinstance(face, tuple) and (not many or len(direction) != len(face)):
            raise PydanticCustomError(
                "direction", "There should be a direction for each of {n} faces", {"n": len(face)}
            )
        if isinstance(face, int) and many:
            raise PydanticCustomError("direction", "One face has one direction: three numbers")
        if not all(any(vector) for vector in (direction if many else (direction,))):
            raise PydanticCustomError("direction", "A direction should not be zero")
        return direction


class Path(_OfSoftMap):
    """Path on the target that follows one on the source, from where that begins (§5.1)."""

    version: ClassVar[int] = 1
    kind: Literal["path"] = "path"
    #: Source vertices, joined by shortest paths.
    source_path: Annotated[
        tuple[Index, ...],
        Field(min_length=1, max_length=MAX_STOPS, fail_fast=True),
        BeforeValidator(as_tuple),
    ]
    start: Index
    #: Longest step along the source path, in √area of the source.
    step: Annotated[float, Field(ge=1e-5, le=1)] = 0.01


class PointMap(Spec):
    """A target vertex for every source vertex: where its mass peaks, or where on the surface it balances."""

    version: ClassVar[int] = 1
    kind: Literal["pointmap"] = "pointmap"
    softmap: SoftMapId
    method: Literal["peak", "barycentre"] = "peak"


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
