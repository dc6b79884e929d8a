"""Tables that benchmarks write into the pages of docs/, each between its marks."""

from pathlib import Path

DOCS = Path(__file__).parents[1] / "docs"


def put(page, name, text):
    """Replace what stands between `<!-- name -->` and `<!-- end of name -->` in docs/`page`. All else stays."""
    path = DOCS / page
    begin, end = f"<!-- {name} -->\n", f"<!-- end of {name} -->"
    before, begun, rest = path.read_text(encoding="utf-8").partition(begin)
    _, ended, after = rest.partition(end)
    if not (begun and ended):
        raise SystemExit(f"docs/{page} has no marks {begin.strip()} and {end}: put them where the table belongs.")
    path.write_text(f"{before}{begin}{text.strip()}\n{end}{after}", encoding="utf-8")
