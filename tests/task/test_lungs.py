import pytest

from ventbench.task.lungs import LUNG_IDS, LUNGS, RECORDED_LUNGS, Lung, lung, scored_lung


def test_the_six():
    assert LUNG_IDS == ("R5C10", "R5C20", "R5C50", "R20C10", "R20C20", "R20C50")
    assert len(RECORDED_LUNGS) == 9
    assert RECORDED_LUNGS[:6] == LUNGS
    assert RECORDED_LUNGS[6:] == (Lung(50, 10), Lung(50, 20), Lung(50, 50))


@pytest.mark.parametrize("item", RECORDED_LUNGS)
def test_ids_round_trip(item):
    assert lung(item.id) == item
    assert str(item) == item.id


def test_fractions():
    assert lung("R7.5C12.25") == Lung(7.5, 12.25)
    assert Lung(7.5, 12.25).id == "R7.5C12.25"


@pytest.mark.parametrize(
    "text",
    [
        "",
        "R5",
        "C10",
        "r5c10",
        "R5C10 ",
        "R-5C10",
        "R5C1e3",
        "xR5C10",
        "R5.C1",
        "R5C10\n",
        "R0C10",
        "R5C0",
    ],
)
def test_not_an_id(text):
    with pytest.raises(ValueError, match="is not a lung id; write R<cmH2O"):
        lung(text)


def test_scored():
    assert scored_lung("R20C50") == LUNGS[-1]
    with pytest.raises(ValueError, match="R50C50 is not a scored lung; choose one of R5C10, "):
        scored_lung("R50C50")
