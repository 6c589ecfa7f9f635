"""What the benchmark compares agrees, and the command says so."""

from __future__ import annotations

import json

import numpy as np
import pytest

from service.bench import Comparison, compared, wks_map
from service.creature import creature
from service.rivals import face_systems
from solver import dirichlet
from tests.service.test_cli import DONE, USAGE, softmaps
from tests.solver.dense import dense_dirichlet

#: Rivals and solver round differently, on systems whose condition is that of ε.
AGREEMENT = 1e-9


@pytest.fixture(scope="module")
def comparison() -> Comparison:
    return compared(wks_map(creature("standing", 0), creature("trotting", 0), 30), threads=2, repeats=2)


def test_every_contender_reaches_the_same_densities(comparison: Comparison) -> None:
    names = [each.name for each in comparison.contenders]
    assert names[:3] == ["softmaps", "softmaps, 2 threads", "softmaps, with gradient"]
    assert {"LAPACK, dense", "SuperLU"} <= set(names)
    for each in comparison.contenders:
        assert each.residual < 1e-12
        assert each.difference < AGREEMENT
        assert 0 < each.microseconds <= each.median
    assert comparison.contenders[0].ratio == 1.0


def test_the_systems_of_rivals_are_those_of_the_dense_twin() -> None:
    softmap = wks_map(creature("standing", 0), creature("trotting", 0), 25)
    faces = np.array([3, 100, 333])
    systems = face_systems(softmap, faces)
    solutions = np.array(
        [np.linalg.solve(a.toarray(), b) for a, b in zip(systems.matrices, systems.right, strict=True)]
    )
    exact = dense_dirichlet(softmap, faces=faces).density
    np.testing.assert_allclose(systems.densities(solutions), exact, rtol=AGREEMENT)
    np.testing.assert_allclose(dirichlet(softmap).density[faces], exact, rtol=AGREEMENT)


def test_the_command_answers_machines() -> None:
    done = softmaps("bench", "--size", 25, "--repeats", 1, "--json")
    assert done.returncode == DONE, done.stderr
    answer = json.loads(done.stdout)
    assert answer["sizes"]["target_functions"] == 25
    assert answer["versions"]["numpy"] == np.__version__


def test_one_mesh_alone_is_a_usage_error() -> None:
    assert softmaps("bench", "lonely.off").returncode == USAGE
