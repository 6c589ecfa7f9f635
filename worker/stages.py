"""One table: each kind of question, the task that answers it, its cost and how it splits into shards."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, Final

from worker import checks, ingredients, motion, sizes, solves, specs
from worker.bench import Bench, Made
from worker.settings import Settings
from worker.sizes import Cost, Sizes


def _no_shards(spec: Any, sizes_: Sizes) -> tuple[specs.Spec, ...]:
    return ()


@dataclass(frozen=True)
class Stage:
    """How one kind is answered.

    Attributes
    ----------
    make : callable
        ``make(spec, bench) -> Made``; raises `SolverError` or `StoreError`.
    cost : callable
        ``cost(spec, sizes) -> Cost``.
    check : callable
        ``check(spec, sizes, settings)`` yields what manifests say is wrong.
    shards : callable
        ``shards(spec, sizes)`` gives the specs that it can be split into, none or one meaning never.
    """

    make: Callable[[Any, Bench], Made]
    cost: Callable[[Any, Sizes], Cost]
    check: Callable[[Any, Sizes, Settings], Iterator[checks.Flaw]] = field(default=checks.of_softmap)
    shards: Callable[[Any, Sizes], tuple[specs.Spec, ...]] = field(default=_no_shards)


STAGES: Final[Mapping[type[specs.Spec], Stage]] = {
    specs.PoissonBasis: Stage(ingredients.make_basis, sizes.basis_cost, checks.basis),
    specs.MaxentBasis: Stage(ingredients.make_basis, sizes.basis_cost, checks.basis),
    specs.Spectrum: Stage(ingredients.make_spectrum, sizes.spectrum_cost, checks.spectrum),
    specs.Descriptor: Stage(ingredients.make_descriptor, sizes.descriptor_cost, checks.descriptor),
    specs.SoftMap: Stage(ingredients.make_softmap, sizes.softmap_cost, checks.softmap),
    specs.Potential: Stage(solves.make_potential, sizes.potential_cost, shards=solves.potential_shards),
    specs.PotentialBlock: Stage(solves.make_potential_block, sizes.potential_block_cost),
    specs.Energy: Stage(solves.make_energy, sizes.energy_cost, shards=solves.energy_shards),
    specs.EnergyBlock: Stage(solves.make_energy_block, sizes.energy_block_cost),
    specs.Momentum: Stage(motion.make_momentum, sizes.momentum_cost, checks.momentum),
    specs.Path: Stage(motion.make_path, sizes.path_cost, checks.path),
    specs.PointMap: Stage(motion.make_pointmap, sizes.pointmap_cost),
}


def stage(spec: specs.Spec) -> Stage:
    """How a question is answered."""
    return STAGES[type(spec)]


def flaws(spec: specs.Spec, sizes_: Sizes, settings: Settings) -> list[checks.Flaw]:
    """What manifests say is wrong with a question, as (place below it, what).

    Parameters
    ----------
    spec : Spec
    sizes_ : Sizes
    settings : Settings

    Returns
    -------
    list of (str, str)
        Empty if it may be computed.
    """
    missing = list(checks.missing_uploads(spec, sizes_))
    return missing or list(stage(spec).check(spec, sizes_, settings))
