"""Entry point of ``python -m proofs``, in a checkout."""

from __future__ import annotations

from proofs.cli import challenge, paper, real, study
from ventbench.cli import options

app = options.program(
    "proofs", "Proofs that ventbench does what it says; each runs from a checkout.",
    completion=False,
)  # fmt: skip

app.add_typer(challenge.app)
app.command()(real.rig)
app.command()(real.pairs)
app.command()(paper.paper)
app.add_typer(study.app)

if __name__ == "__main__":
    options.run(app, "proofs", named="python -m proofs")
