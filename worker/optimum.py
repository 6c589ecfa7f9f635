"""The task that optimises a soft map (§5.3): it says how far it is, and goes on where an earlier run stopped.

The solver is imported inside functions: whoever only plans tasks must not load it.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np
import numpy.typing as npt

from worker import specs
from worker.bench import Bench, Made, rest
from worker.store import Checkpoint

if TYPE_CHECKING:
    import solver

#: Shortest time between two checkpoints, and most of the run that writing them may take.
CHECKPOINT_SECONDS: Final = 1.0
CHECKPOINT_SHARE: Final = 0.05
#: Columns of a history.
HISTORY: Final = ("energy", "gap", "evaluations", "seconds")

FloatArray = npt.NDArray[np.float64]


def make_optimal(spec: specs.SoftMap, bench: Bench) -> Made:
    """Coefficients of an optimal soft map, what is proven of it, and the history of the search."""
    from solver import LinearConstraint, SoftMap, optimal_softmap  # noqa: PLC0415  (see the module)

    chosen, read = spec.map, bench.read
    assert isinstance(chosen, specs.Optimal)
    source, target = read.basis(spec.source), read.basis(spec.target)
    target.require_independent()
    constraints = [
        LinearConstraint.on_region(source, target, each.source, each.target) for each in chosen.constraints
    ]
    start = None if chosen.start is None else read.softmap(chosen.start)
    checkpoint = read.store.checkpoint(bench.task)
    earlier = Earlier.of(checkpoint)
    if checkpoint is not None:
        start = SoftMap(source, target, checkpoint.arrays["coefficients"])
    cost = _attachment(chosen, source, target, bench)
    course = _Course(bench, earlier)
    found = optimal_softmap(
        source,
        target,
        landmarks=chosen.landmarks,
        bijectivity_weight=chosen.bijectivity_weight,
        tolerance=chosen.tolerance,
        max_iterations=max(0, chosen.max_iterations - earlier.iterations),
        method=chosen.method,
        constraints=constraints,
        start=start,
        regularisation=chosen.regularisation,
        threads=bench.threads,
        progress=course.progress,
        report=course.report,
        cost=cost,
    )
    history = course.history
    gap = float(history[-1, 1])
    values = {
        "energy": found.energy,
        "dirichlet": found.dirichlet,
        "bijectivity": found.bijectivity,
        "attachment": found.attachment,
        "gap": gap,
        "converged": found.converged or gap <= chosen.tolerance * found.energy,
        "iterations": len(history) - 1,
    }
    arrays = {"coefficients": np.asarray(found.softmap.coefficients)}
    arrays |= {f"history_{name}": history[:, k].copy() for k, name in enumerate(HISTORY)}
    words = f"{source.size} × {target.size} functions, {len(history) - 1} iterations"
    return Made(values, arrays, words)


def _attachment(
    chosen: specs.Optimal, source: solver.Basis, target: solver.Basis, bench: Bench
) -> FloatArray | float:
    """What draws mass to where descriptors agree, (n₀, n), or 0 for nothing."""
    from solver import descriptor_cost, landmark_distances  # noqa: PLC0415  (see the module)

    if not chosen.attachment:
        return 0.0
    if chosen.source is not None and chosen.target is not None:
        f0, f = bench.read.descriptor(chosen.source), bench.read.descriptor(chosen.target)
    else:
        bench.step(f"distances to {len(chosen.landmarks)} landmarks", 0.0, 0.0)
        f0 = landmark_distances(source.mesh, [v0 for v0, _ in chosen.landmarks])
        f = landmark_distances(target.mesh, [v for _, v in chosen.landmarks])
    return chosen.attachment * descriptor_cost(source, target, f0, f)


@dataclass(frozen=True, eq=False)
class Earlier:
    """What earlier runs of a search found.

    Attributes
    ----------
    history : ndarray of float64, shape (k, 4)
        Energy, gap, evaluations and seconds after each iteration; the first row is the start's.
    """

    history: FloatArray

    @classmethod
    def of(cls, checkpoint: Checkpoint | None) -> Earlier:
        """What a checkpoint tells; nothing without one."""
        return cls(np.zeros((0, 4)) if checkpoint is None else checkpoint.arrays["history"])

    @property
    def iterations(self) -> int:
        """Iterations so far."""
        return max(0, len(self.history) - 1)

    @property
    def bound(self) -> float:
        """What no soft map's energy is below, as far as was proven."""
        return float((self.history[:, 0] - self.history[:, 1]).max(initial=-np.inf))

    def joined(self, iterations: Sequence[solver.Iteration]) -> FloatArray:
        """History of the earlier runs and of this one, whose start is where they ended."""
        rows = [[one.energy, one.gap, one.evaluations, one.seconds] for one in iterations]
        now = np.array(rows, dtype=np.float64).reshape(-1, 4)
        now[:, 1] = np.clip(np.minimum(now[:, 1], now[:, 0] - self.bound), 0, None)
        if not len(self.history):
            return now
        now[:, 2:] += self.history[-1, 2:]
        return np.concatenate([self.history, now[1:]])


class _Course:
    """Follows a search: says how far it is, and writes checkpoints.

    Attributes
    ----------
    history : ndarray of float64, shape (k, 4)
        Of the earlier runs and of this one.
    """

    history: FloatArray

    def __init__(self, bench: Bench, earlier: Earlier) -> None:
        self._bench, self._earlier = bench, earlier
        self._iterations: list[solver.Iteration] = []
        words = f"going on after iteration {earlier.iterations}" if earlier.iterations else "first evaluation"
        self._said = bench.step(words, 0.0, 1.0)
        self._fraction = 0.0
        self._due = 0.0

    def progress(self, done: float) -> None:
        """Take note of the fraction done."""
        self._fraction = done
        self._said(done)

    def report(self, iteration: solver.Iteration, softmap: solver.SoftMap) -> None:
        """Take note of an iteration and of the best soft map so far."""
        self._iterations.append(iteration)
        self.history = self._earlier.joined(self._iterations)
        count = len(self.history) - 1
        energy, gap, evaluations, _ = self.history[-1].tolist()
        values = {"iteration": count, "energy": energy, "gap": gap, "evaluations": round(evaluations)}
        share = f"{100 * gap / energy:.3g} %" if energy > 0 else f"{gap:.2g}"
        words = f"iteration {count}: energy {energy:.4f}, gap {share}"
        self._said = rest(self._bench.step(words, self._fraction, 1.0, values), self._fraction)
        began = time.monotonic()
        if began >= self._due:
            arrays = {"coefficients": np.asarray(softmap.coefficients), "history": self.history}
            self._bench.read.store.write_checkpoint(self._bench.task, values, arrays)
            ended = time.monotonic()
            self._due = ended + max(CHECKPOINT_SECONDS, (ended - began) / CHECKPOINT_SHARE)
