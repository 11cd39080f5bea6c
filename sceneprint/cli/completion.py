"""`sceneprint completion`: a shell script that completes commands and options."""

from __future__ import annotations

import argparse
from collections.abc import Iterator

from sceneprint.cli import parser

_SCRIPT = """\
_sceneprint() {{
    local words="{commands}"
    [ "$COMP_CWORD" -gt 1 ] && case "${{COMP_WORDS[1]}} ${{COMP_WORDS[2]}} " in
{cases}
    *) words= ;;
    esac
    COMPREPLY=($(compgen -W "$words" -- "${{COMP_WORDS[COMP_CWORD]}}"))
}}
complete -o default -F _sceneprint sceneprint"""


def add_completion(command: argparse.ArgumentParser) -> None:
    """Add the options of `sceneprint completion`."""
    command.add_argument("shell", choices=("bash", "zsh"))
    command.set_defaults(run=run_completion)


def run_completion(options: argparse.Namespace) -> int:
    """Print a script that completes commands and options. Add `source <(sceneprint completion
    bash)` to ~/.bashrc, or the same with zsh to ~/.zshrc.
    """
    parsers = [(name, command) for name, _, command in subcommands(parser())]
    # Subcommands come first, because the pattern of their command would match them too.
    cases = [f'    "{name} "*) words="{" ".join(_words(own))}" ;;' for name, own in parsers[::-1]]
    commands = " ".join(name for name, _ in parsers if " " not in name)
    if options.shell == "zsh":
        print("autoload -U +X compinit bashcompinit && compinit && bashcompinit")
    print(_SCRIPT.format(commands=commands, cases="\n".join(cases)))
    return 0


def subcommands(
    above: argparse.ArgumentParser,
) -> Iterator[tuple[str, str, argparse.ArgumentParser]]:
    """Yield name, help line and parser of each command and subcommand."""
    for action in above._actions:
        if isinstance(action, argparse._SubParsersAction):
            lines = {choice.dest: choice.help or "" for choice in action._choices_actions}
            for name, command in action.choices.items():
                yield command.prog.removeprefix("sceneprint "), lines[name], command
                yield from subcommands(command)


def _words(command: argparse.ArgumentParser) -> Iterator[str]:
    """Yield the words that complete a command: its options and fixed values."""
    for action in command._actions:
        yield from action.option_strings or map(str, action.choices or ())
