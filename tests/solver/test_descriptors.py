"""Eigenpairs and signatures: exact on the sphere, equal to another library's, shared by a pair."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pyFM.signatures import HKS_functions, WKS_functions

from solver.descriptors import FEWEST_ENERGIES, hks, hks_of, spectrum, wks, wks_of
from solver.errors import InvalidDescriptor
from solver.fem import mass, stiffness
from solver.mesh import Mesh
from tests.solver.shapes import icosphere, torus

#: Both sides evaluate the same sum of squares.
ROUNDING = 1e-12


@pytest.fixture(scope="module")
def sphere() -> Mesh:
    return icosphere(4)


def test_sphere_eigenvalues_are_l_times_l_plus_1(sphere: Mesh) -> None:
    # The unit-area sphere has radius² = 1/4π; level l has 2l + 1 eigenvalues 4π l(l + 1).
    exact = np.concatenate([np.full(2 * level + 1, 4 * np.pi * level * (level + 1)) for level in range(5)])
    values = spectrum(sphere, 25).values
    assert values[0] == pytest.approx(0, abs=1e-8)
    np.testing.assert_allclose(values[1:], exact[1:], rtol=0.02)


def test_sphere_eigenvalues_converge_at_second_order() -> None:
    errors = [abs(spectrum(icosphere(level), 4).values[1] - 8 * np.pi) for level in (2, 3, 4)]
    slopes = np.log2(np.divide(errors[:-1], errors[1:]))
    assert (slopes > 1.8).all()


@pytest.mark.parametrize("eigenpairs", [3, 40])
def test_eigenpairs_solve_the_generalised_problem(eigenpairs: int) -> None:
    mesh = torus(40, 20)  # 800 vertices: the Lanczos solver
    pairs = spectrum(mesh, eigenpairs)
    weights = mass(mesh)
    residual = stiffness(mesh) @ pairs.functions - weights[:, None] * pairs.functions * pairs.values
    assert np.abs(residual).max() < 1e-9 * pairs.values[-1]
    np.testing.assert_allclose(
        pairs.functions.T @ (weights[:, None] * pairs.functions), np.eye(eigenpairs), atol=1e-10
    )


def test_dense_and_lanczos_solvers_agree() -> None:
    mesh = torus(40, 20)
    np.testing.assert_allclose(
        spectrum(mesh, 100).values, spectrum(mesh, mesh.n_vertices).values[:100], rtol=1e-9, atol=1e-9
    )


def test_the_spectrum_is_repeatable(sphere: Mesh) -> None:
    assert np.array_equal(spectrum(sphere, 30).functions, spectrum(sphere, 30).functions)


def test_unreferenced_vertices_are_zero(sphere: Mesh) -> None:
    mesh = Mesh(np.vstack([sphere.vertices, [[5.0, 5.0, 5.0]]]), sphere.faces)
    assert not spectrum(mesh, 10).functions[-1].any()


@pytest.mark.parametrize("count", [FEWEST_ENERGIES + 1, 100])
def test_signatures_equal_an_independent_implementation(sphere: Mesh, count: int) -> None:
    pairs = spectrum(sphere, 60)
    np.testing.assert_allclose(
        hks_of(pairs, None, count),
        HKS_functions.auto_HKS(pairs.values, pairs.functions, count),
        rtol=ROUNDING,
    )
    np.testing.assert_allclose(
        wks_of(pairs, None, count),
        WKS_functions.auto_WKS(pairs.values, pairs.functions, count),
        rtol=ROUNDING,
    )


@pytest.mark.parametrize("signature", [hks_of, wks_of])
def test_a_signature_integrates_to_one_at_every_time(sphere: Mesh, signature: type(hks_of)) -> None:
    np.testing.assert_allclose(mass(sphere) @ signature(spectrum(sphere, 60), None, 50), 1.0, rtol=1e-10)


@pytest.mark.parametrize("signature", [hks, wks])
def test_a_mesh_paired_with_itself_keeps_its_signature(sphere: Mesh, signature: type(hks)) -> None:
    np.testing.assert_allclose(
        signature(sphere, 40, 60, partner=sphere), signature(sphere, 40, 60), rtol=1e-12
    )


@given(scale=st.floats(1e-3, 1e3), angle=st.floats(0, 6))
@settings(max_examples=10, deadline=None)
def test_signatures_do_not_feel_rigid_motion_or_scale(scale: float, angle: float) -> None:
    mesh = torus(12, 8)
    rotation = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    moved = Mesh(mesh.vertices @ rotation.T * scale + [3, -1, 2], mesh.faces)
    # All eigenpairs, so that no multiplet is cut in two.
    np.testing.assert_allclose(hks(moved, 30, 96), hks(mesh, 30, 96), rtol=1e-7, atol=1e-9)


def test_two_meshes_share_times_and_scales_symmetrically(sphere: Mesh) -> None:
    one, other = spectrum(sphere, 60), spectrum(torus(40, 20), 60)
    ours = wks_of(one, other, 50)
    # Scaling the partner's eigenvalues moves the shared energies, so the signature must feel its partner.
    assert np.abs(ours - wks_of(one, None, 50)).max() > 1e-3
    # Shared scales: both integrals average to one.
    integrals = mass(sphere) @ ours, mass(torus(40, 20)) @ wks_of(other, one, 50)
    np.testing.assert_allclose(np.mean(integrals, axis=0), 1.0, rtol=1e-9)


def test_too_few_energies_or_eigenpairs_are_refused(sphere: Mesh) -> None:
    with pytest.raises(InvalidDescriptor, match="28"):
        wks(sphere, FEWEST_ENERGIES - 1, 40)
    with pytest.raises(InvalidDescriptor, match="eigenpairs"):
        hks(sphere, 10, 1)
    with pytest.raises(InvalidDescriptor, match="positive"):
        hks(sphere, 10, 2)


def test_eigenvalues_repeated_more_often_than_a_block_is_wide_are_all_found() -> None:
    one = torus(16, 12)
    copies = 12  # more than the first blocks have vectors; every eigenvalue is repeated at least as often
    vertices = np.concatenate([one.vertices + 10.0 * k for k in range(copies)])
    faces = np.concatenate([one.faces + k * one.n_vertices for k in range(copies)])
    values = spectrum(Mesh(vertices, faces), 60).values
    # A twelfth of the area has twelve times the eigenvalues.
    alone = copies * spectrum(one, 5).values
    np.testing.assert_allclose(values, np.repeat(alone, copies), rtol=1e-9, atol=1e-8)


def test_the_spectrum_does_not_depend_on_threads() -> None:
    mesh = icosphere(5)  # more vertices than one piece of rows
    one, three = spectrum(mesh, 40), spectrum(mesh, 40, threads=3)
    assert np.array_equal(one.values, three.values)
    assert np.array_equal(one.functions, three.functions)
