"""Equations as MathML."""

from __future__ import annotations

from xml.etree import ElementTree

import pytest

from ventbench.pages.mathml import equation
from ventbench.physics.catalogue import everything


@pytest.mark.parametrize("name", everything())
def test_every_equation_of_the_catalogue_is_rendered(name: str) -> None:
    text = everything()[name].description.equation
    clauses = [ElementTree.fromstring(clause) for clause in equation(text)]
    assert {clause.tag for clause in clauses} == {"math"}
    shown = "".join("".join(clause.itertext()) for clause in clauses)
    assert not set("^_*") & set(shown)
    told = ", ".join(clause.attrib["alttext"] for clause in clauses)
    assert told == text


def test_structure() -> None:
    (ratio,) = equation("a = (1 - loss)^-m / b c")
    tree = ElementTree.fromstring(ratio)
    fraction = tree.find("mfrac")
    assert fraction is not None, "a product after a division stays outside"
    assert "".join(fraction[1].itertext()) == "b"
    assert [node.text for node in tree.findall("mi")] == ["a", "c"]
    power = fraction.find(".//msup")
    assert power is not None
    assert "".join(power[1].itertext()) == "−m"
    slope, given = equation("tau dy/dt = p - y, P_elastic = sqrt(x)")
    assert "τ" in slope
    assert ElementTree.fromstring(slope).find("mfrac") is not None
    assert ElementTree.fromstring(given).find("msub") is not None
    assert ElementTree.fromstring(given).find("msqrt") is not None


def test_what_is_no_equation_is_shown_as_it_is() -> None:
    assert equation("x = <b> & y") == ["<code>x = &lt;b&gt; &amp; y</code>"]
    assert equation("f(x") == ["<code>f(x</code>"]
