"""A process that compiles functions and keeps them: python -m omnilines.compiling FUNCTION..., all that are wanting without one.

With functions, each is named on standard output when it is kept, and the process ends with its standard input: with whoever
started it.
"""

import importlib
import os
import sys
import threading
from pathlib import Path
from typing import Any

from filelock import FileLock
from numba.core import caching

from omnilines.compiling import EVERYTHING, compile_ahead, entries, not_compiled
from omnilines.compiling.argument_types import read


def compile_each(functions: list[str]) -> None:
    """Compile functions of the list, one after another, for all arguments that it names."""
    threading.Thread(target=_end_with_standard_input, daemon=True).start()
    _keep_one_at_a_time()
    listed = {entry.function: entry for entry in entries()}
    for name in functions:
        module, _, own = name.rpartition(".")
        compiled = getattr(importlib.import_module(module), own)
        for arguments in listed[name].arguments:
            compiled.compile(tuple(map(read, arguments)))
        print(name, flush=True)


def _end_with_standard_input() -> None:
    while sys.stdin.read(1):
        pass
    os._exit(1)


def _keep_one_at_a_time() -> None:
    """numba numbers the files of a function by those it finds, without a lock: two processes that keep a helper for two types of
    arguments at the same moment would give both one number, and the second one's code would serve for the first."""
    file: Any = caching.IndexDataCacheFile
    save = file.save

    def locked(self: Any, key: Any, data: Any) -> None:
        with FileLock(Path(self._index_path).with_name("keeping.lock")):
            save(self, key, data)

    file.save = locked


if __name__ == "__main__":
    if sys.argv[1:]:
        compile_each(sys.argv[1:])
    elif left := compile_ahead(not_compiled(EVERYTHING), lambda done, total: print(f"compiled {done} of {total}", end="\r")):
        sys.exit(f"could not be compiled: {', '.join(left)}")
