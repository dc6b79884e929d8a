"""Time from the start of a process to the first chosen point of a session, part by part.

    python benchmarks/cold_start.py --write      into docs/results/run_time.md

Every row is a process of its own, the median over the rounds, with a warm compilation cache or an empty one.
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from statistics import median

from pages import put

ROOT = Path(__file__).parents[1]
X64 = "import jax; jax.config.update('jax_enable_x64', True)\n"
STUDY = f"from hilbo import Session, Study\nstudy = Study.load({str(ROOT / 'hilbo' / 'data' / 'paper.toml')!r})\n"
START = "session = Session.start(study)\n"
ANSWERS = "for _ in range(5): session = session.tell('different')\nsession.ask()\n"
WHOLE = X64 + STUDY + START + ANSWERS
KEPT = WHOLE.replace(X64, "from hilbo.cli.terminal.console import start; start()\n")
PROCESSES = {
    "bare `python`": "",
    "`import jax`": "import jax",
    "`import jax`, one compiled function": X64 + "import jax.numpy as jnp; jax.jit(lambda a: a @ a)(jnp.ones((3, 3)))",
    "`import hilbo`": "import hilbo",
    "`hilbo.session.choose.ask_tell` imported": X64 + "import hilbo.session.choose.ask_tell",
    "study loaded": X64 + STUDY,
    "session started: the first point to show": X64 + STUDY + START,
    "first chosen point, after 5 answers": WHOLE,
    "the same with cached programs, as in commands": KEPT,
    "the same by XLA's newer code generator (`hilbo/numerics/compiling.py`)": "import hilbo.numerics.compiling\n"
    "hilbo.numerics.compiling._TRIED = (0, 0)\n" + WHOLE,
}
CLOCK = """
import sys, time
begin = time.perf_counter()
import jax; jax.config.update('jax_enable_x64', True)
spent = {}
def listen(event, seconds, **_):
    name = event.rsplit('/', 1)[-1]
    spent[name] = spent.get(name, 0.0) + seconds
jax.monitoring.register_event_duration_secs_listener(listen)
"""


def main():
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("--rounds", type=int, default=5)
    options.add_argument("--write", action="store_true")
    chosen = options.parse_args()
    text = document(chosen.rounds)
    print(text)
    if chosen.write:
        put("results/run_time.md", "cold start", text)


def seconds(code, cache):
    start = time.perf_counter()
    run(code, cache)
    return time.perf_counter() - start


def run(code, cache):
    env = os.environ | {
        "JAX_COMPILATION_CACHE_DIR": cache,
        "XDG_CACHE_HOME": cache,
        "PYTHONDONTWRITEBYTECODE": "",  # as a person's Python, which does not parse sources twice
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
        "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": "-1",
        "PYTHONPATH": str(ROOT),
    }
    command = [sys.executable, "-W", "ignore", "-c", code]
    return subprocess.run(command, env=env, check=True, capture_output=True, text=True).stdout


def document(rounds):
    lines = [
        f"Made by `python benchmarks/cold_start.py --write`: seconds of whole processes, medians of {rounds};",
        "the study is the preset `paper`. A warm cache is one that an earlier process filled",
        "(`JAX_COMPILATION_CACHE_DIR`). A live session compiles while the first, given points are felt",
        "(`Session.warm`).",
        "",
        "| process, up to | warm cache | empty cache |",
        "|---|---:|---:|",
    ]
    with tempfile.TemporaryDirectory() as warm:
        run(WHOLE, warm)
        for name, code in PROCESSES.items():
            run(code, warm)
            hot = median(seconds(code, warm) for _ in range(rounds))
            cold = (
                median(in_new_cache(code) for _ in range(max(rounds // 2, 1)))
                if "jax" in code or "hilbo.cli" in code
                else hot
            )
            lines.append(f"| {name} | {hot:.2f} | {cold:.2f} |")
        parts = [spent(warm) for _ in range(rounds)]
    lines += [
        "",
        "Within the first chosen point, warm cache, as JAX itself measures it:",
        "",
        "| part | seconds |",
        "|---|---:|",
    ]
    for name, words in (
        ("jaxpr_trace_duration", "tracing"),
        ("jaxpr_to_mlir_module_duration", "lowering"),
        ("compile_time_saved_sec", "compilation that the cache saved"),
        ("cache_retrieval_time_sec", "loading from the cache"),
        ("backend_compile_duration", "compiler and cache together"),
    ):
        lines.append(f"| {words} | {median(part.get(name, 0.0) for part in parts):.2f} |")
    return "\n".join(lines) + "\n"


def in_new_cache(code):
    with tempfile.TemporaryDirectory() as empty:
        return seconds(code, empty)


def spent(cache):
    """Seconds by JAX's own events."""
    out = run(CLOCK + WHOLE + "import json; print(json.dumps(spent))", cache)
    import json

    return json.loads(out.splitlines()[-1])


if __name__ == "__main__":
    main()
