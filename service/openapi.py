"""What /openapi.json says beyond the models of replies: bodies, examples, and problems by status."""

from __future__ import annotations

from typing import Any

from pydantic import BaseModel

from service.errors import PROBLEM_TYPE, TITLES
from service.parsing import FORMATS
from service.replies import Problem
from service.representations import JSON, NPY, RAW

_MESH = "mesh-6e27ac67bd1abbbc1b4d8e0b6a5a3d54"
_OTHER = "mesh-1f0c9a1d8c4ce7a9b9c1c6f5c1a0d2e3"
_BINARY = {"type": "string", "format": "binary"}

#: A whole question in one body: parents inline, down to the meshes.
JOB_EXAMPLES: dict[str, dict[str, Any]] = {
    "energy": {
        "summary": "Energies of the soft map between two meshes that compares wave kernel signatures",
        "value": {
            "kind": "energy",
            "softmap": {
                "kind": "softmap",
                "source": {"kind": "basis", "mesh": _MESH, "size": 300},
                "target": {"kind": "basis", "mesh": _OTHER, "size": 300},
                "map": {"type": "descriptors", "descriptor": "wks", "sigma": 0.1},
            },
        },
    },
    "basis": {
        "summary": "A basis of 300 functions that reproduces linear functions, so that densities converge",
        "value": {"kind": "basis", "mesh": _MESH, "size": 300, "method": "maxent", "sharpness": 3.0},
    },
    "poisson basis": {
        "summary": "A basis of 300 functions, as the paper makes it",
        "value": {"kind": "basis", "mesh": _MESH, "size": 300, "method": "poisson", "cutoff": 0.1},
    },
    "spectrum": {
        "summary": "The first 200 eigenpairs of a mesh's Laplacian",
        "value": {"kind": "spectrum", "mesh": _MESH, "eigenpairs": 200},
    },
    "descriptor": {
        "summary": "Wave kernel signature at every vertex",
        "value": {"kind": "descriptor", "mesh": _MESH, "type": "wks", "count": 100, "eigenpairs": 200},
    },
    "optimal softmap": {
        "summary": "The soft map of least energy that keeps three landmarks, which are samples of the bases",
        "value": {
            "kind": "softmap",
            "source": {"kind": "basis", "mesh": _MESH, "size": 60, "first": [0, 17, 42]},
            "target": {"kind": "basis", "mesh": _OTHER, "size": 60, "first": [3, 5, 40]},
            "map": {"type": "optimal", "landmarks": [[0, 3], [17, 5], [42, 40]], "tolerance": 1e-3},
        },
    },
    "pointmap": {
        "summary": "The target vertex at which the mass of each source vertex peaks",
        "value": {
            "kind": "pointmap",
            "softmap": "softmap-0123456789abcdef0123456789abcdef",
            "method": "peak",
        },
    },
    "momentum": {
        "summary": "Where mass flows on the target as a source point moves along the x axis in face 0",
        "value": {
            "kind": "momentum",
            "softmap": "softmap-0123456789abcdef0123456789abcdef",
            "face": 0,
            "direction": [1.0, 0.0, 0.0],
        },
    },
    "path": {
        "summary": "The path on the target that follows one on the source",
        "value": {
            "kind": "path",
            "softmap": "softmap-0123456789abcdef0123456789abcdef",
            "source_path": [0, 17, 42],
            "start": 0,
        },
    },
    "potential": {
        "summary": "Transportation potentials of a soft map that is known already",
        "value": {"kind": "potential", "softmap": "softmap-0123456789abcdef0123456789abcdef"},
    },
}

MESH_BODY: dict[str, Any] = {
    "parameters": [
        {
            "name": "format",
            "in": "query",
            "schema": {"type": "string", "enum": list(FORMATS)},
            "description": "Format of the file; needed for OBJ, otherwise seen in its first bytes.",
        }
    ],
    "requestBody": {
        "required": True,
        "content": {
            RAW: {"schema": _BINARY},
            "multipart/form-data": {
                "schema": {"type": "object", "required": ["file"], "properties": {"file": _BINARY}}
            },
        },
    },
}

ARRAY_BODY: dict[str, Any] = {
    "requestBody": {
        "required": True,
        "content": {
            NPY: {"schema": _BINARY},
            JSON: {"schema": {"type": "array", "items": {}}, "example": [[0.25, 0.75], [1.0, 0.0]]},
        },
    }
}

JOB_BODY: dict[str, Any] = {
    "parameters": [
        {
            "name": "Prefer",
            "in": "header",
            "schema": {"type": "string", "examples": ["wait=10"]},
            "description": "wait=N waits up to N seconds (at most 60) for the job to finish.",
        }
    ],
    "requestBody": {
        "required": True,
        "content": {JSON: {"schema": {"$ref": "#/components/schemas/Spec"}, "examples": JOB_EXAMPLES}},
    },
}

_STRING = {"schema": {"type": "string"}}
#: Representations of an array.
ARRAY_CONTENT: dict[str, Any] = {
    "description": "The numbers",
    "headers": {"ETag": _STRING, "Array-Shape": _STRING, "Array-Dtype": _STRING, "Accept-Ranges": _STRING},
    "content": {
        NPY: {"schema": _BINARY},
        RAW: {"schema": _BINARY},
        JSON: {"schema": {"type": "array", "items": {}}},
    },
}
#: What an optimisation has found so far.
SNAPSHOT_CONTENT: dict[str, Any] = {
    "description": "The coefficients",
    "headers": {"Iteration": _STRING, "Array-Shape": _STRING, "Array-Dtype": _STRING},
    "content": {NPY: {"schema": _BINARY}, RAW: {"schema": _BINARY}},
}
#: States of a job, one an event.
EVENTS_CONTENT: dict[str, Any] = {
    "description": "A job an event",
    "content": {"text/event-stream": _STRING},
}
#: All arrays in one file.
NPZ_CONTENT: dict[str, Any] = {
    "description": "A .npz file",
    "content": {"application/zip": {"schema": _BINARY}},
}


def known(model: type[BaseModel]) -> dict[str, Any]:
    """Response to what was there already."""
    return {"model": model, "description": "Known already"}


def problems(*statuses: int) -> dict[int | str, dict[str, Any]]:
    """Responses of an operation that are problem documents; those that any request may meet are added."""
    schema = {"schema": {"$ref": f"#/components/schemas/{Problem.__name__}"}}
    return {
        status: {"description": TITLES[status][1], "content": {PROBLEM_TYPE: schema}}
        for status in sorted({*statuses, 401, 500})
    }


def completed(document: dict[str, Any]) -> dict[str, Any]:
    """Add to the document that FastAPI makes what it does not know: specs, problems and the bearer token."""
    from worker import specs  # noqa: PLC0415  (only when somebody asks for the document)

    components = document.setdefault("components", {})
    schemas = components.setdefault("schemas", {})
    reference = "#/components/schemas/{model}"
    schemas["Problem"] = Problem.model_json_schema(ref_template=reference)
    schemas |= schemas["Problem"].pop("$defs", {})
    kinds = []
    for model in specs.MODELS:
        if model.private:
            continue
        schema = model.model_json_schema(ref_template=reference)
        schemas |= schema.pop("$defs", {})
        schemas[schema["title"]] = schema
        kinds.append({"$ref": reference.format(model=schema["title"])})
    schemas["Spec"] = {
        "oneOf": kinds,
        "description": "A question. Wherever it holds the id of a computed kind, that spec may stand inline, "
        "and wherever it holds the id of an array, a list of numbers may.",
    }
    for operations in document["paths"].values():
        for operation in operations.values():
            # FastAPI adds its own kind of 422 wherever there is a parameter; ours is another.
            if "422" in operation["responses"]:
                operation["responses"]["422"] = problems(422)[422]
    for name in ("HTTPValidationError", "ValidationError"):
        schemas.pop(name, None)
    components["securitySchemes"] = {"bearer": {"type": "http", "scheme": "bearer"}}
    document["security"] = [{}, {"bearer": []}]
    return document
