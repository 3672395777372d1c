"""What can be wrong with a rig: every fault has a reason, which the manifest and the exit line name."""

from enum import StrEnum

from torchpose.errors import TorchposeError


class CameraReason(StrEnum):
    """Why a camera cannot go on."""

    NOT_FOUND = "not_found"
    NOT_OPENED = "not_opened"
    REFUSED_SETTING = "refused_setting"
    NOT_READY = "not_ready"
    TIMED_OUT = "time_out"
    FAILED_BUFFER = "failed_buffer"
    WRONG_SIZE = "wrong_size"
    REMOVED = "camera_removed"
    DRIVER_ERROR = "camera_driver_error"


class RobotReason(StrEnum):
    """Why the robot cannot go on."""

    INVALID_POSE = "invalid_pose"
    OUTSIDE_WORKSPACE = "outside_workspace"
    UNREACHABLE_POSE = "unreachable_pose"
    UNREACHABLE = "unreachable"
    TIMED_OUT = "timed_out"
    NOT_REMOTE = "not_remote"
    NOT_READY = "not_ready"
    REGISTERS_IN_USE = "registers_in_use"
    REFUSED_SCRIPT = "refused_script"
    PROTECTIVE_STOP = "protective_stop"
    EMERGENCY_STOP = "emergency_stop"
    SAFETY_STOP = "safety_stop"
    PROGRAM_STOPPED = "program_stopped"
    NOT_SETTLED = "not_settled"
    STALE_STREAM = "stale_stream"
    CONNECTION_LOST = "connection_lost"
    CHILD_DIED = "child_died"
    STOPPED = "stopped"


class SessionReason(StrEnum):
    """Why a session cannot be written on."""

    DISK_FULL = "disk_full"
    NOT_WRITABLE = "not_writable"


class RigFault(TorchposeError):
    """A part of the rig cannot go on. The message is one line with the fix; `reason` names the kind."""

    def __init__(self, reason: StrEnum, message: str) -> None:
        super().__init__(message)
        self.reason = reason


class CameraFault(RigFault):
    """A camera cannot go on."""


class RobotFault(RigFault):
    """The robot cannot go on."""


class SessionFault(RigFault):
    """A file of the session cannot be written."""
