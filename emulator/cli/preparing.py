"""Compilation of kernels under a progress bar, before a command needs them."""

from __future__ import annotations

from collections.abc import Sequence

from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn

from emulator.cli.output import status
from emulator.run.kernels import Part
from emulator.run.preparation import Preparation, cold, prepare

__all__ = ["prepared"]


def prepared(parts: Sequence[Part]) -> int:
    """Compile those of the parts that this machine has not compiled yet; return how many these were."""
    missing = cold(parts)
    if not missing:
        return 0
    names = ", ".join(part.name for part in missing)
    status.print(f"compiling, once on this machine: {names}", markup=False)
    columns = TextColumn("compiling"), BarColumn(), TaskProgressColumn(), TimeElapsedColumn()
    with Progress(*columns, console=status, transient=True, disable=not status.is_terminal) as bar:
        task = bar.add_task("compiling", total=1.0)
        told: set[str] = set()

        def show(state: Preparation) -> None:
            bar.update(task, completed=state.share)
            for name in [] if status.is_terminal else [n for n in state.ended if n not in told]:
                told.add(name)
                status.print(f"compiled: {name} ({len(state.ended)} of {len(missing)})", markup=False)

        failed = prepare(missing, show)
    if failed:
        status.print(f"not compiled ahead: {', '.join(failed)}; that happens during the run", markup=False)
    return len(missing)
