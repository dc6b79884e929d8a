r"""Formulas of the pages: TeX in Markdown (`$…$`, `$$…$$`) becomes MathML when the site is built, without a script.

pymdownx.arithmatex puts TeX into elements of the class arithmatex, as \(…\) or \[…\]; these are replaced here.
"""

import html
import re

_FORMULA = re.compile(r'<(span|div) class="arithmatex">\\([(\[])(.*?)\\[)\]]</\1>', re.S)


def rendered(page: str) -> str:
    """The HTML of a page with its formulas as MathML. ValueError: a formula has a command that is not known."""
    return _FORMULA.sub(_mathml, page)


def _mathml(match: re.Match) -> str:
    from latex2mathml.converter import convert  # the tests read pages without it

    element, bracket, escaped = match.groups()
    tex = html.unescape(escaped).strip()
    made = convert(tex, display="block" if bracket == "[" else "inline")
    if "\\" in made:
        raise ValueError(f"a formula has a command that latex2mathml does not know: {tex}")
    made = made.replace("<math ", f'<math alttext="{html.escape(" ".join(tex.split()))}" ', 1)
    return f'<{element} class="formula">{made}</{element}>'
