"""A whole session without people: a simulated participant drives real server, real pages and what renders.

The server is a process of its own, as `hilbo session` starts it; the device is the firmware's core on a
pseudo-terminal, whose finger presses while a rendering is shown; in a study without our device a stand-in confirms what
it is asked for (`stand_in`). The participant's page is in Chromium. The participant is drawn from the study's simulated
population (`simulation.presets`) and answers from what was really on the device, or was confirmed.
"""

import contextlib
import functools
import json
import re
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hilbo.app.rehearsal.robot import SIZES, Participant, browser, held, screenshots
from hilbo.app.rehearsal.stand_in import StandIn
from hilbo.device.local.simulator import Simulator
from hilbo.search.apart import levels_of, nrmse
from hilbo.search.rendering import Rendering
from hilbo.session.log.event_log import read_log
from hilbo.session.plan.plan import make_plan
from hilbo.simulation import simulate
from hilbo.simulation.presets import population_of, with_truth
from hilbo.simulation.simulate import Population
from hilbo.study.config import Study
from hilbo.study.file.plan_file import Plan, plan_text

__all__ = ["HILBO", "Decider", "example_sets", "fast_study", "rehearse", "server"]

HILBO = [sys.executable, "-P", "-c", "from hilbo.cli.main import main; main()"]
_STEPS = {
    "warm_up": ("reference", "a"),
    "optimisation": ("reference", "a"),
    "validation": ("reference", "a", "neutral", "b"),
    "aggregate_best": ("reference", "a", "neutral", "b"),
}


_PICTURES = 14  # of the participant's page
_PATIENCE = 10.0  # s
_HEARD = "(count) => view && view.whole.trials.filter((t) => t.status === 'answered').length >= count"


class Decider:
    """A simulated person's answers about renderings, in the labels of the study."""

    def __init__(self, study: Study, population: Population, seed: int = 0):
        self._study, self._key, self._count = study, jax.random.key(seed), 0
        people = simulate.people(study, population, 1, seed)
        self._person = jax.tree.map(lambda leaf: leaf[0], people)
        self._answer = jax.jit(lambda key, x: self._person.answer(key, x, jnp.asarray(0.5, x.dtype)))

    def __call__(self, trial: dict[str, Any], ask: str) -> str:
        """The label for one question about a trial of the experimenter's view."""
        unit = {side: Rendering.of(self._study.space, values).unit for side, values in trial["renderings"].items()}
        if ask == "preferred":
            return min(unit, key=lambda side: self._distance(unit[side]))
        self._count += 1
        key = jax.random.fold_in(self._key, self._count)
        return self._study.responses[int(self._answer(key, jnp.asarray(unit[ask[-1]])))]

    def _distance(self, x):
        away = simulate.felt_apart(self._person.levels, x, np.asarray(self._person.optimum))
        return float(np.linalg.norm(away / np.asarray(self._person.tolerance)))


def fast_study(source: Path, target: Path, seconds: float | None, warm_up: int | None = None) -> Path:
    """A copy of a study file, whose steps all last `seconds`. `warm_up`: how many trials of it, where the file has no
    table for them."""
    text = source.read_text(encoding="utf-8")
    if seconds is not None:
        text = re.sub(r"\bseconds\s*=\s*[\d.]+", f"seconds = {seconds}", text)
        for name, shows in _STEPS.items():
            if re.search(rf"^\s*\[session\.{name}\]", text, re.MULTILINE):
                continue
            steps = ", ".join(f'{{show = "{show}", seconds = {seconds}}}' for show in shows)
            text += f"\n[session.{name}]\nsteps = [{steps}]\n"
            text += f"count = {warm_up}\n" if name == "warm_up" and warm_up else ""
    target.write_text(text, encoding="utf-8")
    return target


def example_sets(study: Study, population: Population) -> dict[str, dict[str, float]]:
    """Best, mid and worst renderings of a simulated population, by their distance from its truth."""
    space, points = study.space, study.space.candidates(256, 0)
    order = np.argsort(nrmse(points, Rendering.of(space, population.truth).unit, levels_of(space.parameters)))
    chosen = {"best": order[0], "mid": order[len(order) // 3], "worst": order[-1]}
    return {name: Rendering.at(space, points[row]).values for name, row in chosen.items()}


@contextlib.contextmanager
def server(*arguments: str, patience: float = 600.0) -> Iterator[tuple[subprocess.Popen, dict[str, str]]]:
    """`hilbo session` as a process, and its links; told to end at the end. Raises `RuntimeError` with its words."""
    process = subprocess.Popen(
        [*HILBO, "session", *arguments, "--json"], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    words: list[str] = []
    reading = _reader(process.stderr, words)
    try:
        assert process.stdout is not None
        line = process.stdout.readline()
        if not line:
            process.wait(patience)
            reading.join(10)
            raise RuntimeError("the server did not start: " + " ".join("".join(words).split()[-60:]))
        yield process, json.loads(line)
    finally:
        if process.poll() is None:
            process.terminate()
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(30)
        if process.poll() is None:
            process.kill()
        process.wait()
        reading.join(10)
        for file in (process.stdout, process.stderr):
            if file is not None:
                file.close()


def _reader(file, words):
    import threading

    thread = threading.Thread(target=lambda: words.extend(file), daemon=True)
    thread.start()
    return thread


def rehearse(
    source: Path,
    out: Path,
    *,
    preset: str | None = None,
    phase: str = "optimisation",
    seconds: float | None = None,
    warm_up: int | None = None,
    seed: int = 0,
    say: Callable[[str], Any] = lambda _: None,
) -> dict[str, Any]:
    """The session's log, screenshots of both pages, and how long answers took to be felt, in `out`."""
    Study.load(source)  # what is refused leaves no folder behind
    out.mkdir(parents=True, exist_ok=True)
    file = fast_study(source, out / "study.toml", seconds, warm_up)
    study = Study.load(file)
    material = next(iter(study.file.materials), None)
    here = study if material is None else study.material(material)
    population = with_truth(here, population_of(here, preset)[1], seed)
    arguments = [str(file), "--participant", "P01", "--logs", str(out / "logs"), "--port", "0"]
    arguments += ["--dry-run", "--gap", "0.7" if seconds is None else "0.05"]
    if phase != "optimisation":
        made = _plan(study, material, example_sets(here, population), phase, seed)
        plan = out / "plan.json"
        plan.write_text(plan_text(made), encoding="utf-8")
        arguments += ["--plan", str(plan)]  # which has the seed
    else:
        arguments += ["--seed", str(seed)] + ([] if material is None else ["--material", material])
    say("starting the server")
    rendered = _by_device if study.file.stimulus is None else functools.partial(_by_stand_in, study.file)
    with rendered(arguments, Decider(here, population, seed)) as (links, decide, touches), browser() as program:
        say("in session")
        summary = _session(program, links, decide, touches, out, say)
    summary["log"] = links["log"]
    summary["events"] = len(read_log(links["log"], study.file)[1])
    (out / "result.json").write_text(json.dumps(summary, indent=2), encoding="utf-8")
    return summary


@contextlib.contextmanager
def _by_device(arguments, decide):
    """Links, what decides, and what makes a hand (given how to look at the session), with a simulated device."""
    finger = Simulator(finger="rest")
    try:
        with server(*arguments, "--device", finger.port) as (_, links):
            yield links, decide, functools.partial(_presser, finger)
    finally:
        finger.close()


@contextlib.contextmanager
def _by_stand_in(study, arguments, decide):
    """The same with who presents in place of a device."""
    role = study.stimulus.role
    with server(*arguments) as (_, links), StandIn(study, links[role], role) as presents:
        yield (
            links,
            lambda trial, ask: decide({"renderings": presents.presented(trial["id"])}, ask),
            lambda _watch: lambda _on: None,
        )


def _plan(study, material, sets, phase, seed) -> Plan:
    """Of one session, with one of the study's materials."""
    if phase == "aggregate-best":
        sets = {"aggregate": sets["best"], "individual:S1": sets["mid"], "individual:S2": sets["worst"]}
    materials = () if material is None else (material,)
    return make_plan(
        study.file, ["P01"], seed, phase, materials=materials, sets={material or "": sets}, source="aggregate"
    )


def _session(program, links, decide, touches, out, say) -> dict[str, Any]:
    screens = out / "screens"
    screens.mkdir(exist_ok=True)
    desk = dict(zip(("width", "height"), SIZES[0], strict=True))
    experimenter = program.new_context(viewport=desk).new_page()
    experimenter.goto(links["experimenter"])
    experimenter.wait_for_url("**/experimenter")

    def watch():
        return experimenter.evaluate("server.ask('/api/experimenter').then(r => r.json())")

    window = program.new_context(viewport=desk).new_page()
    mishaps: list[str] = []
    for page in (window, experimenter):
        page.on("pageerror", lambda error: mishaps.append(str(error)))
    participant = Participant(window, links["participant"], watch, decide, touches(watch))
    begun = time.monotonic()
    cleared = _lead(participant, window, experimenter, screens, say)
    view = watch()
    _watched(experimenter, participant, screens, "end")
    screenshots(window, screens, "participant-end")
    return {
        "answers": participant.answered,
        "seconds": round(time.monotonic() - begun, 1),
        "fits_after_an_answer": view["fits_after_an_answer"],
        "answer_to_device_ms": [round(1000 * d["total"], 1) for d in view["all_delays"]],
        "holds_cleared": cleared,
        "mishaps": mishaps,
        "screens": sorted(path.name for path in screens.iterdir()),
    }


def _lead(participant, window, experimenter, screens, say) -> int:
    """The participant acts until the session ends, with screenshots of what is new; how many HOLDs were cleared."""
    taken: set[tuple[str, str]] = set()
    watched, cleared = {1, 4, 8}, 0
    while True:
        _pictured(window, screens, taken)
        before = participant.answered
        phase = participant.act()
        if participant.answered > before:
            say(f"{participant.answered} answers")
        if participant.answered in watched:
            watched.remove(participant.answered)
            _watched(experimenter, participant, screens, f"{participant.answered}-answers")
        if phase in ("done", "ended"):
            return cleared
        cleared += phase == "wait" and _cleared(experimenter)
        time.sleep(0.02)


def _pictured(window, screens, taken) -> None:
    """The participant's page, where it is in a phase or asks a question of which there is no picture yet."""
    seen = "[document.body.dataset.phase, document.querySelector('#options button') ? at('title').textContent : '']"
    if len(taken) >= _PICTURES or (mark := tuple(window.evaluate(seen))) in taken or mark[0] == "wait":
        return
    with held(window):
        phase, question = mark = tuple(window.evaluate(seen))  # another one may have come just now
        if mark not in taken and phase != "wait":
            taken.add(mark)
            screenshots(window, screens, f"participant-{len(taken)}-{phase}{'-question' if question else ''}")


def _watched(experimenter, participant, screens, name) -> None:
    """The experimenter's page, once it has heard of all the answers."""
    end = time.monotonic() + _PATIENCE  # of a page that hears nothing there is a picture too
    while not experimenter.evaluate(_HEARD, participant.answered) and time.monotonic() < end:
        time.sleep(0.05)
    time.sleep(0.5)  # for the map, which comes after the answers
    with held(experimenter):
        screenshots(experimenter, screens, f"experimenter-{name}", whole=True)


def _cleared(experimenter) -> bool:
    """A device that held on a busy computer is let go again, as the experimenter would."""
    if not experimenter.is_visible("#clear"):
        return False
    experimenter.evaluate("command('clear')")
    return True


def _presser(finger, watch) -> Callable[[bool], None]:
    """Has the finger press while something is felt, and leave the handle after that."""
    pressing = False

    def feel(on):
        nonlocal pressing
        if on and not pressing:
            finger.tell("finger sine")
        elif pressing and not on:
            _let_go(finger, watch)
        pressing = on

    return feel


def _let_go(finger, watch) -> None:
    """The simulated finger leaves the handle out of contact: it taps, and rests where it is away."""
    for _ in range(50):
        finger.tell("finger tap")
        time.sleep(0.28)
        finger.tell("finger rest")
        time.sleep(0.15)
        if ["Contact", "no"] in watch()["device"]["rows"]:
            return
