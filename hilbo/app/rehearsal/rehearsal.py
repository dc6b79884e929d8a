"""A whole session without people: a simulated participant drives real server, real pages and a simulated device.

The server is a separate process, as `hilbo session` starts it; the device is the firmware's core on a
pseudo-terminal, whose finger presses while a rendering is presented. In a study with [stimulus], a stand-in confirms
what it is ordered (`stand_in`). The participant's page is in Chromium. The participant is drawn from the study's
simulated population (`simulation.presets`) and responds to the values on the device, or to the confirmed ones.
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
    """A simulated participant, drawn from a population; called with a trial and a question, it gives a label of the
    study."""

    def __init__(self, study: Study, population: Population, seed: int = 0):
        self._study, self._key, self._count = study, jax.random.key(seed), 0
        people = simulate.people(study, population, 1, seed)
        self._person = jax.tree.map(lambda leaf: leaf[0], people)
        self._answer = jax.jit(lambda key, x: self._person.answer(key, x, jnp.asarray(0.5, x.dtype)))

    def __call__(self, trial: dict[str, Any], ask: str) -> str:
        """The answer to one question (`ask`) about a trial of the experimenter's view: for "preferred" the side ("a",
        "b") that is nearest to the optimum, for "class_a" and "class_b" a random draw of a response's label."""
        unit = {side: Rendering.of(self._study.space, values).unit for side, values in trial["renderings"].items()}
        if ask == "preferred":
            return min(unit, key=lambda side: self._distance(unit[side]))
        self._count += 1
        key = jax.random.fold_in(self._key, self._count)
        return self._study.responses[int(self._answer(key, jnp.asarray(unit[ask[-1]])))]

    def _distance(self, x: np.ndarray) -> float:
        """Distance of a point `x` (d,) of the unit cube from what the participant prefers, in tolerances."""
        return abs(float(self._person.perceived(jnp.asarray(x))))


def fast_study(source: Path, target: Path, seconds: float | None, warm_up: int | None = None) -> Path:
    """Write a copy of a study file to `target`, in which every step lasts `seconds` (None: as it is), and return
    `target`. Protocols that the file does not state are appended with such steps; an appended warm-up has `warm_up`
    trials."""
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
    """Parameters of three renderings, "best", "mid" and "worst", by their distance from the truth of a simulated
    population, which must have one: of 256 candidates the nearest, the one a third of the way in that order, and the
    farthest. Physical values by parameter."""
    space, points = study.space, study.space.candidates(256, 0)
    order = np.argsort(nrmse(points, Rendering.of(space, population.truth).unit, levels_of(space.parameters)))
    chosen = {"best": order[0], "mid": order[len(order) // 3], "worst": order[-1]}
    return {name: Rendering.at(space, points[row]).values for name, row in chosen.items()}


@contextlib.contextmanager
def server(*arguments: str, patience: float = 600.0) -> Iterator[tuple[subprocess.Popen, dict[str, str]]]:
    """Run `hilbo session` with these arguments in a process, and yield the process and its links (role -> link, and log
    and device); terminate it at the end, and kill it after 30 s. Raises `RuntimeError` with the end of its stderr if it
    does not start; then it may take `patience` s to end."""
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
    """A started thread that appends the lines of `file` to `words`."""
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
    """Run a session and return its summary: answers, duration, delays (ms), HOLDs cleared, JavaScript errors
    (`mishaps`), names of screenshots, path of the log, number of events.

    Writes study.toml, the log, screenshots of both pages, and for another phase than optimisation plan.json into `out`.
    `seconds`: duration of every step, by default the study's; `warm_up`: number of warm-up trials, only with `seconds`
    and for a study that does not state its warm-up; `preset`: population, by default the study's; `say`: called with
    each stage. Of several materials the first is taken. Raises `InputError` for a study that is refused, before `out`
    is made, and `RuntimeError` if the server does not start.
    """
    Study.load(source)  # a refusal leaves no folder behind
    out.mkdir(parents=True, exist_ok=True)
    file = fast_study(source, out / "study.toml", seconds, warm_up)
    study = Study.load(file)
    material = next(iter(study.file.materials), None)
    here = study if material is None else study.material(material)
    population = with_truth(here, population_of(here, preset)[1], seed)
    arguments = [str(file), "--participant", "P01", "--logs", str(out / "logs"), "--port", "0"]
    arguments += ["--dry-run", "--pause", "0.7" if seconds is None else "0.05"]
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
    return summary


@contextlib.contextmanager
def _by_device(arguments: list[str], decide: Decider):
    """Run `hilbo session` with these arguments and a simulated device; yields its links, `decide`, and a function that
    makes from `watch` (returns the experimenter's view) what has the finger press (`_presser`)."""
    finger = Simulator(finger="rest")
    try:
        with server(*arguments, "--device", finger.port) as (_, links):
            yield links, decide, functools.partial(_presser, finger)
    finally:
        finger.close()


@contextlib.contextmanager
def _by_stand_in(study, arguments, decide):
    """As `_by_device`, with a stand-in that presents in place of a device: `decide` gets what it confirmed, and no
    finger presses."""
    role = study.stimulus.role
    with server(*arguments) as (_, links), StandIn(study, links[role], role) as presents:
        yield (
            links,
            lambda trial, ask: decide({"renderings": presents.presented(trial["id"])}, ask),
            lambda _watch: lambda _on: None,
        )


def _plan(study, material, sets, phase, seed) -> Plan:
    """A plan of one session of participant P01, with one of the study's materials. `sets`: "best", "mid" and "worst",
    which for aggregate-best become an aggregate and two individual sets."""
    if phase == "aggregate-best":
        sets = {"aggregate": sets["best"], "individual:S1": sets["mid"], "individual:S2": sets["worst"]}
    materials = () if material is None else (material,)
    return make_plan(
        study.file, ["P01"], seed, phase, materials=materials, sets={material or "": sets}, source="aggregate"
    )


def _session(program, links, decide, touches, out, say) -> dict[str, Any]:
    """Open both pages in the browser `program`, act as the participant until the session ends, and return the first
    part of the summary of `rehearse`; screenshots go to `out`/screens. `links`: role -> link; `decide`, `touches`: as
    `_by_device` yields them."""
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
    _picture_experimenter(experimenter, participant, screens, "end")
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


def _lead(participant: Participant, window, experimenter, screens: Path, say: Callable[[str], Any]) -> int:
    """Act as the participant until the session ends, with screenshots in `screens` of the page `window` at each new
    phase, and of `experimenter` at some numbers of answers; `say` gets the number of answers. Returns how many HOLDs
    were cleared."""
    taken: set[tuple[str, str]] = set()
    watched, cleared = {1, 4, 8}, 0
    while True:
        _picture_participant(window, screens, taken)
        before = participant.answered
        phase = participant.act()
        if participant.answered > before:
            say(f"{participant.answered} answers")
        if participant.answered in watched:
            watched.remove(participant.answered)
            _picture_experimenter(experimenter, participant, screens, f"{participant.answered}-answers")
        if phase in ("done", "ended"):
            return cleared
        cleared += phase == "wait" and _clear_hold(experimenter)
        time.sleep(0.02)


def _picture_participant(window, screens: Path, taken: set[tuple[str, str]]) -> None:
    """Take a screenshot of the participant's page if its phase and question are not among `taken` yet, at most
    `_PICTURES`."""
    seen = "[document.body.dataset.phase, document.querySelector('#options button') ? at('title').textContent : '']"
    if len(taken) >= _PICTURES or (mark := tuple(window.evaluate(seen))) in taken or mark[0] == "wait":
        return
    with held(window):
        phase, question = mark = tuple(window.evaluate(seen))  # another one may have come just now
        if mark not in taken and phase != "wait":
            taken.add(mark)
            screenshots(window, screens, f"participant-{len(taken)}-{phase}{'-question' if question else ''}")


def _picture_experimenter(experimenter, participant: Participant, screens: Path, name: str) -> None:
    """Take a screenshot of the experimenter's page, once it shows all answers or after `_PATIENCE` s."""
    end = time.monotonic() + _PATIENCE  # of a page that hears nothing there is a picture too
    while not experimenter.evaluate(_HEARD, participant.answered) and time.monotonic() < end:
        time.sleep(0.05)
    time.sleep(0.5)  # for the map, which comes after the answers
    with held(experimenter):
        screenshots(experimenter, screens, f"experimenter-{name}", whole=True)


def _clear_hold(experimenter) -> bool:
    """Press Clear on the experimenter's page if it is shown, and return whether it was: a device may go to HOLD on a
    busy computer."""
    if not experimenter.is_visible("#clear"):
        return False
    experimenter.evaluate("command('clear')")
    return True


def _presser(finger, watch) -> Callable[[bool], None]:
    """A function `feel(on)` that has the simulated finger press from its first call with True on, and leave the handle
    at the next call with False. `watch`: returns the experimenter's view."""
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
    """Have the simulated finger tap and rest until the experimenter's view (`watch`) shows no contact, at most 50
    times."""
    for _ in range(50):
        finger.tell("finger tap")
        time.sleep(0.28)
        finger.tell("finger rest")
        time.sleep(0.15)
        if ["Contact", "no"] in watch()["device"]["rows"]:
            return
