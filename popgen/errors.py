"""One exception for everything a user can get wrong."""

from __future__ import annotations

import re

MASK = "***"
_CREDENTIALS = re.compile(r"(://)[^/?#\s'\"]*@")


def mask_credentials(text: str) -> str:
    """The text without the user and password that addresses in it hold (`scheme://USER:PASSWORD@HOST`)."""
    return _CREDENTIALS.sub(rf"\1{MASK}@", text)


class UserError(ValueError):
    """Bad input, told in one line that names the field and the fix.

    The command line turns it into that line on stderr and exit code 2; nothing else catches it.
    """

    def __init__(self, field: str, problem: str, fix: str = "") -> None:
        field, problem, fix = mask_credentials(field), mask_credentials(problem), mask_credentials(fix)
        self.field, self.problem, self.fix = field, problem, fix
        message = f"{field}: {problem}" + (f"; {fix}" if fix else "")
        super().__init__(" ".join(message.split()))
