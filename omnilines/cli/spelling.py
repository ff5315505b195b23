"""Parameters as the command line spells them: messages of the library name `min_views`, the command line says --min-views."""

import re


def with_flags(text: str) -> str:
    """A text with the flags of the parameters that it names in backticks."""
    return re.sub("`([a-z_]+)`", lambda name: "--" + name[1].replace("_", "-"), text)
