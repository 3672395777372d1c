"""The errors that torchpose raises on purpose. Each message is one line that names the file, the field and the fix."""


class TorchposeError(Exception):
    """Base of every deliberate error; the command line prints its message alone and exits with 2."""


class ConfigError(TorchposeError):
    """A camera, target, pipeline or hand-eye file, or a command-line argument, is wrong."""


class FrameError(TorchposeError):
    """Frames of a wrong size, type or value range were passed to a stage."""


class ArgumentError(TorchposeError, ValueError):
    """An argument of a function has a wrong shape, type or device, or is out of range; the message names it first."""
