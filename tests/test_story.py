"""From two meshes to the energies of a map between them, over HTTP: read it as the tutorial.

With SOFTMAPS_URL it asks that service, as the compose file's `tests` profile does; else it starts a stack.
"""

from __future__ import annotations

import os
from collections.abc import Iterator

import numpy as np
import pytest
from scipy.spatial import cKDTree

from service.client import Client
from service.creature import creature
from service.stack import Stack
from worker.settings import Settings


@pytest.fixture(scope="module")
def client(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Client]:
    named, token = os.environ.get("SOFTMAPS_URL"), os.environ.get("SOFTMAPS_TOKEN")
    if named:
        with Client(named, token, patience=60.0) as connected:
            yield connected
        return
    with (
        Stack(Settings(data=tmp_path_factory.mktemp("story"))) as stack,
        Client(stack.url, token) as connected,
    ):
        yield connected


def test_the_story(client: Client) -> None:
    # A service is ready when its store and its Redis can be reached and somebody works.
    assert client.ready()

    # Two poses of one creature: the same faces, and vertex k is the same point of its skin in both.
    (standing, faces), (trotting, _) = creature("standing"), creature("trotting")

    # A mesh is named by what it holds, so uploading it again changes nothing.
    source = client.upload_mesh((standing, faces), name="standing")
    target = client.upload_mesh((trotting, faces), name="trotting")
    assert client.upload_mesh((standing, faces)).id == source.id
    assert source.facts["n_vertices"] == len(standing)
    assert source.facts["euler_characteristic"] == 2
    assert source.warnings == ()

    # A point map names the target vertex of every source vertex, counted from 0; here it is the identity.
    targets = client.upload_array(np.arange(len(standing)))

    # The question is one document: energies of a soft map between two bases, each on its mesh.
    def basis(mesh: str) -> dict[str, object]:
        return {"kind": "basis", "mesh": mesh, "size": 40}

    true_map = {"type": "points", "targets": targets.id}
    softmap = {"kind": "softmap", "source": basis(source.id), "target": basis(target.id), "map": true_map}
    question = {"kind": "energy", "softmap": softmap}

    # Asking it starts a job, whose tasks are the bases, the map and the energies; asking again joins it.
    job = client.submit(question)
    assert client.submit(question).id == job.id
    assert [task.kind for task in job.tasks] in (["basis", "basis", "softmap", "energy"], ["energy"])

    # Waiting shows how far it is; nothing ever goes backwards, and the end is 100 %.
    progress: list[float] = []
    done = client.wait(job.id, lambda seen: progress.append(seen.progress), timeout=300)
    assert done.status == "successful"
    assert progress == sorted(progress)
    assert progress[-1] == 100

    # The answer holds both energies: about 2 is stretched nowhere, and 1 is bijective.
    answer = client.artifact(job.id)
    assert 1.0 < answer.values["dirichlet"] < 3.0
    assert 0.999 < answer.values["bijectivity"] < 1.2

    # Energies are densities summed over faces of a mesh with area 1.
    corners = standing[faces]
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    density = client.array(job.id, "dirichlet_density")
    assert (areas / areas.sum()) @ density == pytest.approx(answer.values["dirichlet"], rel=1e-12)

    # Any rows of any array can be had alone, as binary or as JSON.
    assert np.array_equal(client.array(job.id, "dirichlet_density", rows=(100, 200)), density[100:200])

    # Where it came from stays known: every step is an artifact of its own, parents first.
    kinds = [artifact.kind for artifact in client.lineage(job.id)]
    assert kinds[-1] == "energy"
    assert sorted(kinds) == ["array", "basis", "basis", "energy", "mesh", "mesh", "softmap"]

    # Folding its right half onto the left stretches nothing either, but one side receives more than another.
    _, mirrored = cKDTree(standing).query(standing * (-1.0, 1.0, 1.0))
    folded = np.where(standing[:, 0] > 0, mirrored, np.arange(len(standing)))
    fold = client.energy(source.id, target.id, folded, size=40, timeout=300)
    assert fold.dirichlet == pytest.approx(answer.values["dirichlet"], rel=0.3)
    assert 1.2 < fold.bijectivity < 2.2
