"""One exception for user errors, with the parts of its message."""

from dataclasses import dataclass


@dataclass(eq=False)
class UserError(Exception):
    """The input or the call is wrong (exit status 2).

    `file` is the file (or option) at fault, `place` the position in it (key, dataset, row, line), `fault` what is wrong
    there, and `remedy` what the user can do about it.
    """

    fault: str
    file: str = ""
    place: str = ""
    remedy: str = ""

    def __str__(self) -> str:
        where = ", ".join(part for part in (self.file, self.place) if part)
        message = f"{where}: {self.fault}" if where else self.fault
        return f"{message}{'' if message.endswith('?') else '.'} {self.remedy}" if self.remedy else message

    def __reduce__(self) -> tuple[type["UserError"], tuple[str, ...]]:
        """For `pickle`: a dataclass does not pass its fields to the exception."""
        return type(self), (self.fault, self.file, self.place, self.remedy)

    def with_location(self, file: str = "", place: str = "") -> "UserError":
        """The same error with `file` and `place` filled in where they are empty."""
        return UserError(self.fault, self.file or file, self.place or place, self.remedy)

    def with_file_of(self, name: str, file: str) -> "UserError":
        """The same error with `file` where it names nothing, or a run by its `name`."""
        return UserError(self.fault, file if self.file in ("", name) else self.file, self.place, self.remedy)
