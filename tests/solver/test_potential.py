"""The transportation potential: against a dense twin, its constraint, chosen faces, refusals."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy import sparse

from solver.basis import Basis, poisson_basis
from solver.errors import SingularSystem, SolverError
from solver.mesh import Mesh
from solver.potential import potential, potential_block
from solver.softmap import SoftMap
from tests.solver.dense import dense_dirichlet, tensors
from tests.solver.shapes import grid, torus

#: Two solutions of systems with a (scaled) condition of about 1e3 differ by some thousand rounding errors.
AGREEMENT = 1e-11


@pytest.fixture(scope="module")
def softmap() -> SoftMap:
    source, target = poisson_basis(grid(7, 6), size=13), poisson_basis(torus(20, 10), size=35)
    rows = np.random.default_rng(3).dirichlet(np.full(target.size, 0.2), size=source.size)
    return SoftMap(source, target, rows)


def test_it_agrees_with_the_dense_twin(softmap: SoftMap) -> None:
    found, expected = potential(softmap), dense_dirichlet(softmap)
    np.testing.assert_allclose(
        found.potential, expected.potential, atol=AGREEMENT * abs(expected.potential).max()
    )
    assert found.residual < 1e-14


def test_it_unpacks_as_potential_and_frames(softmap: SoftMap) -> None:
    q, frames = potential(softmap)
    n_faces = softmap.source.mesh.n_faces
    assert q.shape == (n_faces, 2, softmap.target.size)
    np.testing.assert_array_equal(frames, softmap.source.mesh.frames)


def test_its_mean_under_the_map_is_zero(softmap: SoftMap) -> None:
    """The constraint u_f · q_fs = 0 of eq. 12, with the blend."""
    q, _ = potential(softmap, 1e-3)
    means, overlap, _, _ = tensors(softmap.target)
    weights = (
        softmap.source.functions.toarray()[softmap.source.mesh.faces].mean(axis=1) @ softmap.coefficients
    )
    integrals = softmap.target.mesh.face_areas @ means
    u = (1 - 1e-3) * weights @ overlap + 1e-3 * integrals
    assert abs(np.einsum("fn,fsn->fs", u, q)).max() < 1e-13 * abs(q).max()


def test_chosen_faces_are_those_of_all_to_the_bit(softmap: SoftMap, rng: np.random.Generator) -> None:
    everywhere = potential(softmap)
    faces = rng.integers(0, softmap.source.mesh.n_faces, 21)
    chosen = potential(softmap, faces=faces, threads=2)
    np.testing.assert_array_equal(chosen.potential, everywhere.potential[faces])
    np.testing.assert_array_equal(chosen.frames, everywhere.frames[faces])
    block = potential_block(softmap, 5, 9)
    np.testing.assert_array_equal(block.potential, everywhere.potential[5:9])
    np.testing.assert_array_equal(block.frames, everywhere.frames[5:9])


def test_no_face_is_an_answer(softmap: SoftMap) -> None:
    found = potential(softmap, faces=[])
    assert found.potential.shape == (0, 2, softmap.target.size)
    assert found.residual == 0


def test_progress_ends_at_one(softmap: SoftMap) -> None:
    heard: list[float] = []
    potential(softmap, progress=heard.append)
    assert heard[-1] == 1
    assert heard == sorted(heard)


@pytest.mark.parametrize("faces", [[-1], [0, 10**6], [0.5], [[0]]])
def test_a_face_that_is_none_is_refused(softmap: SoftMap, faces: list[object]) -> None:
    with pytest.raises(SolverError, match="face"):
        potential(softmap, faces=faces)  # type: ignore[arg-type]


def test_the_face_of_a_singular_system_is_named(softmap: SoftMap) -> None:
    target = softmap.target
    halves = [target.functions[:, :1] / 2, target.functions[:, :1] / 2, target.functions[:, 1:]]
    samples = np.append(target.samples[0], target.samples)
    twins = Basis(target.mesh, sparse.csr_array(sparse.hstack(halves)), samples, target.cells + 1)
    rows = np.hstack(
        [softmap.coefficients[:, :1] / 2, softmap.coefficients[:, :1] / 2, softmap.coefficients[:, 1:]]
    )
    with pytest.raises(SingularSystem, match="face 4 ") as caught:
        potential(SoftMap(softmap.source, twins, rows), faces=[4, 2])
    assert caught.value.index == 4


def read_off(path: Path) -> Mesh:
    words = path.read_text().split()
    n_vertices, n_faces = int(words[1]), int(words[2])
    numbers = np.array(words[4:], dtype=float)
    vertices = numbers[: 3 * n_vertices].reshape(-1, 3)
    return Mesh(vertices, numbers[3 * n_vertices :].reshape(n_faces, 4)[:, 1:].astype(int))


def test_the_wolves_true_map_is_solved_to_rounding(data: Path) -> None:
    """A peaked map: condition 1e9, of which a good ground leaves nothing."""
    folder = data / "pairs" / "academic_tosca_wolf0_wolf1"
    source = poisson_basis(read_off(folder / "source__wolf0.off"), size=100)
    target = poisson_basis(read_off(folder / "target__wolf1.off"), size=100)
    softmap = SoftMap.from_points(source, target, np.loadtxt(folder / "gt.txt", dtype=int))
    faces = np.arange(0, source.mesh.n_faces, 400)
    found = potential(softmap, faces=faces)
    assert found.residual < 1e-14
    expected = dense_dirichlet(softmap, faces=faces).potential
    np.testing.assert_allclose(found.potential, expected, atol=1e-9 * abs(expected).max())
