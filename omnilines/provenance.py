"""What a result was made from."""

import sys
from collections.abc import Mapping
from importlib.metadata import version
from typing import Any

from camera_models.typed import Options


def provenance(inputs: Mapping[str, Any], seed: int | None = None) -> dict[str, Any]:
    """What a result was made from: software and version, the command line, the inputs and the seed."""
    return {
        "software": f"omnilines {version('omnilines')}",
        "command": " ".join(["omnilines", *sys.argv[1:]]) if sys.argv[0].endswith("omnilines") else "python",
        "inputs": {key: value.stated if isinstance(value, Options) else str(value) for key, value in inputs.items()},
        "seed": seed,
    }
