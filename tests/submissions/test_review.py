from ventbench.submissions.contract import check
from ventbench.submissions.review import review
from ventbench.submissions.runner import InProcessRunner

SOURCE = """\
import gc, math
import ctypes.util
from sys import _getframe
import importlib as i

frame = _getframe().f_back
code = exec(bytes(weights[3].tobytes()))
math.sin(1.0)
"""


def test_uses_are_listed_with_their_lines(demo):
    (demo / "train.py").write_text(SOURCE)
    notes = [(n.line, n.what.split(",")[0]) for n in review(demo) if n.file == "train.py"]
    assert sorted(notes) == [
        (1, "uses gc"),
        (2, "uses ctypes.util"),
        (3, "uses _getframe"),
        (4, "uses importlib"),
        (6, "uses _getframe"),
        (6, "uses f_back"),
        (7, "uses .tobytes()"),
        (7, "uses exec"),
    ]


def test_check_lists_them_as_notes(demo):
    path = demo / "controller.py"
    path.write_text("import gc\n" + path.read_text())
    report = check(str(demo), InProcessRunner())
    (note,) = (note for note in report.notes if "uses gc" in note.what)
    assert note.where == "controller.py line 1"
    assert report.ok


def test_packed_text_is_noted(demo):
    (demo / "packed.py").write_text(f"DATA = '{'x' * 300}'\nDOC = '{'plain words ' * 40}'\n")
    assert [(n.file, n.line) for n in review(demo) if n.file == "packed.py"] == [("packed.py", 1)]
