"""Errors that a user can mend."""

from collections.abc import Iterable


class UserError(Exception):
    """Bad input. The message is one line that names the file, link or argument, what was expected, and the remedy.

    Not a ValueError: what catches those of NumPy and JAX must not take a mistake of the user for one of the program.
    """


def require_one_of(name: str, value: str, known: Iterable[str]) -> None:
    """Raises UserError unless the value of the argument or flag `name` is one of the known ones."""
    known = tuple(known)
    if value not in known:
        raise UserError(f"{name} {value}: not one of {', '.join(known)}")


def require_positive(name: str, value: int) -> None:
    """Raises UserError for a count below 1 in the argument or flag `name`."""
    if value < 1:
        raise UserError(f"{name} {value}: must be at least 1")


def summarize_error(error: Exception) -> str:
    """The first line of another library's error message, or the error's type where it has none."""
    return (str(error) or type(error).__name__).splitlines()[0]


class OpenGLError(UserError):
    """MuJoCo finds no OpenGL to draw with, either on import or when a renderer is made."""

    def __init__(self):
        super().__init__(
            "no OpenGL to draw with; install libosmesa6 and set MUJOCO_GL=osmesa, or use --viewer where a display is"
        )
