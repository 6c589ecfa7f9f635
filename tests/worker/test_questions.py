import json
import time

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from worker import questions, specs
from worker.fields import MalformedBody, SpecError, kind_of
from worker.questions import ancestry, flatten, needs, parse

MESH, OTHER = "mesh-" + "0" * 32, "mesh-" + "1" * 32
ARRAY = "array-" + "4" * 32


def basis(mesh=MESH, **fields):
    return {"kind": "basis", "mesh": mesh, **fields}


def softmap(*ends, **map_):
    source, target = ends or (basis(), basis(OTHER))
    return {"kind": "softmap", "source": source, "target": target, "map": map_}


def energy(softmap, **fields):
    return {"kind": "energy", "softmap": softmap, **fields}


def graph(body, known=()):
    """Graph of a body, where a few specs are known already."""
    return flatten(parse(json.dumps(body)), {specs.spec_id(spec): spec for spec in known}.get)


def refusal(body):
    with pytest.raises(SpecError) as error:
        parse(body if isinstance(body, str | bytes) else json.dumps(body))
    return error.value


def places(body):
    return [place for place, _ in refusal(body).errors]


UNIFORM = softmap(type="uniform")


def test_an_inline_parent_asks_what_its_id_asks():
    inline = graph(energy(UNIFORM))
    named = list(inline.specs.values())[:3]
    by_id = graph(energy(list(inline.specs)[2]), named)
    assert inline.root == by_id.root
    assert list(inline.specs) == list(by_id.specs)
    assert inline.specs[inline.root] == specs.Energy(softmap=list(inline.specs)[2])


def test_parents_come_first_and_the_question_last():
    found = graph(energy(softmap(type="descriptors", descriptor="wks")))
    seen = set()
    for name, spec in found.specs.items():
        assert name == specs.spec_id(spec)
        assert {id_ for id_ in specs.parents(spec).values() if kind_of(id_) != "mesh"} <= seen
        seen.add(name)
    assert [kind_of(name) for name in found.specs][-2:] == ["softmap", "energy"]
    assert found.root == next(reversed(found.specs))


def test_equal_parents_are_one():
    same = graph(energy(softmap(basis(), basis(size=300), type="uniform")))
    assert [kind_of(name) for name in same.specs] == ["basis", "softmap", "energy"]
    assert same.pointers[next(iter(same.specs))] == "/softmap/source"


def test_pointers_say_where_each_spec_stands():
    found = graph(energy(softmap(type="descriptors", descriptor="hks")))
    standing = {(kind_of(name), pointer) for name, pointer in found.pointers.items()}
    assert standing == {
        ("basis", "/softmap/source"),
        ("basis", "/softmap/target"),
        ("spectrum", "/softmap/map"),
        ("descriptor", "/softmap/map"),
        ("softmap", "/softmap"),
        ("energy", ""),
    }


def test_a_named_descriptor_is_short_for_two_that_share_scales():
    ours, theirs = (
        {"kind": "descriptor", "mesh": one, "type": "wks", "partner": two}
        for one, two in ((MESH, OTHER), (OTHER, MESH))
    )
    short = graph(energy(softmap(type="descriptors", descriptor="wks", sigma=0.2)))
    long = graph(energy(softmap(type="descriptors", source=ours, target=theirs, sigma=0.2)))
    assert short.root == long.root
    assert set(short.specs) == set(long.specs)


def test_a_named_descriptor_finds_the_meshes_of_bases_given_by_id():
    bases = [specs.MaxentBasis(mesh=MESH), specs.MaxentBasis(mesh=OTHER)]
    by_id = graph(softmap(*map(specs.spec_id, bases), type="descriptors", descriptor="wks"), bases)
    assert by_id.root == graph(softmap(type="descriptors", descriptor="wks")).root


def test_mixed_named_maps_get_their_final_names():
    part = softmap(type="descriptors", descriptor="wks")
    mixed = graph(energy(softmap(type="mixture", maps=[part, UNIFORM], weights=[0.5, 0.5])))
    alone = graph(part)
    assert alone.root in mixed.specs
    mixture = next(s.map for s in mixed.specs.values() if isinstance(getattr(s, "map", None), specs.Mixture))
    assert mixture.maps == (alone.root, graph(UNIFORM).root)


def test_inline_lists_become_arrays_of_their_type():
    body = softmap(type="points", targets=[3, 1, 2], barycentric=[[1, 0, 0.5]])
    found = graph(body)
    map_ = found.specs[found.root].map
    assert found.arrays[map_.targets].dtype == np.int64
    assert found.arrays[map_.targets].tolist() == [3, 1, 2]
    assert found.arrays[map_.barycentric].dtype == np.float64
    assert found.arrays[map_.barycentric].tolist() == [[1.0, 0.0, 0.5]]
    uploaded = softmap(type="points", targets=map_.targets, barycentric=map_.barycentric)
    assert graph(uploaded).root == found.root
    assert graph(uploaded).arrays == {}


def test_equal_inline_lists_are_one_array_and_ints_may_stand_for_floats():
    body = softmap(type="descriptors", source=[[1, 2]], target=[[1.0, 2.0]])
    assert len(graph(body).arrays) == 1


@pytest.mark.parametrize(
    ("body", "pointer"),
    [
        ([], ""),
        ({}, "/kind"),
        ({"kind": "energy_block", "softmap": UNIFORM, "start": 0, "stop": 1}, "/kind"),
        ({"kind": "mesh"}, "/kind"),
        (energy(basis()), "/softmap/kind"),
        (energy({"kind": "softmap"}), "/softmap/source"),
        (energy(softmap(basis(size=0), basis(), type="uniform")), "/softmap/source/size"),
        (energy(softmap(basis({"kind": "mesh"}), basis(), type="uniform")), "/softmap/source/mesh"),
        (energy(softmap(MESH, basis(), type="uniform")), "/softmap/source"),
        (energy(softmap(type="sharpest")), "/softmap/map/type"),
        (energy(softmap()), "/softmap/map/type"),
        (energy(softmap(type="uniform", weights=[1])), "/softmap/map/weights"),
        (energy(softmap(type="points")), "/softmap/map/targets"),
        (energy(softmap(type="points", targets=basis())), "/softmap/map/targets"),
        (energy(softmap(type="points", targets=[0, 1.5])), "/softmap/map/targets/1"),
        (energy(softmap(type="points", targets=[0, True])), "/softmap/map/targets/1"),
        (energy(softmap(type="points", targets=[0, 2**63])), "/softmap/map/targets/1"),
        (energy(softmap(type="points", targets=[])), "/softmap/map/targets"),
        (energy(softmap(type="matrix", coefficients=[[1], [1, 0]])), "/softmap/map/coefficients/1"),
        (energy(softmap(type="matrix", coefficients=[[1, "0"]])), "/softmap/map/coefficients/0/1"),
        (energy(softmap(type="matrix", coefficients=[1, 0])), "/softmap/map/coefficients/0"),
        (energy(softmap(type="matrix", coefficients=[[]])), "/softmap/map/coefficients/0"),
        (energy(softmap(type="descriptors", descriptor="gps")), "/softmap/map/descriptor"),
        (energy(softmap(type="descriptors", descriptor="wks", source=ARRAY)), "/softmap/map/source"),
        (energy(softmap(type="descriptors", source=ARRAY)), "/softmap/map/target"),
        (energy(softmap(type="mixture", maps=[UNIFORM, 3], weights=[0.5, 0.5])), "/softmap/map/maps/1"),
        (energy(softmap(type="mixture", maps=UNIFORM, weights=[1])), "/softmap/map/maps"),
        (energy({**UNIFORM, "map": "uniform"}), "/softmap/map"),
        (energy({**UNIFORM, "ma/p~": 1}), "/softmap/ma~1p~0"),
    ],
)
def test_a_refusal_points_at_the_place(body, pointer):
    assert places(body)[0] == pointer


def test_a_refused_map_does_not_hide_its_neighbours():
    body = energy(softmap(basis(size=0), basis(), type="points", targets=["a"]), regularisation=2)
    assert set(places(body)) == {"/softmap/source/size", "/softmap/map/targets/0", "/regularisation"}


def test_what_no_float_holds_is_refused():
    infinite = json.dumps(softmap(type="matrix", coefficients=[[1, 7]])).replace("7", "1e999")
    assert places(infinite) == ["/map/coefficients/0/1"]
    assert places(json.dumps(basis(cutoff=0.7)).replace("0.7", "1e999")) == ["/cutoff"]
    assert places(basis(cutoff=10**400)) == ["/cutoff"]
    assert places(softmap(type="matrix", coefficients=[[10**400]])) == ["/map/coefficients/0/0"]


@pytest.mark.parametrize(
    "body",
    [
        "",
        "{",
        b"\xff\xfe",
        '{"kind": NaN}',
        '{"kind": -Infinity}',
        '{"kind": "basis", "kind": "basis"}',
        '{"kind": "\\ud800"}',
        '{"\\udfff": 1}',
        "[" * 100_000,
        '{"a":' * 100_000,
        '{"size": ' + "1" * 5_000 + "}",
        "\ufeff{}",
    ],
)
def test_what_is_no_json_is_malformed(body):
    assert isinstance(refusal(body), MalformedBody)


def test_a_pair_of_surrogates_is_a_letter():
    assert not isinstance(refusal('{"\\ud83d\\ude00": 1}'), MalformedBody)


def nested(depth):
    inner = UNIFORM
    for _ in range(depth):
        inner = softmap(type="mixture", maps=[inner], weights=[1])
    return inner


def test_nesting_is_bounded():
    assert graph(nested(questions.MAX_DEPTH - 1)).root
    assert "deep" in str(refusal(nested(questions.MAX_DEPTH)))


def test_the_number_of_inline_specs_is_bounded():
    maps = [UNIFORM] * 400
    assert "inline specs" in str(refusal(softmap(type="mixture", maps=maps, weights=[1 / 400] * 400)))


def test_a_refusal_of_200000_unknown_fields_is_short_and_quick():
    body = json.dumps(basis() | {f"unknown{k:06d}": 0 for k in range(100_000)})
    begun = time.perf_counter()
    error = refusal(body)
    assert len(error.errors) == 10
    assert len(str(error)) < 1_000
    assert time.perf_counter() - begun < 2


def test_two_megabytes_of_targets_are_read_in_a_moment():
    body = json.dumps(softmap(type="points", targets=list(range(100_000, 350_000)))).encode()
    begun = time.perf_counter()
    found = parse(body)
    assert time.perf_counter() - begun < 2
    (array,) = found.arrays.values()
    assert array.shape == (250_000,)


def test_a_key_too_long_to_repeat_is_not_repeated():
    assert places(basis() | {"k" * 100_000: 1}) == [""]


@pytest.mark.parametrize("parent", ["softmap-" + "9" * 32])
def test_an_unknown_parent_is_refused(parent):
    with pytest.raises(SpecError) as error:
        graph(energy(parent))
    assert error.value.errors == (("/softmap", "There is no such softmap"),)


def test_an_unknown_basis_under_named_descriptors_is_refused():
    with pytest.raises(SpecError) as error:
        graph(softmap("basis-" + "9" * 32, basis(), type="descriptors", descriptor="wks"))
    assert error.value.errors == (("/source", "There is no such basis"),)


@pytest.mark.parametrize("by_id", [False, True])
def test_a_mixture_mixes_maps_between_its_own_bases(by_id):
    stranger = softmap(basis(size=7), basis(OTHER), type="uniform")
    known = graph(stranger).specs
    part = list(known)[-1] if by_id else stranger
    with pytest.raises(SpecError) as error:
        graph(softmap(type="mixture", maps=[UNIFORM, part], weights=[0.5, 0.5]), known.values())
    assert error.value.errors[0][0] == "/map/maps/1"


def test_a_soft_map_is_read_with_its_bases_and_a_basis_with_its_mesh():
    found = graph(energy(softmap(type="points", targets=ARRAY)))
    bases = [name for name in found.specs if kind_of(name) == "basis"]
    assert set(found.needs(found.root)) == {found.specs[found.root].softmap, *bases, MESH, OTHER}
    assert set(found.needs(found.specs[found.root].softmap)) == {*bases, MESH, OTHER, ARRAY}
    block = specs.EnergyBlock(softmap=found.specs[found.root].softmap, start=0, stop=4096)
    assert set(needs(block, found.specs.get)) == set(found.needs(found.root))


def test_the_graph_of_a_known_spec_is_found_again():
    found = graph(energy(softmap(type="descriptors", descriptor="wks")))
    again = ancestry(found.root, found.specs.get)
    assert dict(again.specs) == dict(found.specs)
    assert again.root == found.root
    with pytest.raises(KeyError):
        ancestry("energy-" + "9" * 32, found.specs.get)


def test_a_long_chain_of_mixtures_is_followed_without_recursion():
    known = graph(UNIFORM).specs
    last, bases = list(known.values())[-1], list(known)[:2]
    for _ in range(3_000):
        mixture = specs.Mixture(maps=(specs.spec_id(last),), weights=(1.0,))
        last = specs.SoftMap(source=last.source, target=last.target, map=mixture)
        known[specs.spec_id(last)] = last
    chain = ancestry(specs.spec_id(last), known.get)
    assert len(chain.specs) == 3_000 + 1 + len(bases)
    assert chain.root == specs.spec_id(last)


def test_ancestors_that_nobody_remembers_are_left_out():
    last = specs.SoftMap(source="basis-" + "8" * 32, target="basis-" + "8" * 32, map=specs.Uniform())
    found = graph(energy(specs.spec_id(last)), [last])
    assert [kind_of(name) for name in found.specs] == ["softmap", "energy"]


json_values = st.recursive(
    st.none()
    | st.booleans()
    | st.integers()
    | st.floats()
    | st.text(max_size=8)
    | st.sampled_from([MESH, ARRAY]),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=8), inner, max_size=4),
    max_leaves=12,
)
valid_bodies = [
    energy(softmap(type="descriptors", descriptor="wks")),
    energy(softmap(type="points", targets=[0, 1], barycentric=[[1.0, 0.0, 0.0]]), gradient=True),
    softmap(
        type="mixture", maps=[UNIFORM, softmap(type="matrix", coefficients=[[1.0]])], weights=[0.25, 0.75]
    ),
    {"kind": "descriptor", "mesh": MESH, "type": "wks", "count": 28, "partner": OTHER},
    basis(first=[3, 4], method="poisson"),
]


@st.composite
def damaged_bodies(draw):
    """A valid body with one value anywhere in it replaced by any JSON."""

    def damage(value):
        steps = (
            list(value) if isinstance(value, dict) else range(len(value)) if isinstance(value, list) else []
        )
        if not steps or draw(st.integers(0, 4)) == 0:
            return draw(json_values)
        step = draw(st.sampled_from(list(steps)))
        if isinstance(value, dict):
            return {**value, step: damage(value[step])}
        return [*value[:step], damage(value[step]), *value[step + 1 :]]

    return damage(draw(st.sampled_from(valid_bodies)))


@settings(max_examples=200, deadline=None)
@given(json_values | damaged_bodies())
def test_any_json_is_a_spec_or_refused(body):
    try:
        found = flatten(parse(json.dumps(body)), {}.get)
    except SpecError as error:
        assert 1 <= len(error.errors) <= 10
        for pointer, detail in error.errors:
            assert pointer == "" or pointer.startswith("/")
            assert detail
            json.dumps([pointer, detail], ensure_ascii=False).encode()
    else:
        assert found.root == specs.spec_id(found.specs[found.root])
        assert set(found.pointers) == set(found.specs)


@settings(max_examples=100, deadline=None)
@given(st.binary(max_size=40) | st.text(max_size=40).map(lambda text: text.encode("utf-8", "surrogatepass")))
def test_any_bytes_are_a_spec_or_refused(body):
    with pytest.raises(SpecError):
        parse(body)
