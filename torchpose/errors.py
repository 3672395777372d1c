"""The errors that torchpose raises on purpose. Each message is one line that names the file, the field and the fix."""

_LONGEST = 1000  # characters of a message (convention): some lines of a terminal, whatever a file made of a value
_TAIL = 300  # of these, where the fix stands


def printable(text: str) -> str:
    """The text as a terminal may have it: one line, what is not printable as an escape.

    A file's name may hold escape sequences, line ends and halves of surrogate pairs.
    """
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in text)


def plain(text: str) -> str:
    """`printable` text of bounded length."""
    text = printable(text)
    return text if len(text) <= _LONGEST else f"{text[: _LONGEST - _TAIL]} ... {text[-_TAIL:]}"


class TorchposeError(Exception):
    """Base of every deliberate error; the command line prints its message alone and exits with 2."""

    def __init__(self, message: str = "") -> None:
        super().__init__(plain(message))


class ConfigError(TorchposeError):
    """A camera, target, pipeline or hand-eye file, or a command-line argument, is wrong."""


class FrameError(TorchposeError):
    """Frames of a wrong size, type or value range were passed to a stage."""


class ArgumentError(TorchposeError, ValueError):
    """An argument of a function has a wrong shape, type or device, or is out of range; the message names it first."""
