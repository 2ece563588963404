"""Entry point of ``python -m proofs``, in a checkout."""

from __future__ import annotations

from proofs.cli import challenge, paper, real, release
from ventbench.cli import options

app = options.program(
    "proofs",
    "Proofs that ventbench does what it says.",
    former={"--jobs": "`--workers`"},
    completion=False,
)

app.add_typer(challenge.app)
app.command()(real.rig)
app.command()(real.pairs)
app.command()(paper.paper)
app.add_typer(paper.app)
app.command()(release.population)

if __name__ == "__main__":
    options.run(app, "proofs", named="python -m proofs")
