"""Bodies into questions: JSON with inline parents and lists becomes a graph of specs that hold ids."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Final, NoReturn, TypeVar

import numpy.typing as npt
from pydantic import BaseModel

from worker import specs
from worker.bodies import array_from_lists, decoded
from worker.fields import MAX_ERRORS, Parent, SpecError, escaped, kind_of, validated
from worker.specs import Spec

#: Deepest nesting of inline specs, and most of them, in one body.
MAX_DEPTH: Final = 32
MAX_NODES: Final = 1_000

_M = TypeVar("_M", bound=BaseModel)

#: What is known under an id: the spec of an artifact, a job or something forgotten; None for an unknown id.
Lookup = Callable[[str], Spec | None]

_MAPS: Final[Mapping[str, type[BaseModel]]] = {
    model.model_fields["type"].default: model
    for model in (
        specs.Points,
        specs.Descriptors,
        specs.Matrix,
        specs.Uniform,
        specs.Mixture,
        specs.Optimal,
    )
}


@dataclass(frozen=True, eq=False)
class SpecTree:
    """A well-formed body: every inline spec and list once, parents first, the root last.

    Attributes
    ----------
    specs : mapping of id to Spec
        Ids of and above a soft map with named descriptors are provisional: `flatten` gives the final ones.
    arrays : mapping of id to ndarray
        Inline lists, int64 (n,), float64 (n,) or float64 (n, m).
    pointers : mapping of id to str
        Where in the body each first stands.
    """

    specs: dict[str, Spec]
    arrays: dict[str, npt.NDArray[Any]]
    pointers: dict[str, str]

    @property
    def root(self) -> str:
        """Id of the body's own spec; provisional."""
        return next(reversed(self.specs))


@dataclass(frozen=True, eq=False)
class Graph:
    """Specs by id, parents before children, the root last; uploads (meshes, arrays) are not in it.

    Attributes
    ----------
    specs : mapping of id to Spec
    pointers : mapping of id to str
        Where in the body a spec stands; those that are not in the body have the place that led to them.
    arrays : mapping of id to ndarray
        Inline lists, to be stored before anything is planned.
    """

    specs: dict[str, Spec]
    pointers: dict[str, str]
    arrays: dict[str, npt.NDArray[Any]]

    @property
    def root(self) -> str:
        """Id of the question."""
        return next(reversed(self.specs))

    def needs(self, id_: str) -> tuple[str, ...]:
        """Ids of all that making `id_` reads; see the function of this name."""
        return needs(self.specs[id_], self.specs.get)


def needs(spec: Spec, lookup: Lookup) -> tuple[str, ...]:
    """Ids of all that making a spec reads: parents, a soft map's bases and a basis' mesh."""
    found: dict[str, None] = {}
    waiting = list(specs.parents(spec).values())
    while waiting:
        id_ = waiting.pop(0)
        if id_ in found:
            continue
        found[id_] = None
        parent = lookup(id_) if kind_of(id_) in ("softmap", "basis") else None
        if isinstance(parent, specs.SoftMap):
            waiting += [parent.source, parent.target]
        elif isinstance(parent, specs.Basis):
            waiting.append(parent.mesh)
    return tuple(found)


def parse(body: bytes | str) -> SpecTree:
    """Read a spec with inline parents and lists.

    Raises
    ------
    MalformedBody
        If the body is no JSON, or holds NaN, a repeated key, a lone surrogate or absurd nesting.
    SpecError
        If it is no spec.
    """
    value = decoded(body)
    reader = _Reader()
    reader.spec(value, specs.PUBLIC_KINDS, "")
    if reader.errors:
        raise SpecError(*reader.errors)
    return SpecTree(reader.specs, reader.arrays, reader.pointers)


class _Refused(Exception):
    """A spec that was refused, its errors noted."""


class _Reader:
    """Walks a body once, parents first, noting errors until there are ten."""

    def __init__(self) -> None:
        self.specs: dict[str, Spec] = {}
        self.arrays: dict[str, npt.NDArray[Any]] = {}
        self.pointers: dict[str, str] = {}
        self.errors: list[tuple[str, str]] = []
        self._nodes = 0

    def spec(self, value: object, kinds: tuple[str, ...], pointer: str, depth: int = 0) -> str:
        """Read an inline spec of one of some kinds; the id is a stand-in where the spec was refused."""
        self._nodes += 1
        if depth > MAX_DEPTH:
            raise SpecError((pointer, f"Inline specs may be {MAX_DEPTH} deep"))
        if self._nodes > MAX_NODES:
            raise SpecError((pointer, f"A body may hold {MAX_NODES} inline specs"))
        try:
            model = self._chosen(value, "kind", {kind: specs.KINDS[kind] for kind in kinds}, pointer)
            fields: dict[str, Any] = dict(value)  # type: ignore[call-overload]
            noted = len(self.errors)
            if model is specs.Basis:
                fields = specs.with_method(fields)
                model = self._chosen(fields, "method", specs.BASES, pointer)
            if model is specs.SoftMap and "map" in fields:
                inner = fields["map"] = self._map(fields["map"], f"{pointer}/map", depth)
                model = specs.NamedSoftMap if isinstance(inner, specs.NamedDescriptors) else specs.SoftMap
            spec = self._model(model, fields, pointer, depth)
            if len(self.errors) > noted:
                raise _Refused
        except _Refused:
            return f"{kinds[0]}-{'0' * 32}"
        id_ = specs.spec_id(spec)
        self.specs.setdefault(id_, spec)
        self.pointers.setdefault(id_, pointer)
        return id_

    def _map(self, value: object, pointer: str, depth: int) -> BaseModel:
        """Read a map; one that was refused is stood in for, so that its neighbours are read too."""
        try:
            model = self._chosen(value, "type", _MAPS, pointer)
            fields: dict[str, Any] = dict(value)  # type: ignore[call-overload]
            if model is specs.Descriptors and "descriptor" in fields:
                model = specs.NamedDescriptors
            return self._model(model, fields, pointer, depth)
        except _Refused:
            return specs.Uniform()

    def _chosen(self, value: object, tag: str, models: Mapping[str, type[_M]], pointer: str) -> type[_M]:
        """Model that a tag names."""
        if not isinstance(value, dict):
            self._refuse(pointer, "Input should be an object")
        name = value.get(tag)
        if not isinstance(name, str) or name not in models:
            self._refuse(f"{pointer}/{tag}", f"Input should be {' or '.join(repr(name) for name in models)}")
        return models[name]

    def _model(self, model: type[_M], fields: dict[str, Any], pointer: str, depth: int) -> _M:
        """Make a model of fields, inline parents and lists replaced by their ids."""
        for key in fields:
            if key not in model.model_fields:
                self._note(pointer + escaped(key), _stray(model, key))
        known = {key: value for key, value in fields.items() if key in model.model_fields}
        for key, value in known.items():
            mark, many = specs.parent_mark(model, key)
            at = f"{pointer}/{key}"
            if mark and many and isinstance(value, list):
                known[key] = [self._parent(item, mark, f"{at}/{k}", depth) for k, item in enumerate(value)]
            elif mark:
                known[key] = self._parent(value, mark, at, depth)
        try:
            return validated(model, known, pointer)
        except SpecError as error:
            for place, detail in error.errors:
                self._note(place, detail)
            raise _Refused from None

    def _parent(self, value: object, mark: Parent, pointer: str, depth: int) -> object:
        """Id of an inline parent or list; anything else is left for the model to judge."""
        inline = tuple(kind for kind in mark.kinds if kind not in specs.UPLOADED_KINDS)
        if isinstance(value, dict) and inline:
            return self.spec(value, inline, pointer, depth + 1)
        if isinstance(value, list) and mark.dtype:
            try:
                array = array_from_lists(value, mark.dtype, mark.ndim, pointer)
            except SpecError as error:
                self._note(*error.errors[0])
                return f"array-{'0' * 32}"
            id_ = specs.array_id(array)
            self.arrays[id_] = array
            return id_
        return value

    def _note(self, pointer: str, detail: str) -> None:
        self.errors.append((pointer, detail))
        if len(self.errors) >= MAX_ERRORS:
            raise SpecError(*self.errors)

    def _refuse(self, pointer: str, detail: str) -> NoReturn:
        self._note(pointer, detail)
        raise _Refused


def _stray(model: type[BaseModel], key: str) -> str:
    """What is wrong with a field that a model does not have."""
    if issubclass(model, specs.Basis):
        for method, other in specs.BASES.items():
            if key in other.model_fields:
                return f"This field belongs to the method {method!r}"
    return "There is no such field"


def flatten(tree: SpecTree, lookup: Lookup) -> Graph:
    """Give every spec of a body its final id and add what is known of its ancestors.

    Parameters
    ----------
    tree : SpecTree
        What `parse` read.
    lookup : callable
        Spec known under an id of a computed kind, or None.

    Returns
    -------
    Graph
        With the ancestors of what the body names, as far as `lookup` knows them.

    Raises
    ------
    SpecError
        If the body names a computed id that is unknown, or a mixture mixes maps between other bases.
    """
    known: dict[str, Spec] = {}
    pointers: dict[str, str] = {}
    final: dict[str, str] = {}

    def spec_of(id_: str) -> Spec | None:
        return known.get(id_) or lookup(id_)

    def add(spec: Spec, pointer: str) -> str:
        id_ = specs.spec_id(spec)
        known.setdefault(id_, spec)
        pointers.setdefault(id_, pointer)
        return id_

    id_ = ""
    for provisional, given in tree.specs.items():
        pointer = tree.pointers[provisional]
        spec = _renamed(given, final)
        for path, parent in specs.references(spec):
            if kind_of(parent) not in specs.UPLOADED_KINDS and spec_of(parent) is None:
                raise SpecError((f"{pointer}/{path}", f"There is no such {kind_of(parent)}"))
        if isinstance(spec, specs.NamedSoftMap):
            source, target = _descriptors(spec, spec_of)
            pair = specs.Descriptors(
                source=add(source, f"{pointer}/map"),
                target=add(target, f"{pointer}/map"),
                sigma=spec.map.sigma,
            )
            spec = specs.SoftMap(source=spec.source, target=spec.target, map=pair)
        elif isinstance(spec, specs.SoftMap) and isinstance(spec.map, specs.Mixture):
            for k, mixed in enumerate(spec.map.maps):
                part = spec_of(mixed)
                if not isinstance(part, specs.SoftMap) or (part.source, part.target) != (
                    spec.source,
                    spec.target,
                ):
                    raise SpecError(
                        (f"{pointer}/map/maps/{k}", "A mixture mixes maps between its own two bases")
                    )
        id_ = final[provisional] = add(spec, pointer)
    return Graph(*_ancestry(id_, spec_of, pointers), tree.arrays)


def ancestry(id_: str, lookup: Lookup) -> Graph:
    """Graph of a spec that is known already, with its ancestors as far as they are.

    Raises
    ------
    KeyError
        If `id_` itself is unknown.
    """
    if lookup(id_) is None:
        raise KeyError(id_)
    return Graph(*_ancestry(id_, lookup, {id_: ""}), {})


def _ancestry(root: str, lookup: Lookup, pointers: dict[str, str]) -> tuple[dict[str, Spec], dict[str, str]]:
    """Specs that a root follows from, parents first, and where each stands; without recursion."""
    known: dict[str, Spec] = {}
    ordered: dict[str, Spec] = {}
    waiting = [(root, False)]
    while waiting:
        id_, parents_done = waiting.pop()
        if id_ in ordered:
            continue
        if parents_done:
            ordered[id_] = known[id_]
            continue
        spec = known.get(id_) or lookup(id_)
        if spec is None:
            continue
        known[id_] = spec
        waiting.append((id_, True))
        follow = specs.derived(spec)
        known.update((specs.spec_id(parent), parent) for parent in follow.values())
        for path, parent in specs.parents(spec).items():
            if kind_of(parent) not in specs.UPLOADED_KINDS:
                pointers.setdefault(parent, pointers[id_] if path in follow else f"{pointers[id_]}/{path}")
                waiting.append((parent, False))
    return ordered, {id_: pointers[id_] for id_ in ordered}


def _renamed(spec: Spec, names: Mapping[str, str]) -> Spec:
    """Put final ids in the place of provisional ones."""
    if all(names.get(id_, id_) == id_ for _, id_ in specs.references(spec)):
        return spec
    return validated(type(spec), _replaced(specs.dump(spec), names), "")


def _replaced(value: Any, names: Mapping[str, str]) -> Any:
    if isinstance(value, dict):
        return {key: _replaced(item, names) for key, item in value.items()}
    if isinstance(value, list):
        return [_replaced(item, names) for item in value]
    return names.get(value, value) if isinstance(value, str) else value


def _descriptors(spec: specs.NamedSoftMap, lookup: Lookup) -> tuple[specs.Descriptor, specs.Descriptor]:
    """The named descriptor of the source's and the target's mesh, each with the other as partner."""
    bases = (lookup(spec.source), lookup(spec.target))
    source, target = (basis.mesh for basis in bases if isinstance(basis, specs.Basis))
    return (
        specs.Descriptor(mesh=source, type=spec.map.descriptor, partner=target),
        specs.Descriptor(mesh=target, type=spec.map.descriptor, partner=source),
    )
