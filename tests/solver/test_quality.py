"""How good maps are, where that is known by hand."""

from __future__ import annotations

import numpy as np
import pytest

from solver.errors import InvalidSoftMap
from solver.fem import mass
from solver.geodesics import distances_from
from solver.maxent import maxent_basis
from solver.mesh import Mesh
from solver.quality import map_quality, mass_within
from solver.softmap import SoftMap
from tests.solver.shapes import fibonacci_sphere, grid


@pytest.fixture(scope="module")
def mesh() -> Mesh:
    return fibonacci_sphere(120)


def test_the_identity_is_perfect(mesh: Mesh) -> None:
    here = np.arange(mesh.n_vertices)
    found = map_quality(mesh, mesh, here, here)
    np.testing.assert_array_equal(found.errors, 0)
    np.testing.assert_array_equal(found.curve, 1)
    assert found.mean == 0
    assert found.coverage == pytest.approx(1, rel=1e-12)
    assert found.bijectivity == pytest.approx(1, rel=1e-12)


def test_one_target_for_all_is_as_bad_as_its_distances(mesh: Mesh) -> None:
    here = np.arange(mesh.n_vertices)
    found = map_quality(mesh, mesh, np.full(mesh.n_vertices, 7), here)
    np.testing.assert_allclose(found.errors, distances_from(mesh, 7), rtol=0.05, atol=1e-12)
    shares = [(found.errors <= t).mean() for t in found.thresholds]
    np.testing.assert_array_equal(found.curve, shares)
    assert (np.diff(found.curve) >= 0).all()
    assert found.mean == found.errors.mean()
    assert found.coverage == pytest.approx(mass(mesh)[7], rel=1e-12)
    assert found.bijectivity == pytest.approx(1 / mass(mesh)[7], rel=1e-12)


def test_the_nearer_of_truth_and_twin_counts() -> None:
    """A square map to its mirror image: wrong by up to a width, and right by its twin."""
    mesh = grid(4, 4)
    here = np.arange(25)
    mirrored = here.reshape(5, 5)[:, ::-1].ravel()
    assert map_quality(mesh, mesh, mirrored, here).errors.max() == pytest.approx(1.0, rel=1e-6)
    assert map_quality(mesh, mesh, mirrored, here, mirrored).errors.max() == 0
    both = np.where(here % 2, here, mirrored)
    assert map_quality(mesh, mesh, both, here, mirrored).mean == 0


def test_unknown_truths_and_missing_targets_count_for_nothing(mesh: Mesh) -> None:
    here = np.arange(mesh.n_vertices)
    truth, targets = here.copy(), here.copy()
    truth[:10], targets[10:20] = -1, -1
    found = map_quality(mesh, mesh, targets, truth)
    assert np.isnan(found.errors[:20]).all()
    assert (found.errors[20:] == 0).all()
    assert found.mean == 0
    assert found.coverage == pytest.approx(1 - mass(mesh)[10:20].sum(), rel=1e-12)
    lost = map_quality(mesh, mesh, targets, np.full(mesh.n_vertices, -1))
    assert np.isnan(lost.mean)
    assert np.isnan(lost.curve).all()


def test_some_sources_are_measured_as_all_are(mesh: Mesh, rng: np.random.Generator) -> None:
    here, targets = np.arange(mesh.n_vertices), rng.permutation(mesh.n_vertices)
    some = np.array([5, 90, 17])
    seen: list[float] = []
    whole = map_quality(mesh, mesh, targets, here)
    part = map_quality(mesh, mesh, targets, here, sources=some, progress=seen.append)
    np.testing.assert_array_equal(part.errors, whole.errors[some])
    assert part.coverage == whole.coverage
    assert seen == sorted(seen)
    assert seen[-1] == 1.0


def test_mass_within_a_radius(mesh: Mesh) -> None:
    basis = maxent_basis(mesh, size=12)
    here = np.arange(mesh.n_vertices)
    even = SoftMap.uniform(basis, basis)
    cap = [mass(mesh)[distances_from(mesh, v) <= 0.3].sum() for v in (3, 50)]
    np.testing.assert_allclose(mass_within(even, here, 0.3, [3, 50]), cap, rtol=1e-12)
    np.testing.assert_allclose(mass_within(even, here, 9.0, [3, 50]), 1, rtol=1e-12)
    sharp = SoftMap.from_points(basis, basis, here)
    assert (mass_within(sharp, here, 0.3) > mass_within(even, here, 0.3) + 0.2).all()
    assert np.isnan(mass_within(sharp, np.full(mesh.n_vertices, -1), 0.3, [0]))[0]


def test_maps_that_do_not_fit_are_refused_by_index(mesh: Mesh) -> None:
    here = np.arange(mesh.n_vertices)
    with pytest.raises(InvalidSoftMap, match="each of the 120"):
        map_quality(mesh, mesh, here[1:], here)
    with pytest.raises(InvalidSoftMap, match="the truth must hold an integer"):
        map_quality(mesh, mesh, here, here + 0.5)
    wrong = here.copy()
    wrong[8] = 120
    with pytest.raises(InvalidSoftMap, match=r"targets\[8\] is 120") as refused:
        map_quality(mesh, mesh, wrong, here)
    assert refused.value.index == 8
    wrong[8] = -2
    with pytest.raises(InvalidSoftMap, match=r"the truth\[8\] is -2"):
        map_quality(mesh, mesh, here, wrong)
    with pytest.raises(InvalidSoftMap, match=r"sources\[1\] is 120"):
        map_quality(mesh, mesh, here, here, sources=[0, 120])
    with pytest.raises(InvalidSoftMap, match="list of source vertices"):
        map_quality(mesh, mesh, here, here, sources=0.5)
