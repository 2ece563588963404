"""Equations of the catalogue, which are plain text, as MathML: browsers draw it without a script.

The notation is that of ``Description.equation``: a product is a space, ``a / b c`` is (a / b) c,
``f(x)`` applies a function while ``R (1 + x)`` multiplies, ``dQ/dt`` is a derivative, and clauses
are separated by commas. Words of prose stay prose.
"""

from __future__ import annotations

import re
from collections.abc import Collection
from dataclasses import dataclass
from html import escape

#: Kinds of tokens; the first that matches counts.
_TOKEN = re.compile(
    r"(?P<space>\s+)|(?P<slope>d(?P<upper>[A-Za-z]\w*)/d(?P<lower>[A-Za-z]))|(?P<unit>L/s2?|cmH2O)"
    r"|(?P<range>\d+\.\.\d+)|(?P<number>\d+(?:\.\d+)?)|(?P<dots>\.\.\.)"
    r"|(?P<name>[A-Za-z][A-Za-z0-9]*(?:_[A-Za-z0-9]+)?(?:'s)?)|(?P<sign>-\+|<=|[-+=<,/^()|%])"
)

#: Words that are prose and no quantities.
_PROSE = frozenset(
    {
        "above",
        "before",
        "below",
        "between",
        "breath",
        "during",
        "effort",
        "far",
        "how",
        "in",
        "integral",
        "inwards",
        "is",
        "it",
        "knots",
        "mean",
        "of",
        "open",
        "outwards",
        "position",
        "pressure",
        "recording",
        "straight",
        "supply's",
        "the",
        "to",
        "up",
        "while",
    }
)

_GREEK = {"tau": "τ", "pi": "π"}
_SIGNS = {"-": "−", "-+": "∓", "<=": "≤"}
_TIMES = '<mo rspace="0.22em">\u2062</mo>'


@dataclass(frozen=True)
class _Token:
    kind: str
    text: str
    spaced: bool


@dataclass(frozen=True)
class _Node:
    """Markup, and what is within its parentheses if it is a pair of them."""

    markup: str
    inner: str = ""

    @property
    def bare(self) -> str:
        return self.inner or self.markup


def equation(text: str) -> list[str]:
    """Clauses of an equation as MathML, one ``<math>`` element each, so that lines can break.

    Text that is not in the notation comes back as one ``<code>`` element.
    """
    try:
        clauses = _clauses(_tokens(text))
        return [
            f'<math alttext="{escape(_plain(clause))}">{_Parser(clause).whole()}</math>'
            for clause in clauses
        ]
    except ValueError:
        return [f"<code>{escape(text)}</code>"]


def _tokens(text: str) -> list[_Token]:
    tokens, at, spaced = [], 0, False
    while at < len(text):
        match = _TOKEN.match(text, at)
        if match is None:
            raise ValueError(f"{text[at:]!r} is not in the notation of equations")
        at, kind = match.end(), match.lastgroup or ""
        if kind in ("upper", "lower"):
            kind = "slope"
        if kind == "space":
            spaced = True
            continue
        tokens.append(_Token(kind, match.group(), spaced))
        spaced = False
    return tokens


def _clauses(tokens: list[_Token]) -> list[list[_Token]]:
    """Split at the commas that are in no parentheses."""
    clauses: list[list[_Token]] = [[]]
    depth = 0
    for token in tokens:
        depth += (token.text == "(") - (token.text == ")")
        if token.text == "," and depth == 0:
            clauses.append([])
        else:
            clauses[-1].append(token)
    return [clause for clause in clauses if clause]


def _plain(clause: list[_Token]) -> str:
    return "".join(f"{' ' if t.spaced else ''}{t.text}" for t in clause).strip()


class _Parser:
    """Recursive descent over the tokens of one clause."""

    def __init__(self, tokens: list[_Token]) -> None:
        self.tokens, self.at = tokens, 0

    def whole(self) -> str:
        markup = self._row(())
        if self.at < len(self.tokens):
            raise ValueError(f"{self.tokens[self.at].text!r} closes nothing")
        return markup

    def _next(self) -> _Token | None:
        return self.tokens[self.at] if self.at < len(self.tokens) else None

    def _row(self, closing: Collection[str]) -> str:
        """Everything up to a closing sign, which is left where it is."""
        parts: list[str] = []
        product: list[_Node] = []
        while (token := self._next()) is not None and token.text not in closing:
            if token.text == "/":
                self.at += 1
                above = _TIMES.join(n.markup for n in product) if len(product) > 1 else ""
                above = above or (product[0].bare if product else "")
                under = self._factor().bare
                product = [_Node(f"<mfrac><mrow>{above}</mrow><mrow>{under}</mrow></mfrac>")]
            elif token.kind == "sign" and token.text not in ("(", "|"):
                parts += self._flushed(product)
                product = []
                form = "" if parts and not parts[-1].startswith("<mo") else ' form="prefix"'
                form = form if token.text in "-+" else ""
                parts.append(f"<mo{form}>{escape(_SIGNS.get(token.text, token.text))}</mo>")
                self.at += 1
            elif self._is_prose(token):
                parts += self._flushed(product)
                product = []
                follows = bool(parts) and parts[-1].endswith("\u00a0</mtext>")
                space = "" if follows else "\u00a0"
                parts.append(f"<mtext>{space}{escape(token.text)}\u00a0</mtext>")
                self.at += 1
            else:
                product.append(self._factor())
        return "".join([*parts, *self._flushed(product)])

    def _flushed(self, product: list[_Node]) -> list[str]:
        return [_TIMES.join(node.markup for node in product)] if product else []

    def _is_prose(self, token: _Token) -> bool:
        return token.text in _PROSE and not self._applies()

    def _applies(self) -> bool:
        """Whether the name at hand is a function of what follows."""
        after = self.tokens[self.at + 1] if self.at + 1 < len(self.tokens) else None
        return after is not None and after.text == "(" and not after.spaced

    def _factor(self) -> _Node:
        base = self._atom()
        token = self._next()
        if token is None or token.text != "^":
            return base
        self.at += 1
        sign = ""
        if (token := self._next()) is not None and token.text == "-":
            sign, self.at = "<mo>−</mo>", self.at + 1
        power = self._atom().bare
        return _Node(f"<msup><mrow>{base.markup}</mrow><mrow>{sign}{power}</mrow></msup>")

    def _atom(self) -> _Node:
        token = self._next()
        if token is None:
            raise ValueError("the equation ends where a quantity is missing")
        if token.text in ("(", "|"):
            close = {"(": ")", "|": "|"}[token.text]
            return self._fenced(token.text, close)
        applies = self._applies()
        self.at += 1
        if token.kind == "name":
            if token.text == "sqrt" and applies:
                return _Node(f"<msqrt>{self._fenced('(', ')').inner}</msqrt>")
            name = _name(token.text)
            if applies:
                return _Node(f"<mrow>{name}{self._fenced('(', ')').markup}</mrow>")
            return _Node(name)
        if token.kind == "number":
            return _Node(f"<mn>{token.text}</mn>")
        if token.kind == "unit":
            return _Node(f"<mtext>{token.text.replace('H2O', 'H₂O').replace('s2', 's²')}</mtext>")
        if token.kind == "slope":
            above, under = token.text[1:].split("/d")
            d = '<mi mathvariant="normal">d</mi>'
            slope = f"<mfrac><mrow>{d}{_name(above)}</mrow><mrow>{d}{_name(under)}</mrow></mfrac>"
            if (after := self._next()) is not None and after.text == "(" and not after.spaced:
                return _Node(f"<mrow>{slope}{self._fenced('(', ')').markup}</mrow>")
            return _Node(slope)
        if token.kind == "dots":
            return _Node("<mi>…</mi>")
        if token.kind == "range":
            return _Node(f"<mtext>{token.text.replace('..', ' to ')}</mtext>")
        raise ValueError(f"{token.text!r} where a quantity is missing")

    def _fenced(self, opening: str, closing: str) -> _Node:
        self.at += 1
        inner = self._row((closing,))
        if self._next() is None:
            raise ValueError(f"{opening!r} is never closed")
        self.at += 1
        inner = f"<mrow>{inner}</mrow>"
        first, last = (f'<mo stretchy="true">{end}</mo>' for end in (opening, closing))
        return _Node(f"<mrow>{first}{inner}{last}</mrow>", inner)


def _name(text: str) -> str:
    """A quantity; what follows an underscore is its index."""
    letter, _, index = text.partition("_")
    if letter == "sum":
        return f"<msub><mo>∑</mo><mi>{escape(index)}</mi></msub>"
    shown = f"<mi>{escape(_GREEK.get(letter, letter))}</mi>"
    if not index:
        return shown
    below = f"<mi>{index}</mi>" if len(index) == 1 else f"<mtext>{escape(index)}</mtext>"
    return f"<msub>{shown}{below}</msub>"
