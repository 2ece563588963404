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

#: What commands and options are called now, by their former names.
FORMER = {
    "adversary": "`python -m proofs study adversary`",
    "board coverage": "the function `ventbench.task.metrics.open_loop.by_lung`",
    "headroom": "`ventbench board headroom`",
    "isolability": "`ventbench diagnose PLAN --isolability`",
    "lungs": "`ventbench list lungs`",
    "open-loop": "`ventbench data open-loop`",
    "report": "`ventbench view RUN --out report.html`",
    "stressors": "`ventbench list stressors`",
    "train dqn": "`python submissions/dqn/train.py`",
    "train population": "`python -m proofs population`",
    "train ppo": "`python submissions/ppo/train.py`",
    "train residual": "`python submissions/residual_mlp/train.py`",
    "tune": "`ventbench train pid`",
    "--dir": "`--out`",
    "--jobs": "`--workers`",
    "--plant": "`--simulator`",
    "--simulated": "`--simulator`",
    "--supersedes": "`ventbench board withdraw`, then `ventbench board add`",
}

app = options.program(
    "ventbench", "A benchmark for the control of mechanical ventilators.", former=FORMER
)
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
