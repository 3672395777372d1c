"""Entry point: ``torchpose COMMAND ...``. Errors of the user end in one line on stderr and the exit code 2."""

import contextlib
import errno
import os
import re
import sys
import traceback
import warnings
from collections.abc import Sequence
from copy import copy
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any, NoReturn

import typer

from torchpose.cli.calibrate import calibrate
from torchpose.cli.capture import capture
from torchpose.cli.common import INTERRUPTED
from torchpose.cli.design import design
from torchpose.cli.detect import detect
from torchpose.cli.estimate import estimate
from torchpose.cli.evaluate import evaluate
from torchpose.cli.examples import examples
from torchpose.cli.live import live
from torchpose.cli.reproduce import reproduce
from torchpose.cli.sensitivity import sensitivity
from torchpose.cli.simulate import simulate
from torchpose.cli.watch import watch
from torchpose.errors import ConfigError, TorchposeError, plain, printable

_HELP = Path(__file__).with_name("help")
_FAULTS_OF_MACHINES = (
    *(errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO, errno.EROFS, errno.EPIPE),
    *(errno.EMFILE, errno.ENFILE, errno.ENOMEM, errno.EAGAIN),
)
INTERNAL_ERROR = 70  # EX_SOFTWARE of sysexits.h: none of the codes that say something about the input

app = typer.Typer(
    name="torchpose",
    no_args_is_help=True,
    rich_markup_mode="markdown",
    context_settings={"help_option_names": ["-h", "--help"]},
)


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"torchpose {version('torchpose')}")
        raise typer.Exit


@app.callback()
def _torchpose(
    _version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version and exit.")
    ] = False,
) -> None:
    """Pose of flat concentric-ring targets from camera frames, to microns, with its uncertainty."""


# what stands below the options: help/COMMAND.md
_MEASURING = (estimate, live, watch, detect, simulate, evaluate, capture)
_COMMANDS = (*_MEASURING, sensitivity, reproduce, design, calibrate, examples)
for _each in _COMMANDS:
    app.command(epilog=(_HELP / f"{_each.__name__}.md").read_text(encoding="utf-8"))(_each)


def main(arguments: Sequence[str] | None = None) -> NoReturn:
    """Runs the command line and exits.

    Args:
        arguments: of the command line, without the program's name; those of the process by default.
    """
    words = sys.argv[1:] if arguments is None else arguments
    command = _wanted(words)
    try:
        _refuse_empty(words)
        with warnings.catch_warnings():
            warnings.showwarning = _say
            code = command.main(
                args=None if arguments is None else list(arguments), prog_name="torchpose", standalone_mode=False
            )
    except TorchposeError as error:
        _fail(str(error))
    except (KeyboardInterrupt, typer.Abort):
        _fail("interrupted before anything was computed", INTERRUPTED)
    except Exception as error:
        # typer brings its own copy of click or depends on click, by version: known by what its errors can do
        if hasattr(error, "format_message"):
            _fail_usage(error.format_message(), words)
        if outside := _of_the_machine(error):
            _fail(outside)
        traceback.print_exc()
        _fail(f"internal: {type(error).__name__}: {error}; please report it with the lines above", INTERNAL_ERROR)
    try:
        sys.stdout and sys.stdout.flush()
    except OSError as error:
        _fail(_of_the_machine(error) or str(error))
    sys.exit(code if isinstance(code, int) else 0)


def _wanted(arguments: Sequence[str]) -> Any:
    """What runs: all commands, or the one alone that is named; the options of all are a tenth of a second's reading."""
    named = [one for one in app.registered_commands if one.callback and one.callback.__name__ in arguments[:1]]
    some = copy(app)
    some.registered_commands = named or app.registered_commands
    return typer.main.get_command(some)


def _refuse_empty(words: Sequence[str]) -> None:
    """Refuses empty arguments: as a path "" would be the folder that the shell is in."""
    for place, word in enumerate(words):
        if not word or re.fullmatch(r"--[a-z-]+=", word):
            before = words[place - 1] if place and words[place - 1].startswith("-") else ""
            name = word.rstrip("=") or before or "an argument"
            raise ConfigError(f"{name}: is empty; give a value, or leave it out (has a variable of the shell none?)")


def _say(
    message: Warning | str,
    category: type[Warning],
    filename: str,
    lineno: int,
    file: object = None,
    line: object = None,
) -> None:
    """A warning in one line: where in the program it was raised helps no user."""
    typer.echo(printable(f"torchpose: warning: {message}"), err=True)


def _of_the_machine(error: Exception) -> str | None:
    """The line about an error that is not the program's: a full disk, no memory; None for any other."""
    if isinstance(error, OSError) and error.errno in _FAULTS_OF_MACHINES:
        place = error.filename or "output"
        return f"{place}: cannot be written or opened ({error.strerror}); free some, or choose another place"
    # torch has no type of its own for memory of the CPU
    if isinstance(error, MemoryError) or (isinstance(error, RuntimeError) and "can't allocate memory" in str(error)):
        return "memory: there is not enough for this; give a smaller --batch, fewer --threads or smaller frames"
    return None


def _fail_usage(message: str, arguments: Sequence[str]) -> NoReturn:
    if not message:  # no command was given and the help has been shown
        sys.exit(2)
    known = [command.callback.__name__ for command in app.registered_commands if command.callback]
    command = next((f"{word} " for word in arguments[:1] if word in known), "")
    numbers = [word for word in arguments if re.fullmatch(r"-\.?\d\S*", word)]
    if numbers and "No such option" in message:
        _fail(f"{numbers[0]}: a negative number stands where an option should; no deviation or size is negative")
    _fail(f"{message.rstrip('.')}; see torchpose {command}--help")


def _fail(message: str, code: int = 2) -> NoReturn:
    with contextlib.suppress(OSError):  # where even that cannot be printed the code has to do
        print(f"torchpose: error: {plain(' '.join(message.split()))}", file=sys.stderr, flush=True)
    for stream in (sys.stdout, sys.stderr):
        _mute_if_full(stream)
    sys.exit(code)


def _mute_if_full(stream: Any) -> None:
    """What a stream cannot take is let go, so that Python does not try again at its end, and fail then."""
    try:
        if stream is not None:
            stream.flush()
    except OSError:
        with contextlib.suppress(OSError, ValueError):
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, stream.fileno())
            os.close(nowhere)


if __name__ == "__main__":
    main()
