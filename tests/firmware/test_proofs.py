"""The core's contracts are proved: no access out of bounds, no overflow, every loop ends."""

import importlib.util
import shutil
from pathlib import Path

import pytest

_FILE = Path(__file__).parents[2] / "firmware" / "tests" / "prove.py"
_SPEC = importlib.util.spec_from_file_location("prove", _FILE)
assert _SPEC is not None and _SPEC.loader is not None
prover = importlib.util.module_from_spec(_SPEC)
_SPEC.loader.exec_module(prover)

pytestmark = pytest.mark.deep
needs_the_tools = pytest.mark.skipif(bool(prover.missing()), reason="the proofs need " + ", ".join(prover.TOOLS))


@pytest.mark.parametrize("file", prover.FILES)
def test_what_was_proved_is_what_stands_there(file):
    known = prover.recorded()[file]
    assert known == prover.to_record(file, known.goals), "changed since it was proved: run make -C firmware prove"


@pytest.mark.release  # minutes of provers
@needs_the_tools
@pytest.mark.parametrize("file", prover.FILES)
def test_all_goals_are_proved(file):
    outcome = prover.prove(file)
    assert outcome.proved == outcome.goals == prover.recorded()[file].goals > 0, outcome.report


@needs_the_tools
@pytest.mark.parametrize(
    ("file", "function", "old", "new"),
    [
        ("hb_frame.c", "hb_receiver_push", "receiver->size < HB_MAX_ENCODED", "receiver->size <= HB_MAX_ENCODED"),
        ("hb_frame.c", "hb_cobs_decode", "if (i > 0U) {", "{"),
        ("hb_renderer.c", "short_push", "renderer->oldest + 1U < length", "renderer->oldest < length"),
        ("hb_line.c", "hb_output_put", "size + spare > HB_OUTPUT_BYTES", "size > HB_OUTPUT_BYTES + spare"),
    ],
)
def test_what_is_wrong_is_not_proved(tmp_path, file, function, old, new):
    core = tmp_path / "core"
    shutil.copytree(prover.CORE, core)
    text = (core / file).read_text(encoding="utf-8")
    assert text.count(old) == 1
    (core / file).write_text(text.replace(old, new), encoding="utf-8")
    outcome = prover.prove(file, function, core, seconds=2)
    assert 0 < outcome.proved < outcome.goals, outcome.report
