"""Soft maps and their makers: rows that sum to 1, exact projections, and refusals that name the row."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from solver.basis import Basis, poisson_basis
from solver.errors import InvalidDescriptor, InvalidMesh, InvalidSoftMap
from solver.fem import mass
from solver.mesh import Mesh
from solver.softmap import SoftMap, root_mean_square_distance
from tests.solver.shapes import icosphere, torus

#: Rows are normalised by one division; this is a few hundred rounding errors.
ROW_SUM = 1e-12


@pytest.fixture(scope="module")
def sphere() -> Basis:
    return poisson_basis(icosphere(2), size=40)


@pytest.fixture(scope="module")
def ring() -> Basis:
    return poisson_basis(torus(12, 8), size=30)


def dense_projection(source: Basis, target: Basis, fine: np.ndarray) -> np.ndarray:
    """C of a dense ρ_fine (V₀, V), loop by loop as the equation says."""
    m0, m = mass(source.mesh), mass(target.mesh)
    b0, b = source.functions.toarray(), target.functions.toarray()
    c = np.zeros((source.size, target.size))
    for i in range(source.size):
        for j in range(target.size):
            c[i, j] = sum(m0[x] * b0[x, i] * (fine[x] * m * b[:, j]).sum() for x in range(len(m0)))
        c[i] /= (m0 * b0[:, i]).sum()
    return c


def test_a_point_map_is_projected_as_the_equation_says(
    sphere: Basis, ring: Basis, rng: np.random.Generator
) -> None:
    targets = rng.integers(0, ring.mesh.n_vertices, sphere.mesh.n_vertices)
    fine = np.zeros((sphere.mesh.n_vertices, ring.mesh.n_vertices))
    fine[np.arange(len(targets)), targets] = 1 / mass(ring.mesh)[targets]
    made = SoftMap.from_points(sphere, ring, targets)
    np.testing.assert_allclose(made.coefficients, dense_projection(sphere, ring, fine), atol=1e-13)


def test_corners_of_faces_are_vertices(sphere: Basis, ring: Basis, rng: np.random.Generator) -> None:
    faces = rng.integers(0, ring.mesh.n_faces, sphere.mesh.n_vertices)
    corner = np.tile([0.0, 1.0, 0.0], (len(faces), 1))
    by_face = SoftMap.from_points(sphere, ring, faces, barycentric=corner)
    by_vertex = SoftMap.from_points(sphere, ring, ring.mesh.faces[faces, 1])
    np.testing.assert_allclose(by_face.coefficients, by_vertex.coefficients, atol=1e-15)


def test_descriptors_are_projected_as_the_equation_says(
    sphere: Basis, ring: Basis, rng: np.random.Generator
) -> None:
    f0, f = (
        rng.normal(size=(sphere.mesh.n_vertices, 5)) + 100,
        rng.normal(size=(ring.mesh.n_vertices, 5)) + 100,
    )
    scale = 0.3 * root_mean_square_distance(sphere, ring, f0, f)
    fine = np.exp(-((f0[:, None] - f[None]) ** 2).sum(axis=2) / scale**2)
    fine /= (fine @ mass(ring.mesh))[:, None]
    made = SoftMap.from_descriptors(sphere, ring, f0, f, sigma=0.3)
    np.testing.assert_allclose(made.coefficients, dense_projection(sphere, ring, fine), atol=1e-12)


def test_the_unit_of_sigma_is_the_root_mean_square_distance(
    sphere: Basis, ring: Basis, rng: np.random.Generator
) -> None:
    f0, f = rng.normal(size=(sphere.mesh.n_vertices, 3)), 2 + rng.normal(size=(ring.mesh.n_vertices, 3))
    squared = ((f0[:, None] - f[None]) ** 2).sum(axis=2)
    exact = np.sqrt(mass(sphere.mesh) @ squared @ mass(ring.mesh))
    assert root_mean_square_distance(sphere, ring, f0, f) == pytest.approx(exact, rel=1e-12)


@given(sigma=st.floats(1e-3, 10), seed=st.integers(0, 2**32 - 1))
@settings(max_examples=15, deadline=None)
def test_rows_sum_to_one(sigma: float, seed: int) -> None:
    source, target = poisson_basis(icosphere(2), size=20), poisson_basis(torus(12, 8), size=15)
    draw = np.random.default_rng(seed)
    f0, f = draw.normal(size=(source.mesh.n_vertices, 4)), draw.normal(size=(target.mesh.n_vertices, 4))
    for made in (
        SoftMap.from_descriptors(source, target, f0, f, sigma=sigma),
        SoftMap.from_points(source, target, draw.integers(0, target.mesh.n_vertices, source.mesh.n_vertices)),
        SoftMap.uniform(source, target),
    ):
        assert (made.coefficients >= 0).all()
        assert np.abs(made.coefficients.sum(axis=1) - 1).max() < ROW_SUM


def test_threads_do_not_change_a_bit(
    sphere: Basis, rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("solver.similarity.ROWS", 20)
    f = rng.normal(size=(sphere.mesh.n_vertices, 4))
    seen: list[float] = []
    one = SoftMap.from_descriptors(sphere, sphere, f, f, threads=1, progress=seen.append)
    two = SoftMap.from_descriptors(sphere, sphere, f, f, threads=2)
    assert np.array_equal(one.coefficients, two.coefficients)
    assert seen == sorted(seen) and seen[-1] == 1.0 and len(seen) == 9


def test_sharper_descriptors_make_sharper_maps(sphere: Basis) -> None:
    f = sphere.mesh.vertices
    entropies = []
    for sigma in (1.0, 0.3, 0.1):
        c = SoftMap.from_descriptors(sphere, sphere, f, f, sigma=sigma).coefficients
        entropies.append(-(c * np.log(c + 1e-300)).sum())
    assert entropies == sorted(entropies, reverse=True)


def test_the_uniform_map_says_nothing(sphere: Basis, ring: Basis) -> None:
    made = SoftMap.uniform(sphere, ring)
    assert np.array_equal(made.coefficients, np.tile(ring.integrals, (sphere.size, 1)))


def test_a_mixture_is_the_weighted_sum(sphere: Basis, ring: Basis, rng: np.random.Generator) -> None:
    maps = [
        SoftMap.from_points(sphere, ring, rng.integers(0, ring.mesh.n_vertices, sphere.mesh.n_vertices))
        for _ in range(3)
    ]
    mixed = SoftMap.mixture(maps, [0.2, 0.3, 0.5])
    exact = 0.2 * maps[0].coefficients + 0.3 * maps[1].coefficients + 0.5 * maps[2].coefficients
    np.testing.assert_allclose(mixed.coefficients, exact, atol=1e-15)
    with pytest.raises(InvalidSoftMap, match="sum"):
        SoftMap.mixture(maps, [0.2, 0.3, 0.6])
    with pytest.raises(InvalidSoftMap, match="as many weights"):
        SoftMap.mixture(maps, [0.5, 0.5])
    with pytest.raises(InvalidSoftMap, match="both bases") as refusal:
        SoftMap.mixture([*maps[:2], SoftMap.uniform(ring, ring)], [0.2, 0.3, 0.5])
    assert refusal.value.index == 2


@pytest.mark.parametrize(
    ("spoil", "index"),
    [(-1, 7), (10**6, 3), (np.nan, 0)],
)
def test_targets_outside_are_refused_naming_the_index(
    sphere: Basis, ring: Basis, spoil: float, index: int
) -> None:
    targets = np.zeros(sphere.mesh.n_vertices, dtype=float if np.isnan(spoil) else int)
    targets[index] = spoil
    with pytest.raises(InvalidSoftMap) as refusal:
        SoftMap.from_points(sphere, ring, targets)
    if np.isnan(spoil):
        assert "integers" in str(refusal.value)
    else:
        assert refusal.value.index == index
        assert refusal.value.value == spoil


def test_a_map_of_the_wrong_length_is_refused_saying_the_direction(sphere: Basis, ring: Basis) -> None:
    with pytest.raises(InvalidSoftMap, match="from source to target"):
        SoftMap.from_points(sphere, ring, np.zeros(ring.mesh.n_vertices, dtype=int))


def test_a_target_without_a_face_is_refused(sphere: Basis) -> None:
    mesh = Mesh(np.vstack([sphere.mesh.vertices, [[9.0, 9.0, 9.0]]]), sphere.mesh.faces)
    target = poisson_basis(mesh, size=10)
    targets = np.zeros(sphere.mesh.n_vertices, dtype=int)
    targets[5] = mesh.n_vertices - 1
    with pytest.raises(InvalidSoftMap, match="belongs to no face") as refusal:
        SoftMap.from_points(sphere, target, targets)
    assert refusal.value.index == 5


def test_barycentric_weights_must_be_weights(sphere: Basis, ring: Basis) -> None:
    faces = np.zeros(sphere.mesh.n_vertices, dtype=int)
    weights = np.tile([0.2, 0.3, 0.5], (len(faces), 1))
    weights[11] = [0.5, 0.6, 0.2]
    with pytest.raises(InvalidSoftMap, match=r"row 11 sums to 1\.3") as refusal:
        SoftMap.from_points(sphere, ring, faces, barycentric=weights)
    assert refusal.value.index == 11


@pytest.mark.parametrize("bad", [-0.25, np.nan, np.inf])
def test_bad_coefficients_are_refused_naming_row_and_value(sphere: Basis, ring: Basis, bad: float) -> None:
    c = SoftMap.uniform(sphere, ring).coefficients.copy()
    c[4, 2] = bad
    with pytest.raises(InvalidSoftMap, match="row 4") as refusal:
        SoftMap(sphere, ring, c)
    assert refusal.value.index == 4
    np.testing.assert_equal(refusal.value.value, bad)


def test_coefficients_of_another_shape_are_refused(sphere: Basis, ring: Basis) -> None:
    with pytest.raises(InvalidSoftMap, match=r"\(40, 30\)"):
        SoftMap(sphere, ring, np.full((30, 40), 1 / 40))


def test_coefficients_cannot_change_afterwards(sphere: Basis, ring: Basis) -> None:
    with pytest.raises(ValueError, match="read-only"):
        SoftMap.uniform(sphere, ring).coefficients[0, 0] = 1


def test_a_disconnected_target_is_refused(sphere: Basis) -> None:
    v, f = sphere.mesh.vertices, sphere.mesh.faces
    two = poisson_basis(Mesh(np.vstack([v, v + 5]), np.vstack([f, f + len(v)])), size=10)
    assert SoftMap.uniform(two, sphere).source is two  # as a source it is welcome
    with pytest.raises(InvalidMesh, match="2 components") as refusal:
        SoftMap.uniform(sphere, two)
    assert refusal.value.index == len(v)


def test_descriptors_that_cannot_be_compared_are_refused(sphere: Basis, ring: Basis) -> None:
    f0, f = np.ones((sphere.mesh.n_vertices, 2)), np.ones((ring.mesh.n_vertices, 2))
    with pytest.raises(InvalidDescriptor, match="do not vary"):
        SoftMap.from_descriptors(sphere, ring, f0, f)
    with pytest.raises(InvalidDescriptor, match="columns"):
        SoftMap.from_descriptors(sphere, ring, f0, f[:, :1])
    with pytest.raises(InvalidDescriptor, match="needs a row for each"):
        SoftMap.from_descriptors(sphere, ring, f, f0)
    f[3, 1] = np.nan
    with pytest.raises(InvalidDescriptor, match="vertex 3") as refusal:
        SoftMap.from_descriptors(sphere, ring, f0, f)
    assert refusal.value.index == 3
