"""The command line ``ventbench``: parses, calls, prints. One module per group of commands.

Exit codes: 0 done; 1 the command ran and the answer is no; 2 bad input; 130 stopped by Ctrl-C.
Heavy packages are imported inside the commands, so that ``ventbench --help`` answers at once.
"""

from __future__ import annotations

import typer

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

app = options.program("ventbench", "A benchmark for the control of mechanical ventilators.")
listing = typer.Typer(
    name="list",
    help="List the lungs, stressors, submissions and examples.",
    no_args_is_help=True,
)

#: Groups of `ventbench --help`, the commands of each, and where the commands of the groups belong.
_PANELS = {
    "Controllers": (score.score, score.new, score.check),
    "Recordings": (diagnose.diagnose, diagnose.mechanics, diagnose.isolability),
    "Simulators and pictures": (simulators.simulate, simulators.view, simulators.report),
    "This machine": (doctor.doctor,),
}
_GROUPS = {
    listing: (simulators.lungs, score.stressors, score.entries, data.examples),
    data.app: (simulators.open_loop,),
    board.app: (simulators.coverage, score.headroom),
}
for _panel, _commands in _PANELS.items():
    for _command in _commands:
        app.command(rich_help_panel=_panel)(_command)
for _group, _commands in _GROUPS.items():
    for _command in _commands:
        _group.command()(_command)
app.add_typer(train.tune, rich_help_panel="Controllers")
app.add_typer(train.app, rich_help_panel="Controllers")
app.add_typer(data.app, rich_help_panel="Recordings")
app.add_typer(listing, rich_help_panel="Simulators and pictures")
app.add_typer(board.app, rich_help_panel="Leaderboard")
app.add_typer(round.app, rich_help_panel="Leaderboard")


def main() -> None:
    """Entry point of the console script."""
    options.run(app, "ventbench")
