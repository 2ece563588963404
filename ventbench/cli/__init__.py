"""The command line ``ventbench``: parses, calls, prints. One module per group of commands.

Exit codes: 0 done; 1 the command ran and the answer is no; 2 bad input; 130 stopped by Ctrl-C.
Heavy packages are imported inside the commands, so that ``ventbench --help`` answers at once.
"""

from __future__ import annotations

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

for _module in (score, simulators, diagnose):
    for _command in _module.COMMANDS:
        app.command(_command.__name__.replace("_", "-"))(_command)
app.command()(doctor.doctor)
app.add_typer(train.tune)
for _module in (train, board, round, data):
    app.add_typer(_module.app)


def main() -> None:
    """Entry point of the console script."""
    options.run(app, "ventbench")
