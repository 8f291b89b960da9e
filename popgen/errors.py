"""One exception for everything a user can get wrong."""

from __future__ import annotations


class UserError(ValueError):
    """Bad input, told in one line that names the field and the fix.

    The command line turns it into that line on stderr and exit code 2; nothing else catches it.
    """

    def __init__(self, field: str, problem: str, fix: str = "") -> None:
        self.field, self.problem, self.fix = field, problem, fix
        message = f"{field}: {problem}" + (f"; {fix}" if fix else "")
        super().__init__(" ".join(message.split()))
