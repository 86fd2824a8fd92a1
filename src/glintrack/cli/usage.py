"""What is wrong with a command line, in one sentence, in place of the parser's box."""

import re

from glintrack.core.designs import offered

_LONGEST = 100  # characters of a value that are shown


def usage_sentence(error: Exception) -> str:
    """The fault of a command line: name, requirement, what came, and a remedy if there is one.

    Parameters
    ----------
    error
        As the parser raises it, an `app.UsageError`.
    """
    context, said = getattr(error, "ctx", None), str(getattr(error, "message", error))
    program = getattr(context, "command_path", "") or "glintrack"
    kind, help = type(error).__name__, f"see `{program} --help`"
    parameter = getattr(error, "param", None)
    if kind == "MissingParameter" and parameter is not None:
        return f"`{_named(parameter)}` must be given, got none ({help})"
    if parameter is not None:
        requirement, got = _requirement(error, said)
        return f"`{_named(parameter)}` must be {requirement}, got {got}"
    if kind == "NoSuchOption":
        name = getattr(error, "option_name", "")
        hint = offered(name, _options(context)) or help
        return f"`{name}` must be an option of `{program}`, got an unknown one ({hint})"
    if kind == "BadOptionUsage":
        name = getattr(error, "option_name", "")
        need = "be given without a value, got one" if "not take" in said else "be given a value, got none"
        return f"`{name}` must {need} ({help})"
    command = re.match(r"No such command '(.*?)'", said)
    if command:
        known = getattr(getattr(context, "command", None), "commands", {})
        hint = offered(command[1], known) or help
        return f"`{program}` must be followed by a known command, got '{command[1]}' ({hint})"
    extra = re.match(r"Got unexpected extra arguments?(?:\(s\))? \((.*)\)", said)
    if extra:
        return f"`{program}` must be given no more words than it takes, got {extra[1]} too ({help})"
    return f"`{program}` must be called as its help says, got: {said.rstrip('.')} ({help})"


def _named(parameter) -> str:
    """An option by its longest name, an argument by the name that its help has."""
    names = [name for name in parameter.opts if name.startswith("-")]
    return max(names, key=len) if names else str(parameter.name)


def _requirement(error: Exception, said: str) -> tuple[str, str]:
    """What a value must be, and the one that came, from the parser's words; they differ by its version."""
    said = said.removeprefix("Value error, ").rstrip(".")
    refused = re.match(r"(?P<got>'.*'|\S+) is not (?P<why>.*)", said, re.DOTALL)
    if refused is None:
        faults = getattr(error.__cause__, "errors", list)()
        got = _short(faults[0].get("input")) if faults else "another value"
        return said.removeprefix("Input should be ").split(", unable")[0], got
    got, why = refused["got"], refused["why"]
    if why.startswith("in the range"):
        return f"within {why.removeprefix('in the range ')}", got
    words = re.findall(r"'([^']*)'", why.removeprefix("one of ")) if why.startswith("one of") else []
    hint = offered(got.strip("'"), words)
    return why, f"{got} ({hint})" if hint else got


def _short(value: object) -> str:
    text = str(value)
    return text if len(text) <= _LONGEST else f"{text[:_LONGEST]}…"


def _options(context) -> list[str]:
    """The options of the command at fault."""
    parameters = getattr(getattr(context, "command", None), "params", [])
    return [name for one in parameters for name in one.opts if name.startswith("--")]
