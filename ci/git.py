"""git on repositories of strangers: plumbing only, nothing is checked out, output has an end."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import tempfile
import threading
from collections.abc import Mapping, Sequence
from pathlib import Path

from ventbench.base.errors import InputError

#: Who commits records and pages.
AUTHOR = {
    "GIT_AUTHOR_NAME": "ventbench records",
    "GIT_AUTHOR_EMAIL": "records@ventbench.invalid",
    "GIT_COMMITTER_NAME": "ventbench records",
    "GIT_COMMITTER_EMAIL": "records@ventbench.invalid",
}

_KEPT_VARIABLES = ("PATH", "HTTPS_PROXY", "https_proxy", "SSL_CERT_FILE", "SSL_CERT_DIR")


class GitError(InputError):
    """git failed, or had more to say than anybody asked for."""


def environment() -> dict[str, str]:
    """Environment in which no configuration, replacement object or question is looked at."""
    return {
        **{name: os.environ[name] for name in _KEPT_VARIABLES if name in os.environ},
        "LC_ALL": "C",
        "HOME": os.devnull,
        "GIT_CONFIG_NOSYSTEM": "1",
        "GIT_CONFIG_GLOBAL": os.devnull,
        "GIT_ALLOW_PROTOCOL": "https:file",
        "GIT_ASKPASS": "true",
        "GIT_LITERAL_PATHSPECS": "1",
        "GIT_NO_REPLACE_OBJECTS": "1",
        "GIT_TERMINAL_PROMPT": "0",
    }


class Git:
    """A repository.

    Args:
        folder: of it, bare or not.
        timeout_s: longest that one command may take.
    """

    def __init__(self, folder: Path, timeout_s: float = 300.0):
        self.folder, self.timeout_s = folder, timeout_s

    def output(
        self,
        *arguments: str,
        given: bytes = b"",
        limit: int = 1_000_000,
        more: Mapping[str, str] | None = None,
    ) -> bytes:
        """Run git and return what it prints.

        A few kilobytes of trees can list billions of files; hence the limit.

        Args:
            arguments: of git.
            given: to its standard input.
            limit: most bytes that it may print.
            more: environment variables.

        Raises:
            GitError: if it fails, prints more, or takes too long.
        """
        command = ["git", "-C", str(self.folder), "-c", "core.hooksPath=/dev/null", *arguments]
        with tempfile.TemporaryFile() as stderr, tempfile.TemporaryFile() as stdin:
            stdin.write(given)
            stdin.seek(0)
            process = subprocess.Popen(
                command,
                stdin=stdin,
                stdout=subprocess.PIPE,
                stderr=stderr,
                start_new_session=True,
                env={**environment(), **(more or {})},
            )
            assert process.stdout is not None
            timer = threading.Timer(self.timeout_s, _end, [process])
            timer.start()
            with process, process.stdout:
                printed = process.stdout.read(limit + 1)
                if len(printed) > limit:
                    _end(process)
                code = process.wait()
            in_time = timer.is_alive()
            timer.cancel()
            if len(printed) > limit:
                raise GitError(f"git {arguments[0]} lists more than {limit} bytes")
            if not in_time:
                raise GitError(f"git {arguments[0]} took over {self.timeout_s:g} s")
            if code:
                stderr.seek(0)
                words = stderr.read(2000).decode(errors="replace").strip()
                raise GitError(f"git {arguments[0]} failed: {words or f'exit code {code}'}")
        return printed

    def text(self, *arguments: str, more: Mapping[str, str] | None = None) -> str:
        """Return the one line that git prints; ``more`` as in :meth:`output`."""
        return self.output(*arguments, more=more).decode().strip()


def _end(process: subprocess.Popen[bytes]) -> None:
    """End git and all that it has started, which would keep its pipe open."""
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)


def fetch(folder: Path, source: str, commits: Sequence[str], largest: int) -> Git:
    """Make a bare repository with some commits and their histories.

    Args:
        folder: for it, empty.
        source: URL or path of the repository that has them.
        commits: full hexadecimal names, checked before.
        largest: files beyond this many bytes are left out, where the source can do so.

    Raises:
        GitError: if one cannot be fetched.
    """
    repository = Git(folder)
    repository.output("init", "--quiet", "--bare", "--template=")
    options = ("--quiet", "--no-tags", "--no-recurse-submodules", "--no-write-fetch-head")
    filtered = f"--filter=blob:limit={largest + 1}"
    repository.output("fetch", *options, filtered, "--", source, *commits)
    # Else git would fetch what was left out as soon as it is asked for.
    if (folder / "config").read_text().count('[remote "'):
        repository.output("config", "--remove-section", f"remote.{source}")
    return repository
