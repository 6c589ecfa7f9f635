"""The errors of the solver.

SolverError
├── InvalidMesh           a mesh that cannot be measured: which vertex or face, and its value
├── InvalidBasis          a basis that cannot be built or used: which function, and why
├── InvalidDescriptor     a descriptor that cannot be computed or compared
├── InvalidSoftMap        coefficients or targets that are no soft map: which row, and its value
└── SingularSystem        a linear system without a trustworthy solution: which face, and its pivot

Every one carries ``index`` and ``value`` where there is a culprit, so that an HTTP answer can name it.
"""

from __future__ import annotations


class SolverError(Exception):
    """A computation that was refused or failed, naming the culprit.

    Parameters
    ----------
    message : str
        What is wrong, in words that say what to do.
    index : int, optional
        Index of the offending vertex, face, function or row (0-based).
    value : float or str, optional
        The offending value.
    """

    def __init__(self, message: str, *, index: int | None = None, value: float | str | None = None) -> None:
        super().__init__(message)
        self.index = index
        self.value = value


class InvalidMesh(SolverError):
    """Vertices and faces that are not a measurable triangle mesh."""


class InvalidBasis(SolverError):
    """A basis that cannot be built on its mesh, or whose functions are linearly dependent."""


class InvalidDescriptor(SolverError):
    """A descriptor that cannot be computed on its mesh, or two that cannot be compared."""


class InvalidSoftMap(SolverError):
    """Coefficients, targets or weights that do not make a soft map."""


class SingularSystem(SolverError):
    """A linear system with no trustworthy solution."""
