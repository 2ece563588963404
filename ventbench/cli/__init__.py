"""The command line ``ventbench``: parses, calls, prints. One module per group of commands.

Exit codes: 0 done; 1 the command ran and the answer is no; 2 bad input; 130 stopped by Ctrl-C.
Heavy packages are imported inside the commands, so that ``ventbench --help`` answers at once.
"""

from __future__ import annotations

from typing import Any

import typer
from typer.core import TyperGroup

from ventbench.base.errors import InputError
from ventbench.cli import (
    board,
    data,
    diagnose,
    doctor,
    options,
    round,
    score,
    simulators,
    train,
)

#: Commands by their former names.
_MOVED = {
    "headroom": "board headroom",
    "isolability": "diagnose PLAN --isolability",
    "lungs": "list lungs",
    "open-loop": "data open-loop",
    "report": "view RUN --out report.html",
    "stressors": "list stressors",
    "tune": "train",
}


class _Commands(TyperGroup):
    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        if args[0] in _MOVED:
            raise InputError(f"`ventbench {args[0]}` is now `ventbench {_MOVED[args[0]]}`")
        return super().resolve_command(ctx, args)


app = options.program("ventbench", "A benchmark for the control of mechanical ventilators.")
app.info.cls = _Commands
listing = typer.Typer(
    name="list",
    help="List the lungs, stressors, submissions and examples.",
    no_args_is_help=True,
)

#: Groups of `ventbench --help`, the commands of each, and where the commands of the groups belong.
_PANELS = {
    "Controllers": (score.score, score.new, score.check, train.app),
    "Recordings": (diagnose.diagnose, diagnose.mechanics, data.app),
    "Simulators and pictures": (simulators.simulate, simulators.view, listing),
    "This machine": (doctor.doctor,),
    "Leaderboard": (board.app, round.app),
}
_GROUPS = {
    listing: (simulators.lungs, score.stressors, score.entries, data.examples),
    data.app: (simulators.open_loop,),
    board.app: (score.headroom,),
}
for _panel, _commands in _PANELS.items():
    for _command in _commands:
        if isinstance(_command, typer.Typer):
            app.add_typer(_command, rich_help_panel=_panel)
        else:
            app.command(rich_help_panel=_panel)(_command)
for _group, _commands in _GROUPS.items():
    for _command in _commands:
        _group.command()(_command)


def main() -> None:
    """Entry point of the console script."""
    options.run(app, "ventbench")
