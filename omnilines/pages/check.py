"""What a check of a calibration tells: tables and figures for `--json`."""

import math
from collections.abc import Sequence
from typing import Any

from omnilines.pages.limits_of_lines import check_advice
from omnilines.pipelines.check import CheckResult
from omnilines.records import Summary
from omnilines.report.numbers import figure, with_sigma


def check_summaries(result: CheckResult, given: Sequence[str] = ()) -> tuple[Summary, ...]:
    """The verdict, what lines would change, and the drift by region; `given` are the photos, and how they are read, as words of
    a command, by default their folder."""
    found = result.found
    rows = (
        ("photos used", f"{len(result.images)} of {len(result.images) + len(result.skipped)}"),
        ("edges", f"{found.edges}, {found.members} of them along a direction"),
        ("photos with lines at right angles", f"{found.frames}"),
        ("statistic", f"{found.statistic:.1f}, Hotelling's T^2 of {found.freedom} and {found.samples:.0f} degrees of freedom"),
        ("probability of it by chance", f"{found.probability:.2g}"),
        ("off by at least", f"{figure(found.least_drift_px, unit='px')}, with {result.confidence}"),
        (
            "most likely off by, beyond noise",
            "open"
            if result.hardly_known
            else f"{figure(found.drift_px, unit='px')} (known to {figure(found.sigma_px, unit='px')})",
        ),
    )
    names = found.model.PARAMETER_NAMES
    changes = tuple(
        (name, with_sigma(value, sigma))
        for name, value, sigma in zip(names, found.change.tolist(), found.change_sigma.tolist(), strict=True)
        if sigma > 0
    )
    regions = tuple(
        (
            one.name,
            f"off by at least {_px(one.least_px)}; drift {_px(one.drift_px)}, its noise {_px(one.sigma_px)}; "
            f"{one.edges} pieces of edges, {_px(one.rms_px)} from their lines",
        )
        if math.isfinite(one.drift_px)
        else (one.name, f"the model does not reach there; {one.edges} pieces of edges, {_px(one.rms_px)} from their lines")
        for one in found.regions
    )
    return (
        Summary("Check of a calibration", rows, verdict=result.verdict, advice=check_advice(result, given)),
        Summary("Change of parameters that lines ask for", changes),
        Summary("Drift by region", regions),
    )


def _px(value: float) -> str:
    return "not seen" if math.isnan(value) else figure(value, unit="px")


def check_data(result: CheckResult) -> dict[str, Any]:
    """What `--json` prints; see docs/formats.md."""
    found = result.found
    names = found.model.PARAMETER_NAMES
    return {
        "holds": result.holds,
        "verdict": result.verdict,
        "statistic": found.statistic,
        "freedom": found.freedom,
        "samples": found.samples,
        "probability": found.probability,
        "drift_px": found.drift_px,
        "least_drift_px": found.least_drift_px,
        "sigma_px": found.sigma_px,
        "change": dict(zip(names, found.change.tolist(), strict=True)),
        "change_sigma": dict(zip(names, found.change_sigma.tolist(), strict=True)),
        "regions": [
            {
                "region": one.name,
                "edges": one.edges,
                "rms_px": one.rms_px,
                "drift_px": one.drift_px,
                "sigma_px": one.sigma_px,
                "least_px": one.least_px,
            }
            for one in found.regions
        ],
        "photos": list(result.images),
        "edges": found.edges,
        "along_directions": found.members,
        "right_angles": found.frames,
    }
