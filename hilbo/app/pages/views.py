"""The data of each role's page, from the state, the runner's stage and the device.

The participant's view is built from `participant_view`, that is from the protocol and its texts: nothing here adds a
parameter, a set or a prediction to it. Times are sent as remaining seconds, so that clocks need not agree.
"""

import math
import time
from collections.abc import Callable
from datetime import datetime

from hilbo.app.interface import HubInterface
from hilbo.app.pages.log_words import line, meant, place_of, table
from hilbo.app.pages.pace import duration, minutes_left
from hilbo.app.pages.session_views import View, experimenter_view, participant_view
from hilbo.session.log.records import PAUSE, Trial
from hilbo.session.log.state import LiveSession

__all__ = ["choice_rows", "experimenter", "map_version", "participant", "place_of", "seconds_of", "trial_name"]

Text = Callable[[str], str]
"""The study's text of a key."""
_TEXTS = {
    "page_title": "title", "more": "another", "break": "break", "saving": "sent", "disconnected": "offline",
    "moved": "moved", "space_key": "space_key",
}  # fmt: skip
_PHASE_WORDS = {
    "hello": "Waiting for the participant to press Begin",
    "choosing": "Choosing the next rendering",
    "between": "Between two trials",
    "showing": "Waiting until it is shown",
    "let-go": "Waiting for the hand to leave the device",
    "answer": "Waiting for the answer",
    "idle": "Nothing to do",
}
_ROLES = {"Stimulus": "stimulus program", "Preparer": "page of the preparer"}
_SCREEN_WORDS = {
    "ready": "Warm-up done: the participant may have another one, or begin",
    "rest": "Rest: go on when the participant is ready",
    "done": "All trials are answered: note the participant's remarks, then end the server with Ctrl-C in its terminal",
    "ended": "Ended",
}


def trial_name(hub: HubInterface) -> str | None:
    """The pending trial's name in browsers, `tag:id.presentation`, new for each presentation; None without a pending
    trial."""
    trial = hub.state.pending
    return None if trial is None else f"{hub.tag}:{trial.id}.{trial.presentation}"


def participant(hub: HubInterface) -> View:
    """The participant's view, as a dict for JSON; docs/guides/live.md describes it."""
    seen, session, stage = participant_view(hub.state), hub.state.study.session, hub.runner.stage
    trial, screen = seen["trial"], seen["screen"]
    step = _step(hub, trial) if screen == "trial" and stage == "step" else None
    asking = screen == "trial" and trial["felt"] and (stage == "answer" or _last_of_one(hub, step))
    title, message, phase = _words(hub, screen, stage, session.text)
    if step is not None and trial is not None:
        title, message, phase = trial["steps"][step["index"]]["text"], "", "step"
    hello = screen == "trial" and stage == "hello"
    return {
        "lang": session.text("lang"),
        "phase": "answer" if asking and step is None else phase,
        "title": title,
        "message": message,
        "trial": None if trial is None else {"id": trial_name(hub)},
        "step": step,
        "questions": [_question(ask) for ask in trial["asks"]] if asking and trial is not None else None,
        "progress": _progress(seen["progress"], session.text),
        "may": {
            "begin": hello or seen["may"]["go_on"],
            "more": seen["may"]["another"],
            "break": seen["may"]["break"] and not hello,
        },
        "texts": {name: session.text(key) for name, key in _TEXTS.items()}
        | {"begin": session.text("start" if hello else "begin")},
    }


def _words(hub: HubInterface, screen: str, stage: str, text: Text) -> tuple[str, str, str]:
    """Title, message and phase ("hello", "wait" or the name of the screen) of the participant's page while nothing is
    presented. The text of a screen other than "trial" is split after its first sentence. A study with a device adds how
    to release it to the text of the stage "let-go"."""
    if screen == "trial":
        key = {"hello": "title", "between": "sent", "let-go": "let_go", "trouble": "trouble"}.get(stage, "wait")
        more = {"hello": "hello"} | ({"let-go": "lift"} if hub.state.study.stimulus is None else {})
        message = text(more[stage]) if stage in more else ""
        return text(key), message, stage if stage == "hello" else "wait"
    title, stop, message = text(screen).partition(". ")
    return title + stop.strip(), message, screen


def _last_of_one(hub: HubInterface, step: View | None) -> bool:
    """Whether the last step of a trial with a single rendering is presented: it may be answered meanwhile, a pair only
    after both."""
    pending = hub.state.pending
    return (
        step is not None and step["index"] + 1 == step["count"] and pending is not None and len(pending.renderings) == 1
    )


def _step(hub: HubInterface, trial: View) -> View | None:
    """The step that is presented: its index, texts, duration and the seconds left; None while no step is. `trial`: as
    in `participant_view`."""
    index, steps = hub.runner.step, trial["steps"]
    if index is None:
        return None
    left = max(0.0, hub.runner.ends - time.monotonic())
    return {
        "index": index,
        "show": steps[index]["show"],
        "count": len(steps),
        "labels": [step["text"] for step in steps],
        "seconds": steps[index]["seconds"],
        "left": round(left, 3),
    }


def _question(ask: View) -> View:
    """A question of `participant_view`, with the keys that the page uses."""
    options = [{"value": c["value"], "label": c["label"], "text": c["definition"]} for c in ask["choices"]]
    return {"name": ask["name"], "text": ask["question"], "options": options}


def _progress(progress: View, text: Text) -> View:
    """The progress of `participant_view`, with the keys that the page uses; the text names the warm-up."""
    words = f"{text('warm_up')}: {progress['text']}" if progress["warm_up"] else progress["text"]
    return {"done": progress["done"], "of": progress["of"], "text": words}


def experimenter(hub: HubInterface) -> View:
    """The experimenter's view, as a dict for JSON in the order of the page; `whole` is the complete state, for
    programs."""
    state, runner = hub.state, hub.runner
    header, trial = state.header, state.pending
    phase = _SCREEN_WORDS.get(state.screen) or _phase_words(hub, trial)
    if state.screen == "paused":
        phase = f"Paused by the {state.paused}"
    return {
        "who": f"{header.participant}, session {header.session}",
        "what": f"{state.study.name}, study {state.study.hash}" + (f", plan {header.plan}" if header.plan else ""),
        "banners": _banners(hub),
        "phase": state.screen if state.screen != "trial" else runner.stage,
        "phase_words": phase,
        "trial": _trial_rows(hub, trial),
        "device": _device(hub),
        "trust": hub.trust,
        "table": table(state),
        "log": [line(state, event) for event in list(hub.recent)[:60]],
        "alert": hub.alert or hub.fault or _trouble(hub) or hub.without_map or None,
        "may": _may(hub),
        "means": {"void": meant(state.voidable), "undo": meant(state.last_answered), "skip": meant(state.skippable)},
        "map_version": map_version(state) + ("" if hub.draws else " later"),
        "participant_here": hub.watchers.participant_here,
        "all_delays": hub.delays[-1000:],
        "fits_after_an_answer": hub.runner.fits_after,
        "whole": experimenter_view(state),
    }


def _banners(hub: HubInterface) -> list[str]:
    """Notices of a session whose data are not ordinary: dry run, simulated device, unblinded."""
    header, banners = hub.state.header, []
    if header.dry_run:
        banners.append("Dry run: without a participant; these responses are in no table")
    if hub.rig.simulated:
        banners.append("Simulated device: nothing moves")
    if header.unblinded:
        banners.append("Unblinded: the participant was shown the parameters")
    return banners


def _phase_words(hub: HubInterface, trial: Trial | None) -> str:
    """What the runner does now, in words."""
    runner = hub.runner
    if runner.stage == "step" and trial is not None:
        return participant_view(hub.state)["trial"]["steps"][runner.step]["text"]
    if runner.stage == "trouble":
        waits = f"Waiting for the {_ROLES[hub.rig.title]}: start it with its link" if _waiting(hub) else ""
        return waits or "Stopped: " + runner.trouble
    return _PHASE_WORDS.get(runner.stage, runner.stage)


def _waiting(hub: HubInterface) -> bool:
    """Whether no program or person has joined yet, which is no fault."""
    return hub.rig.snapshot.state == "WAITING"


def _trouble(hub: HubInterface) -> str:
    """Why nothing can be presented, if that is a fault; else empty."""
    return hub.runner.trouble if hub.runner.stage == "trouble" and not _waiting(hub) else ""


def _trial_rows(hub: HubInterface, trial: Trial | None) -> list[list[str]]:
    """Rows of name and value for the experimenter: progress of each block, time left, pauses, and for a pending trial
    its renderings, why they were chosen, and the last delay."""
    state = hub.state
    rows = []
    for i, block in enumerate(state.header.blocks):
        name = block.phase + (f", {block.material}" if block.material else "")
        rows.append([("→ " if i == state.block else "") + name, _how_far(state, i)])
    if state.screen not in ("done", "ended"):
        left = minutes_left(state)
        rows.append(["Time left", f"about {left:.0f} min" if left >= 1 else "below a minute"])
    rows += _pause_rows(state)
    if trial is None:
        return rows
    for side, values in trial.renderings.items():
        name = trial.sets.get(side)
        rows.append([f"Rendering {side.upper()}" + (f" ({name})" if name else ""), _set_words(state.study, values)])
    rows += choice_rows(trial.data.get("choice", {}))
    if hub.delays:
        rows.append([f"Answer to {hub.rig.title.lower()}", f"{1000 * hub.delays[-1]['total']:.0f} ms"])
    return rows


def _pause_rows(state: LiveSession) -> list[list[str]]:
    """Rows of name and value: the pause that is going on, if it is long enough to count, and the earlier ones."""
    rows, away = [], 0.0 if state.active is None else time.time() - state.active
    if away >= PAUSE and state.screen not in ("done", "ended"):
        at = datetime.fromtimestamp(state.active or 0.0).strftime("%d %b %H:%M")
        rows.append(["Last activity", f"{at}, {duration(away)} ago"])
    if state.pauses:
        last = state.pauses[-1]
        words = f"{len(state.pauses)}, the last of {duration(last.seconds)} before {place_of(state.trial(last.trial))}"
        rows.append(["Pauses", words])
    return rows


def choice_rows(choice: View) -> list[list[str]]:
    """Why a rendering was chosen, as rows of name and value. `choice`: that of a proposal's data, in which None stands
    for numbers that were not finite; rows without a number are left out."""
    rows = []
    mean, sd = choice.get("mean"), choice.get("sd")
    if "by" in choice and choice["by"] != "plan":
        known = "" if mean is None or sd is None else f", mean {mean:.3f} ± {sd:.3f}"
        rows.append(["Chosen by", choice["by"] + known])
    chances = {name: p for name, p in (choice.get("probabilities") or {}).items() if p is not None}
    if chances:
        rows.append(["Predicted answer", ", ".join(f"{name} {100 * p:.0f} %" for name, p in chances.items())])
    certificate = choice.get("certificate") or {}
    if certificate:
        residual = certificate.get("residual")
        words = "fit converged" if certificate.get("converged") else "fit NOT converged"
        rows.append(["Certificate", words + ("" if residual is None else f", residual {residual:.1g}")])
    margin = choice.get("margin")
    margins = {k: v for k, v in (margin if isinstance(margin, dict) else {"": margin}).items() if v is not None}
    if margins:
        rows.append(["Passivity margin", ", ".join(f"{k} {v:.4f} N·s/m".strip() for k, v in margins.items())])
    return rows


def _how_far(state: LiveSession, block: int) -> str:
    """Progress of a block in words: answers, and trials that were skipped or that the device stopped."""
    words = [f"{len(state.counted(block))} of {state.quota(block)}"]
    last, out, excluded = (len(f(block)) for f in (state.put_off, state.skipped, state.excluded))
    words += [f"{last} put off to the end: stopped twice by the device"] if last else []
    words += [f"{out} left out"] if out else []
    words += [f"{excluded} not shown again: stopped twice by the device"] if excluded else []
    return "; ".join(words)


def _set_words(study, values):
    """A parameter set in words; levels by their names, and K0, which is derived, included."""
    parameters = {p.name: p for p in study.space.parameters}
    return ", ".join(
        f"{name} {parameters[name].words(value)} {parameters[name].unit}".strip()
        if name in parameters
        else f"{name} {value:.4g} N/mm"
        for name, value in values.items()
    )


def _device(hub: HubInterface) -> View:
    """State of the rig for the experimenter: title, state, colour (`level`: "bad", "good" or "rest"), words and
    rows."""
    seen = hub.rig.snapshot
    waits = _waiting(hub)
    level = "bad" if seen.state in ("HOLD", "ESTOP") or (seen.lost and not waits) else "rest"
    level = "good" if seen.state == "RUNNING" and not seen.lost else level
    state = "lost" if seen.lost and not waits else seen.state.lower()
    rows = [list(row) for row in seen.rows]
    rows = ([["Reason", seen.reason]] if seen.reason and not seen.lost else []) + rows
    words = seen.lost or hub.rig.words
    return {"title": hub.rig.title, "state": state, "level": level, "words": words, "rows": rows}


def _may(hub: HubInterface) -> list[str]:
    """The commands that are possible now, by name."""
    state, seen = hub.state, hub.rig.snapshot
    actions = ["note", "invite"] + ([] if seen.lost else ["estop"])
    if seen.state in ("HOLD", "ESTOP") and not seen.lost:
        actions.append("clear")
    if hub.lost:
        return [action for action in actions if action != "note"]
    if state.screen == "ended":
        return actions
    if state.screen in ("paused", "ready", "rest"):
        actions.append("resume")
    elif state.screen != "done":
        actions.append("pause")
    answered = state.last_answered is not None
    begun = state.pending is not None and state.pending.step is not None
    actions += ["repeat"] if begun else []
    actions += ["undo"] if answered else []
    actions += ["void"] if answered or begun else []
    actions += ["skip"] if state.skippable else []
    return [*actions, "abort"]


def map_version(state: LiveSession) -> str:
    """A text that changes whenever the map may: with the answers and the pending trial."""
    answered = sum(1 for t in state.trials if t.status == "answered")
    undone = sum(1 for t in state.trials if t.status in ("undone", "void"))
    return f"{answered}.{undone}.{state.pending.id if state.pending else 0}"


def seconds_of(text: str) -> float | None:
    """A browser's ISO 8601 time in s since the epoch; None if it is not valid."""
    try:
        seconds = datetime.fromisoformat(text).timestamp()
    except (ValueError, OverflowError, OSError):
        return None
    return seconds if math.isfinite(seconds) else None
