"""Submissions for the sandbox alone: one file, not checked."""

import pytest

from ventbench.submissions.folder import Submission, open_submission


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
