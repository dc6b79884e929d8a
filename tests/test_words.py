"""The prose of hilbo uses the field's terms: rates of words that stand in for them, and phrases that nobody understood.

The rates are per 1,000 words and by kind of text. Code, names in backticks and labels of buttons (in italics in the
docs) are not counted."""

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
HILBO = ROOT / "hilbo"
MOST = 0.3  # per 1,000 words; statsmodels, SciPy and ArviZ have 0.00 to 0.4 of each
PATTERNS = {
    "say": r"sa(?:y|ys|id)",
    "what is": r"what (?:is|are|was|were|may|might|can|could|will|has|have|had|should)",
    "somebody": r"(?:some|no)body|(?:who|what)ever|whom",
    "hold": r"(?:hold|holds|held(?!-out))",
    "asked": r"asked",
    "everybody": r"everybody(?:'s)?",
    "stand": r"(?:stand|stands|stood)",
    "tell": r"(?:tell|tells|told)",
    "beside": r"besides?",
    "of their own": r"of (?:yours|ours|theirs|(?:their|its|his|her|our|your) own)",
    "apart": r"apart",
    "seek": r"(?:seek|seeks|sought)",
    "anew": r"anew",
    "in force": r"in force",
}
RIDDLES = (
    "by hope",
    "decides last",
    "disc of their shares",
    "everybody's first",
    "how near does it come",
    "is to be known of",
    "and its fate",
    "like best",
    "may be rendered",
    "moves with one more",
    "one after the other is presented",
    "preparing what chooses",
    "said thank you",
    "stands there twice",
    "takes people to be alike",
    "the answers do not tell",
    "the fold of its events",
    "what chooses",
    "what it says and draws",
    "what may be presented",
    "what shows renderings",
    "where it ends",
    "where it lies",
    "whom the people are drawn",
)
CODE = re.compile(r"```.*?```|``[^`]*``|`[^`]*`", re.S)
MARKUP = re.compile(
    r"<(script|style|button|code)\b.*?</\1>|\{#.*?#\}|\{%.*?%\}|\{\{.*?\}\}|<!--.*?-->|<[^>]*>|\]\([^)]*\)|(?<!\*)\*[^*\n]+\*(?!\*)",
    re.S,
)


def texts_of_modules() -> tuple[str, str]:
    """The docstrings of hilbo's modules, and their other strings of three words or more, with blanks for values."""
    docs, others = [], []

    def visit(node: ast.AST) -> None:
        for child in ast.iter_child_nodes(node):
            if isinstance(child, ast.Expr) and isinstance(child.value, ast.Constant):
                docs.append(str(child.value.value))
            elif isinstance(child, ast.JoinedStr):
                parts = (part.value if isinstance(part, ast.Constant) else " … " for part in child.values)
                others.append("".join(map(str, parts)))
            elif isinstance(child, ast.Constant):
                if isinstance(child.value, str):
                    others.append(child.value)
            else:
                visit(child)

    for path in HILBO.rglob("*.py"):
        visit(ast.parse(path.read_text(encoding="utf-8")))
    return "\n".join(docs), "\n".join(text for text in others if text.count(" ") > 1)


def texts_of(*paths: Path) -> str:
    """The contents of files without markup, and without the marks of their templates."""
    return "\n".join(MARKUP.sub(" ", CODE.sub(" ", path.read_text(encoding="utf-8"))) for path in paths)


@pytest.fixture(scope="module")
def texts() -> dict[str, str]:
    """Kind of text -> its prose without code."""
    docstrings, messages = texts_of_modules()
    pages = [*HILBO.rglob("*.html"), *(HILBO / "report" / "templates").glob("*.md")]
    return {
        "docstrings": CODE.sub(" ", docstrings),
        "messages": CODE.sub(" ", messages),
        "pages": texts_of(*pages),
        "docs": texts_of(ROOT / "README.md", *(ROOT / "docs").rglob("*.md")),
    }


def rates(text: str) -> dict[str, float]:
    """Occurrences of each pattern per 1,000 words. States of a device in capitals (HOLD) are names."""
    words = len(re.findall(r"[^\W\d_]{2,}", text))
    lower = re.sub(r"\b[A-Z]{2,}\b", " ", text).lower()
    return {name: 1000 * len(re.findall(rf"\b{pattern}\b", lower)) / words for name, pattern in PATTERNS.items()}


@pytest.mark.parametrize("kind", ["docstrings", "messages", "pages", "docs"])
def test_words_of_a_dialect_are_rare(texts, kind):
    assert len(texts[kind].split()) > 2000
    assert {name: round(rate, 2) for name, rate in rates(texts[kind]).items() if rate >= MOST} == {}


def test_riddles_do_not_come_back(texts):
    found = {(kind, phrase) for kind, text in texts.items() for phrase in RIDDLES if phrase in text.lower()}
    assert found == set()


def test_a_text_in_the_dialect_is_found():
    text = "Everybody is told what is in force, whoever asked; nobody says where it stands. HOLD holds. " * 20
    found = {name for name, rate in rates(CODE.sub(" ", text + "`beside`")).items() if rate >= MOST}
    assert found == {"everybody", "tell", "what is", "in force", "somebody", "asked", "say", "stand", "hold"}
