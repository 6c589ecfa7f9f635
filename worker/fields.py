"""What specs are built from: the fields that hold parents and numbers, and the errors that refuse them."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Final, Literal, TypeVar

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, GetCoreSchemaHandler, ValidationError
from pydantic_core import CoreSchema, PydanticCustomError, core_schema

#: Most errors that one answer lists.
MAX_ERRORS: Final = 10
#: Integers up to here survive every JSON reader.
MAX_INTEGER: Final = 2**53 - 1
#: Longest key that a pointer repeats.
MAX_KEY: Final = 64

Model = TypeVar("Model", bound=BaseModel)

_ID = re.compile(r"(?P<kind>[a-z]+(?:_[a-z]+)*)-[0-9a-f]{32}")


class Closed(BaseModel):
    """Strict, frozen and closed: `true` is no integer, an unknown field is an error, NaN is refused."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)


class SpecError(Exception):
    """A spec that was refused.

    Parameters
    ----------
    *errors : tuple of (str, str)
        JSON pointer (RFC 6901) into the body, and what is wrong there. At most ten are kept.
    """

    def __init__(self, *errors: tuple[str, str]) -> None:
        self.errors = errors[:MAX_ERRORS]
        super().__init__("; ".join(f"{pointer or '/'}: {detail}" for pointer, detail in self.errors))


class MalformedBody(SpecError):
    """A body that is not JSON as RFC 8259 means it, or cannot be read without guessing."""


def _article(noun: str) -> str:
    return "an" if noun[0] in "aeiou" else "a"


def kind_of(id_: str) -> str | None:
    """Kind that an id begins with, or None if it is no id at all."""
    match = _ID.fullmatch(id_)
    return match["kind"] if match else None


@dataclass(frozen=True)
class Parent:
    """Marks a field that holds a parent's id, and says what may stand inline in its place.

    Attributes
    ----------
    kinds : tuple of str
        Kinds that the id may have; those with a spec may stand inline in a body.
    dtype : {"int64", "float64"} or None
        Type of an inline list, or None where no list may stand.
    ndim : int
        Depth of an inline list.
    """

    kinds: tuple[str, ...]
    dtype: Literal["int64", "float64"] | None = None
    ndim: int = 1

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        pattern = f"^(?:{'|'.join(self.kinds)})-[0-9a-f]{{32}}$"
        return core_schema.no_info_before_validator_function(
            self._check, core_schema.str_schema(pattern=pattern)
        )

    def _check(self, value: object) -> object:
        if isinstance(value, str) and kind_of(value) in self.kinds:
            return value
        raise PydanticCustomError("parent", "Input should be {wanted}", {"wanted": self.wanted})

    @property
    def wanted(self) -> str:
        """What may stand in the field, in words."""
        forms = [f"the id of {_article(kind)} {kind} ({kind}-…)" for kind in self.kinds]
        forms += [f"an inline {kind} spec" for kind in self.kinds if kind not in ("mesh", "array")]
        forms += [f"a {self.ndim}-D list of numbers"] if self.dtype else []
        return " or ".join(forms)


MeshId = Annotated[str, Parent(("mesh",))]
BasisId = Annotated[str, Parent(("basis",))]
SoftMapId = Annotated[str, Parent(("softmap",))]
TargetsId = Annotated[str, Parent(("array",), "int64", 1)]
MatrixId = Annotated[str, Parent(("array",), "float64", 2)]
DescriptorId = Annotated[str, Parent(("array", "descriptor"), "float64", 2)]

Count = Annotated[int, Field(ge=1, le=MAX_INTEGER)]
Index = Annotated[int, Field(ge=0, le=MAX_INTEGER)]
Eigenpairs = Annotated[int, Field(ge=2, le=MAX_INTEGER)]
Fraction = Annotated[float, Field(gt=0, lt=1)]
Sharpness = Annotated[float, Field(ge=0.5, le=50)]
Positive = Annotated[float, Field(gt=0)]
#: Adding zero turns -0.0, which asks the same question, into 0.0.
Weight = Annotated[float, Field(ge=0), AfterValidator(lambda weight: weight + 0.0)]
#: A component of a vector; -0.0 is 0.0 here too.
Component = Annotated[float, AfterValidator(lambda component: component + 0.0)]


def as_tuple(value: object) -> object:
    """Let a list, as JSON has it, stand for a tuple."""
    return tuple(value) if isinstance(value, list) else value


def as_three(value: object) -> object:
    """Let a list of three, as JSON has it, stand for a tuple."""
    if isinstance(value, list | tuple) and len(value) != 3:
        raise PydanticCustomError("three", "Input should be three numbers")
    return as_tuple(value)


def one_as_tuple(value: object) -> object:
    """Let a single item stand for a tuple of one."""
    return tuple(value) if isinstance(value, list | tuple) else (value,)


def one_or_many(value: object) -> str:
    """Tell a list from a single item, for unions of both."""
    return "many" if isinstance(value, list | tuple) else "one"


def validated(model: type[Model], fields: Mapping[str, Any], pointer: str) -> Model:
    """Make a model of fields that stand at a pointer of the body.

    Raises
    ------
    SpecError
        Naming at most ten places, never quoting what stands there.
    """
    try:
        return model.model_validate(dict(fields))
    except ValidationError as error:
        found = error.errors(include_url=False, include_context=False, include_input=False)
    # Pydantic quotes a tag that it does not know; everything else it says names only what it wants.
    errors = [
        (
            pointer + _pointer(one["loc"], fields),
            "Input should be of a known type" if one["type"] == "union_tag_invalid" else one["msg"],
        )
        for one in found[:MAX_ERRORS]
    ]
    raise SpecError(*errors)


def escaped(key: str) -> str:
    """One reference token of a JSON pointer; a key too long to repeat becomes nothing."""
    return "/" + key.replace("~", "~0").replace("/", "~1") if len(key) <= MAX_KEY else ""


def _pointer(location: tuple[int | str, ...], value: object) -> str:
    """Turn pydantic's location into a JSON pointer, without the tags of unions, which no body holds."""
    pointer = ""
    for position, step in enumerate(location):
        if isinstance(value, Mapping) and isinstance(step, str):
            if step not in value and position < len(location) - 1:
                continue
            value = value.get(step)
            pointer += escaped(step)
        elif isinstance(value, list | tuple) and isinstance(step, int) and step < len(value):
            value = value[step]
            pointer += f"/{step}"
    return pointer
