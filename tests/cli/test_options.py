"""Options: one meaning each, and a sentence for an earlier name."""

import sys

import pytest
from typer.main import get_command

from hilbo.cli import main
from hilbo.cli.terminal.renamed import _RENAMED, check_renamed
from hilbo.errors import InputError


def options(command=None):
    """Command -> names of its options."""
    command = get_command(main.app) if command is None else command
    if not hasattr(command, "commands"):
        return {option for p in command.params for option in (*p.opts, *p.secondary_opts) if option.startswith("-")}
    return {name: options(one) for name, one in command.commands.items()}


def test_an_earlier_name_has_a_new_one_that_exists():
    every = options()
    every["device"] = set().union(*every["device"].values())
    for command, names in _RENAMED.items():
        assert not set(names) & (every[command] - {"--device"} if command == "device" else every[command])
        assert {new.split()[0] for new in names.values()} <= every[command]


@pytest.mark.parametrize(
    ("line", "sentence"),
    [
        ("plan study.toml --trials logs", "--trials is called --table now."),
        ("init study.toml --device", "--device is called --by device now."),
        ("device set --sets sets.csv --name=S", "--name is called --set now."),
    ],
)
def test_an_earlier_name_gets_a_sentence(line, sentence):
    with pytest.raises(InputError, match=f"^{sentence}$"):
        check_renamed(line.split())


def test_other_commands_keep_the_name():
    check_renamed([])
    check_renamed(["power", "study.toml", "--participants", "4", "--trials", "5"])


def test_an_earlier_name_ends_with_code_2(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["hilbo", "aggregate", "trials.csv", "--participants", "A,B"])
    with pytest.raises(SystemExit) as ended:
        main.main()
    assert ended.value.code == 2 and "--participants is called --names now." in capsys.readouterr().err
