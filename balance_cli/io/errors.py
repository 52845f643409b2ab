"""What a user can do wrong: one exception, with everything that its one message must name."""

from dataclasses import dataclass


@dataclass(eq=False)
class UserError(Exception):
    """The input or the call is wrong (exit status 2).

    `file` is the file (or option) at fault, `place` the spot in it (key, dataset, row, line), `fault` what is wrong
    there, `remedy` what the user can do about it.
    """

    fault: str
    file: str = ""
    place: str = ""
    remedy: str = ""

    def __str__(self) -> str:
        where = ", ".join(part for part in (self.file, self.place) if part)
        message = f"{where}: {self.fault}" if where else self.fault
        return f"{message}. {self.remedy}" if self.remedy else message

    def at(self, file: str = "", place: str = "") -> "UserError":
        """The same error with the file or place filled in where it was not known below."""
        return UserError(self.fault, self.file or file, self.place or place, self.remedy)
