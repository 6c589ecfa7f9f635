"""What can be computed, by kind, and the name that its content gives each question.

The models are in ``worker.kinds`` and ``worker.maps``; here they are read, written, named and followed.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping
from functools import cache
from typing import Any, Final, get_args

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel

from worker.fields import Parent, SpecError, validated
from worker.kinds import (
    BASES,
    Basis,
    Descriptor,
    Energy,
    EnergyBlock,
    MaxentBasis,
    Momentum,
    NamedSoftMap,
    Path,
    PointMap,
    PoissonBasis,
    Potential,
    PotentialBlock,
    SoftMap,
    Spec,
    Spectrum,
    with_method,
)
from worker.maps import (
    MAX_MIXED,
    Constraint,
    Descriptors,
    Matrix,
    Mixture,
    NamedDescriptors,
    Optimal,
    Points,
    Uniform,
)

__all__ = [
    "BASES",
    "KINDS",
    "MAX_MIXED",
    "MODELS",
    "PUBLIC_KINDS",
    "UPLOADED_KINDS",
    "Basis",
    "Constraint",
    "Descriptor",
    "Descriptors",
    "Energy",
    "EnergyBlock",
    "Matrix",
    "MaxentBasis",
    "Mixture",
    "Momentum",
    "NamedDescriptors",
    "NamedSoftMap",
    "Optimal",
    "Path",
    "PointMap",
    "Points",
    "PoissonBasis",
    "Potential",
    "PotentialBlock",
    "SoftMap",
    "Spec",
    "Spectrum",
    "Uniform",
    "array_id",
    "derived",
    "dump",
    "load",
    "mesh_id",
    "parent_mark",
    "parents",
    "references",
    "spec_id",
    "versions_digest",
    "with_method",
]

#: Every kind that has a spec, public ones first.
KINDS: Final[Mapping[str, type[Spec]]] = {
    model.model_fields["kind"].default: model
    for model in (
        Basis,
        Spectrum,
        Descriptor,
        SoftMap,
        Potential,
        Energy,
        Momentum,
        Path,
        PointMap,
        PotentialBlock,
        EnergyBlock,
    )
}
#: Every model that a question is an instance of: a basis has one for each method.
MODELS: Final = (*BASES.values(), *(model for model in KINDS.values() if model is not Basis))
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
    model = KINDS[kind]
    if model is Basis:
        fields = with_method(fields)
        method = fields["method"]
        if not isinstance(method, str) or method not in BASES:
            raise SpecError(("/method", f"Input should be one of {', '.join(BASES)}"))
        model = BASES[method]
    return validated(model, fields, "")


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
