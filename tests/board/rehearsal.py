"""A whole round from an empty clone, by the documented commands and three identities.

The *author* sends an entry, the *maintainer* opens, freezes, draws, scores, signs and builds, the
*referee* stands in for the public beacon and knows nothing but the number that is due. Each works
in a clone of their own; every step is a commit that the others pull. Usage::

    python tests/board/rehearsal.py --out runs/rehearsal --workers 2

With ``--entries`` only some bundled submissions take part. A round to publish has a ``--name``, a
``--key`` of the maintainer, as ``ventbench board new-key`` prints it, and no ``--newcomer``. At the
end a changed byte of the beacon, of an entry, of the protocol and of a record must each be found.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import time
from datetime import UTC, datetime, timedelta
from pathlib import Path

import msgspec

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

from ci import apart  # noqa: E402
from tests.board import referee  # noqa: E402

SECRET, DELAY_S = 271828182845904523536, 5


class Person:
    """Somebody with a clone, a name and an environment of their own."""

    def __init__(self, name: str, folder: Path, origin: Path, **environ: str):
        self.name, self.folder = name, folder / name
        mail = f"{name}@ventbench.invalid"
        self.environ = {
            **os.environ,
            "JAX_PLATFORMS": "cpu",
            "PYTHONPATH": str(self.folder),
            **environ,
            "GIT_AUTHOR_NAME": name,
            "GIT_AUTHOR_EMAIL": mail,
            "GIT_COMMITTER_NAME": name,
            "GIT_COMMITTER_EMAIL": mail,
        }
        subprocess.run(["git", "clone", "--quiet", origin, self.folder], check=True)

    def run(self, *command: str, code: int = 0) -> str:
        done = subprocess.run(
            command, cwd=self.folder, env=self.environ, capture_output=True, text=True
        )
        if done.returncode != code:
            raise SystemExit(f"{self.name}: {' '.join(command)}\n{done.stdout}{done.stderr}")
        return done.stdout

    def ventbench(self, *arguments: str, code: int = 0) -> str:
        begun = time.perf_counter()
        said = self.run(sys.executable, "-m", "ventbench", *arguments, code=code)
        took = time.perf_counter() - begun
        print(f"{self.name}: ventbench {' '.join(arguments)}  ({took:.0f} s)\n{said}", flush=True)
        return said

    def share(self, message: str) -> None:
        """Commit everything and push it; no change may hold what must come apart."""
        self.run("git", "add", "--all")
        self.run("git", "commit", "--quiet", "--message", message)
        changed = self.run("git", "diff", "--name-only", "HEAD~1").splitlines()
        assert apart.problems(changed) == [], changed
        self.run("git", "push", "--quiet", "origin", "HEAD:main")

    def pull(self) -> None:
        self.run("git", "pull", "--quiet", "--rebase", "origin", "main")


def empty_clone(out: Path, entries: list[str]) -> Path:
    """A repository of what is committed here, with some submissions and no leaderboard."""
    seed, origin = out / "seed", out / "origin.git"
    subprocess.run(["git", "clone", "--quiet", ROOT, seed], check=True)
    shutil.rmtree(seed / "leaderboard", ignore_errors=True)
    for folder in (seed / "submissions").iterdir():
        if folder.is_dir() and entries and folder.name not in entries:
            shutil.rmtree(folder)
    who = ("-c", "user.name=maintainer", "-c", "user.email=maintainer@ventbench.invalid")
    for command in (("checkout", "-q", "-B", "main"), ("add", "-A"), ("commit", "-qm", "Empty")):
        subprocess.run(["git", "-C", seed, *who, *command], check=True)
    subprocess.run(["git", "clone", "--quiet", "--bare", seed, origin], check=True)
    return origin


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=ROOT / "runs" / "rehearsal")
    parser.add_argument("--entries", default="", help="bundled submissions, by comma; default: all")
    parser.add_argument("--workers", default="2")
    parser.add_argument("--name", default="rehearsal-1")
    parser.add_argument("--key", type=Path, help="default: a new one, which nobody keeps")
    parser.add_argument("--newcomer", default="newcomer", help="the author's entry; empty: none")
    given = parser.parse_args()
    begun, out = time.perf_counter(), given.out.resolve()
    out.mkdir(parents=True)
    origin = empty_clone(out, list(filter(None, given.entries.split(","))))
    maintainer, author = (Person(x, out, origin) for x in ("maintainer", "author"))

    # The keys come first, and alone.
    new_key = (sys.executable, "-m", "ventbench", "board", "new-key")
    printed = given.key.read_text("utf-8") if given.key else maintainer.run(*new_key)
    secret, public = printed.split("# public", 1)  # the secret is not printed
    key = next(line for line in secret.splitlines() if not line.startswith("#") and line)
    listed = maintainer.folder / "leaderboard" / "attestations.toml"
    listed.parent.mkdir()
    listed.write_text("".join(line + "\n" for line in public.splitlines()[1:]))
    maintainer.environ["VENTBENCH_SIGNING_KEY"] = key
    maintainer.ventbench("board", "sign", "leaderboard/attestations.toml")
    del maintainer.environ["VENTBENCH_SIGNING_KEY"]
    maintainer.share("A key")

    chain = out / "chain.json"
    chain.write_bytes(msgspec.json.encode(referee.chain(SECRET)))
    closes = datetime.now(UTC).replace(microsecond=0) + timedelta(seconds=30)
    maintainer.ventbench(
        "round",
        "open",
        given.name,
        "--closes",
        f"{closes:%Y-%m-%dT%H:%M:%S}",
        "--delay",
        str(DELAY_S),
        "--rehearsal",
        str(chain),
    )
    maintainer.share("The round is open")

    author.pull()
    if given.newcomer:
        author.ventbench("new", given.newcomer, "--out", "submissions")
        author.share("An entry")
    requests = out / "requests.json"  # what the platform would say
    asked = [{"name": given.newcomer, "account": "author", "asked": closes.isoformat()}]
    requests.write_text(json.dumps(asked if given.newcomer else []))

    maintainer.pull()
    time.sleep(max(0.0, (closes - datetime.now(UTC)).total_seconds()))
    maintainer.ventbench("round", "freeze", given.name, "--requests", str(requests))
    maintainer.share("The round is frozen")

    author.pull()  # anybody can see now which value is due
    show = (sys.executable, "-m", "ventbench", "round", "show", given.name, "--json", "-")
    shown = json.loads(author.run(*show))
    time.sleep(DELAY_S)
    value = out / "value.json"
    value.write_bytes(referee.value(SECRET, shown["beacon_round"]))
    maintainer.ventbench("round", "draw", given.name, "--beacon", str(value))
    maintainer.share("The round is drawn")

    maintainer.environ["VENTBENCH_SIGNING_KEY"] = key
    scoring = time.perf_counter()
    maintainer.ventbench("round", "score", given.name, "--workers", given.workers)
    del maintainer.environ["VENTBENCH_SIGNING_KEY"]
    maintainer.run(sys.executable, "benchmarks/board_tables.py", "--write")
    maintainer.share("The round is scored")
    author.pull()
    author.ventbench("board", "verify")
    author.ventbench("board", "build", "--out", str(out / "site"))
    author.ventbench("round", "show", given.name)
    took = time.perf_counter() - scoring
    print(
        f"scored, verified and shown in {took:.0f} s; all of it in "
        f"{time.perf_counter() - begun:.0f} s",
        flush=True,
    )
    board = author.folder / "leaderboard"
    for path in (
        board / "rounds" / given.name / "beacon.json",
        board / "rounds" / given.name / "protocol.json",
        next((board / "records").glob("*.json")),
        author.folder / "submissions" / (given.newcomer or "pid_best") / "controller.py",
    ):
        content = path.read_bytes()
        path.write_bytes(content[:-20] + bytes([content[-20] ^ 1]) + content[-19:])
        author.ventbench("board", "verify", code=1)
        path.write_bytes(content)


if __name__ == "__main__":
    main()
