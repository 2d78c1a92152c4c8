"""Errors that a user can mend."""


class UserError(ValueError):
    """Bad input. The message is one line that names the file, link or flag, what was expected, and the remedy."""


class OpenGLError(UserError):
    """MuJoCo finds no OpenGL to draw with, either on import or when a renderer is made."""

    def __init__(self):
        super().__init__(
            "no OpenGL to draw with; install libosmesa6 and set MUJOCO_GL=osmesa, or use --viewer where a display is"
        )
