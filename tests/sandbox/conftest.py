"""Submissions for the sandbox alone: one file, not checked."""

import pytest

from ventbench.entries.folder import Submission, open_submission
from ventbench.sandbox.pipes import Allowance

#: So long that only what hangs meets it, on a busy machine too.
PATIENT = Allowance(start_patience_s=300.0, patience_s=300.0, total_s=3600.0)


@pytest.fixture
def written(tmp_path):
    """A submission with this controller.py, as if it had been checked."""

    def write(source, **files):
        (tmp_path / "controller.py").write_text(source)
        for name, content in files.items():
            (tmp_path / name).write_bytes(content)
        return Submission(
            "mine", tmp_path.resolve(), open_submission("pid_best").manifest, "0" * 64
        )

    return write
