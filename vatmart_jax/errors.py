"""Errors that a user can mend."""

from collections.abc import Iterable


class UserError(ValueError):
    """Bad input. The message is one line that names the file, link or flag, what was expected, and the remedy."""


def require_one_of(flag: str, value: str, known: Iterable[str]) -> None:
    """Raises UserError unless the flag's value is one of the known ones."""
    if value not in known:
        raise UserError(f"{flag} {value}: not one of {', '.join(known)}")


def require_positive(flag: str, value: int) -> None:
    """Raises UserError for a count below 1."""
    if value < 1:
        raise UserError(f"{flag} {value}: must be at least 1")


def summarize_error(error: Exception) -> str:
    """What another's error says, or its type where it says nothing."""
    return (str(error) or type(error).__name__).splitlines()[0]


class OpenGLError(UserError):
    """MuJoCo finds no OpenGL to draw with, either on import or when a renderer is made."""

    def __init__(self):
        super().__init__(
            "no OpenGL to draw with; install libosmesa6 and set MUJOCO_GL=osmesa, or use --viewer where a display is"
        )
