from ventbench.entries.cells import InProcessRunner
from ventbench.entries.contract import check
from ventbench.entries.review import check_sources, inspect_folder
from ventbench.sandbox import reader

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
    notes = [(n.line, n.what.split(",")[0]) for n in check_sources(demo) if n.file == "train.py"]
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
    assert [(n.file, n.line) for n in check_sources(demo) if n.file == "packed.py"] == [
        ("packed.py", 1)
    ]


def test_characters_that_mislead_are_listed(demo):
    lines = [
        'a = "\u202e } \u2066if b\u2069"',
        "p\u0430ssword = 1  # the second letter is Cyrillic",
        "# a comment\ra = 2",
        "b = '\u00e4, plain text of another language is a note too'",
        "c = 3; d = 4",
    ]
    (demo / "train.py").write_bytes("\n".join(lines).encode())
    notes = {n.line: n.what for n in check_sources(demo) if n.file == "train.py"}
    assert notes[1].startswith("holds U+202E, U+2066, U+2069, which is not seen")
    assert "p\u0430ssword" in notes[2]
    assert notes[3].startswith("holds U+000D")
    assert set(notes) == {1, 2, 3, 4}


def test_code_that_another_encoding_hides_is_not_looked_for_there(demo):
    hidden = b"# -*- coding: unicode_escape -*-\n# plain \\nimport gc\n"
    (demo / "train.py").write_bytes(hidden)
    assert not [n for n in check_sources(demo) if "uses gc" in n.what]
    (finding,) = (f for f in check_sources(demo) if f.file == "train.py")
    assert finding.what == "names the encoding unicode_escape, and is read as UTF-8"


def test_sources_that_cannot_be_read_are_named_once(demo, monkeypatch):
    asked = []

    def unreadable(function, folder, checks):
        asked.append(checks)
        if len(checks) > 1 or checks[0] == "source":
            raise reader.UnreadableError("takes more than 20 s of processor time to be read")
        return []

    monkeypatch.setattr("ventbench.entries.review.read_apart", unreadable)
    (finding,) = inspect_folder(demo)
    assert (finding.group, finding.file) == ("source", "the folder")
    assert asked[1:] == [["manifest"], ["files"], ["source"]]
