"""What people see of the command line: progress of jobs, tables of results, and errors in words."""

from __future__ import annotations

import json
import signal
import sys
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from types import FrameType
from typing import Any, Never

import typer
from pydantic import ValidationError
from rich.console import Console
from rich.markup import escape
from rich.progress import (
    BarColumn,
    Progress,
    SpinnerColumn,
    TaskID,
    TaskProgressColumn,
    TextColumn,
    TimeElapsedColumn,
)
from rich.table import Table

from service.answers import Artifact, Job
from service.refusals import ClientError, Refused
from service.stack import StackError
from worker.settings import Settings

#: What a shell expects of a command that was interrupted.
INTERRUPTED = 130
_MARKS = {
    "successful": "[green]✓[/]",
    "failed": "[red]✗[/]",
    "dismissed": "[yellow]–[/]",
    "running": "[cyan]▸[/]",
}


class Screen:
    """Where a command's words go: results to standard output, everything else to standard error.

    Parameters
    ----------
    machine : bool
        Whether one JSON document is wanted instead of tables, and no progress.
    """

    def __init__(self, machine: bool) -> None:
        self.machine = machine
        self._out = Console(highlight=False)
        self._err = Console(stderr=True, highlight=False)

    def say(self, words: str) -> None:
        """Tell people what happens."""
        if not self.machine:
            self._err.print(f"[dim]{escape(words)}[/]")

    def show(self, *parts: Table | str) -> None:
        """Show a result to people; machines get theirs from `answer`."""
        if not self.machine:
            for part in parts:
                self._out.print(part)

    def answer(self, document: Mapping[str, Any]) -> None:
        """Print a result for machines."""
        if self.machine:
            sys.stdout.write(json.dumps(document, indent=1) + "\n")
            sys.stdout.flush()

    def fail(self, words: str, code: int = 1) -> Never:
        """Say what went wrong and end."""
        self._err.print(f"[red]error:[/] {escape(words)}", soft_wrap=True)
        self.answer({"error": words})
        raise typer.Exit(code)

    @contextmanager
    def waiting(self, words: str = "") -> Iterator[Progress]:
        """Show progress while the block runs: a spinner with words, if any, and what `Bars` adds."""
        progress = Progress(
            SpinnerColumn(finished_text=" "),
            TextColumn("{task.description}"),
            BarColumn(bar_width=28),
            TaskProgressColumn(text_format_no_percentage=""),
            TimeElapsedColumn(),
            console=self._err,
            transient=True,
            disable=self.machine or not self._err.is_terminal,
        )
        with progress:
            if words:
                progress.add_task(words, total=None)
            yield progress


class Bars:
    """Progress of one job as bars: one for the whole, one line for each of its tasks.

    Parameters
    ----------
    progress : Progress
        Where they are drawn.
    title : str
        What the job is.
    look : callable
        Job of an id; a task is looked at like a job of its own.
    """

    def __init__(self, progress: Progress, title: str, look: Callable[[str], Job]) -> None:
        self._progress, self._title, self._look = progress, title, look
        self._whole = progress.add_task(f"[bold]{escape(title)}", total=100)
        self._lines: dict[str, TaskID] = {}

    def __call__(self, job: Job) -> None:
        """Draw a job as it stands."""
        if self._progress.disable:
            return
        self._progress.update(
            self._whole,
            completed=job.progress,
            description=f"[bold]{escape(self._title)}[/] · {escape(job.phase)}",
        )
        names = labels(job)
        for task in job.tasks:
            if task.id not in self._lines and task.status == "accepted":
                continue
            if task.id not in self._lines:
                self._lines[task.id] = self._progress.add_task("", total=100)
            percent = 100.0 if task.status == "successful" else 0.0
            if task.status == "running":
                percent = self._look(task.id).progress
            self._progress.update(
                self._lines[task.id],
                description=f"  {_MARKS.get(task.status, ' ')} {names[task.id]}",
                completed=percent,
            )
            if task.status != "running":
                self._progress.stop_task(self._lines[task.id])


def labels(job: Job) -> dict[str, str]:
    """Name of every task of a job: its kind, numbered where there are several."""
    counts, seen, found = Counter(task.kind for task in job.tasks), Counter[str](), {}
    for task in job.tasks:
        seen[task.kind] += 1
        number = f" {seen[task.kind]} of {counts[task.kind]}" if counts[task.kind] > 1 else ""
        found[task.id] = task.kind.replace("_", " ") + number
    return found


def table(title: str, columns: Sequence[str], rows: Sequence[Sequence[str]]) -> Table:
    """Table of words; the first column to the left, the others to the right."""
    drawn = Table(
        title=title,
        title_justify="left",
        title_style="bold",
        header_style="dim",
        box=None,
        pad_edge=False,
        show_header=any(columns),
    )
    for number, column in enumerate(columns):
        # Names and ids are there to be copied: what is short of room are the numbers.
        widest = max((len(row[0]) for row in rows), default=0) if number == 0 else None
        drawn.add_column(column, justify="right" if number else "left", no_wrap=number > 0, min_width=widest)
    for row in rows:
        drawn.add_row(*map(escape, row))
    return drawn


@dataclass(frozen=True)
class Timing:
    """What was computed, in words, and how long it took."""

    id: str
    what: str
    seconds: float


def timings(artifacts: Sequence[Artifact], names: Mapping[str, str]) -> list[Timing]:
    """What was computed for a result, uploads left out.

    Parameters
    ----------
    artifacts : sequence of Artifact
        Parents first.
    names : mapping of str
        What meshes and maps are called, by id.

    Returns
    -------
    list of Timing
        In the same order.
    """
    rows = []
    for artifact in artifacts:
        if artifact.spec is not None:
            # The first name is its own, or its mesh's; the partner of a descriptor comes second.
            about = [names[one] for one in (artifact.id, *artifact.parents.values()) if one in names]
            what = (
                f"{artifact.kind.replace('_', ' ')}: {about[0]}" if about else artifact.kind.replace("_", " ")
            )
            rows.append(Timing(artifact.id, what, artifact.seconds))
    return rows


def timing_table(rows: Sequence[Timing]) -> Table:
    """Seconds of every piece, and their sum."""
    words = [(row.what, f"{row.seconds:.2f}") for row in rows]
    total = sum(row.seconds for row in rows)
    return table("computed", ("job", "seconds"), [*words, ("all jobs", f"{total:.2f}")])


@contextmanager
def errors_in_words(screen: Screen) -> Iterator[None]:
    """End a command with a message instead of a traceback for everything that may be expected."""
    try:
        yield
    except Refused as error:
        screen.fail(f"the service refused ({error.status}): {error}")
    except (ClientError, StackError) as error:
        screen.fail(str(error))
    except OSError as error:
        screen.fail(f"{error.filename}: {error.strerror}" if error.filename else str(error))
    except KeyboardInterrupt:
        screen.fail("interrupted", INTERRUPTED)


def settings_in_words(screen: Screen, **fields: Any) -> Settings:
    """Settings from the environment and options, or a usage error that names what is wrong."""
    try:
        return Settings(**{name: value for name, value in fields.items() if value is not None})
    except ValidationError as error:
        wrong = [f"SOFTMAPS_{'_'.join(map(str, e['loc'])).upper()}: {e['msg']}" for e in error.errors()]
        screen.fail("; ".join(wrong), 2)


def interrupt_on_termination() -> None:
    """Let SIGTERM and a closed terminal end a command as Ctrl-C does: once, with everything cleaned up."""
    numbers = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)

    def interrupt(number: int, frame: FrameType | None) -> None:
        # Whoever presses it again must not interrupt the cleaning up, which ends soon enough.
        for each in numbers:
            signal.signal(each, ignore)
        raise KeyboardInterrupt

    def ignore(number: int, frame: FrameType | None) -> None:
        """Do nothing; SIG_IGN would have Python complain about a second signal at the same moment."""

    for number in numbers:
        signal.signal(number, interrupt)
