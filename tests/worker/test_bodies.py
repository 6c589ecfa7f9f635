import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from worker.bodies import MAX_NDIM, parse_array
from worker.fields import MalformedBody, SpecError

shapes = hnp.array_shapes(max_dims=MAX_NDIM, max_side=5)


@given(
    hnp.arrays(np.int64, shapes)
    | hnp.arrays(np.float64, shapes, elements=st.floats(allow_nan=False, allow_infinity=False))
)
def test_an_array_survives_json(array):
    found = parse_array(json.dumps(array.tolist()))
    assert found.dtype == array.dtype
    assert found.tobytes() == array.tobytes()
    assert found.shape == array.shape


def test_one_float_makes_all_floats():
    assert parse_array("[[1, 2], [3, 4.5]]").dtype == np.float64


@pytest.mark.parametrize(
    ("body", "pointer"),
    [
        ("3", ""),
        ("{}", ""),
        ("[]", ""),
        ("[[]]", "/0"),
        ("[[[[1]]]]", ""),
        ('["a"]', "/0"),
        ("[1, true]", "/1"),
        ("[1, null]", "/1"),
        ("[1, [2]]", "/1"),
        ("[[1], 2]", "/1"),
        ("[[1, 2], [3]]", "/1"),
        ("[[[1], [2]], [[3], [4, 5]]]", "/1/1"),
        ("[1, 1e999]", "/1"),
        (f"[1, {2**63}]", "/1"),
        (f"[1.0, {10**400}]", "/1"),
    ],
)
def test_a_refusal_points_at_the_first_wrong_place(body, pointer):
    with pytest.raises(SpecError) as error:
        parse_array(body)
    assert [place for place, _ in error.value.errors] == [pointer]
    assert not isinstance(error.value, MalformedBody)


def test_what_is_no_json_is_malformed():
    with pytest.raises(MalformedBody):
        parse_array("[1, NaN]")
