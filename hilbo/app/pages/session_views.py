"""The participant's and the experimenter's view of a session, as plain dicts for JSON.

The participant's view contains no parameter, no name of a set and no prediction: it is built from the protocol and its
texts, never by removing something from the experimenter's.
"""

from typing import Any

import msgspec

from hilbo.session.log.header_check import protocol_of
from hilbo.session.log.records import Trial
from hilbo.session.log.state import LiveSession
from hilbo.study.file.languages import language

__all__ = ["View", "experimenter_view", "participant_view"]

View = dict[str, Any]
"""A view, or a part of one, as it becomes JSON."""


def participant_view(state: LiveSession) -> View:
    """What the participant's page is made from; nothing else of a session may reach their browser.

    `screen` and its `message`; `trial` (id, presentation, steps with their texts and seconds, the running `step`,
    `felt`, `asks`) or None; `progress` (done, of, text); `rest` (s) or None; `may` (which buttons); `texts`.
    """
    session = state.study.session
    trial = state.pending if state.screen in ("trial", "paused") else None
    return {
        "screen": state.screen,
        "message": session.text("wait" if state.screen == "trial" else state.screen),
        "trial": None if trial is None else _shown_trial(state, trial),
        "progress": _progress(state),
        "rest": state.header.blocks[state.block].rest if state.screen == "rest" and state.block is not None else None,
        "may": {
            "break": state.screen in ("trial", "wait", "ready"),
            "another": state.screen == "ready" and _spare(state),
            "go_on": state.screen == "ready",
        },
        "texts": {key: session.text(key) for key in language("en").texts},
    }


def _spare(state: LiveSession) -> bool:
    """Whether the warm-up has another trial to offer. Only for the screen "ready"."""
    before = None if state.block is None else state.warm_up(state.block)
    assert before is not None  # the screen is "ready"
    return state.quota(before) < len(state.header.blocks[before].trials)


def _shown_trial(state: LiveSession, trial: Trial) -> View:
    """A trial for the participant: its steps, the index of the running one, whether all renderings were presented
    (`felt`), and its questions; no parameters."""
    session = state.study.session
    asks = protocol_of(state.study, state.header.blocks[trial.block]).asks
    alone = "b" not in trial.renderings
    return {
        "id": trial.id,
        "presentation": trial.presentation,
        "again": trial.presentation > 1,
        "steps": [
            {"show": show, "seconds": seconds, "text": session.text(_step_text(show, alone))}
            for show, seconds in state.steps_of(trial)
        ],
        "step": trial.step,
        "felt": trial.felt == frozenset(trial.renderings),
        "asks": [_ask(state, ask, alone) for ask in asks],
    }


def _step_text(show: str, alone: bool) -> str:
    """The key of the participant's text for a step. `alone`: the trial has a single rendering."""
    if show == "neutral":
        return "neutral"
    return "feel_test" if alone and show == "a" else f"feel_{show}"


def _ask(state: LiveSession, ask: str, alone: bool) -> View:
    """A question and its choices. `ask`: "class_a", "class_b" or "preferred"; `alone`: the trial has a single
    rendering."""
    session = state.study.session
    if ask == "preferred":
        choices = [{"value": side, "label": session.text(side), "definition": ""} for side in ("a", "b")]
        return {"name": ask, "question": session.text("question_preferred"), "choices": choices}
    key = "question" if alone else f"question_{ask[-1]}"
    choices = [
        {"value": label, "label": session.label(label), "definition": session.definition(label)}
        for label in state.study.responses
    ]
    return {"name": ask, "question": session.text(key), "choices": choices}


def _progress(state: LiveSession) -> View:
    """Answered and required trials of the block of the pending trial (without one: of the current block, of the warm-up
    that has just ended, or at the end of the last block), and the text with the number of the trial, from 1."""
    block = len(state.header.blocks) - 1 if state.block is None else state.block
    if state.pending is not None:
        block = state.pending.block
    elif state.screen == "ready":
        block = state.warm_up(block) or 0
    done, of = len(state.counted(block)), state.quota(block)
    numbers = {"{trial}": min(done + 1, of), "{done}": done, "{of}": of}
    text = state.study.session.text("progress")
    for name, number in numbers.items():
        text = text.replace(name, str(number))
    return {"done": done, "of": of, "warm_up": state.header.blocks[block].phase == "warm-up", "text": text}


def experimenter_view(state: LiveSession) -> View:
    """The whole state as a dict for JSON, parameters included, for the experimenter's page and for programs; without
    the study file in the log."""
    header = state.header
    return {
        "study": {"name": state.study.name, "hash": state.study.hash, "responses": list(state.study.responses)},
        "header": {name: value for name, value in msgspec.to_builtins(header).items() if name != "study_tables"},
        "screen": state.screen,
        "seq": state.seq,
        "block": state.block,
        "blocks": [
            {
                "phase": block.phase,
                "material": block.material,
                "done": len(state.counted(i)),
                "of": state.quota(i),
                "skipped": [msgspec.to_builtins(block.trials[k]) for k in state.skipped(i)],
                "put_off": [_put_off(state, i, k) for k in state.put_off(i)],
                "excluded": state.excluded(i),
            }
            for i, block in enumerate(header.blocks)
        ],
        "pending": None if state.pending is None else state.pending.id,
        "trials": [_whole_trial(state, trial) for trial in state.trials],
        "paused": state.paused,
        "aborted": state.aborted,
        "device": dict(state.machine),
        "notes": [{"time": at, "text": text} for at, text in state.notes],
        "began": state.began,
        "last": state.last,
        "pauses": [pause._asdict() for pause in state.pauses],
        "participant": participant_view(state),
    }


def _put_off(state: LiveSession, block: int, k: int) -> View:
    """Planned trial number `k` of a block, which was moved to the end, and how often the device stopped in it
    (`stops`)."""
    return msgspec.to_builtins(state.header.blocks[block].trials[k]) | {"stops": state.stops(block)[k]}


def _whole_trial(state: LiveSession, trial: Trial) -> View:
    """All data of a trial, parameters included."""
    return {
        **trial.data,
        "status": trial.status,
        "presentation": trial.presentation,
        "proposed": trial.proposed,
        "steps": state.steps_of(trial),
        "step": trial.step,
        "on": trial.on,
        "sent": dict(trial.sent),
        "presented": trial.presented,
        "values": trial.values,
        "answered": trial.answered,
        "telemetry": trial.telemetry,
        "voided": trial.voided,
    }
