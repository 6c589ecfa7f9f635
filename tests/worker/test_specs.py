import json
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from worker import specs
from worker.fields import SpecError, kind_of

MESH, OTHER = "mesh-" + "0" * 32, "mesh-" + "1" * 32
BASIS, SOFTMAP = "basis-" + "2" * 32, "softmap-" + "3" * 32
ARRAY, DESCRIPTOR = "array-" + "4" * 32, "descriptor-" + "5" * 32

POISSON = {"kind": "basis", "mesh": MESH, "method": "poisson"}
MAXENT = {"kind": "basis", "mesh": MESH, "method": "maxent"}
MOMENTUM = {"kind": "momentum", "softmap": SOFTMAP, "face": 7, "direction": [1, 0.5, 0]}
PATH = {"kind": "path", "softmap": SOFTMAP, "source_path": [3, 1], "start": 0}
ENDS = {"source": BASIS, "target": BASIS}


def optimal(**fields):
    return {"kind": "softmap", **ENDS, "map": {"type": "optimal", **fields}}


#: One flat spec of every kind and map, in its shortest form, and the id that it must have for ever.
GOLDEN = [
    (POISSON, "basis-6febb9aae45068e32d9c7216160eca95"),
    (
        {**POISSON, "size": 40, "cutoff": 0.5, "first": [7, 3]},
        "basis-b9fd3a5ace8c40f611a475bd73f84a64",
    ),
    (MAXENT, "basis-71a2cba2614a8e3f76c9f377e642e1b7"),
    ({"kind": "spectrum", "mesh": MESH}, "spectrum-e7374d46c8f6147aa396fc88e3f3d1d7"),
    ({"kind": "descriptor", "mesh": MESH, "type": "wks"}, "descriptor-aa4086e862ac22d7ea319ce083012104"),
    (
        {"kind": "descriptor", "mesh": MESH, "type": "hks", "count": 16, "eigenpairs": 50, "partner": OTHER},
        "descriptor-d1884dd8e36300f9ee0618a163dc984e",
    ),
    (
        {"kind": "softmap", **ENDS, "map": {"type": "points", "targets": ARRAY}},
        "softmap-0b1495e271c97fd890797de51ee9bb3a",
    ),
    (
        {"kind": "softmap", **ENDS, "map": {"type": "points", "targets": ARRAY, "barycentric": ARRAY}},
        "softmap-c17872413233baca5c68a45e2508aff0",
    ),
    (
        {"kind": "softmap", **ENDS, "map": {"type": "descriptors", "source": ARRAY, "target": DESCRIPTOR}},
        "softmap-c812f6c366bf4e6f1d7fa37308349a40",
    ),
    (
        {"kind": "softmap", **ENDS, "map": {"type": "matrix", "coefficients": ARRAY}},
        "softmap-6f539f6a81ef1c1c5114f8fb2285fec8",
    ),
    ({"kind": "softmap", **ENDS, "map": {"type": "uniform"}}, "softmap-d79d2f4db80e718139b7369b4af0f57f"),
    (
        {"kind": "softmap", **ENDS, "map": {"type": "mixture", "maps": [SOFTMAP], "weights": [1]}},
        "softmap-56b60944e0313ad48ebbee28f24e7018",
    ),
    (optimal(), "softmap-10e5310250e76cab4188ff598966ce0e"),
    (
        optimal(
            landmarks=[[3, 4], [5, 6]],
            bijectivity_weight=2,
            constraints=[{"source": [1, 2], "target": 7}],
            start=SOFTMAP,
            attachment=10,
            source=ARRAY,
            target=DESCRIPTOR,
        ),
        "softmap-6fd5df5b1e6f2061d91bc283aadca499",
    ),
    ({"kind": "potential", "softmap": SOFTMAP}, "potential-cc88d4df3f49f0310aafd3a26a220eda"),
    ({"kind": "energy", "softmap": SOFTMAP}, "energy-0d83ea4f6b32b9ef3d691feb754a4165"),
    (
        {"kind": "energy", "softmap": SOFTMAP, "gradient": True, "regularisation": 1e-3},
        "energy-75f366083576556b6974955890e90815",
    ),
    (MOMENTUM, "momentum-89154f541545da3e97b24bbc91ab5704"),
    ({**MOMENTUM, "face": [7], "direction": [[1, 0, -0.0]]}, "momentum-347b6b2dc8d177f44846d34cdc2f91b4"),
    (PATH, "path-6e8689f95fb172ac99210cf6daf21b45"),
    ({"kind": "pointmap", "softmap": SOFTMAP}, "pointmap-b8df3097797a9c6e18884de4115112d8"),
    (
        {"kind": "potential_block", "softmap": SOFTMAP, "start": 0, "stop": 4096},
        "potential_block-f46a32ba0622a532d16e104807cf9cd9",
    ),
    (
        {"kind": "energy_block", "softmap": SOFTMAP, "start": 4096, "stop": 5000},
        "energy_block-cd3363fa4353d54fd69b112a0ed1c1c2",
    ),
]


@pytest.mark.parametrize(("fields", "name"), GOLDEN, ids=[name.partition("-")[0] for _, name in GOLDEN])
def test_golden_ids_never_change(fields, name):
    assert specs.spec_id(specs.load(fields)) == name


def test_every_model_and_map_has_a_golden_id():
    assert {type(specs.load(fields)) for fields, _ in GOLDEN} == set(specs.MODELS)
    maps = {fields["map"]["type"] for fields, _ in GOLDEN if fields["kind"] == "softmap"}
    assert maps == {"points", "descriptors", "matrix", "uniform", "mixture", "optimal"}


def test_golden_ids_differ_from_one_another():
    assert len({name for _, name in GOLDEN}) == len(GOLDEN)


@pytest.mark.parametrize("fields", [fields for fields, _ in GOLDEN], ids=lambda fields: fields["kind"])
def test_a_dumped_spec_loads_as_itself_through_json(fields):
    spec = specs.load(fields)
    again = specs.load(json.loads(json.dumps(specs.dump(spec))))
    assert again == spec
    assert specs.spec_id(again) == specs.spec_id(spec)


def shuffled(value, random):
    if isinstance(value, dict):
        items = list(value.items())
        random.shuffle(items)
        return {key: shuffled(item, random) for key, item in items}
    return value


@given(st.sampled_from([fields for fields, _ in GOLDEN]), st.randoms(use_true_random=False))
def test_the_order_of_keys_is_no_part_of_a_question(fields, random):
    whole = specs.dump(specs.load(fields))
    assert specs.spec_id(specs.load(shuffled(whole, random))) == specs.spec_id(specs.load(fields))


@pytest.mark.parametrize(
    ("one", "other"),
    [
        ('{"kind":"basis","mesh":"%s","cutoff":0.25}', '{"kind":"basis","mesh":"%s","cutoff":25e-2}'),
        ('{"kind":"basis","mesh":"%s","first":4}', '{"kind":"basis","mesh":"%s","first":[4]}'),
        (
            '{"kind":"basis","mesh":"%s"}',
            '{"kind":"basis","mesh":"%s","first":[0],"size":300,"method":"maxent","sharpness":3}',
        ),
        ('{"kind":"basis","mesh":"%s","cutoff":0.1}', '{"kind":"basis","mesh":"%s","method":"poisson"}'),
        ('{"kind":"basis","mesh":"%s","first":0}', '{"kind":"basis","mesh":"%s","first":-0}'),
    ],
)
def test_the_same_question_has_the_same_id(one, other):
    ids = {specs.spec_id(specs.load(json.loads(text % MESH))) for text in (one, other)}
    assert len(ids) == 1


@given(st.floats(min_value=1e-300, max_value=1e300), st.integers(1, 10**6))
def test_a_float_is_named_by_its_value_not_its_spelling(sigma, whole):
    def named(text):
        fields = {"type": "descriptors", "source": ARRAY, "target": DESCRIPTOR, "sigma": json.loads(text)}
        return specs.spec_id(specs.load({"kind": "softmap", **ENDS, "map": fields}))

    assert named(repr(sigma)) == named(f"{sigma:.20e}")
    assert named(f"{whole}") == named(f"{whole}.0")


def test_minus_zero_asks_what_zero_asks():
    def named(*weights):
        mixture = {"type": "mixture", "maps": [SOFTMAP, SOFTMAP], "weights": list(weights)}
        return specs.spec_id(specs.load({"kind": "softmap", **ENDS, "map": mixture}))

    assert named(1.0, -0.0) == named(1, 0)


def test_a_mesh_shares_its_scales_with_itself():
    alone = specs.Descriptor(mesh=MESH, type="wks")
    assert specs.spec_id(specs.Descriptor(mesh=MESH, type="wks", partner=MESH)) == specs.spec_id(alone)
    assert specs.spec_id(specs.Descriptor(mesh=MESH, type="wks", partner=OTHER)) != specs.spec_id(alone)


@pytest.mark.parametrize(
    ("fields", "pointer"),
    [
        ({"kind": "basis"}, "/mesh"),
        ({"kind": "basis", "mesh": BASIS}, "/mesh"),
        ({"kind": "basis", "mesh": MESH + "\n"}, "/mesh"),
        ({"kind": "basis", "mesh": MESH.upper()}, "/mesh"),
        ({"kind": "basis", "mesh": 3}, "/mesh"),
        ({"kind": "basis", "mesh": MESH, "size": 0}, "/size"),
        ({"kind": "basis", "mesh": MESH, "size": 300.0}, "/size"),
        ({"kind": "basis", "mesh": MESH, "size": True}, "/size"),
        ({"kind": "basis", "mesh": MESH, "size": "300"}, "/size"),
        ({"kind": "basis", "mesh": MESH, "size": 2**53}, "/size"),
        ({**POISSON, "cutoff": 0}, "/cutoff"),
        ({**POISSON, "cutoff": 1}, "/cutoff"),
        ({**POISSON, "cutoff": float("nan")}, "/cutoff"),
        ({**POISSON, "sharpness": 3.0}, "/sharpness"),
        ({**MAXENT, "sharpness": 0.4}, "/sharpness"),
        ({**MAXENT, "sharpness": 51}, "/sharpness"),
        ({**MAXENT, "cutoff": 0.1}, "/cutoff"),
        ({"kind": "basis", "mesh": MESH, "method": "moment"}, "/method"),
        ({"kind": "basis", "mesh": MESH, "method": ["maxent"]}, "/method"),
        ({"kind": "basis", "mesh": MESH, "first": -1}, "/first"),
        ({"kind": "basis", "mesh": MESH, "first": []}, "/first"),
        ({"kind": "basis", "mesh": MESH, "first": [1, 1]}, "/first"),
        ({"kind": "basis", "mesh": MESH, "first": [1, "2"]}, "/first/1"),
        ({"kind": "basis", "mesh": MESH, "first": {"a": 1}}, "/first"),
        ({"kind": "basis", "mesh": MESH, "first": [1, 2], "size": 1}, "/first"),
        ({"kind": "spectrum", "mesh": MESH, "eigenpairs": 1}, "/eigenpairs"),
        ({"kind": "descriptor", "mesh": MESH}, "/type"),
        ({"kind": "descriptor", "mesh": MESH, "type": "wks", "count": 27}, "/count"),
        ({"kind": "descriptor", "mesh": MESH, "type": "hks", "count": 0}, "/count"),
        ({"kind": "descriptor", "mesh": MESH, "type": "hks", "partner": BASIS}, "/partner"),
        ({"kind": "potential", "softmap": SOFTMAP, "regularisation": 1}, "/regularisation"),
        ({"kind": "energy", "softmap": SOFTMAP, "regularisation": -1e-5}, "/regularisation"),
        ({"kind": "energy", "softmap": SOFTMAP, "gradient": 1}, "/gradient"),
        ({"kind": "energy", "softmap": SOFTMAP, "a/b~c": 1}, "/a~1b~0c"),
        ({"kind": "energy", "softmap": SOFTMAP, "k" * 65: 1}, ""),
        ({"kind": "energy_block", "softmap": SOFTMAP, "start": 4, "stop": 4}, "/stop"),
        ({**MOMENTUM, "face": -1}, "/face"),
        ({**MOMENTUM, "face": True}, "/face"),
        ({**MOMENTUM, "face": [], "direction": [[1, 0, 0]]}, "/face"),
        ({**MOMENTUM, "face": [1, "2"], "direction": [[1, 0, 0]] * 2}, "/face/1"),
        ({**MOMENTUM, "face": [1] * 1001, "direction": [[1, 0, 0]] * 1001}, "/face"),
        ({**MOMENTUM, "face": [1]}, "/direction"),
        ({**MOMENTUM, "face": [1], "direction": [[1, 0, 0]] * 2}, "/direction"),
        ({**MOMENTUM, "direction": [[1, 0, 0]]}, "/direction"),
        ({**MOMENTUM, "direction": [0, -0.0, 0]}, "/direction"),
        ({**MOMENTUM, "direction": []}, "/direction"),
        ({**MOMENTUM, "direction": [1, 0]}, "/direction"),
        ({**MOMENTUM, "face": [1, 2], "direction": [[1, 0, 0], []]}, "/direction/1"),
        ({**MOMENTUM, "direction": [1, 0, float("inf")]}, "/direction/2"),
        ({**MOMENTUM, "face": [1, 2], "direction": [[1, 0, 0], [0, 1, "0"]]}, "/direction/1/2"),
        ({"kind": "pointmap", "softmap": SOFTMAP, "method": "mean"}, "/method"),
        ({**PATH, "source_path": []}, "/source_path"),
        ({**PATH, "source_path": [0, -1]}, "/source_path/1"),
        ({**PATH, "source_path": 3}, "/source_path"),
        ({**PATH, "start": [3]}, "/start"),
        ({**PATH, "step": 1e-6}, "/step"),
        ({"kind": "mesh"}, "/kind"),
        ({"kind": ["basis"]}, "/kind"),
        ({}, "/kind"),
        ({"kind": "softmap", **ENDS, "map": {"type": "sharpest"}}, "/map"),
        (optimal(landmarks=[[0, 1, 2]]), "/map/landmarks/0"),
        (optimal(landmarks=[[0, -1]]), "/map/landmarks/0/1"),
        (optimal(landmarks=[[0, 1], [0, 2]]), "/map/landmarks"),
        (optimal(tolerance=0), "/map/tolerance"),
        (optimal(bijectivity_weight=-1), "/map/bijectivity_weight"),
        (optimal(max_iterations=10_001), "/map/max_iterations"),
        (optimal(method="newton"), "/map/method"),
        (optimal(constraints=[{"source": [], "target": 3}]), "/map/constraints/0/source"),
        (optimal(constraints=[{"source": 1}]), "/map/constraints/0/target"),
        (optimal(constraints=[{"source": 1, "target": 1}], method="softmax"), "/map/constraints"),
        (optimal(start=BASIS), "/map/start"),
        (optimal(attachment=1), "/map/target"),
        (optimal(landmarks=[[0, 1]], attachment=1, source=ARRAY), "/map/target"),
        (optimal(source=ARRAY, target=ARRAY), "/map/target"),
        ({"kind": "softmap", **ENDS, "map": {"type": "points"}}, "/map/targets"),
    ],
)
def test_a_refusal_points_at_the_place(fields, pointer):
    with pytest.raises(SpecError) as refusal:
        specs.load(fields)
    assert [place for place, _ in refusal.value.errors] == [pointer]


@pytest.mark.parametrize(
    ("maps", "weights", "pointer"),
    [
        ([], [], "/map/maps"),
        ([SOFTMAP], [0.5, 0.5], "/map/weights"),
        ([SOFTMAP, SOFTMAP], [0.5, 0.5 + 2e-9], "/map/weights"),
        ([SOFTMAP, SOFTMAP], [1.5, -0.5], "/map/weights/1"),
        ([SOFTMAP, SOFTMAP], [True, 0], "/map/weights/0"),
        ([SOFTMAP, BASIS], [0.5, 0.5], "/map/maps/1"),
        ([SOFTMAP] * (specs.MAX_MIXED + 1), [1 / 1001] * 1001, "/map/maps"),
    ],
)
def test_a_mixture_is_a_convex_combination(maps, weights, pointer):
    mixture = {"type": "mixture", "maps": maps, "weights": weights}
    with pytest.raises(SpecError) as refusal:
        specs.load({"kind": "softmap", **ENDS, "map": mixture})
    assert refusal.value.errors[0][0] == pointer


def test_a_refusal_says_what_weights_sum_to():
    with pytest.raises(ValidationError, match=r"sum to 1, these sum to 0\.75"):
        specs.Mixture(maps=(SOFTMAP, SOFTMAP), weights=(0.5, 0.25))


def test_a_refusal_lists_ten_errors_and_never_the_input():
    fields = {**POISSON, "mesh": "hunter2", "cutoff": "hunter2"} | {
        f"field{k}": "hunter2" for k in range(1000)
    }
    with pytest.raises(SpecError) as refusal:
        specs.load(fields)
    assert len(refusal.value.errors) == 10
    assert "hunter2" not in str(refusal.value)


def test_parents_are_named_by_their_place():
    points = specs.SoftMap(source=BASIS, target=BASIS, map=specs.Points(targets=ARRAY))
    assert specs.parents(points) == {"source": BASIS, "target": BASIS, "map/targets": ARRAY}
    mixture = specs.Mixture(maps=(SOFTMAP, SOFTMAP), weights=(0.5, 0.5))
    mixed = specs.SoftMap(source=BASIS, target=BASIS, map=mixture)
    assert list(specs.parents(mixed)) == ["source", "target", "map/maps/0", "map/maps/1"]
    assert specs.parents(specs.Energy(softmap=SOFTMAP)) == {"softmap": SOFTMAP}


def test_a_descriptor_follows_from_the_spectra_of_both_meshes():
    descriptor = specs.Descriptor(mesh=MESH, type="hks", eigenpairs=50, partner=OTHER)
    spectra = [specs.spec_id(specs.Spectrum(mesh=mesh, eigenpairs=50)) for mesh in (MESH, OTHER)]
    found = specs.parents(descriptor)
    assert found == {"mesh": MESH, "partner": OTHER, "spectrum": spectra[0], "partner_spectrum": spectra[1]}
    alone = specs.parents(specs.Descriptor(mesh=MESH, type="hks", eigenpairs=50))
    assert alone == {"mesh": MESH, "spectrum": spectra[0]}


def test_specs_are_frozen_and_hashable():
    basis = specs.PoissonBasis(mesh=MESH)
    with pytest.raises(ValidationError, match="frozen"):
        basis.size = 4
    assert {basis: 1}[specs.PoissonBasis(mesh=MESH, first=(0,))] == 1


def test_blocks_are_private():
    assert not {kind for kind in specs.PUBLIC_KINDS if "block" in kind}
    assert set(specs.KINDS) - set(specs.PUBLIC_KINDS) == {"potential_block", "energy_block"}


@pytest.mark.parametrize(
    "text", ["", "energy", "energy-", "../energy-" + "0" * 32, "energy-" + "0" * 33, "-" + "0" * 32]
)
def test_what_is_no_id_has_no_kind(text):
    assert kind_of(text) is None


def test_the_digest_of_versions_is_eight_hex_digits_and_pinned():
    assert specs.versions_digest() == "f52c6767"


def test_golden_ids_of_arrays_and_meshes():
    vertices, faces = np.eye(3), np.array([[0, 1, 2]])
    assert specs.mesh_id(vertices, faces) == "mesh-e5e054286e7e8c1c9e070ff75260d617"
    assert specs.array_id(np.arange(3)) == "array-fc8d88636b54af55ba8eb18e04a38f5a"


def test_an_array_is_named_by_dtype_shape_and_bytes():
    array = np.arange(6.0).reshape(2, 3)
    same = [array.copy(order="F"), array.astype(">f8"), np.repeat(array, 2, axis=0)[::2]]
    assert {specs.array_id(other) for other in same} == {specs.array_id(array)}
    others = [
        array.reshape(3, 2),
        array.ravel(),
        array.astype(np.int64),
        array.view(np.int64),
        -array,
        array[:1],
    ]
    assert len({specs.array_id(other) for other in [array, *others]}) == 7


def test_a_mesh_is_named_by_its_order_too():
    vertices, faces = np.eye(3), np.array([[0, 1, 2]])
    names = {
        specs.mesh_id(vertices, faces),
        specs.mesh_id(vertices[::-1], faces),
        specs.mesh_id(vertices, faces[:, ::-1]),
        specs.mesh_id(np.vstack([vertices, faces]), faces[:0]),
    }
    assert len(names) == 4
    assert specs.mesh_id(vertices.astype(np.float32), faces.astype(np.int32)) in names


def test_importing_the_worker_core_loads_nothing_heavy():
    code = (
        "import sys, worker.specs, worker.questions, worker.store, worker.settings\n"
        "print(sorted({'scipy', 'numba', 'trimesh', 'solver', 'redis', 'rq'} & set(sys.modules)))"
    )
    answer = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert answer.stdout.strip() == "[]"
